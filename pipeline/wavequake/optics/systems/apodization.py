"""The amplitude of the light over the pupil of a system."""

from math import isinf

import numpy as np
from numpy.typing import NDArray

from wavequake.optics.media.glasses import refractive_index
from wavequake.optics.systems.paraxial import paraxial
from wavequake.optics.systems.system import OpticalSystem, wavelength_of

Array = NDArray[np.float64]


def pupil_amplitude(system: OpticalSystem, x: Array, y: Array) -> Array | None:
    """Return the amplitude of the light at places of the pupil, 1 at its center; None: it is 1 everywhere.

    Parameters
    ----------
    system : OpticalSystem
    x, y : ndarray, shape (N,)
        In units of the pupil's radius; the light is that of the whole pupil, whatever part a field fills.

    Returns
    -------
    ndarray, shape (N,), or None
        By the formulas of `wavequake.optics.systems.system.Apodization` (OpticStudio User Guide, "Apodization
        Type").
    """
    given, square = system.pupil.apodization, x**2 + y**2
    if given is None:
        return None
    if given.kind == "gaussian":
        return np.exp(-given.factor * square) if given.factor else None
    if isinf(system.object_distance):
        return None
    tangent = paraxial(system).object_na / refractive_index(system.medium, wavelength_of(system))
    return np.asarray((1.0 + tangent**2 * square) ** -0.75, dtype=np.float64)
