"""Where the segments of large telescopes are: scaled lattices of hexagons, and round mirrors."""

from collections.abc import Sequence
from math import cos, pi, sqrt

import numpy as np
from numpy.typing import NDArray

from wavequake.kernels.trace.surfaces import conic_path
from wavequake.optics.segments.layout import (
    TMT_CONIC,
    TMT_RADIUS,
    Segments,
    on_conic,
    projected_axes,
    require_gap,
    ring_centers,
    segments_on_conic,
)
from wavequake.optics.shapes.polygons import inset

Array = NDArray[np.float64]

_SKY_TO_OPTICS = np.array([1.0, 1.0, -1.0])


def tmt_segments(gap: float = 2.5) -> Segments:
    """Return the 492 segments of the Thirty Meter Telescope, A1..A82, B1..F82.

    They follow the definition of the telescope's public segmentation database: a lattice of regular hexagons
    of side 716 mm with centers from 1.5 to 14.4 m, scaled radially so that the segments become alike, lifted
    onto the conic; each edge then moves in by half the gap in the segment's tangent plane. Sector A reaches
    from azimuth 30 (excluded) to 90 degrees; the others are turned by multiples of 60 degrees.

    Parameters
    ----------
    gap : float
        Distance between neighboring edges, mm.

    Raises
    ------
    UserError
        If the gap is negative or leaves no glass.
    """
    side, rows = 716.0, range(2, 14)
    flat = sqrt(3.0) * side
    require_gap(gap, 0.9 * flat)
    lattice = np.array(
        [
            (column * flat * cos(pi / 6.0), flat * (row - 0.5 * column))
            for row in rows
            for column in range(row)
        ]
    )
    lattice = lattice[np.hypot(*lattice.T) < 14400.0]  # rows 0 and 1, inside 1.5 m, are not there
    turns = pi / 3.0 * np.arange(6)
    vertices = lattice[:, None] + side * np.stack([np.cos(turns), np.sin(turns)], axis=1)
    largest = np.hypot(vertices[..., 0], vertices[..., 1]).max()
    centers, vertices = (_scaled(points, largest, 60000.0) for points in (lattice, vertices))

    centers_3d, normals = on_conic(centers, TMT_RADIUS, TMT_CONIC)
    axes = _untwisted_axes(normals)
    corners = _gapped_in_tangent_planes(vertices, centers_3d, axes, gap, TMT_RADIUS, TMT_CONIC)
    sectors = [_turn(60.0 * sector) for sector in range(6)]
    return Segments(
        names=tuple(f"{letter}{number}" for letter in "ABCDEF" for number in range(1, len(centers) + 1)),
        centers=np.concatenate([centers_3d @ turn.T for turn in sectors]),
        axes=np.concatenate([turn @ axes for turn in sectors]),
        corners=np.concatenate([corners @ turn[:2, :2].T for turn in sectors]),
    )


def _scaled(points: Array, largest: float, reach: float) -> Array:
    """Scale the flat lattice (..., 2) radially, most at the center; a point at radius `largest` stays."""
    strength = 0.165
    square = np.sum(points**2, axis=-1, keepdims=True)
    scaled: Array = points * (1.0 + strength * (largest / reach) ** 2) / (1.0 + strength * square / reach**2)
    return scaled


def _gapped_in_tangent_planes(
    vertices: Array, centers: Array, axes: Array, gap: float, radius: float, conic: float
) -> Array:
    """Move edges between `vertices` (S, V, 2) on a conic in by half a gap; return corners."""
    lifted, _ = on_conic(vertices, radius, conic)
    to_optics = _SKY_TO_OPTICS[:, None] * axes
    local = (lifted - centers[:, None]) @ to_optics
    flat = inset(local[..., :2], gap / 2.0)
    plane = centers[:, None] + flat @ np.swapaxes(to_optics[:, :, :2], 1, 2)
    return _down_to_conic(plane, -to_optics[:, :, 2], radius, conic)


