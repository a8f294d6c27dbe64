"""Where the segments of a primary mirror are, as far as their disturbances ask."""

import hashlib
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class SegmentLayout:
    """Segments in sky orientation (z to the sky), lengths in m; hashed by content, so that caches find it.

    Attributes
    ----------
    names : tuple of str, length S
    centers_m : ndarray, shape (S, 3)
        Pivots of the rigid motion.
    axes : ndarray, shape (S, 3, 3)
        Columns are the local x axis, y axis and normal of each segment.
    corners_m : ndarray, shape (S, V, 2)
        Projected glass corners, counter-clockwise; a polygon with fewer than V corners repeats its last one.
    areas_m2 : ndarray, shape (S,)
        Area of glass.
    """

    names: tuple[str, ...]
    centers_m: NDArray[np.float64]
    axes: NDArray[np.float64]
    corners_m: NDArray[np.float64]
    areas_m2: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.names)

    @cached_property
    def digest(self) -> bytes:
        """Fingerprint of all numbers."""
        arrays = (self.centers_m, self.axes, self.corners_m, self.areas_m2)
        return hashlib.blake2b(b"".join(np.ascontiguousarray(array).tobytes() for array in arrays)).digest()

    def __hash__(self) -> int:
        return hash(self.digest)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, SegmentLayout) and self.names == other.names and self.digest == other.digest
