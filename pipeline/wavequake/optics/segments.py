"""Segments of a primary mirror: where the glass is."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Segments:
    """Polygons of glass on the parent surface of M1, in the optics frame (x, y as on the sky, z along the light), mm.

    Attributes
    ----------
    names : tuple of str, length S
    centers : ndarray, shape (S, 3)
        Pivots of the rigid motion, on the parent surface.
    axes : ndarray, shape (S, 3, 3)
        Columns are the local x axis, y axis and normal *in sky orientation* (z to the sky, right handed); a vector v in the
        local frame is ``F @ axes[k] @ v`` in the optics frame with F = diag(1, 1, -1).
    corners : ndarray, shape (S, V, 2)
        Projected glass corners, counter-clockwise; a polygon with fewer than V corners repeats its last one.
    """

    names: tuple[str, ...]
    centers: NDArray[np.float64]
    axes: NDArray[np.float64]
    corners: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.names)
