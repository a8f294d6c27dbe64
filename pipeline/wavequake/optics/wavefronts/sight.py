"""The line of sight of a system, from the chief ray and the tilt of the wavefront about it."""

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from wavequake.optics.wavefronts.wavefront import PreparedSystem

Array = NDArray[np.float64]


def line_of_sight(prepared: "PreparedSystem", chief: Array, zernike: Array) -> Array:
    """Return the image point of the best-fit plane, shape (T, 2), mm (Störkle 2018, Eq. 3.39).

    A tilt that grows by W waves from the pupil's center to its rim moves the image by W wavelengths over the
    numerical aperture there; the signs of the aperture's direction cosines hold for folded and inverting
    systems. The tilt of an annular polynomial is steeper by 1 / sqrt(1 + eps^2) (see `los_eq339`).
    """
    slope = 2.0 / np.sqrt(1.0 + prepared.system.pupil.obscuration**2) * prepared.wavelength * zernike[:, 1:3]
    shift: Array = slope @ np.linalg.inv(prepared.cosines) / prepared.image_index
    return chief + shift
