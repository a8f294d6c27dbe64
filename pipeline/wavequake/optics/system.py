"""Any sequential optical system: surfaces, stop, pupil, fields and wavelengths. Lengths in mm, angles in rad.

The z axis runs along the incoming light and keeps its sense after a reflection, as in Table 4.2 of Störkle
2018: a surface that follows an odd number of mirrors stands at smaller z.
"""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from wavequake.optics.media import AIR, Medium
from wavequake.optics.shapes import Conic, Deformation, Opening, Shape, SurfaceAction

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Surface:
    """One surface: its shape, where its vertex stands (3,), how it is turned (3, 3), and what it does.

    ``rotation`` turns the surface's frame into the system's. ``medium`` follows a refracting surface.
    """

    name: str
    shape: Shape = field(default_factory=Conic)
    position: Array = field(default_factory=lambda: np.zeros(3))
    rotation: Array = field(default_factory=lambda: np.eye(3))
    action: SurfaceAction = "pass"
    medium: Medium = AIR
    opening: Opening | None = None
    deformation: Deformation | None = None


@dataclass(frozen=True)
class Pupil:
    """How wide the beam is: one number, of the kind that the system is specified by.

    "entrance_diameter" (mm), "image_na", "object_na", "f_number" (paraxial image-space), or "stop" (the stop
    surface's opening limits the beam; ``value`` is its radius in mm). ``obscuration`` is the inner radius as
    a fraction of the outer.
    """

    kind: Literal["entrance_diameter", "image_na", "object_na", "f_number", "stop"]
    value: float
    obscuration: float = 0.0


@dataclass(frozen=True)
class OpticalSystem:
    """A sequential system; the last surface is the image.

    Attributes
    ----------
    name : str
    surfaces : tuple of Surface
    stop : int
        Index of the surface that is the aperture stop.
    pupil : Pupil
    object_distance : float
        From the object plane to the first surface's vertex; infinite for a star.
    fields : ndarray, shape (F, 2)
        Angles (tan of them is the slope) for an infinite object, heights in mm for a finite one.
    wavelengths : ndarray, shape (W,)
        mm.
    primary_wavelength : int
    telecentric : bool
        The entrance pupil is at infinity: chief rays leave a finite object parallel to the axis.
    medium : Medium
        Before the first surface.
    """

    name: str
    surfaces: tuple[Surface, ...]
    stop: int
    pupil: Pupil
    object_distance: float = np.inf
    fields: Array = field(default_factory=lambda: np.zeros((1, 2)))
    wavelengths: Array = field(default_factory=lambda: np.array([550e-6]))
    primary_wavelength: int = 0
    telecentric: bool = False
    medium: Medium = AIR


@dataclass(frozen=True)
class SystemStates:
    """What moves and deforms at T instants.

    Attributes
    ----------
    surface_motion : ndarray, shape (T, L, 6)
        Displacement along and rotation about the axes of each surface's own frame at rest (mm, rad), Cardan
        angles x-y-z about its vertex.
    deformations : tuple of (ndarray or None), one per surface
        (T, terms) Noll coefficients or (T, rows, columns) grid heights in mm, along the surface's z.
    line_of_sight : ndarray, shape (T, 2)
        Rotation of the whole incoming bundle, as an angle on the sky along x and y, rad.
    """

    surface_motion: Array
    deformations: tuple[Array | None, ...]
    line_of_sight: Array
