"""Images through focus: the same wavefront with more and less defocus."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wavequake.errors import UserError
from wavequake.imaging.engines.matrix_fourier import MatrixFourier, check_phase, psf
from wavequake.imaging.pupils.nyquist import samples_for, warn_of_coarse

Real = NDArray[np.float64]


def through_focus(transform: MatrixFourier, phase: Real, defocus: ArrayLike) -> Real:
    """Return the images (k, pixels, pixels) of a phase with defocus added.

    Parameters
    ----------
    transform : MatrixFourier
        Of a circular or annular pupil.
    phase : ndarray, shape (m,)
        Of the wavefront in focus, rad, at the pupil's lit cells.
    defocus : array_like, shape (k,)
        Noll coefficients c_4 of the circular pupil, in waves: sqrt(3) (2 rho² - 1) each, of the phase's sign.
        A shift of the image plane by dz makes NA² dz / (4 sqrt(3) wavelength) of it.

    Raises
    ------
    UserError
        If a defocus is not finite, or the phase does not fit the pupil.
    """
    coefficients = np.asarray(defocus, dtype=np.float64).ravel()
    if not coefficients.size or not np.isfinite(coefficients).all():
        raise UserError("a scan through focus needs defocus coefficients, which are finite numbers")
    grid = transform.pupil
    shape = np.sqrt(3.0) * (2.0 * (grid.x**2 + grid.y**2) - 1.0)
    if phase.shape != grid.cells.shape:
        raise UserError(f"the phase has the shape {phase.shape}; it must be {grid.cells.shape}")
    phases = phase + 2.0 * np.pi * coefficients[:, None] * shape
    check_phase(transform, phases)
    field = 2.0 * float(np.abs(transform.axis).max())
    warn_of_coarse(len(grid.axis), samples_for(grid, phases, field), field)
    return psf(transform, phases)
