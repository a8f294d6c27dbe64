"""The workflow "controller-mor": reduced models, judged by the controllers that are designed on them.

A case is a variant with an effort. Regulator and filter are designed on the variant alone, and their loop is
closed with the full model: its poles, what spills over, margins, and the wavefront that is left, beside how
far the transfer function and the frequencies of the variant are off.
"""

from collections.abc import Iterable, Iterator, Mapping
from functools import partial
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment
from threadpoolctl import threadpool_limits

from wavequake.campaign.measured import Block, CaseTable, study_kind
from wavequake.campaign.measures import Axis, Measure, stored
from wavequake.campaign.stopwatch import Stopwatch
from wavequake.chain.images.camera import frame_axes
from wavequake.control.linear import LinearModel
from wavequake.control.linear import in_units as model_in_units
from wavequake.control.robustness.feedback import Loop, Pole, closed_poles, lqg, refined_pole
from wavequake.control.robustness.margins import curves, grid, margins, truncation_share
from wavequake.control.robustness.plant import Plant, in_units, linear, transfer
from wavequake.control.robustness.residual import (
    closed_covariance,
    closed_spectra,
    open_covariance,
    open_spectrum,
)
from wavequake.errors import UserError
from wavequake.mechanics.model import Array, Integers
from wavequake.reduction.metrics import eps_mor, mac
from wavequake.reduction.names import parse
from wavequake.workflows.loops.controller_bench import (
    COMPARED,
    Bench,
    bench_of,
    exact_response,
    exposed,
    reduced,
    reduced_plant,
    wavefront_grams,
)
from wavequake.workflows.loops.controller_study import ControllerStudy
from wavequake.workflows.loops.loop_margins import Makers, StudyLoop, margins_of

Numbers = dict[str, float | Array]

POLES = 40
# A mode of the full model is that of a variant which resembles it and its like by this much at least; modes
# nearer in frequency than this are alike, as the pairs of a symmetric mirror.
_RESEMBLES, _ALIKE = 0.5, 0.01
# A shape whose frequency is farther off than this share is a static shape with some mass, not the mode.
_FAR = 0.5
_NM = 1e9


