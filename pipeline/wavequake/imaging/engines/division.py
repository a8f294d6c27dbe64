"""Segments cut into parts, whose slopes bend the phase less.

A plane of phase on a segment is a plane on each of its parts, about the part's own center. A part of half the
size needs far fewer moments (`wavequake.imaging.engines.segment_psf`), so that steep segments have exact
images, too.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wavequake.optics.shapes.concave import triangles
from wavequake.optics.shapes.polygons import concave, signed_areas

Real = NDArray[np.float64]
# Parts smaller than this share of the largest are corners that were repeated.
_EMPTY = 1e-12


@dataclass(frozen=True)
class Division:
    """Triangles that make up segments.

    Attributes
    ----------
    corners : ndarray, shape (P, 3, 2)
        In mm, counter-clockwise.
    centers : ndarray, shape (P, 2)
        Their centroids in mm.
    segment : ndarray of int, shape (P,)
        The segment that each is a part of.
    offset : ndarray, shape (P, 2)
        Its center from the segment's, in mm.
    """

    corners: Real
    centers: Real
    segment: NDArray[np.intp]
    offset: Real


def divide(corners: Real, centers: Real, halvings: int) -> Division:
    """Cut polygons into triangles, and these `halvings` times into four of half the size.

    Parameters
    ----------
    corners : ndarray, shape (S, V, 2)
        Counter-clockwise corners in mm; a polygon with fewer than V corners repeats its last one.
    centers : ndarray, shape (S, 2)
        Points in mm about which the slopes of the segments turn.
    halvings : int
        At least 0. Hexagons become 6 * 4**halvings triangles.
    """
    parts = _fans(corners)
    for _ in range(halvings):
        middle = 0.5 * (parts + np.roll(parts, -1, axis=2))  # of edges 0-1, 1-2, 2-0
        a, b, c = np.moveaxis(parts, 2, 0)
        ab, bc, ca = np.moveaxis(middle, 2, 0)
        quarters = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
        parts = np.concatenate([np.stack(quarter, axis=2) for quarter in quarters], axis=1)
    segment = np.repeat(np.arange(len(parts)), parts.shape[1])
    flat = parts.reshape(-1, 3, 2)
    areas = signed_areas(flat)
    glass = areas > _EMPTY * areas.max()
    flat, segment = flat[glass], segment[glass]
    middle = flat.mean(axis=1)
    return Division(flat, middle, segment, middle - centers[segment])


def divided_phase(division: Division, segment_phase: Real) -> Real:
    """Return the pistons and slopes (batch, P, 3) of the parts of segments with such (batch, S, 3)."""
    phase = segment_phase[:, division.segment]
    phase[..., 0] += np.sum(phase[..., 1:] * division.offset, axis=-1)
    return phase


def _fans(corners: Real) -> Real:
    """Return triangles (S, T, 3, 2): about the mean of the corners, or ears where a polygon is not convex."""
    if concave(corners).any():
        return triangles(corners)
    following = np.roll(corners, -1, axis=1)
    middle = np.broadcast_to(corners.mean(axis=1, keepdims=True), corners.shape)
    return np.stack([middle, corners, following], axis=2)
