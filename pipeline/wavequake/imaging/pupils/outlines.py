"""Outlines of pupils: signed polygons, and what blocks them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wavequake.errors import UserError
from wavequake.imaging.engines.polygon_transform import polygon_areas
from wavequake.optics.shapes.concave import crossing, triangles
from wavequake.optics.shapes.polygons import signed_areas

Real = NDArray[np.float64]

# A circle is a polygon of this many corners and the circle's area: its outline is off by 1e-7 of the radius.
_CIRCLE_CORNERS = 4096


@dataclass(frozen=True)
class Outline:
    """Where light passes: a sum of polygons, of which some count as holes.

    Attributes
    ----------
    corners : ndarray, shape (Q, V, 2)
        Corners, counter-clockwise, in any unit of length; a polygon with fewer than V repeats its last one.
    sign : ndarray, shape (Q,)
        1 for glass and -1 for what is taken from it.
    piece : ndarray of int, shape (Q,)
        Which piece of the wavefront (segment) a polygon belongs to.
    """

    corners: Real
    sign: Real
    piece: NDArray[np.intp]


def disc(radius: float, center: ArrayLike = (0.0, 0.0), corners: int = _CIRCLE_CORNERS) -> Real:
    """Return the regular polygon (V, 2) that has the area of a circle."""
    if not (np.isfinite(radius) and radius > 0.0):
        raise UserError(f"the radius of a disc must be above 0, not {radius}")
    reach = radius * np.sqrt(2.0 * np.pi / corners / np.sin(2.0 * np.pi / corners))
    angle = 2.0 * np.pi * (np.arange(corners) + 0.5) / corners
    return np.asarray(center + reach * np.stack([np.cos(angle), np.sin(angle)], axis=1))


def vane(start: ArrayLike, end: ArrayLike, width: float) -> Real:
    """Return the rectangle (4, 2) of a spider's vane of some width between two points.

    Raises
    ------
    UserError
        If the vane has no length or width.
    """
    first, last = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
    length = float(np.hypot(*(last - first)))
    if not (np.isfinite(length) and length > 0.0 and np.isfinite(width) and width > 0.0):
        raise UserError(f"a vane needs a length and a width above 0, not {length:g} and {width:g}")
    along = (last - first) / length
    across = 0.5 * width * np.array([-along[1], along[0]])
    return np.stack([first - across, last - across, last + across, first + across])


def annulus(outer: float, inner: float = 0.0) -> Outline:
    """Return the outline of a ring, or of a disc if the inner radius is 0."""
    rings = [disc(outer)] + ([disc(inner)] if inner else [])
    return Outline(np.stack(rings), np.array([1.0, -1.0])[: len(rings)], np.zeros(len(rings), dtype=np.intp))


def segments(corners: Real) -> Outline:
    """Return the outline of segments (S, V, 2), each of which is a piece of its own.

    Raises
    ------
    UserError
        If a polygon is clockwise, empty, not finite or crosses itself.
    """
    corners = np.asarray(corners, dtype=np.float64)
    polygon_areas(corners)
    for number, polygon in enumerate(corners):
        _is_convex(polygon, f"segment {number}")
    return Outline(corners, np.ones(len(corners)), np.arange(len(corners)))


def blocked(outline: Outline, obstruction: Real) -> Outline:
    """Take a polygon (V, 2), counter-clockwise, from an outline.

    What obstructions have in common is blocked once.

    Raises
    ------
    UserError
        If the obstruction is clockwise, empty, not finite or crosses itself.
    """
    obstruction = np.asarray(obstruction, dtype=np.float64)
    polygon_areas(obstruction[None])
    if not _is_convex(obstruction, "an obstruction"):
        parts = triangles(obstruction[None])[0]
        for part in parts[signed_areas(parts) > 0.0]:
            outline = blocked(outline, part)
        real = signed_areas(outline.corners) > 0.0  # what parts share is a line, but for rounding
        return Outline(outline.corners[real], outline.sign[real], outline.piece[real])
    # What is left of a polygon that falls apart stays one polygon, along whose cut an edge leads back.
    shadow, hit = outline.corners, np.arange(len(outline.corners))
    for start, end in zip(obstruction, np.roll(obstruction, -1, axis=0), strict=True):
        shadow, kept = _clip(shadow, start, end - start)
        hit = hit[kept]
        if not hit.size:
            return outline
    width = max(shadow.shape[1], outline.corners.shape[1])
    both = [np.pad(c, ((0, 0), (0, width - c.shape[1]), (0, 0)), "edge") for c in (outline.corners, shadow)]
    return Outline(
        np.concatenate(both),
        np.concatenate([outline.sign, -outline.sign[hit]]),
        np.concatenate([outline.piece, outline.piece[hit]]),
    )


def _is_convex(corners: Real, name: str) -> bool:
    """Return whether a polygon is convex; if not, it must not cross itself."""
    edges = np.roll(corners, -1, axis=0) - corners
    edges = edges[np.any(edges != 0.0, axis=1)]
    following = np.roll(edges, -1, axis=0)
    turns = edges[:, 0] * following[:, 1] - edges[:, 1] * following[:, 0]
    convex = bool(turns.min() >= -1e-9 * float((edges**2).sum(axis=1).max()))
    if not convex and crossing(corners[None])[0]:
        raise UserError(f"{name} crosses or touches itself: list its corners in order around it")
    return convex


def _clip(corners: Real, point: Real, direction: Real) -> tuple[Real, NDArray[np.intp]]:
    """Keep what lies left of a line of polygons (Q, V, 2); return it and which polygons have any."""
    height = direction[0] * (corners[..., 1] - point[1]) - direction[1] * (corners[..., 0] - point[0])
    kept = np.flatnonzero((height > 0.0).any(axis=1))
    corners, height = corners[kept], height[kept]
    following, further = np.roll(corners, -1, axis=1), np.roll(height, -1, axis=1)
    crosses = (height > 0.0) != (further > 0.0)
    share = height / np.where(crosses, height - further, 1.0)
    meeting = corners + share[..., None] * (following - corners)
    slots = np.stack([corners, meeting], axis=2).reshape(len(kept), 2 * corners.shape[1], 2)
    used = np.stack([height > 0.0, crosses], axis=2).reshape(len(kept), 2 * corners.shape[1])
    order = np.argsort(~used, axis=1, kind="stable")
    counts = used.sum(axis=1)
    places = np.minimum(np.arange(counts.max(initial=0)), counts[:, None] - 1)
    chosen = np.take_along_axis(order, places, axis=1)
    return np.take_along_axis(slots, chosen[..., None], axis=1), kept
