"""Bases of images of segmented pupils: Fourier transforms of segments times monomials, on a grid of nodes.

See `wavequake.imaging.engines.segment_psf` for what they are good for.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import DTypeLike, NDArray

from wavequake.errors import UserError
from wavequake.imaging.engines.band_limit import image_nodes, middle_of, waves
from wavequake.imaging.engines.mirror_twins import find_twins, lone, parts_of
from wavequake.imaging.engines.polygon_transform import polygon_areas
from wavequake.imaging.engines.segment_moments import largest_means, moments_on_grid
from wavequake.imaging.pupils.outlines import Outline

Real = NDArray[np.float64]
Floating = NDArray[np.float32] | NDArray[np.float64]

# Complete polynomials of degree 0, 2, 4, 6, 8; an odd last degree would buy next to nothing.
MOMENTS = (1, 6, 15, 28, 45)
_BLOCK = 32
# Shadows smaller than this share of all glass are rounding.
_DARK = 1e-13


@dataclass(frozen=True)
class SegmentBasis:
    """What all images of one pupil on one grid have in common.

    Attributes
    ----------
    pixels : int
        An image has pixels x pixels points, axis 0 is y; [pixels // 2, pixels // 2] is the origin.
    sampling : float
        Distance of the points in units of wavelength / diameter.
    segments, moments : int
        Number of segments S, and of moments J of each.
    twins, shares : ndarray, shape (4, R)
        Segments whose transforms are one but for signs: `wavequake.imaging.engines.mirror_twins.Twins`.
    matrix : ndarray, shape (4, Q, J * R), real
        The moments' parts (`wavequake.imaging.engines.mirror_twins.parts_of`) at the Q nodes with f_x > 0 and
        f_y > 0; the segment varies fastest.
    interpolation : ndarray, shape (pixels, M), real
        Takes values at the nodes to the image points, along either axis.
    slope_scale : float
        Length in mm that makes slopes and moments dimensionless.
    peak : float
        Field at the origin without phases: the area in mm² (or the sum of the rays' weights).
    remainders : ndarray, shape (degrees, S)
        Bound of the relative error of the field per |slope|^(n+1) if the series ends with degree n = 0,
        2, ...
    """

    pixels: int
    sampling: float
    segments: int
    moments: int
    twins: NDArray[np.intp]
    shares: Real
    matrix: Floating
    interpolation: Floating
    slope_scale: float
    peak: float
    remainders: Real


def segment_basis(
    corners: Real,
    centers: Real,
    pixels: int,
    sampling: float,
    diameter: float,
    moments: int = 6,
    dtype: DTypeLike = np.complex64,
    shadows: Outline | None = None,
) -> SegmentBasis:
    """Build the basis of a pupil of polygons.

    Parameters
    ----------
    corners : ndarray, shape (S, V, 2)
        Projected corners in mm, counter-clockwise; a polygon with fewer than V corners repeats its last one.
    centers : ndarray, shape (S, 2)
        Points in mm to which the pistons belong and about which the slopes turn.
    pixels : int
        An image has pixels x pixels points.
    sampling : float
        Distance of the points in units of wavelength / `diameter`.
    diameter : float
        Length in mm that defines the unit wavelength / diameter, usually the outer diameter of the pupil.
    moments : {1, 6, 15, 28, 45}
        1 is exact for pistons; 6, 15, ... are the second, fourth, ... order in the slopes (`moments_needed`).
    dtype : complex64 or complex128
        Precision: errors are below 2e-6 or 1e-12 of the perfect peak.
    shadows : Outline, optional
        What is taken from the segments (its pieces), by spiders for example: polygons in mm of sign -1, and
        1 where two of them overlap.

    Raises
    ------
    UserError
        If a polygon is clockwise, empty or not finite, or the grid, diameter or number of moments impossible.
    """
    if moments not in MOMENTS:
        raise UserError(f"an image takes {', '.join(map(str, MOMENTS))} moments per segment, not {moments}")
    corners, centers = np.asarray(corners, dtype=np.float64), np.asarray(centers, dtype=np.float64)
    areas = polygon_areas(corners)
    if centers.shape != (len(corners), 2) or not np.isfinite(centers).all():
        raise UserError(f"{len(corners)} segments need as many finite centers, not {centers.shape}")
    middle = middle_of(corners.reshape(-1, 2))  # a shift of the pupil turns the field's phase only
    corners, centers = corners - middle, centers - middle
    dark, sign, piece = _shadows(shadows, areas)
    net = areas + np.bincount(piece, sign * _areas(dark), len(areas))
    if not net.sum() > _DARK * areas.sum():
        raise UserError("no light passes the segments: everything is blocked")
    dark = dark - middle
    nodes, interpolation = image_nodes(corners.reshape(-1, 2), pixels, sampling, diameter, dtype)
    half = nodes[nodes.size // 2 :]
    twins = lone(len(corners)) if len(dark) else find_twins(corners, centers)
    first_of = twins.segment[0]
    matrix = np.empty((4, half.size**2, moments, len(first_of)), dtype=interpolation.dtype)
    degree = 2 * MOMENTS.index(moments)
    remainders = np.empty((degree // 2 + 1, len(corners)))
    scale = float(np.hypot(*np.moveaxis(corners - centers[:, None], -1, 0)).max())

    def parts(polygons: Real, about: Real) -> Real:
        field = moments_on_grid(polygons, about, half, nodes, degree, scale)
        return parts_of(field.reshape(half.size, nodes.size, *field.shape[1:])).reshape(
            4, -1, *field.shape[1:]
        )

    for first in range(0, len(corners), _BLOCK):
        block = slice(first, first + _BLOCK)
        remainders[:, block] = largest_means(corners[block], centers[block], degree) / net.sum()
    for first in range(0, len(first_of), _BLOCK):
        block = slice(first, first + _BLOCK)
        matrix[..., block] = parts(corners[first_of[block]], centers[first_of[block]])
    for first in range(0, len(dark), _BLOCK):
        block = slice(first, first + _BLOCK)
        each = np.moveaxis(parts(dark[block], centers[piece[block]]), 3, 0)
        for number, factor, part in zip(piece[block], sign[block], each, strict=True):
            matrix[..., number] += factor * part
    return SegmentBasis(
        pixels=pixels,
        sampling=sampling,
        segments=len(corners),
        moments=moments,
        twins=twins.segment,
        shares=twins.share,
        matrix=matrix.reshape(4, half.size**2, -1),
        interpolation=interpolation,
        slope_scale=scale,
        peak=float(net.sum()),
        remainders=remainders,
    )


def ray_basis(
    x: Real,
    y: Real,
    weight: Real,
    pixels: int,
    sampling: float,
    diameter: float,
    dtype: DTypeLike = np.complex64,
) -> SegmentBasis:
    """Build the basis of a pupil sampled by rays; `psf` then takes their OPDs (batch, R) in waves.

    A ray stands for the pupil around it, so the image is right only well within wavelength / (distance of the
    rays) of the center; rays on a lattice repeat the image there.

    Parameters
    ----------
    x, y : ndarray, shape (R,)
        Pupil coordinates of the rays in mm.
    weight : ndarray, shape (R,)
        Share of the pupil of each ray, for example an area in mm²; zero for a ray that is lost.
    pixels, sampling, diameter, dtype
        As for `segment_basis`.

    Raises
    ------
    UserError
        If no ray has a positive weight, a number is not finite, or the grid or diameter is impossible.
    """
    x, y, weight = (np.asarray(a, dtype=np.float64) for a in (x, y, weight))
    points = np.stack([x, y], axis=1)
    if not (np.isfinite(points).all() and np.isfinite(weight).all()):
        raise UserError("the rays of a pupil need finite coordinates and weights: leave lost rays out")
    if not weight.size or weight.min() < 0.0 or weight.sum() == 0.0:
        raise UserError("the rays of a pupil need weights of at least 0, and one must be above 0")
    points = points - middle_of(points)
    nodes, interpolation = image_nodes(points, pixels, sampling, diameter, dtype)
    half = nodes[nodes.size // 2 :]
    matrix = np.empty((4, half.size, half.size, x.size), dtype=interpolation.dtype)
    along_x = waves(nodes, points[:, 0])
    for row, along_y in enumerate(waves(half, points[:, 1]) * weight):
        matrix[:, row] = parts_of((along_x * along_y)[None])[:, 0]
    twins = lone(x.size)
    return SegmentBasis(
        pixels=pixels,
        sampling=sampling,
        segments=x.size,
        moments=1,
        twins=twins.segment,
        shares=twins.share,
        matrix=matrix.reshape(4, -1, x.size),
        interpolation=interpolation,
        slope_scale=1.0,
        peak=float(weight.sum()),
        remainders=np.full((1, x.size), 1e100),  # rays have no slopes
    )


def _shadows(shadows: Outline | None, areas: Real) -> tuple[Real, Real, NDArray[np.intp]]:
    """Return the corners, signs and segments of shadows that are more than rounding."""
    if shadows is None:
        return np.zeros((0, 3, 2)), np.zeros(0), np.zeros(0, dtype=np.intp)
    if shadows.piece.size and not 0 <= shadows.piece.min() <= shadows.piece.max() < len(areas):
        raise UserError(f"shadows must fall on segments 0 to {len(areas) - 1}")
    kept = _areas(shadows.corners) > _DARK * areas.sum()
    return shadows.corners[kept], shadows.sign[kept], shadows.piece[kept]


def _areas(corners: Real) -> Real:
    spokes = corners - corners[:, :1]
    following = np.roll(spokes, -1, axis=1)
    cross = spokes[..., 0] * following[..., 1] - spokes[..., 1] * following[..., 0]
    return np.asarray(0.5 * cross.sum(axis=1))