def _down_to_conic(points: Array, down: Array, radius: float, conic: float) -> Array:
    """Project `points` (S, V, 3) along a direction of each segment (S, 3) onto a conic; return x and y."""
    direction = np.broadcast_to(down[:, None], points.shape)
    path = conic_path(np.moveaxis(points, -1, 0), np.moveaxis(direction, -1, 0), 1.0 / radius, conic)
    projected: Array = (points + path[..., None] * direction)[..., :2]
    return projected


def elt_segments(diameter: float, gap: float, radius: float, conic: float) -> Segments:
    """Return the 798 segments of the Extremely Large Telescope, named 1, 2, ... by ring and azimuth.

    They are rings 5 to 17 of a lattice of regular hexagons, less ten at each of its corners, scaled radially
    as those of the TMT are, so that the segments become alike.

    Parameters
    ----------
    diameter : float
        Of the circle about the glass, without gaps, mm.
    gap : float
        Distance between neighboring edges, mm.
    radius, conic : float
        Of the parent surface.
    """
    lattice = np.concatenate([ring_centers(1.0, ring) for ring in range(5, 18)])
    lattice = lattice[np.hypot(*lattice.T) < 15.4]
    angles = pi / 6.0 + pi / 3.0 * np.arange(6)
    vertices = lattice[:, None] + np.stack([np.cos(angles), np.sin(angles)], axis=1) / sqrt(3.0)
    pitch = 0.5 * diameter / np.hypot(vertices[..., 0], vertices[..., 1]).max()
    centers, vertices = (_scaled(pitch * points, 0.5 * diameter, -radius) for points in (lattice, vertices))
    middle, normals = on_conic(centers, radius, conic)
    axes = _untwisted_axes(normals)
    corners = _gapped_in_tangent_planes(vertices, middle, axes, gap, radius, conic)
    return Segments(tuple(str(number) for number in range(1, len(centers) + 1)), middle, axes, corners)


def circular_segments(
    names: Sequence[str], centers: Array, diameter: float, radius: float, conic: float, corners: int = 72
) -> Segments:
    """Return circular mirrors of one parent surface as polygons of the same area, with equal sides.

    An off-axis mirror is round in its own tangent plane; projected along the axis it is narrower towards it.

    Parameters
    ----------
    names : sequence of str, length S
    centers : ndarray, shape (S, 2)
        Where the vertices stand, projected, mm.
    diameter : float
        Of the glass, mm.
    radius, conic : float
        Of the parent surface.
    corners : int
        Of the polygons.
    """
    turns = 2.0 * pi * (np.arange(corners) + 0.5) / corners
    reach = 0.5 * diameter * sqrt(2.0 * pi / (corners * np.sin(2.0 * pi / corners)))
    middle, normals = on_conic(centers, radius, conic)
    flat = _SKY_TO_OPTICS[:, None] * projected_axes(normals)[:, :, :2]
    plane = middle[:, None] + reach * np.stack([np.cos(turns), np.sin(turns)], axis=1) @ np.swapaxes(
        flat, 1, 2
    )
    down = _SKY_TO_OPTICS * -normals
    outline = _down_to_conic(plane, down, radius, conic)
    return segments_on_conic(names, outline, radius, conic, centers)


def _untwisted_axes(normals: Array) -> Array:
    """Return the global axes (S, 3, 3) after the smallest rotation of z to the normal, as in the TMT."""
    both = normals + np.array([0.0, 0.0, 1.0])
    columns = [np.eye(3)[k] - (normals[:, k] / both[:, 2])[:, None] * both for k in range(2)]
    return np.stack([*columns, normals], axis=-1)


def _turn(degrees: float) -> Array:
    """Return the rotation (3, 3) about z by a multiple of 60 degrees, exact to the last bit of sqrt(3)/2."""
    c, s = cos(degrees * pi / 180.0), np.sin(degrees * pi / 180.0)
    c, s = round(2.0 * c) / 2.0, round(s / sqrt(0.75)) * sqrt(0.75)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
