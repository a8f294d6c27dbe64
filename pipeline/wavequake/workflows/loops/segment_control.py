"""The workflow "segment-control": how fast the loop of a mirror's edge sensors may be, and what remains.

What a loop of each bandwidth leaves of wind, of the structure's motion and of sensor noise is known exactly,
by integrals over frequency. A case draws errors of the interaction matrix and finds where it is unstable.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from typing import Any

import numpy as np

from wavequake.campaign.measured import Block, CaseTable, one_by_one, study_kind
from wavequake.campaign.measures import Axis, Measure
from wavequake.campaign.stopwatch import Stopwatch
from wavequake.control.linear import Array
from wavequake.control.sampled.flexible import (
    Reduced,
    flexible_controller,
    flexible_plant,
    mixed,
    mixed_is_stable,
    poles,
    reduced,
)
from wavequake.control.sampled.flexible_left import flexible_margins
from wavequake.mechanics.model import Integers
from wavequake.mechanics.segment_control import SensingErrors, mode_interaction
from wavequake.prepared import one_thread
from wavequake.words import counted
from wavequake.workflows.loops.curves import curve_axes, phases
from wavequake.workflows.loops.loop_margins import LoopMargins, Makers, StudyLoop, converted
from wavequake.workflows.loops.segment_control_bench import (
    Bench,
    bandwidth_of,
    bench_of,
    loop_of,
    mirror_of,
    sensing_of,
    structure_of,
)
from wavequake.workflows.loops.segment_control_study import SegmentControlStudy

# Gains that are tried for the limit of a mirror with errors, as shares of the nominal one, and halvings.
_TRIED, _HALVINGS = (0.02, 0.1, 0.3, 0.5, 0.65, 0.8, 0.9, 1.0, 1.1, 1.25, 1.5, 2.0), 7


def cases(study: SegmentControlStudy, ids: Integers) -> CaseTable:
    """Return the realization of errors of each case; the first has none."""
    return {"realization": np.asarray(ids)}


def compute(bench: Bench, table: CaseTable, device: str, clock: Stopwatch) -> Iterator[Block]:
    """Judge cases one by one."""
    return one_by_one(table["realization"], lambda realization: _case(bench, realization, clock))


def _case(bench: Bench, realization: int, clock: Stopwatch) -> dict[str, float]:
    study, section = bench.study, bench.study.errors
    errors = SensingErrors() if realization == 0 else SensingErrors(
        section.sensor_gain, section.actuator_gain, section.entries, section.arm, section.misplaced_mm * 1e-3
    )  # fmt: skip
    with clock("errors"):
        random = np.random.default_rng([study.study.seed, realization])
        interaction = mode_interaction(bench.layout, bench.sensing, bench.modes, errors, random)
        values, vectors = np.linalg.eig(interaction)
        focus = values[np.abs(vectors[0]).argmax()]
    with clock("loop"):
        limit = _limit(bench, interaction)
    return {
        "limit_hz": limit,
        "least_gain": float(focus.real),
        "gain_low": float(np.abs(values).min()),
        "gain_high": float(np.abs(values).max()),
    }


def _limit(bench: Bench, interaction: Array) -> float:
    """Return the bandwidth from which on a loop with errors is unstable; 0 and inf: it always, never is."""
    study, first = bench.study, bench.study.control.bandwidths_hz[0]
    nominal = min(bench.limit_hz, study.control.rate_hz / 6) or first
    loop = mixed(loop_of(study, bench.structure, nominal), interaction)
    last = 0.0
    for factor in _TRIED:
        if not mixed_is_stable(loop, factor):
            break
        last = factor
    else:
        return np.inf
    if last == 0.0:
        return 0.0
    for _ in range(_HALVINGS):
        middle = 0.5 * (last + factor)
        last, factor = (middle, factor) if mixed_is_stable(loop, middle) else (last, middle)
    return bandwidth_of(study, nominal, 0.5 * (last + factor))


def measures(bench: Bench) -> Iterable[Measure]:
    """Return what is stored of a case."""
    for name, units, words in (
        ("limit_hz", "Hz", "bandwidth from which on the loop is unstable"),
        ("least_gain", "1", "gain of the least seen mode (focus) through the errors; 1 = nominal"),
        ("gain_low", "1", "smallest gain of any mode through the errors"),
        ("gain_high", "1", "largest gain of any mode through the errors"),
    ):
        yield Measure(name, units, words, (), partial(_taken, name))


def _taken(name: str, found: Mapping[str, Array]) -> Array:
    return found[name]


def fixed(bench: Bench) -> dict[str, Any]:
    """Return the mirror's modes and, by bandwidth, what its nominal loop leaves."""
    loops = bench.loops

    def by_bandwidth(key: str, units: str, words: str) -> tuple[Any, ...]:
        return (
            ("bandwidth",),
            np.array([getattr(one, key) for one in loops]),
            {"units": units, "long_name": words},
        )

    def words(text: str, units: str = "1") -> dict[str, str]:
        return {"units": units, "long_name": text}

    nan = float("nan")
    return {
        "open_wind": ((), bench.open_wind, words("surface by wind without a loop, rms", "nm")),
        "open_structure": (
            (),
            bench.open_structure,
            words("surface by the structure without a loop, rms", "nm"),
        ),
        "nominal_limit": (
            (),
            bench.limit_hz,
            words("bandwidth from which on the nominal loop is unstable", "Hz"),
        ),
        "rigid_limit": ((), bench.limit_rigid_hz, words("the same on a structure that does not move", "Hz")),
        "wind": by_bandwidth("wind", "nm", "surface that is left of wind, rms"),
        "structure": by_bandwidth("structure", "nm", "surface that is left of the structure's motion, rms"),
        "noise": by_bandwidth("noise", "nm", "surface by sensor noise, rms"),
        "total": by_bandwidth("total", "nm", "surface by all of them, rms"),
        "growth": by_bandwidth("growth", "1/s", "largest real part of the poles"),
        "growth_hz": by_bandwidth("growth_hz", "Hz", "frequency of that pole"),
        "sensitivity_peak": by_bandwidth("peak", "1", "largest singular value of the sensitivity"),
        "peak_hz": by_bandwidth("peak_hz", "Hz", "frequency of the largest sensitivity"),
        "peak_by_mode": (
            ("bandwidth", "structure_mode"),
            np.array([one.by_mode for one in loops]),
            words("largest sensitivity along each mode of the structure"),
        ),
        "sensitivity": (
            ("bandwidth", "frequency"),
            np.array([one.sensitivity for one in loops]),
            words("largest singular value of the sensitivity"),
        ),
        **_over_frequency(bench),
        "singular": (
            ("mirror_mode",),
            bench.stroke_values,
            words("reading per stroke of the actuators", "m/m"),
        ),
        "multiplier": (
            ("mirror_mode",),
            bench.modes.multipliers,
            words("surface rms per rms of sensor noise"),
        ),
        "multiplier_all": (
            (),
            float(np.sqrt(np.sum(bench.modes.multipliers**2))),
            words("of all modes together"),
        ),
        "multiplier_rest": (
            (),
            float(np.sqrt(np.sum(bench.modes.multipliers[1:] ** 2)))
            if len(bench.modes.multipliers) > 1
            else nan,
            words("without the least seen mode"),
        ),
    }


