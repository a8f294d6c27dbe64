"""Linear loops of a study over frequency, as its store keeps them."""

from collections.abc import Iterable, Mapping

import numpy as np

from wavequake.campaign.contract import Fixed
from wavequake.campaign.measures import Axis
from wavequake.chain.loops.answers import answering, shown_of
from wavequake.chain.loops.block import Sensor, stuck_of
from wavequake.chain.loops.blocks import LoopBlocks
from wavequake.chain.loops.designed import Sighted, timing_of
from wavequake.control.linear import Array
from wavequake.control.sampled.propagated import noise_spectra
from wavequake.control.sampled.stability import SampledLoop, Sight, curve

_POINTS = 200
_CURVES = (
    ("loop_gain", "1", "size of the loop gain's eigenvalue that is nearest to -1"),
    ("loop_phase", "deg", "its phase"),
    ("rejection", "1", "what is left of a motion, |S|, of the eigenvalue that leaves most"),
    ("passed_noise", "1", "what comes of noise, |T|, of the eigenvalue that passes most"),
    ("noise_los", "{}^2/Hz", "what sensor noise does to the line of sight, both axes, by frame means"),
    ("noise_wfe", "nm^2/Hz", "what sensor noise does to the Zernikes j >= 4, by frame means"),
)
_MARGINS = (
    ("gain_up", "1", "factor of the gain at which the loop is unstable, as these frequencies show it"),
    ("phase_margin", "deg", "phase that makes the loop unstable, as these frequencies show it"),
)


def frequencies(sensors: Iterable[Sensor]) -> Axis:
    """Return the frequencies of curves, Hz, up to half the rate of the fastest sensor."""
    return Axis(_shown(sensors), "frequency", "Hz")


def curves(
    study: LoopBlocks, optics: Sighted, loops: Mapping[str, SampledLoop], unit: str = "mas", size: float = 1.0
) -> dict[str, Fixed]:
    """Return the curves of loops by controller, each alone; NaN of controllers without a linear loop.

    One unit of the light's line of sight is of this size in the unit of the store.
    """
    names, hertz = [one.name for one in study.controller], _shown(study.sensor)
    values = np.full((len(_CURVES), len(names), len(hertz)), np.nan)
    margins = np.full((len(_MARGINS), len(names)), np.nan)
    for name, loop in loops.items():
        found, place = curve(loop, hertz), names.index(name)
        los, wfe = _noise(study, optics, name, loop, hertz)
        phase = np.degrees(np.angle(found.gain))
        values[:, place] = np.abs(found.gain), phase, found.rejection, found.passed, size**2 * los, wfe
        margins[:, place] = found.gain_up, np.degrees(found.phase)
    kept: dict[str, Fixed] = {}
    for known, dims, arrays in (
        (_CURVES, ("controller", "frequency"), values),
        (_MARGINS, ("controller",), margins),
    ):
        for (name, units, text), one in zip(known, arrays, strict=True):
            kept[name] = dims, one, {"units": units.format(unit), "long_name": text}
    return kept


def _noise(
    study: LoopBlocks, optics: Sighted, name: str, loop: SampledLoop, hertz: Array
) -> tuple[Array, Array]:
    """Return the spectra of line of sight and wavefront by sensor noise, (f,) each."""
    one, light = study.part("controller", name), optics.light
    actuator, frames = study.part("actuator", one.actuator), timing_of(study, one).frames
    free = np.isnan(stuck_of(actuator, actuator.channels(light)))
    look = Sight(
        actuator.dynamics(),
        optics.sights[actuator.name][: light.optical] * free,
        shown_of(answering(optics.answers, [actuator.name]), len(light))[: light.optical],
    )
    noise = np.concatenate(
        [np.full(len(each.labels(light)), each.noise_rms(light)) for each in study.sensors(one)]
    )
    found = noise_spectra(loop, look, noise / np.sqrt(frames), hertz)
    return found[:, :2].sum(axis=1), found[:, 2:].sum(axis=1)


def _shown(sensors: Iterable[Sensor]) -> Array:
    high = 0.5 * max((one.rate_hz for one in sensors), default=2.0)
    return np.geomspace(1e-3 * high, high, _POINTS)
