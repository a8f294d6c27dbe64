"""The monolithic parent of a segmented telescope as a general optical system."""

import numpy as np

from wavequake.optics.segments.telescope import SegmentedTelescope
from wavequake.optics.shapes.shapes import Conic, Opening
from wavequake.optics.systems.system import OpticalSystem, Pupil, Surface


def parent_system(telescope: SegmentedTelescope, wavelength: float | None = None) -> OpticalSystem:
    """Return the telescope with a primary mirror of one piece: the annulus of its pupil.

    The stop is a surface of its own in the plane of M1's rim, before the mirror; the frame stays that of M1.
    Mirrors and lenses after M1 keep their edges, and stop what light they stop in the telescope.

    Parameters
    ----------
    telescope : SegmentedTelescope
    wavelength : float, optional
        mm; that of the telescope by default.
    """
    inner, outer = telescope.pupil_inner, telescope.pupil_outer
    annulus = Opening(outer, inner)
    stop = Surface("stop", position=np.array([0.0, 0.0, telescope.stop_z]), opening=annulus)
    primary = Surface("M1", Conic(telescope.primary_radius, telescope.primary_conic), action="reflect")
    return OpticalSystem(
        name=telescope.name,
        surfaces=(stop, primary, *telescope.surfaces),
        stop=0,
        pupil=Pupil("entrance_diameter", 2.0 * outer, inner / outer),
        wavelengths=np.array([wavelength or telescope.wavelength]),
        note=telescope.note,
    )
