"""Optical systems: a segmented (or monolithic) primary mirror followed by sequential surfaces."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wavequake.optics.segments import Segments


@dataclass(frozen=True)
class Surface:
    """One rotationally symmetric surface in the optics frame of M1 (z along the incoming light, mm).

    ``radius`` is infinite for a plane and positive if the centre of curvature lies on the surface's +z side. ``position`` (3,)
    is the vertex, ``rotation`` (3, 3) turns the surface's frame into the optics frame. The image plane does not reflect.
    """

    name: str
    radius: float
    conic: float
    position: NDArray[np.float64]
    rotation: NDArray[np.float64]
    reflects: bool = True


@dataclass(frozen=True)
class OpticalSystem:
    """A telescope in a reference configuration; lengths in mm.

    ``primary_radius``/``primary_conic`` describe the parent surface of M1 (vertex at the origin), ``segments`` its glass,
    ``surfaces`` M2, M3, ... and last the image plane. ``pupil_inner``/``pupil_outer`` are the radii of the annulus that
    normalises the Zernike polynomials; ``stop_z`` is the plane in which rays start (that of M1's rim).
    """

    name: str
    segments: Segments
    primary_radius: float
    primary_conic: float
    surfaces: tuple[Surface, ...]
    stop_z: float
    pupil_inner: float
    pupil_outer: float