def cases(study: ControllerStudy, ids: Integers) -> CaseTable:
    """Return variant, method and effort of cases; the variants of the first effort come first."""
    names = study.reduction.variants
    chosen = [names[one % len(names)] for one in ids]
    return {
        "variant": np.array(chosen, dtype=object),
        "method": np.array([parse(one).method for one in chosen], dtype=object),
        "effort": np.array(study.controller.effort)[np.asarray(ids) // len(names)],
    }


def compute(bench: Bench, table: CaseTable, device: str, clock: Stopwatch) -> Iterator[Block]:
    """Judge variants one by one; one that does not suit the model, or gives no controller, says why."""
    for row, (name, effort) in enumerate(zip(table["variant"], table["effort"], strict=True)):
        rows = np.array([row])
        try:
            found = judged(bench, str(name), float(effort), clock)
        except UserError as error:
            yield Block({}, rows, {0: f"{name}, effort {effort:g}: {error}"})
            continue
        yield Block({key: np.array([value]) for key, value in found.items()}, rows)


def judged(bench: Bench, name: str, effort: float, clock: Stopwatch) -> Numbers:
    """Return all numbers of a variant and the controller that is designed on it."""
    with clock("reduce"):
        variant = reduced(bench, name)
        model, shapes = reduced_plant(bench, variant)
    with clock("design"):
        controller = lqg(model, effort, effort)
    found: Numbers = {"order": float(variant.order), "reduce_seconds": variant.seconds}
    found |= _open_loop(bench, model, shapes)
    with clock("loop"):
        own = Loop(model, controller)
        promised = closed_covariance(own, effort)[0]
        whole = wavefront_grams(variant, shapes[2::3])[0]
        found["wavefront_promised"] = _rms(whole, promised)
        found |= _closed_loop(bench, Loop(bench.plant, controller), found, effort)
    return found


def _open_loop(bench: Bench, model: Plant, shapes: Array) -> Numbers:
    """Return how far a variant is off without a controller: transfer function and every frequency."""
    section = bench.study.reduction
    band = np.linspace(section.first_hz, section.last_hz, section.frequencies)
    above = np.linspace(section.last_hz, section.beyond_hz, section.frequencies)
    inside, outside = (_error(bench, model, hz) for hz in (band, above))
    shift = frequency_shifts(bench, model, shapes)
    ratio = shift / _zeta(bench)[: len(shift)]
    near = ratio[bench_frequencies(bench)[: len(shift)] <= section.last_hz]
    return {
        "error_median": float(np.median(inside)),
        "error_max": float(inside.max()),
        "error_beyond": float(outside.max()),
        "mode_shift": shift,
        "missing_modes": float(np.isnan(near).sum()),
        "shift_over_zeta": float(np.nanmax(near, initial=-np.inf)) if np.isfinite(near).any() else np.nan,
    }


def _error(bench: Bench, model: Plant, hertz: Array) -> Array:
    s = np.asarray(2j * np.pi * hertz * bench.time_unit)
    return eps_mor(transfer(bench.plant, s), transfer(model, s))


def bench_frequencies(bench: Bench) -> Array:
    """Return the frequencies of the full model's modes, Hz."""
    found: Array = np.sqrt(bench.plant.squared) / bench.time_unit / (2 * np.pi)
    return found


def _zeta(bench: Bench) -> Array:
    found: Array = bench.plant.rates / (2 * np.sqrt(bench.plant.squared))
    return found


def frequency_shifts(bench: Bench, model: Plant, shapes: Array) -> Array:
    """Return |dw/w| of the first modes of the full model in a variant; NaN where it has no such mode.

    Modes are told by their shapes on the optical surface.
    """
    alike = mac(bench.shapes, shapes)
    ours, theirs = linear_sum_assignment(-alike)
    omega, own = np.sqrt(bench.plant.squared[:COMPARED]), np.sqrt(model.squared)
    shift = np.full(bench.shapes.shape[1], np.nan)
    for one, other in zip(ours, theirs, strict=True):
        like = np.abs(omega - omega[one]) <= _ALIKE * omega[one]
        off = abs(own[other] / omega[one] - 1.0)
        if alike[like, other].sum() >= _RESEMBLES and off < _FAR:
            shift[one] = off
    return shift


def _closed_loop(bench: Bench, loop: Loop, known: Mapping[str, Any], effort: float) -> Numbers:
    """Return what becomes of a controller on the full model."""
    unit = bench.time_unit
    poles, worst = closed_poles(loop)
    own = np.linalg.eigvals(loop.controller.a)
    omega = grid(loop, poles)
    stable = worst.value.real < 0
    shown = poles[poles.imag >= 0]
    shown = shown[np.argsort(-shown.real / np.abs(shown), kind="stable")][:POLES]
    filled = np.full(POLES, np.nan + 1j * np.nan)
    filled[: len(shown)] = shown / unit
    return {
        "stable": float(stable),
        "unstable_poles": float(np.sum(poles.real >= 0)),
        "growth": worst.value.real / unit,
        "growth_hz": abs(worst.value.imag) / unit / (2 * np.pi),
        "growth_full": np.nan if stable else _refined(bench, worst, loop.controller),
        "controller_growth": float(own.real.max()) / unit,
        "truncation": truncation_share(loop, omega),
        "pole_real": filled.real,
        "pole_hz": filled.imag / (2 * np.pi),
        **_spill_over(bench, worst, known["mode_shift"], stable),
        **(_robustness(bench, loop, omega) if stable else dict.fromkeys(_ROBUSTNESS, np.nan)),
        **_residual(bench, loop, effort, stable),
        **_curves(bench, loop, effort, stable),
    }


def _curves(bench: Bench, loop: Loop, effort: float, stable: bool) -> Numbers:
    """Return the loop over frequency; an unstable one has no sensitivity, and no spectrum."""
    omega = 2 * np.pi * bench.hertz * bench.time_unit
    loci, rejected, rest = curves(loop, omega)
    none = np.full(len(bench.hertz), np.nan)
    left, heard = closed_spectra(loop, bench.forces, effort, omega) if stable else (none, none)
    return {
        "loop_gain": np.abs(loci),
        "loop_phase": np.degrees(np.angle(loci)),
        "sensitivity": rejected if stable else none,
        "complementary": rest if stable else none,
        "left_psd": _NM**2 * bench.time_unit * left,
        "noise_psd": _NM**2 * bench.time_unit * heard,
    }


def _refined(bench: Bench, worst: Pole, controller: LinearModel) -> float:
    try:
        return refined_pole(worst.value, exact_response(bench), controller).real / bench.time_unit
    except UserError:
        return np.nan


def _spill_over(bench: Bench, worst: Pole, shift: Array, stable: bool) -> Numbers:
    """Return which mode of the full model grows, and whether the variant knew it."""
    if stable:
        return dict.fromkeys(("spill_mode", "spill_hz", "spill_share", "spill_shift"), np.nan)
    known = shift[worst.mode] if worst.mode < len(shift) else np.nan
    return {
        "spill_mode": worst.mode + 1.0,
        "spill_hz": float(bench_frequencies(bench)[worst.mode]),
        "spill_share": worst.share,
        "spill_shift": float(known / _zeta(bench)[worst.mode]),
    }


_ROBUSTNESS = (
    "sensitivity_peak",
    "sensitivity_hz",
    "gain_up",
    "gain_down",
    "phase_margin",
    "delay_margin",
    "last_hz",
)


def _robustness(bench: Bench, loop: Loop, omega: Array) -> Numbers:
    found, unit = margins(loop, omega), bench.time_unit
    values = (
        found.peak,
        found.peak_omega / unit / (2 * np.pi),
        found.gain_up,
        found.gain_down,
        float(np.degrees(found.phase)),
        1e3 * found.delay * unit,
        found.last_omega / unit / (2 * np.pi),
    )
    return dict(zip(_ROBUSTNESS, values, strict=True))


def _residual(bench: Bench, loop: Loop, effort: float, stable: bool) -> Numbers:
    open_loop = _NM * bench.open_wavefront
    if not stable:
        lost = dict.fromkeys(("wavefront", "figure", "strehl", "force"), np.nan)
        none = np.full((bench.study.image.pixels,) * 2, np.nan)
        return {"wavefront_open": open_loop, "exposure": none, **lost}
    moved, forces = closed_covariance(loop, effort)
    image = exposed(bench, moved)
    return {
        "wavefront_open": open_loop,
        "wavefront": _rms(bench.gram, moved),
        "figure": _rms(bench.figure_gram, moved),
        "strehl": image.max(),
        "exposure": image,
        "force": bench.study.controller.force_n * float(np.sqrt(np.trace(forces))),
    }


def _rms(gram: Array, covariance: Array) -> float:
    return _NM * float(np.sqrt(max(np.sum(gram * covariance), 0.0)))


def measures(bench: Bench) -> Iterable[Measure]:
    """Return what is stored of a case."""
    return (
        stored("order", "1", "coordinates of the variant"),
        stored("reduce_seconds", "s", "time of the reduction", measured=True),
        stored("error_median", "1", "relative error of the open-loop transfer function in the band, median"),
        stored("error_max", "1", "relative error of the open-loop transfer function in the band, largest"),
        stored("error_beyond", "1", "the same from the band's end to reduction.beyond_hz, largest"),
        stored(
            "mode_shift",
            "1",
            "|dw/w| of each mode of the full model in the variant; NaN: not in it",
            ("mode",),
        ),
        stored("shift_over_zeta", "1", "largest |dw/w| of the modes in the band over their damping ratio"),
        stored("missing_modes", "1", "modes of the full model in the band that the variant has not"),
        stored("stable", "1", "1 where the loop with the full model is stable"),
        stored("unstable_poles", "1", "poles of that loop that do not decay"),
        stored("growth", "1/s", "largest real part of its poles"),
        stored("growth_hz", "Hz", "frequency of that pole"),
        stored(
            "growth_full",
            "1/s",
            "the same of an unstable pole by Newton's iteration with all degrees of freedom",
        ),
        stored("controller_growth", "1/s", "largest real part of the controller's own poles"),
        stored(
            "truncation", "1", "certificate: below 1 the modes left out change no number of unstable poles"
        ),
        stored("pole_real", "1/s", "real parts of the least damped poles", ("pole",)),
        stored("pole_hz", "Hz", "frequencies of the least damped poles", ("pole",)),
        stored("spill_mode", "1", "number of the mode that grows; NaN: none"),
        stored("spill_hz", "Hz", "its frequency"),
        stored("spill_share", "1", "its share of the energy of all modes of the growing motion"),
        stored(
            "spill_shift", "1", "its |dw/w| in the variant as a share of its damping ratio; NaN: not in it"
        ),
        stored("sensitivity_peak", "1", "largest singular value of (I + G H)^-1 over frequency"),
        stored("sensitivity_hz", "Hz", "where it is"),
        stored("gain_up", "1", "factor of all gains at which the loop becomes unstable, above 1"),
        stored("gain_down", "1", "the same below 1; 0: none"),
        stored("phase_margin", "deg", "phase of all channels at which the loop becomes unstable"),
        stored("delay_margin", "ms", "delay of all channels at which the loop becomes unstable"),
        stored("last_hz", "Hz", "highest frequency at which the loop gain reaches 1"),
        stored("wavefront_open", "nm", "rms of the wavefront over surface and time without a controller"),
        stored("wavefront", "nm", "rms of the wavefront over surface and time in the loop, piston included"),
        stored("figure", "nm", "the same with piston, tip and tilt taken out"),
        stored(
            "wavefront_promised",
            "nm",
            "the same of the variant with its own controller, as a designer would see",
        ),
        stored("strehl", "1", "peak of the long exposure of a star; 1: of a mirror that stands still"),
        stored("exposure", "1", "that exposure, in closed form", ("y", "x")),
        stored("force", "N", "rms of the forces together"),
        stored("loop_gain", "1", "sizes of the eigenvalues of the loop gain", ("frequency", "channel")),
        stored("loop_phase", "deg", "phases of the eigenvalues of the loop gain", ("frequency", "channel")),
        stored("sensitivity", "1", "largest singular value of S = (I + G H)^-1", ("frequency",)),
        stored("complementary", "1", "largest singular value of T = I - S", ("frequency",)),
        stored("left_psd", "nm^2/Hz", "wavefront that is left of the forces, one-sided", ("frequency",)),
        stored("noise_psd", "nm^2/Hz", "wavefront by sensor noise, one-sided", ("frequency",)),
    )


def axes(bench: Bench) -> Mapping[str, Axis]:
    """Return the modes, numbered, the poles, and frequencies and channels of curves."""
    count = bench.shapes.shape[1]
    return {
        "mode": Axis(np.arange(1, count + 1), "mode of the full model"),
        "pole": Axis(POLES),
        "frequency": Axis(bench.hertz, "frequency", "Hz"),
        "channel": Axis(len(bench.plant.outputs)),
        **frame_axes(bench.study.image.pixels, bench.study.image.sampling),
    }


def fixed(bench: Bench) -> dict[str, Any]:
    """Return frequency and damping ratio of the full model's modes, and its spectrum without a controller."""
    count = bench.shapes.shape[1]
    open_psd = _NM**2 * bench.time_unit * open_spectrum(bench.forces)
    words = {"units": "nm^2/Hz", "long_name": "wavefront by the forces without a controller, one-sided"}
    image = {"units": "1", "long_name": "long exposure of a star without a controller"}
    return {
        "open_exposure": (("y", "x"), exposed(bench, open_covariance(bench.plant)), image),
        "open_psd": (("frequency",), open_psd, words),
        "mode_hz": (("mode",), bench_frequencies(bench)[:count], {"units": "Hz", "long_name": "frequency"}),
        "mode_zeta": (("mode",), _zeta(bench)[:count], {"units": "1", "long_name": "damping ratio"}),
    }


def describe(bench: Bench) -> Mapping[str, str]:
    """Return what the full model is, for the plan."""
    frequencies = bench_frequencies(bench)
    return {
        "full model": f"{bench.full().order} degrees of freedom, {len(frequencies)} modes up to "
        f"{frequencies[-1]:.0f} Hz one by one, the others as their flexibility",
        "without a controller": f"wavefront {_NM * bench.open_wavefront:.1f} nm rms",
    }


def loops(study: ControllerStudy) -> Makers:
    """Return the loops of all cases, with forces in N and readings in m."""
    with threadpool_limits(1):
        bench = bench_of(study)
    table = cases(study, np.arange(study.cases))
    return {
        f"{name}, effort {effort:g}": partial(_made, bench, str(name), float(effort))
        for name, effort in zip(table["variant"], table["effort"], strict=True)
    }


def _made(bench: Bench, name: str, effort: float) -> StudyLoop:
    with threadpool_limits(1):
        model, _ = reduced_plant(bench, reduced(bench, name))
        loop = Loop(bench.plant, lqg(model, effort, effort))
    unit, section = bench.time_unit, bench.study.controller
    second, newton, metre = 1 / unit, 1 / section.force_n, 1 / section.length_m
    return StudyLoop(
        linear(in_units(loop.plant, second, newton, metre)),
        model_in_units(loop.controller, second, metre, newton),
        lambda: margins_of(f"{name}, effort {effort:g}", loop, unit),
    )


KIND = study_kind(
    "controller-mor",
    ControllerStudy,
    prepare=bench_of,
    cases=cases,
    compute=compute,
    measures=measures,
    axes=axes,
    fixed=fixed,
    describe=describe,
    compared=("variant",),
)
