"""The workflow "tip-tilt-vibration": integrator against LQG on a line of sight that wind and lines shake.

What a loop leaves is known exactly (covariances) and as an integral over frequency; a case is a run in time
of disturbances that are drawn from their spectra, which knows neither.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from wavequake.campaign.measured import Block, CaseTable, one_by_one, study_kind
from wavequake.campaign.measures import Axis, Measure, stored
from wavequake.campaign.stopwatch import Stopwatch
from wavequake.control.frames.controllers import (
    FrameController,
    integrator,
    integrator_pole,
    largest_gain,
    plant_and_controller,
    predictor,
)
from wavequake.control.frames.disturbance import Sampled, Shaped, joined, line, sampled, wind_shake
from wavequake.control.frames.margins import frame_margins
from wavequake.control.frames.residual import (
    best_gain,
    dense_grid,
    loop_gain,
    passed,
    residual,
    resonances,
    run,
    sensitivity,
    spectral_radius,
)
from wavequake.errors import UserError
from wavequake.mechanics.disturbances.motion import RAD_PER_MAS
from wavequake.mechanics.disturbances.sources.line_of_sight import LineOfSight, sight_spectrum
from wavequake.mechanics.disturbances.sources.vibration_lines import Line, VibrationLines, lines_of
from wavequake.mechanics.disturbances.spectra import (
    Bands,
    Spectrum,
    band_variance,
    frequencies,
    resonance,
    scaled,
    split,
    total,
    variance,
)
from wavequake.mechanics.model import Array, Integers
from wavequake.workflows.loops.loop_margins import LoopMargins, Makers, StudyLoop, converted
from wavequake.workflows.loops.tip_tilt_study import TipTiltStudy

# Spectra are integrated from and to these frequencies, beyond which nothing is left; edges in the report.
_LOW, _HIGH, _FIRST, _SHOWN = 1e-4, 1e5, 0.01, 400
# Points of curves about a line, in its widths.
_ABOUT_LINES = np.linspace(-4.0, 4.0, 41)
# Where integrals are parted about a pole, in its half widths.
_ABOUT = np.array([-30.0, -10.0, -4.0, -1.5, -0.5, 0.0, 0.5, 1.5, 4.0, 10.0, 30.0])
_BLOCK = 256


@dataclass(frozen=True)
class Loop:
    """A controller at a rate, and what is known of it without a run; mas.

    `curves` are measures over the frequencies of the bench; those of frame means end (NaN) at half the rate.
    """

    name: str
    rate_hz: float
    controller: FrameController
    gain: float
    exact: float
    integral: float
    peak: float
    gain_up: float
    phase_deg: float
    curves: Mapping[str, Array]


@dataclass(frozen=True)
class Bench:
    """The disturbance of a study and its loops, in the order of cases."""

    study: TipTiltStudy
    bands: Bands
    open_mas: float
    hertz: Array
    open_psd: Array
    open_cumulative: Array
    loops: tuple[Loop, ...]


def lines_along(study: TipTiltStudy, off: float = 0.0) -> list[Line]:
    """Return the lines along the motion, by a share `off` higher than the study says."""
    section = study.shaken
    if section.lines == "none":
        return []
    named = VibrationLines(
        name="lines", set=section.lines, rms_mas=section.lines_mas, fwhm_hz=section.fwhm_hz
    )
    return [
        one.model_copy(update={"frequency_hz": one.frequency_hz * (1 + off)})
        for one in lines_of(named)
        if not one.across
    ]


def spectra_of(study: TipTiltStudy, off: float = 0.0) -> list[Spectrum]:
    """Return the one-sided spectra of the disturbance, mas^2/Hz."""
    found = []
    if study.shaken.wind_percentile:
        wind = sight_spectrum(LineOfSight(name="wind", percentile=study.shaken.wind_percentile))
        found.append(scaled(wind, 1 / RAD_PER_MAS**2))
    return found + [resonance(one.frequency_hz, one.fwhm_hz, one.rms_mas) for one in lines_along(study, off)]


def shaped(study: TipTiltStudy, off: float = 0.0) -> Shaped:
    """Return the same as filtered white noise."""
    parts = []
    if study.shaken.wind_percentile:
        wind = LineOfSight(name="wind", percentile=study.shaken.wind_percentile)
        corner, mode = wind.windshake_corner_hz, wind.windshake_mode_hz
        free = wind_shake(wind.windshake_amplitude_rad2_s3, corner, mode, wind.windshake_damping)
        power = variance(sight_spectrum(wind)) / variance(
            sight_spectrum(wind.model_copy(update={"percentile": 50}))
        )
        parts.append(Shaped(free.a, free.g, free.c * np.sqrt(power) / RAD_PER_MAS))
    return joined(
        [*parts, *(line(one.frequency_hz, one.fwhm_hz, one.rms_mas) for one in lines_along(study, off))]
    )


def bench_of(study: TipTiltStudy) -> Bench:
    """Prepare a study.

    Raises
    ------
    UserError
        If an integrator of the given gain is unstable.
    """
    off = study.loop.lines_off
    spectra = spectra_of(study, off)
    hertz = _shown(study, off)
    true = shaped(study, off)
    count = len(lines_along(study))
    loops = tuple(
        _loop(study, name, rate, true, spectra, hertz)
        for rate in study.loop.rates_hz
        for name in study.loop.controllers
    )
    return Bench(
        study,
        split(total(spectra), 128 + 48 * count),
        float(np.sqrt(sampled(true, 1.0).variance)),
        hertz,
        total(spectra).density(hertz),
        _cumulative(spectra, None, hertz),
        loops,
    )


def designed(study: TipTiltStudy, name: str, true: Sampled) -> tuple[FrameController, float]:
    """Return a controller for a disturbance by frames, and the gain of an integrator (else NaN).

    Raises
    ------
    UserError
        If an integrator of the given gain is unstable.
    """
    section = study.loop
    noise, frames = section.noise_mas, section.delay_frames
    if name == "integrator":
        gain = best_gain(true, noise, frames) if section.gain is None else section.gain
        if gain >= (most := largest_gain(frames)):
            worst, rate = integrator_pole(gain, frames), 1 / true.frame
            growth, hertz = np.log(np.abs(worst)) * rate, abs(np.angle(worst)) * rate / (2 * np.pi)
            raise UserError(
                f"loop.gain: the line of sight grows by {growth:.3g} 1/s at {hertz:.4g} Hz with frames of "
                f"{rate:g} Hz; with {frames} frames of delay give a gain below {most:.6g}."
            )
        return integrator(gain, frames), gain
    return predictor(sampled(shaped(study), true.frame), noise, frames), np.nan


def _loop(
    study: TipTiltStudy, name: str, rate: float, true: Shaped, spectra: list[Spectrum], hertz: Array
) -> Loop:
    noise, frame = study.loop.noise_mas, 1.0 / rate
    by_frames = sampled(true, frame)
    controller, gain = designed(study, name, by_frames)
    factor = passed(controller, frame)
    turns = _turns(controller, rate)
    left = [Spectrum(_product(one.density, factor), _LOW, _HIGH, (*one.breaks_hz, *turns)) for one in spectra]
    white = 2 * noise**2 * frame  # one-sided
    heard = Spectrum(lambda f: white * _noise_passed(controller, frame, f), 1e-9 * rate, rate / 2, turns)
    from_noise = variance(heard)
    peak = float(np.sqrt(sensitivity(controller, frame, dense_grid(controller, frame))[0].max()))
    found, density = frame_margins(controller, frame), total(spectra).density(hertz)
    around = loop_gain(controller, frame, hertz)
    by_means = {
        "rejection": 1 / np.abs(1 + around),
        "passed_noise": np.abs(around / (1 + around)),
        "loop_gain": np.abs(around),
        "loop_phase": np.degrees(np.angle(around)),
        "noise_psd": white * _noise_passed(controller, frame, hertz),
    }
    return Loop(
        name,
        rate,
        controller,
        gain,
        residual(by_frames, controller, noise),
        float(np.sqrt(sum(variance(one) for one in left) + from_noise)),
        peak,
        found.gain_up,
        float(np.degrees(found.phase)),
        {
            **{key: np.where(hertz < rate / 2, values, np.nan) for key, values in by_means.items()},
            "left_psd": density * factor(hertz),
            "cumulative": _cumulative(left, from_noise, hertz),
        },
    )


def _shown(study: TipTiltStudy, off: float) -> Array:
    """Return the frequencies of the curves, Hz, some about each line."""
    high = max(study.loop.rates_hz) / 2
    lines = np.array([one.frequency_hz for one in lines_along(study, off)])
    about = (lines[:, None] + study.shaken.fwhm_hz * _ABOUT_LINES).ravel()
    inside = about[(about > _FIRST) & (about < high)]
    return np.unique(np.concatenate([np.geomspace(_FIRST, high, _SHOWN), inside]))


def _product(density: Callable[[Array], Array], factor: Callable[[Array], Array]) -> Callable[[Array], Array]:
    return lambda f: density(f) * factor(f)


def _noise_passed(controller: FrameController, frame: float, hertz: Array) -> Array:
    return sensitivity(controller, frame, hertz.ravel())[1].reshape(hertz.shape)


def _turns(controller: FrameController, rate: float) -> tuple[float, ...]:
    """Return frequencies between which the sensitivity, periodic with the rate, is smooth."""
    hertz, width = resonances(controller, 1 / rate)
    about = (hertz[:, None] + width[:, None] * _ABOUT).ravel()
    return tuple(map(float, [*np.arange(1, 81) * rate / 4, *about[(about > 0) & (about < rate / 2)]]))


def _cumulative(spectra: list[Spectrum], from_noise: float | None, hertz: Array) -> Array:
    """Return the rms of all that is below each frequency; what noise adds is counted from the start."""
    edges = np.concatenate([[_LOW], hertz])
    found = sum(np.cumsum(band_variance(one, edges)) for one in spectra) + (from_noise or 0.0)
    return np.asarray(np.sqrt(found))


def cases(study: TipTiltStudy, ids: Integers) -> CaseTable:
    """Return controller, rate and realization; all loops of a realization share its draw."""
    loops = [(name, rate) for rate in study.loop.rates_hz for name in study.loop.controllers]
    chosen = [loops[int(one) % len(loops)] for one in ids]
    return {
        "controller": np.array([name for name, _ in chosen], dtype=object),
        "rate_hz": np.array([rate for _, rate in chosen]),
        "realization": np.asarray(ids) // len(loops),
    }


def compute(bench: Bench, table: CaseTable, device: str, clock: Stopwatch) -> Iterator[Block]:
    """Run cases one by one."""

    def of_case(case: int) -> dict[str, Array | float]:
        realization, place = divmod(case, len(bench.loops))
        loop = bench.loops[place]
        return {
            "open_mas": bench.open_mas,
            "exact_mas": loop.exact,
            "integral_mas": loop.integral,
            "gain": loop.gain,
            "sensitivity_peak": loop.peak,
            "gain_up": loop.gain_up,
            "phase_margin": loop.phase_deg,
            **loop.curves,
            "simulated_mas": _simulated(bench, loop, realization, clock),
        }

    return one_by_one(table["case"], of_case)


def _simulated(bench: Bench, loop: Loop, realization: int, clock: Stopwatch) -> float:
    """Return the rms of a run; what a frame hides within itself no command changes, and is added exactly."""
    _, left = run_of(bench, loop, realization, clock)
    within = sampled(shaped(bench.study, bench.study.loop.lines_off), 1.0 / loop.rate_hz).within
    return float(np.sqrt(np.mean(left**2) + within))


def run_of(bench: Bench, loop: Loop, realization: int, clock: Stopwatch) -> tuple[Array, Array]:
    """Return the means over frames, without a loop and what it leaves, (n,) in mas, once it has settled."""
    section, frame = bench.study.simulated, 1.0 / loop.rate_hz
    late, count = (int(np.ceil(one * loop.rate_hz)) for one in (section.settling_s, section.duration_s))
    random = np.random.default_rng([bench.study.study.seed, realization])
    with clock("draw"):
        means = frame_means(bench.bands, frame, late + count, random)
        noise = bench.study.loop.noise_mas * random.standard_normal(late + count)
    with clock("loop"):
        left = means - run(loop.controller, means + noise)
    return means[late:], left[late:]


def frame_means(bands: Bands, frame: float, count: int, random: np.random.Generator) -> Array:
    """Return the means (count,) over frames of a random series with a spectrum's variance in every band."""
    hertz = frequencies(bands, random)
    cosine, sine = random.standard_normal((2, len(hertz))) * np.sqrt(bands.variances) * np.sinc(hertz * frame)
    starts = np.arange(-(-count // _BLOCK))[:, None] * _BLOCK + 0.5
    slow = np.exp(2j * np.pi * frame * starts * hertz) * (cosine - 1j * sine)
    fast = np.exp(2j * np.pi * frame * np.arange(_BLOCK) * hertz[:, None])
    return np.asarray((slow @ fast).real.ravel()[:count])


def measures(bench: Bench) -> Iterable[Measure]:
    """Return what is stored of a case."""
    for name, units, words, dims in (
        ("simulated_mas", "mas", "rms of the line of sight over a run in time", ()),
        ("exact_mas", "mas", "the same exactly, from covariances (Van Loan, Lyapunov)", ()),
        ("integral_mas", "mas", "the same as an integral over frequency", ()),
        ("open_mas", "mas", "rms without a controller", ()),
        ("gain", "1", "of the integrator", ()),
        ("sensitivity_peak", "1", "largest amplification of frame means over frequency", ()),
        ("gain_up", "1", "factor of the gain at which the loop becomes unstable", ()),
        ("phase_margin", "deg", "phase at which the loop becomes unstable", ()),
        ("loop_gain", "1", "size of the loop gain", ("frequency",)),
        ("loop_phase", "deg", "phase of the loop gain", ("frequency",)),
        ("passed_noise", "1", "complementary sensitivity of frame means, |T|", ("frequency",)),
        ("left_psd", "mas^2/Hz", "what is left of the disturbance's spectrum", ("frequency",)),
        ("noise_psd", "mas^2/Hz", "what the sensor's noise adds to that, by frame means", ("frequency",)),
        ("rejection", "1", "what is left of frame means at a frequency, |S|", ("frequency",)),
        ("cumulative", "mas", "rms of what is left below a frequency, noise from the start", ("frequency",)),
    ):
        yield stored(name, units, words, dims)


def axes(bench: Bench) -> Mapping[str, Axis]:
    """Return the frequencies of the curves."""
    return {"frequency": Axis(bench.hertz, "frequency", "Hz")}


def fixed(bench: Bench) -> dict[str, Any]:
    """Return the disturbance without a controller: its spectrum, and the rms below each frequency."""
    words = {"units": "mas", "long_name": "rms of the disturbance below a frequency"}
    power = {"units": "mas^2/Hz", "long_name": "one-sided spectrum of the disturbance"}
    return {
        "open_cumulative": (("frequency",), bench.open_cumulative, words),
        "open_psd": (("frequency",), bench.open_psd, power),
    }


def describe(bench: Bench) -> Mapping[str, str]:
    """Return the disturbance and the stable gains, for the plan."""
    frames = bench.study.loop.delay_frames
    return {
        "without a controller": f"{bench.open_mas:.3f} mas rms",
        "delay": f"{frames} frames; integrators are stable below a gain of {largest_gain(frames):.4f}",
    }


def loops(study: TipTiltStudy) -> Makers:
    """Return every controller at every rate."""
    return {
        f"{name}, {rate:g} Hz": partial(_made, study, name, rate)
        for rate in study.loop.rates_hz
        for name in study.loop.controllers
    }


def _made(study: TipTiltStudy, name: str, rate: float) -> StudyLoop:
    frame = 1.0 / rate
    true = sampled(shaped(study, study.loop.lines_off), frame)
    controller, _ = designed(study, name, true)

    def found() -> LoopMargins:
        growth = float(np.log(spectral_radius(controller))) / frame
        return converted(f"{name}, {rate:g} Hz", growth, np.nan, frame_margins(controller, frame))

    return StudyLoop(*plant_and_controller(controller, study.loop.delay_frames, frame), found)


KIND = study_kind(
    "tip-tilt-vibration",
    TipTiltStudy,
    prepare=bench_of,
    cases=cases,
    compute=compute,
    measures=measures,
    axes=axes,
    fixed=fixed,
    describe=describe,
    compared=("controller", "rate_hz"),
)
