"""The sphere about the image point from which wavefronts count: it goes through the exit pupil."""

import numpy as np

# Radius where the exit pupil is at infinity, and of one far away (rounding), mm.
_TELECENTRIC, _LARGEST = 1e5, 1e6


def sphere_radius(exit_pupil_distance: float) -> float:
    """Return the radius of the reference sphere, mm; negative where it lies behind the image.

    Parameters
    ----------
    exit_pupil_distance : float
        From the exit pupil to the image along the light, mm; infinite for light that is telecentric there.
    """
    if not np.isfinite(exit_pupil_distance):
        return _TELECENTRIC
    return float(np.clip(exit_pupil_distance, -_LARGEST, _LARGEST))
