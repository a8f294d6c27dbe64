"""What the cases of ``segment-control`` share: modes, structure, and what each bandwidth leaves."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from wavequake.chain.loops.structure import zernike_motion
from wavequake.control.linear import Array
from wavequake.control.sampled.channel import RIGID, Timing, second_order
from wavequake.control.sampled.filters import crossover_gain
from wavequake.control.sampled.flexible import FlexibleLoop, Reduced, Structure, poles, reduced
from wavequake.control.sampled.flexible_left import (
    Covariance,
    covariance,
    curve_of,
    frequency_grid,
    left_of,
    noise_left,
    radius,
    sensitivity_of,
    turns,
)
from wavequake.control.sampled.margins import first_unstable
from wavequake.control.sampled.stability import LoopCurve
from wavequake.errors import UserError
from wavequake.mechanics.disturbances.layout import SegmentLayout
from wavequake.mechanics.disturbances.sources.segment_wind import SegmentWind, gusts_of, piston_spectrum
from wavequake.mechanics.disturbances.spectra import Spectrum, band_variance, resonance
from wavequake.mechanics.segment_control import EdgeSensing, SeenModes, seen_modes
from wavequake.optics.segments.catalog import telescope
from wavequake.prepared import one_thread, prepared
from wavequake.workflows.loops.segment_control_study import SeenMode, SegmentControlStudy
from wavequake.workflows.segments.bench import layout_of

# Points of the curves and their first frequency, Hz; factors of the gain that are tried for a limit.
_SHOWN, _FIRST = 400, 0.01
_TRIED = np.geomspace(1.0, 1e4, 160)
# A shape of which the sensors see less than this share is a motion of the whole mirror.
_SEEN = 1e-3


@dataclass(frozen=True)
class Left:
    """A loop of one bandwidth; surface rms in nm, NaN where it is unstable.

    Attributes
    ----------
    found : Reduced
    growth, growth_hz : float
        Of the pole that decays most slowly, 1/s and Hz.
    peak, peak_hz : float
        Largest singular value of the sensitivity.
    by_mode : ndarray, shape (K,)
        Largest sensitivity along each mode of the structure.
    wind, structure, noise : float
    sensitivity, complementary : ndarray, shape (f,)
        Largest singular values.
    curve : LoopCurve
    shaken_density, noise_density : ndarray, shape (f,)
        Spectra of the surface: what is left of wind and structure, and what noise does, nm^2/Hz.
    """

    found: Reduced
    growth: float
    growth_hz: float
    peak: float
    peak_hz: float
    by_mode: Array
    wind: float
    structure: float
    noise: float
    sensitivity: Array
    complementary: Array
    curve: LoopCurve
    shaken_density: Array
    noise_density: Array

    @property
    def total(self) -> float:
        """Root of the sum of squares."""
        return float(np.sqrt(self.wind**2 + self.structure**2 + self.noise**2))


@dataclass(frozen=True)
class Bench:
    """A mirror with its loops, in the order of bandwidths, and where they become unstable.

    `open_density` (f,) is the spectrum of the surface without a loop, nm^2/Hz.
    """

    study: SegmentControlStudy
    layout: SegmentLayout
    sensing: EdgeSensing
    modes: SeenModes
    structure: Structure
    stroke_values: Array
    open_wind: float
    open_structure: float
    limit_hz: float
    limit_rigid_hz: float
    hertz: Array
    open_density: Array
    loops: tuple[Left, ...]


@prepared(maxsize=2)
def mirror_of(name: str, sensing: EdgeSensing) -> tuple[SegmentLayout, SeenModes, Array]:
    """Return segments, modes, and the singular values of the interaction matrix per stroke, rising."""
    layout = layout_of(telescope(name))
    modes = seen_modes(layout, sensing)
    seen = modes.readings @ (modes.strokes - modes.rigid @ (modes.rigid.T @ modes.strokes))
    squares = np.linalg.eigvalsh(seen.T @ seen)
    return layout, modes, np.sqrt(squares[len(squares) - len(modes.singular) :])


def sensing_of(study: SegmentControlStudy) -> EdgeSensing:
    """Return where actuators and sensors are."""
    one = study.mirror
    return EdgeSensing(one.actuator_radius_m, one.actuator_angles_deg, one.arm_m, one.offset_m, one.curved)


def structure_of(study: SegmentControlStudy, layout: SegmentLayout, modes: SeenModes) -> Structure:
    """Return the modes of the structure among those of the mirror.

    Raises
    ------
    UserError
        If sensors do not see one.
    """
    motions = zernike_motion(layout, modes.radius, [one.zernike for one in study.mode])
    shapes = []
    for one, motion in zip(study.mode, motions.reshape(len(study.mode), -1), strict=True):
        seen = modes.shapes.T @ motion
        if np.linalg.norm(seen) < _SEEN * np.linalg.norm(motion):
            raise UserError(
                f"mode.{one.name} ({one.hz:g} Hz): edge sensors do not see its shape, which is of the whole "
                "mirror; drop it."
            )
        shapes.append(seen / np.linalg.norm(seen))
    hertz, zeta, shares = (
        np.array([getattr(one, key) for one in study.mode]) for key in ("hz", "zeta", "share")
    )
    return Structure(hertz, zeta, shares, np.array(shapes).T)


def loop_of(study: SegmentControlStudy, structure: Structure, bandwidth_hz: float) -> FlexibleLoop:
    """Return the loop of a bandwidth.

    Raises
    ------
    UserError
        If a slow mode is none of the mirror, or shares of the structure are too large.
    """
    control, mirror = study.control, study.mirror
    frame = 1.0 / control.rate_hz
    gains = np.full(len(structure.shapes), crossover_gain(bandwidth_hz, frame))
    for one in control.slow:
        if one.last > len(gains):
            raise UserError(f"control.slow names mode {one.last}; the sensors see {len(gains)} modes.")
        gains[one.first - 1 : one.last] *= one.factor
    servo = RIGID if mirror.servo_hz is None else second_order(mirror.servo_hz, mirror.servo_damping)
    timing = Timing(frame, frame, 1, control.latency_frames * frame)
    return FlexibleLoop(timing, servo, gains, control.leak, structure)


def bandwidth_of(study: SegmentControlStudy, bandwidth_hz: float, factor: float) -> float:
    """Return the bandwidth of the gain of another one times a factor; beyond a gain of 2 there is none."""
    half = 0.5 * factor * crossover_gain(bandwidth_hz, 1.0 / study.control.rate_hz)
    return float(np.arcsin(half) * study.control.rate_hz / np.pi) if half <= 1 else np.inf


@dataclass(frozen=True)
class _Gust:
    """Wind in a band of frequencies: modes (M, n) whose squares times a spectrum are their power."""

    factor: Array
    edges_hz: Array


def _wind(
    study: SegmentControlStudy, layout: SegmentLayout, modes: SeenModes
) -> tuple[Spectrum, list[_Gust]]:
    source = SegmentWind(name="wind", **study.wind.model_dump())
    spectrum = piston_spectrum(source, float(layout.areas_m2.mean()))
    found = gusts_of(source, layout)
    pushed = modes.shapes[::3].T * (layout.areas_m2 * 1e9 / np.sqrt(len(layout)))
    bands = [
        _Gust(pushed @ root / np.sqrt(power), np.array(edges))
        for root, power, edges in zip(
            found.factors, found.together.variances, pairwise(found.together.edges_hz), strict=True
        )
    ]
    return spectrum, [*bands, _Gust(pushed, found.apart.edges_hz[[0, -1]])]


def bench_of(study: SegmentControlStudy) -> Bench:
    """Prepare a study.

    Raises
    ------
    UserError
        If sensors do not see a mode of the structure, or shares of the structure are too large.
    """
    with one_thread():
        return _bench(study)


def _bench(study: SegmentControlStudy) -> Bench:
    sensing = sensing_of(study)
    layout, modes, stroke_values = mirror_of(study.mirror.telescope, sensing)
    structure = structure_of(study, layout, modes)
    spectrum, bands = _wind(study, layout, modes)
    open_wind = sum(float(np.sum(one.factor**2) * band_variance(spectrum, one.edges_hz)[0]) for one in bands)
    shown = np.geomspace(_FIRST, 0.5 * study.control.rate_hz, _SHOWN)
    about = structure.hertz[:, None] * (1 + structure.zeta[:, None] * np.linspace(-6, 6, 25))
    hertz = np.unique(np.concatenate([shown, about[(about > 0) & (about < shown[-1])]]))
    loops = tuple(
        _left(study, modes, reduced(loop_of(study, structure, one)), spectrum, bands, hertz)
        for one in study.control.bandwidths_hz
    )
    none = np.zeros(0)
    first, still = study.control.bandwidths_hz[0], Structure(none, none, none, structure.shapes[:, :0])
    limit, rigid = (_limit(study, reduced(loop_of(study, one, first)), first) for one in (structure, still))
    return Bench(
        study,
        layout,
        sensing,
        modes,
        structure,
        stroke_values,
        float(np.sqrt(open_wind)),
        float(np.sqrt(sum(one.rms_nm**2 for one in study.mode))),
        limit,
        rigid,
        hertz,
        sum((np.sum(one.factor**2) * _inside(spectrum, one, hertz) for one in bands), np.zeros(len(hertz)))
        + sum(_line(mode).density(hertz) for mode in study.mode if mode.rms_nm),
        loops,
    )


def _limit(study: SegmentControlStudy, found: Reduced, bandwidth_hz: float) -> float:
    """Return the bandwidth from which on a loop is unstable, 0 if it is at the given, lowest one."""
    if radius(found, 1.0) >= 1.0:
        return 0.0
    factor = first_unstable(lambda one: radius(found, one), _TRIED, np.inf)
    return bandwidth_of(study, bandwidth_hz, factor) if np.isfinite(factor) else np.inf


def _left(
    study: SegmentControlStudy,
    modes: SeenModes,
    found: Reduced,
    spectrum: Spectrum,
    bands: Sequence[_Gust],
    hertz: Array,
) -> Left:
    period, values = found.loop.timing.period, poles(found)
    last = values[np.abs(values).argmax()]
    growth, growth_hz = float(np.log(abs(last)) / period), float(abs(np.angle(last)) / (2 * np.pi * period))
    if growth >= 0:
        nan = np.nan
        nothing, unknown = np.full(len(study.mode), nan), np.full(len(hertz), nan)
        none = LoopCurve(np.full((len(hertz), 2), nan + 0j), unknown, unknown, nan, nan)
        curves = unknown, unknown, none, unknown, unknown
        return Left(found, growth, growth_hz, nan, nan, nothing, nan, nan, nan, *curves)
    grid = frequency_grid(found)
    sizes, along = sensitivity_of(found, grid)
    knots = turns(found)

    def integral(left: Spectrum, low: float, high: float) -> float:
        return float(band_variance(left, np.array([low, high]))[0])

    wind, remaining = 0.0, np.zeros(len(hertz))
    for one in bands:
        share, (low, high) = left_of(found, covariance(found, one.factor)), one.edges_hz
        remaining += _inside(spectrum, one, hertz) * share(hertz)[0]
        density = _times(spectrum, share)
        wind += integral(Spectrum(density, low, high, (*spectrum.breaks_hz, *knots)), low, high)
    lines = [
        (
            _line(mode),
            covariance(found, found.basis @ shape[:, None]),
        )
        for mode, shape in zip(study.mode, found.loop.structure.shapes.T, strict=True)
        if mode.rms_nm
    ]
    shaken = 0.0
    if lines:
        together = _together(lines, left_of(found, *(moved for _, moved in lines)), knots)
        shaken = integral(together, together.low_hz, together.high_hz)
        remaining += together.density(hertz)
    heard = noise_left(found, covariance(found, np.diag(modes.multipliers)))
    noise = integral(Spectrum(heard, 1e-7 / period, 0.5 / period, knots), 1e-7 / period, 0.5 / period)
    return Left(
        found,
        growth,
        growth_hz,
        float(sizes.max()),
        float(grid[sizes.argmax()]),
        along.max(axis=0),
        float(np.sqrt(wind)),
        float(np.sqrt(shaken)),
        float(np.sqrt(noise)) * study.mirror.sensor_nm,
        sensitivity_of(found, hertz)[0],
        *curve_of(found, hertz),
        remaining,
        study.mirror.sensor_nm**2 * heard(hertz),
    )


def _line(mode: SeenMode) -> Spectrum:
    return resonance(mode.hz, 2 * mode.zeta * mode.hz, mode.rms_nm)


def _inside(spectrum: Spectrum, gust: _Gust, hertz: Array) -> Array:
    """Return the density within a gust's band, 0 beyond."""
    low, high = gust.edges_hz
    return np.where((hertz >= low) & (hertz < high), spectrum.density(hertz), 0.0)


def _together(
    lines: Sequence[tuple[Spectrum, Covariance]], left: Callable[[Array], Array], knots: tuple[float, ...]
) -> Spectrum:
    """Return the spectrum of what is left of all lines together, from one response of the loop."""

    def density(hertz: Array) -> Array:
        summed = np.zeros_like(hertz)
        for (line, _), share in zip(lines, left(hertz), strict=True):
            inside = (hertz >= line.low_hz) & (hertz <= line.high_hz)
            summed += np.where(inside, line.density(hertz), 0.0) * share
        return summed

    spectra = [line for line, _ in lines]
    ends = [end for one in spectra for end in (one.low_hz, one.high_hz)]
    breaks = sorted({*ends, *knots, *(knot for one in spectra for knot in one.breaks_hz)})
    return Spectrum(density, min(ends), max(ends), tuple(breaks))


def _times(spectrum: Spectrum, factor: Callable[[Array], Array]) -> Callable[[Array], Array]:
    return lambda hertz: spectrum.density(hertz) * factor(hertz)[0]
