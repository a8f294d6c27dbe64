"""Linear loops of a study over frequency, as its store keeps them."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wavequake.campaign.contract import Fixed
from wavequake.campaign.measures import Axis
from wavequake.chain.loops.answers import answering, shown_of
from wavequake.chain.loops.block import Sensor, stuck_of
from wavequake.chain.loops.blocks import LoopBlocks
from wavequake.chain.loops.designed import Sighted, timing_of
from wavequake.chain.loops.light import Light
from wavequake.control.linear import Array
from wavequake.control.sampled.propagated import noise_spectra
from wavequake.control.sampled.stability import SampledLoop, Sight, curve

_POINTS = 200
# Of phases at half the rate of commands, where a loop gain is real, rounding chooses the sign; deg.
_STILL = 1e-6
# The margin that an eigenvalue has which is kept.
MARGINS = ("gain", "phase")
_GAINS = (
    ("loop_gain", "1", "size of the loop gain's eigenvalue that has the margin"),
    ("loop_phase", "deg", "its phase"),
)
_CURVES = (
    ("rejection", "1", "what is left of a motion, |S|, of the eigenvalue that leaves most"),
    ("passed_noise", "1", "what comes of noise, |T|, of the eigenvalue that passes most"),
    ("noise_los", "{}^2/Hz", "what sensor noise does to the line of sight, both axes, by frame means"),
    ("noise_wfe", "nm^2/Hz", "what sensor noise does to the Zernikes j >= 4, by frame means"),
)
_MARGINS = (
    ("gain_up", "1", "factor of the gain at which the loop is unstable, as these frequencies show it"),
    ("phase_margin", "deg", "phase that makes the loop unstable, as these frequencies show it"),
)
# Unit and meaning of what a store has of a loop in all kinds of studies.
WORDS = {name: (units, words) for name, units, words in (*_GAINS, *_MARGINS)}


@dataclass(frozen=True)
class Looked:
    """A stable loop, what is looked at, and what disturbs it.

    Attributes
    ----------
    loop : SampledLoop
    look : Sight
        Line of sight along x and y, then coefficients of the wavefront.
    noise : ndarray, shape (m,)
        Rms of the readings of a period.
    """

    loop: SampledLoop
    look: Sight
    noise: Array


def curve_axes(hertz: Array) -> dict[str, Axis]:
    """Return the dimensions of curves."""
    words = "margin that an eigenvalue of the loop gain has"
    return {"frequency": Axis(hertz, "frequency", "Hz"), "margin": Axis(list(MARGINS), words)}


def shown(study: LoopBlocks) -> Array:
    """Return the frequencies of the curves of a study, Hz."""
    return frequencies(study.sensor, [timing_of(study, one).period for one in study.controller if one.sensor])


def frequencies(sensors: Iterable[Sensor], periods: Iterable[float]) -> Array:
    """Return frequencies up to half the rate of the fastest sensor, among them half that of each period."""
    high = 0.5 * max((one.rate_hz for one in sensors), default=2.0)
    halves = [0.5 / one for one in periods]
    slower = [one for one in halves if one < high * (1 - 1e-9)]
    return np.unique(np.concatenate([np.geomspace(1e-3 * high, high, _POINTS), slower]))


def curves(
    study: LoopBlocks, optics: Sighted, loops: Mapping[str, SampledLoop], unit: str = "mas", size: float = 1.0
) -> dict[str, Fixed]:
    """Return the curves of loops by controller, each alone; NaN of controllers without a linear loop.

    One unit of the light's line of sight is of this size in the unit of the store.
    """
    found = {name: _looked(study, optics, name, loop) for name, loop in loops.items()}
    return kept([one.name for one in study.controller], shown(study), found, unit, size)


def kept(
    names: Sequence[str], hertz: Array, found: Mapping[str, Looked], unit: str, size: float = 1.0
) -> dict[str, Fixed]:
    """Return the curves of some of the controllers of these names, NaN of the others, as a store has them."""
    gains = np.full((len(_GAINS), len(names), len(hertz), len(MARGINS)), np.nan)
    values = np.full((len(_CURVES), len(names), len(hertz)), np.nan)
    margins = np.full((len(_MARGINS), len(names)), np.nan)
    for name, one in found.items():
        place, known = names.index(name), curve(one.loop, hertz)
        heard = noise_spectra(one.loop, one.look, one.noise, hertz)
        los, wfe = heard[:, :2].sum(axis=1), heard[:, 2:].sum(axis=1)
        gains[:, place] = np.abs(known.gain), phases(known.gain)
        values[:, place] = known.rejection, known.passed, size**2 * los, wfe
        margins[:, place] = known.gain_up, np.degrees(known.phase)
    stored: dict[str, Fixed] = {}
    for words, dims, arrays in (
        (_GAINS, ("controller", "frequency", "margin"), gains),
        (_CURVES, ("controller", "frequency"), values),
        (_MARGINS, ("controller",), margins),
    ):
        for (name, units, text), array in zip(words, arrays, strict=True):
            stored[name] = dims, array, {"units": units.format(unit), "long_name": text}
    return stored


def spectrum(time: Array, motion: Array, hertz: Array) -> Array:
    """Return the one-sided spectrum of a motion that goes straight between its instants.

    Parameters
    ----------
    time : ndarray, shape (n,)
        Rising, about evenly.
    motion : ndarray, shape (n, axes)
        Its mean over time does not count.
    hertz : ndarray, shape (f,)
        Rising, above 0.

    Returns
    -------
    ndarray, shape (f,)
        unit^2/Hz, all axes together, by a Hann window; mean over the band that is nearest to each frequency,
        NaN where that is slower than half a cycle.
    """
    from scipy.signal import periodogram  # takes half a second to load, in every worker

    even = np.linspace(time[0], time[-1], len(time))
    values = np.stack([np.interp(even, time, one) for one in motion.T], axis=1)
    at, density = periodogram(values, 1 / (even[1] - even[0]), "hann", axis=0)
    powers = np.concatenate([[0.0], np.cumsum(density[1:].sum(axis=1)) * at[1]])
    between = np.sqrt(hertz[1:] * hertz[:-1])
    edges = np.concatenate([[hertz[0] ** 2 / between[0]], between, hertz[-1:]])
    # A density belongs to all frequencies that are nearest to its own.
    found = np.diff(np.interp(edges, at + 0.5 * at[1], powers)) / np.diff(edges)
    return np.where(edges[1:] > 0.5 * at[1], found, np.nan)


def phases(gain: NDArray[np.complex128]) -> Array:
    """Return phases in deg, above -180."""
    found = np.degrees(np.angle(gain))
    return np.where(found < -180.0 + _STILL, found + 360.0, found)


def _looked(study: LoopBlocks, optics: Sighted, name: str, loop: SampledLoop) -> Looked:
    one, light = study.part("controller", name), optics.light
    actuator, frames = study.part("actuator", one.actuator), timing_of(study, one).frames
    free = np.isnan(stuck_of(actuator, actuator.channels(light)))
    look = Sight(
        actuator.dynamics(),
        optics.sights[actuator.name][: light.optical] * free,
        shown_of(answering(optics.answers, [actuator.name]), len(light))[: light.optical],
    )
    return Looked(loop, look, noise_of(study.sensors(one), light, frames))


def noise_of(sensors: Iterable[Sensor], light: Light, frames: int) -> Array:
    """Return the rms of the mean readings of so many frames, of all sensors (m,)."""
    every = [np.full(len(each.labels(light)), each.noise_rms(light)) for each in sensors]
    return np.asarray(np.concatenate(every) / np.sqrt(frames))
