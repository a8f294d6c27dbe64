"""The monolithic parent of a segmented telescope as a general optical system."""

from dataclasses import replace

import numpy as np

from wavequake.optics.systems.system import OpticalSystem, with_surface


def parent_system(telescope: OpticalSystem, wavelength: float | None = None) -> OpticalSystem:
    """Return the telescope with a primary mirror of one piece: the annulus of its pupil.

    The stop is a surface of its own in the plane of M1's rim, before the mirror; the frame stays that of M1.
    Mirrors and lenses after M1 keep their edges, and stop what light they stop in the telescope.

    Parameters
    ----------
    telescope : OpticalSystem
    wavelength : float, optional
        mm; that of the telescope by default.
    """
    assert telescope.segmented is not None
    whole = with_surface(telescope, telescope.segmented, replace(telescope.primary, segments=None))
    return whole if wavelength is None else replace(whole, wavelengths=np.array([wavelength]))
