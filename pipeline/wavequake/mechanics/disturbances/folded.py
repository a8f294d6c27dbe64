"""Lines and modes for which the instants of a disturbance are too far apart: they look like slower ones."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from wavequake.mechanics.disturbances.population import MOST_ON_AXIS, Population
from wavequake.mechanics.disturbances.registry import instants_of, parts

_FEWEST = 16  # instants of a spectrum
_UNEVEN = 1e-3  # of the step
_ALIKE = 1e-9


def has_spectrum(time: NDArray[np.float64]) -> bool:
    """Return whether instants are many enough and evenly spaced."""
    steps = np.diff(time)
    return len(time) >= _FEWEST and bool(np.ptp(steps) <= _UNEVEN * steps.mean()) and steps.mean() > 0.0


def folded_lines(populations: Sequence[Population], name: str, every: int = 1) -> str:
    """Return a sentence on the lines and modes of a disturbance above half the rate of its instants.

    Only what its sources say of themselves counts: lines, harmonics and modes, not continuous spectra. The
    sentence is empty where there are none, no such disturbance, or instants so few or uneven that no spectrum
    is drawn. Of the instants every n-th one is kept.
    """
    population = next((one for one in populations if one.name == name), None)
    if population is None or not has_spectrum(
        time := instants_of(populations, population)[every - 1 :: every]
    ):
        return ""
    sources = parts(populations, population)
    half = 0.5 * (len(time) - 1) / float(time[-1] - time[0])
    most = max((hertz for one in sources for hertz in one.frequencies_hz()), default=0.0)
    if most <= half * (1.0 + _ALIKE):
        return ""
    enough, way = every * (int(2.0 * most * population.duration_s) + 1), ""
    if all(one.instants_of_file() is None for one in sources):
        way = f"; instants = {enough} show them where they are"
        if enough > MOST_ON_AXIS:
            way = f"; shorten duration_s, as {enough} instants would show them where they are"
    return (
        f"{name} has lines or modes up to {most:.4g} Hz, above half the rate of its instants ({half:.4g} "
        f"Hz): spectra show them folded to lower frequencies{way}."
    )
