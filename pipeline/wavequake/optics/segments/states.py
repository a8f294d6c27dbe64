"""What moves: the state of every segment and surface over a batch of instants."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class SurfaceStates:
    """Rigid-body motion and figure of a batch of instants; zeros are the reference configuration.

    Attributes
    ----------
    segment_motion : ndarray, shape (batch, segment, 6)
        dx, dy, dz in mm and rx, ry, rz in rad in each segment's local frame (dz along the normal that points
        to the sky, Cardan angles x-y-z, pivot at the segment's centre).
    segment_figure : ndarray, shape (batch, segment, term)
        Circular Noll Zernike coefficients in mm, j = 1..term, over the segment's circumscribed circle in its
        local frame; positive towards the sky. ``term`` may be 0.
    surface_motion : ndarray, shape (batch, surface, 6)
        dx, dy, dz in mm and rx, ry, rz in rad of M2, M3, ..., image in the optics frame of M1 (z along the
        incoming light), pivot at the surface's vertex.
    field : ndarray, shape (batch, 2)
        Direction of the incoming light: angles in rad to the z axis, x and y; mount motion and field points.
    mirror_figure : ndarray, shape (batch, surface - 1, term), optional
        Circular Noll Zernike coefficients in mm of M2, M3, ... (not the image), j = 1..term, over the axial
        beam's footprint; positive along the z axis of the surface's frame, which for M2 is along the incoming
        light.
    """

    segment_motion: NDArray[np.float64]
    segment_figure: NDArray[np.float64]
    surface_motion: NDArray[np.float64]
    field: NDArray[np.float64]
    mirror_figure: NDArray[np.float64] | None = None

    def __len__(self) -> int:
        return int(self.field.shape[0])


def rest(
    batch: int, segments: int, surfaces: int, figure_terms: int = 0, mirror_terms: int = 0
) -> SurfaceStates:
    """Return the reference configuration for `batch` instants."""
    return SurfaceStates(
        segment_motion=np.zeros((batch, segments, 6)),
        segment_figure=np.zeros((batch, segments, figure_terms)),
        surface_motion=np.zeros((batch, surfaces, 6)),
        field=np.zeros((batch, 2)),
        mirror_figure=np.zeros((batch, surfaces - 1, mirror_terms)) if mirror_terms else None,
    )
