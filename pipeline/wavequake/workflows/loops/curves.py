"""Linear loops of a study over frequency, as its store keeps them."""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from wavequake.campaign.contract import Fixed
from wavequake.campaign.measures import Axis
from wavequake.chain.loops.block import Sensor
from wavequake.control.linear import Array
from wavequake.control.sampled.stability import SampledLoop, curve

_POINTS = 200
_CURVES = (
    ("loop_gain", "1", "size of the loop gain's eigenvalue that is nearest to -1"),
    ("loop_phase", "deg", "its phase"),
    ("rejection", "1", "what is left of a motion, |S|, of the eigenvalue that leaves most"),
    ("passed_noise", "1", "what comes of noise, |T|, of the eigenvalue that passes most"),
)


def frequencies(sensors: Iterable[Sensor]) -> Axis:
    """Return the frequencies of curves, Hz, up to half the rate of the fastest sensor."""
    return Axis(_shown(sensors), "frequency", "Hz")


def curves(
    names: Sequence[str], loops: Mapping[str, SampledLoop], sensors: Iterable[Sensor]
) -> dict[str, Fixed]:
    """Return the curves of loops by controller, each alone; NaN of controllers without a linear loop."""
    hertz = _shown(sensors)
    values = np.full((len(_CURVES), len(names), len(hertz)), np.nan)
    for name, loop in loops.items():
        gain, rejection, passed = curve(loop, hertz)
        values[:, names.index(name)] = np.abs(gain), np.degrees(np.angle(gain)), rejection, passed
    return {
        name: (("controller", "frequency"), one, {"units": units, "long_name": text})
        for (name, units, text), one in zip(_CURVES, values, strict=True)
    }


def _shown(sensors: Iterable[Sensor]) -> Array:
    high = 0.5 * max((one.rate_hz for one in sensors), default=2.0)
    return np.geomspace(1e-3 * high, high, _POINTS)
