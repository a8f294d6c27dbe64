"""One case in full detail, recomputed for the report's maps."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Bent:
    """The glass of segments as triangles.

    Attributes
    ----------
    points : ndarray, shape (V, 2)
        Corners, mm.
    faces : ndarray of int, shape (F, 3)
    heights : ndarray, shape (T, V)
        By the figure alone, along the segment's normal, nm.
    """

    points: NDArray[np.float64]
    faces: NDArray[np.int64]
    heights: NDArray[np.float64]


@dataclass(frozen=True)
class Detail:
    """Everything that the maps of one case show.

    Attributes
    ----------
    case : int
        Id of the case.
    disturbance : str
        Name of its population.
    segment_names : tuple of str, length S
    corners : ndarray, shape (S, V, 2)
        Glass corners projected on the aperture, mm.
    centers : ndarray, shape (S, 2)
        Projected centers, mm.
    time_s : ndarray, shape (T,)
    segment_motion : ndarray, shape (T, S, 6)
        dx, dy, dz, rx, ry, rz in each segment's local frame (dz along its normal, to the sky), m and rad.
    ray_x, ray_y : ndarray, shape (N,)
        Where the rays meet the aperture, mm.
    ray_segment : ndarray of int, shape (N,)
        Index of the segment that each ray hits, -1 for none.
    opd : ndarray, shape (T, N)
        Optical path differences, nm; NaN for a lost ray.
    spot : ndarray, shape (T, N, 2)
        Where the rays meet the image, on the sky about the chief ray at rest, mas; NaN for a lost ray.
    airy_mas : float
        Radius of the Airy disk of the pupil's outer diameter, 1.22 lambda/D.
    image : ndarray, shape (Y, X)
        Exposure: mean of the instants' point spread functions, 1 = peak of the perfect one.
    image_x, image_y : ndarray, shape (X,) and (Y,)
        Pixel centers, lambda/D.
    bent : Bent, optional
        The glass of segments that deform.
    folded : str
        A sentence on lines and modes that its instants are too far apart for; empty where there are none.
    """

    case: int
    disturbance: str
    segment_names: tuple[str, ...]
    corners: NDArray[np.float64]
    centers: NDArray[np.float64]
    time_s: NDArray[np.float64]
    segment_motion: NDArray[np.float64]
    ray_x: NDArray[np.float64]
    ray_y: NDArray[np.float64]
    ray_segment: NDArray[np.integer]
    opd: NDArray[np.float64]
    spot: NDArray[np.float64]
    airy_mas: float
    image: NDArray[np.float64]
    image_x: NDArray[np.float64]
    image_y: NDArray[np.float64]
    bent: Bent | None = None
    folded: str = ""

    @cached_property
    def glass(self) -> NDArray[np.bool_]:
        """Rays that hit a segment and arrive at every instant, shape (N,)."""
        return (self.ray_segment >= 0) & np.isfinite(self.opd).all(axis=0)

    @cached_property
    def flat_opd(self) -> NDArray[np.float64]:
        """OPD of the rays on `glass` without their least-squares piston and tilt, (T, rays on glass), nm."""
        opd = self.opd[:, self.glass]
        if not opd.size:
            return opd
        scale = max(float(np.abs(self.ray_x).max()), float(np.abs(self.ray_y).max()))
        plane = np.stack(
            [np.ones(opd.shape[1]), self.ray_x[self.glass] / scale, self.ray_y[self.glass] / scale], axis=1
        )
        coefficients = np.linalg.lstsq(plane, opd.T, rcond=None)[0]
        return np.asarray(opd - (plane @ coefficients).T)

    @cached_property
    def worst_instant(self) -> int:
        """The instant of the largest rms of :attr:`flat_opd`, the one that the maps show."""
        return int(np.argmax(np.square(self.flat_opd).sum(axis=1)))