def _over_frequency(bench: Bench) -> dict[str, Any]:
    """Return curves and spectra of the nominal loops, and margins as these frequencies show them."""
    loops, hertz = bench.loops, ("bandwidth", "frequency")
    gains = np.array([one.curve.gain for one in loops])
    surface = "nm^2/Hz"
    found = {
        "loop_gain": (
            (*hertz, "margin"), np.abs(gains), "1", "size of the loop gain's eigenvalue that has the margin"
        ),
        "loop_phase": ((*hertz, "margin"), phases(gains), "deg", "its phase"),
        "complementary": (
            hertz, np.array([one.complementary for one in loops]),
            "1", "largest singular value of the complementary sensitivity",
        ),
        "gain_up": (
            hertz[:1], np.array([one.curve.gain_up for one in loops]),
            "1", "factor of the gain at which the loop is unstable, as these frequencies show it",
        ),
        "phase_margin": (
            hertz[:1], np.degrees([one.curve.phase for one in loops]),
            "deg", "phase that makes the loop unstable, as these frequencies show it",
        ),
        "open_psd": (hertz[1:], bench.open_density, surface, "surface by wind and structure without a loop"),
        "left_psd": (
            hertz, np.array([one.shaken_density for one in loops]),
            surface, "surface that is left of wind and structure",
        ),
        "noise_psd": (
            hertz, np.array([one.noise_density for one in loops]), surface, "surface by sensor noise"
        ),
    }  # fmt: skip
    return {
        name: (dims, values, {"units": units, "long_name": words})
        for name, (dims, values, units, words) in found.items()
    }


def axes(bench: Bench) -> Mapping[str, Axis]:
    """Return bandwidths, modes and frequencies."""
    return {
        "bandwidth": Axis(np.array(bench.study.control.bandwidths_hz), "bandwidth", "Hz"),
        **curve_axes(bench.hertz),
        "structure_mode": Axis([one.name for one in bench.study.mode], "mode of the structure"),
        "mirror_mode": Axis(
            np.arange(1, len(bench.modes.singular) + 1), "mode of the mirror, the least seen first"
        ),
    }


def describe(bench: Bench) -> Mapping[str, str]:
    """Return sizes and limits, for the plan."""
    readings, strokes = bench.modes.readings.shape
    return {
        "mirror": f"{len(bench.layout)} segments, {readings} edge sensors, {strokes} actuators, "
        f"{counted(len(bench.modes.singular), 'mode')} seen",
        "stable": f"up to {bench.limit_hz:.3g} Hz ({bench.limit_rigid_hz:.3g} Hz on a still structure)",
    }


def loops(study: SegmentControlStudy) -> Makers:
    """Return the nominal loop of every bandwidth, in the directions in which the structure takes part."""
    layout, modes, _ = mirror_of(study.mirror.telescope, sensing_of(study))
    structure = structure_of(study, layout, modes)

    def made(bandwidth: float) -> StudyLoop:
        found = reduced(loop_of(study, structure, bandwidth))
        margins = partial(_margins, f"{bandwidth:g} Hz", found)
        return StudyLoop(flexible_plant(found.loop), flexible_controller(found.loop), margins)

    makers: dict[str, Callable[[], StudyLoop]] = {
        f"{one:g} Hz": partial(made, one) for one in study.control.bandwidths_hz
    }
    return makers


def _margins(name: str, found: Reduced) -> LoopMargins:
    with one_thread():
        return _judged(name, found)


def _judged(name: str, found: Reduced) -> LoopMargins:
    values, period = poles(found), found.loop.timing.period
    last = values[np.abs(values).argmax()]
    growth, hertz = float(np.log(abs(last)) / period), float(abs(np.angle(last)) / (2 * np.pi * period))
    if growth >= 0:
        return LoopMargins(name, growth, hertz)
    return converted(name, growth, hertz, flexible_margins(found))


KIND = study_kind(
    "segment-control",
    SegmentControlStudy,
    prepare=bench_of,
    cases=cases,
    compute=compute,
    measures=measures,
    axes=axes,
    fixed=fixed,
    describe=describe,
    compared=(),
)
