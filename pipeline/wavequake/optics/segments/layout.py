"""Segments of a primary mirror: where the glass is.

The segments of the TMT are computed from their published definition, those of the simplified 18-segment model
from a side length; those of the JWST, and anybody's own, are polygons read from a table.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from io import StringIO
from itertools import pairwise
from math import cos, isfinite, pi, sqrt
from pathlib import Path
from typing import TextIO

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.kernels.trace.surfaces import conic_sag, conic_slopes
from wavequake.optics.shapes.polygon_table import read_polygons
from wavequake.optics.shapes.polygons import (
    centroids,
    concave,
    edge_lines,
    edge_spans,
    polygons_at,
    signed_areas,
)

Array = NDArray[np.float64]

TMT_RADIUS, TMT_CONIC = -60000.0, -1.00095348
TABLE_4_2_CONIC = -1.0009535  # the same conic as printed in the reference text
JWST_RADIUS, JWST_CONIC = -15879.7, -1.0  # the conic of the stigmatic equivalent, see `telescopes.jwst`
TMT18_SIDE = 15000.0 / sqrt(19.0)  # the outermost corners lie on the rim of 15 m

_SKY_TO_OPTICS = np.array([1.0, 1.0, -1.0])


@dataclass(frozen=True)
class Segments:
    """Polygons of glass on the parent surface of M1, in mm, in the optics frame.

    There x and y are as on the sky and z is along the light.

    Attributes
    ----------
    names : tuple of str, length S
    centers : ndarray, shape (S, 3)
        Pivots of the rigid motion, on the parent surface.
    axes : ndarray, shape (S, 3, 3)
        Columns are the local x axis, y axis and normal *in sky orientation* (z to the sky, right handed); a
        vector v in the local frame is ``F @ axes[k] @ v`` in the optics frame with F = diag(1, 1, -1).
    corners : ndarray, shape (S, V, 2)
        Projected glass corners, counter-clockwise; a polygon with fewer than V corners repeats its last one.
        V = 0 is a mirror without segments, whose aperture is the annulus of the pupil.
    figure_terms : int
        Number of Noll polynomials by which each segment can deform.
    """

    names: tuple[str, ...]
    centers: NDArray[np.float64]
    axes: NDArray[np.float64]
    corners: NDArray[np.float64]
    figure_terms: int = 0

    def __len__(self) -> int:
        return len(self.names)


def is_monolithic(segments: Segments) -> bool:
    """Return whether the mirror is one piece without edges."""
    return bool(segments.corners.shape[1] == 0)


def areas(segments: Segments) -> Array:
    """Return the projected areas of glass (S,) in mm²; NaN for a mirror without edges."""
    return np.full(len(segments), np.nan) if is_monolithic(segments) else signed_areas(segments.corners)


def half_planes(segments: Segments) -> Array:
    """Return the edges (S, V, 3) as half planes: (x, y) is on the glass where ``a x + b y <= c`` for all V.

    That holds for convex segments. (a, b) is a unit vector, so c is in mm; the edge between a repeated corner
    and itself is ``0 x + 0 y <= 1e9``.
    """
    return edge_lines(segments.corners)


def edges_of(segments: Segments) -> Array:
    """Return the edges as the trace takes them: `half_planes` of convex segments, else `edge_spans`."""
    return (edge_spans if concave(segments.corners).any() else edge_lines)(segments.corners)


def candidates(segments: Segments, x: Array, y: Array, margin: float = 0.0) -> NDArray[np.int32]:
    """Return the segments that each ray may meet when it wanders by up to `margin`.

    Parameters
    ----------
    segments : Segments
    x, y : ndarray, shape (N,)
        Where the rays meet M1, projected, mm.
    margin : float
        Every edge is moved outwards by this distance, mm.

    Returns
    -------
    ndarray of int32, shape (N, C)
        The segment that contains the ray first, then the others in the order of their distance, then -1. C is
        as small as possible.
    """
    if is_monolithic(segments):
        return np.zeros((len(x), 1), dtype=np.int32)
    return polygons_at(segments.corners, x, y, margin)


def hexagon_ring_segments(
    side: float,
    rings: int,
    gap: float = 0.0,
    radius: float = TMT_RADIUS,
    conic: float = TABLE_4_2_CONIC,
    central: bool = False,
) -> Segments:
    """Return rings of regular hexagons about a missing one, named 1, 2, ... by ring and azimuth.

    Parameters
    ----------
    side : float
        Side length of a cell, half a gap included on every edge, mm.
    rings : int
        Ring k has 6 k hexagons.
    gap : float
        Distance between neighboring edges, mm.
    radius, conic : float
        Of the parent surface.
    central : bool
        Whether there is one in the middle, too; it is then number 1.

    Raises
    ------
    UserError
        If the side is not positive, the gap leaves no glass, or the parent does not reach out to the corners.
    """
    if not (isfinite(side) and side > 0.0):
        raise UserError(f"The side of a hexagonal segment is {side:g} mm; it must be a positive length.")
    pitch = sqrt(3.0) * side
    require_gap(gap, 0.9 * pitch)
    middle = np.zeros((int(central), 2))
    centers = np.concatenate([middle, *(ring_centers(pitch, ring) for ring in range(1, rings + 1))])
    angles = pi / 6.0 + pi / 3.0 * np.arange(6)
    corners = centers[:, None] + (side - gap / sqrt(3.0)) * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    names = [str(number) for number in range(1, len(centers) + 1)]
    return segments_on_conic(names, corners, radius, conic, centers)


def ring_centers(pitch: float, ring: int) -> Array:
    """Return the centers (6 ring, 2) of a ring from azimuth 0 on, `ring` along each side of a hexagon."""
    spokes = ring * pitch * np.array([(cos(pi / 3.0 * k), np.sin(pi / 3.0 * k)) for k in range(7)])
    part = np.arange(ring)[:, None] / ring
    return np.concatenate([start + part * (end - start) for start, end in pairwise(spokes)])


def tmt18_segments(side: float = TMT18_SIDE, gap: float = 0.0) -> Segments:
    """Return the 18 segments of the simplified TMT (Störkle 2018, section 4.6).

    The text gives no side length. The default puts the outermost corners on the rim; ``15000 / sqrt(13)``
    would cover the whole disk of 15 m about the hole, ``30000 / (5 sqrt(3))`` makes five rows 30 m wide.
    """
    return hexagon_ring_segments(side, 2, gap)


def jwst_segments() -> Segments:
    """Return the 18 segments of the James Webb Space Telescope, A1-1 .. C6-18, on their parent surface.

    The corners are those published with the WebbPSF simulation package; the segments are not regular
    hexagons.
    """
    table = files("wavequake.optics.segments").joinpath("jwst_segments.csv").read_text(encoding="utf-8")
    return polygons_from_csv(StringIO(table), JWST_RADIUS, JWST_CONIC)


def polygons_from_csv(source: str | Path | TextIO, radius: float, conic: float) -> Segments:
    """Return the segments of a user's table (see `optics.shapes.polygon_table`) on a parent surface.

    Parameters
    ----------
    source : path or text stream
        CSV with the columns ``id,x1_m,y1_m,x2_m,y2_m,...`` in m and optional pivots ``cx_m,cy_m``; by default
        a segment turns about its centroid.
    radius, conic : float
        Of the parent surface; mm, negative for a concave mirror.

    Raises
    ------
    UserError
        If the table is wrong in any way, or reaches beyond the parent surface.
    """
    names, corners, centers = read_polygons(source)
    return segments_on_conic(names, corners, radius, conic, centers)


def monolithic(outer: float) -> Segments:
    """Return a mirror without segments as one segment without corners, pivot at the vertex.

    Its aperture is the annulus of the pupil; `outer`, the radius of the glass in mm, must be positive.
    """
    if not (isfinite(outer) and outer > 0.0):
        raise UserError(
            f"The outer radius of a monolithic mirror is {outer:g} mm; it must be a positive length."
        )
    return Segments(("M1",), np.zeros((1, 3)), np.eye(3)[None], np.zeros((1, 0, 2)))


def segments_on_conic(
    names: Sequence[str], corners: Array, radius: float, conic: float, centers: Array | None = None
) -> Segments:
    """Put polygons onto a parent surface.

    Parameters
    ----------
    names : sequence of str, length S
    corners : ndarray, shape (S, V, 2)
        Projected, counter-clockwise, mm.
    radius, conic : float
        Of the parent; the radius is negative for a concave mirror.
    centers : ndarray, shape (S, 2), optional
        Projected pivots; the centroids by default.

    Returns
    -------
    Segments
        With pivots on the parent; the local x axis is the global one projected into the tangent plane.

    Raises
    ------
    UserError
        If the parent does not reach out to every corner and pivot.
    """
    pivots = centroids(corners) if centers is None else centers
    places = np.concatenate([corners, pivots[:, None]], axis=1)
    reach = np.isfinite(conic_sag(places[..., 0], places[..., 1], 1.0 / radius, conic)).all(axis=1)
    if not reach.all():
        name = names[int(np.argmin(reach))]
        raise UserError(
            f"Segment {name!r} reaches beyond the primary mirror's parent surface (radius {radius:g} mm, "
            f"conic {conic:g}); its corners and its pivot must lie on it."
        )
    middle, normals = on_conic(pivots, radius, conic)
    return Segments(tuple(names), middle, projected_axes(normals), corners)


def on_conic(points: Array, radius: float, conic: float) -> tuple[Array, Array]:
    """Lift points (..., 2) onto the conic; return them in the optics frame and normals in sky orientation."""
    x, y = points[..., 0], points[..., 1]
    z = conic_sag(x, y, 1.0 / radius, conic)
    slope_x, slope_y = conic_slopes(x, y, 1.0 / radius, conic)
    normals = np.stack(
        [slope_x, slope_y, np.ones_like(slope_x)], axis=-1
    )  # z to the sky: slopes change their signs
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    return np.concatenate([points, z[..., None]], axis=-1), normals


def projected_axes(normals: Array) -> Array:
    """Return right-handed axes (S, 3, 3) whose x axis is the global one projected into the tangent plane."""
    x_axis = np.array([1.0, 0.0, 0.0]) - normals[:, :1] * normals
    x_axis /= np.linalg.norm(x_axis, axis=1, keepdims=True)
    return np.stack([x_axis, np.cross(normals, x_axis), normals], axis=-1)


def require_gap(gap: float, limit: float) -> None:
    """Raise UserError unless a gap between segments leaves glass."""
    if not 0.0 <= gap < limit:
        raise UserError(
            f"The gap between segments is {gap:g} mm; it must be at least 0 and below {limit:g} mm."
        )
