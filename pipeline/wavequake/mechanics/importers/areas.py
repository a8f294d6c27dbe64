"""Shares of an optical surface's area that belong to its nodes: positive, sum 1."""

import numpy as np

from wavequake.errors import UserError
from wavequake.mechanics.importers.entries import Array, Integers
from wavequake.mechanics.importers.mesh import MeshFile, positions

# Facets of elements: local nodes, corners in order around the facet, then the mid-side nodes.
_TET = ((0, 1, 2), (0, 1, 3), (1, 2, 3), (0, 2, 3))
_TET10 = ((0, 1, 2, 4, 5, 6), (0, 1, 3, 4, 8, 7), (1, 2, 3, 5, 9, 8), (0, 2, 3, 6, 9, 7))
_HEX = ((0, 1, 2, 3), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7))
_HEX20 = (
    (0, 1, 2, 3, 8, 9, 10, 11),
    (4, 5, 6, 7, 12, 13, 14, 15),
    (0, 1, 5, 4, 8, 17, 12, 16),
    (1, 2, 6, 5, 9, 18, 13, 17),
    (2, 3, 7, 6, 10, 19, 14, 18),
    (3, 0, 4, 7, 11, 16, 15, 19),
)
_WEDGE = ((0, 1, 2), (3, 4, 5), (0, 1, 4, 3), (1, 2, 5, 4), (2, 0, 3, 5))
_WEDGE15 = (
    (0, 1, 2, 6, 7, 8),
    (3, 4, 5, 9, 10, 11),
    (0, 1, 4, 3, 6, 13, 9, 12),
    (1, 2, 5, 4, 7, 14, 10, 13),
    (2, 0, 3, 5, 8, 12, 11, 14),
)
FACETS: dict[str, tuple[tuple[int, ...], ...]] = {
    "tetra": _TET,
    "tetra10": _TET10,
    "hexahedron": _HEX,
    "hexahedron20": _HEX20,
    "wedge": _WEDGE,
    "wedge15": _WEDGE15,
    "triangle": ((0, 1, 2),),
    "quad": ((0, 1, 2, 3),),
    "triangle6": ((0, 1, 2, 3, 4, 5),),
    "quad8": ((0, 1, 2, 3, 4, 5, 6, 7),),
}
# Powers of the two local coordinates that the shape functions of a facet combine, and its nodes there.
_LINEAR, _QUADRATIC = ((0, 0), (1, 0), (0, 1)), ((2, 0), (1, 1), (0, 2))
_SQUARE = ((-1, -1), (1, -1), (1, 1), (-1, 1), (0, -1), (1, 0), (0, 1), (-1, 0))
_TRIANGLE = ((0, 0), (1, 0), (0, 1), (0.5, 0), (0.5, 0.5), (0, 0.5))
POWERS: dict[int, tuple[tuple[int, int], ...]] = {
    3: _LINEAR,
    4: (*_LINEAR, (1, 1)),
    6: _LINEAR + _QUADRATIC,
    8: (*_LINEAR, *_QUADRATIC, (2, 1), (1, 2)),
}
_WIDE, _SPARSE = 2.5, 3.0


def area_shares(mesh: MeshFile, nodes: Integers) -> Array:
    """Return each surface node's share of the area, shape (p,).

    From the facets of elements whose nodes all belong to the surface; where these do not reach every node,
    from triangles between the nodes, projected on the surface's mean plane.

    Raises
    ------
    UserError
        If the nodes lie on one line.
    """
    shares = np.zeros(len(mesh.labels))
    inside = np.zeros(len(mesh.labels), dtype=bool)
    inside[nodes] = True
    seen: list[Integers] = []
    for kind, labels in mesh.cells.items():
        place = positions(mesh, labels.ravel(), "element").reshape(labels.shape)
        for facet in FACETS.get(kind, ()):
            corners = place[:, facet]
            corners = corners[inside[corners].all(axis=1)]
            if len(corners):
                seen.append(_add_facets(shares, mesh.points, _new(corners, seen)))
    if (shares[nodes] > 0.0).all():
        return np.asarray(shares[nodes] / shares[nodes].sum())
    return _triangle_shares(mesh.points[nodes], mesh.source)


def _new(corners: Integers, seen: list[Integers]) -> Integers:
    """Return the facets that no earlier element has: a facet of two elements counts once."""
    keys = np.sort(corners[:, :3], axis=1)
    _, first = np.unique(keys, axis=0, return_index=True)
    corners, keys = corners[np.sort(first)], keys[np.sort(first)]
    if not seen:
        return corners
    known = {tuple(row) for row in np.concatenate(seen).tolist()}
    return corners[[tuple(row) not in known for row in keys.tolist()]]


def _add_facets(shares: Array, points: Array, corners: Integers) -> Integers:
    """Add the shares of facets of one kind; return their keys.

    A facet's area is shared in proportion to the integrals of the squared shape functions (Hinton, Rock and
    Zienkiewicz 1976): the integrals of quadratic shape functions themselves are negative or zero.
    """
    values, gradients, weights = _shape_functions(corners.shape[1])
    tangents = np.einsum("gnd,fnx->dfgx", gradients, points[corners], optimize=True)
    areas = np.linalg.norm(np.cross(tangents[0], tangents[1]), axis=2) * weights
    diagonal = areas @ values**2
    parts = diagonal * (areas.sum(axis=1) / diagonal.sum(axis=1))[:, None]
    np.add.at(shares, corners, parts)
    return np.sort(corners[:, :3], axis=1)


def _shape_functions(count: int) -> tuple[Array, Array, Array]:
    """Return values (g, count), local gradients (g, count, 2) and weights at Gauss points of a facet."""
    nodes, weights = np.polynomial.legendre.leggauss(3)
    x, y = (part.ravel() for part in np.meshgrid(nodes, nodes))
    weight = np.outer(weights, weights).ravel()
    if count in (3, 6):  # the square collapsed to a triangle
        x, y, weight = (1 + x) / 2, (1 - x) * (1 + y) / 4, weight * (1 - x) / 8
    places = np.array((_TRIANGLE if count in (3, 6) else _SQUARE)[:count], dtype=np.float64)
    i, j = np.array(POWERS[count]).T
    combine = np.linalg.inv(places[:, :1] ** i * places[:, 1:] ** j)
    u, v = x[:, None], y[:, None]
    along_x = i * u ** np.maximum(i - 1, 0) * v**j
    along_y = j * u**i * v ** np.maximum(j - 1, 0)
    return u**i * v**j @ combine, np.stack([along_x @ combine, along_y @ combine], axis=2), weight


def mesh_points(plane: Array) -> Integers:
    """Return triangles between points of a plane, shape (n, 2); holes stay open.

    A triangle spans a hole where its circumscribed circle is larger than 2.5 times the median of all (the
    alpha shape of Edelsbrunner, Kirkpatrick and Seidel 1983) and, since meshes may be graded, than thrice the
    distances from its corners to their nearest neighbors.

    Returns
    -------
    ndarray of int, shape (m, 3)
        None if there are fewer than three points, or all lie on a line.
    """
    from scipy.spatial import Delaunay, QhullError  # slow to import, and few models have no elements

    try:
        found = np.asarray(Delaunay(plane).simplices, dtype=np.int64)
    except (QhullError, ValueError):
        return np.zeros((0, 3), dtype=np.int64)
    sides = np.linalg.norm(plane[found] - np.roll(plane[found], 1, axis=1), axis=2)
    with np.errstate(divide="ignore"):
        radii = sides.prod(axis=1) / (4.0 * _triangle_areas(plane[found]))
    nearest = np.full(len(plane), np.inf)
    for first, second in ((0, 2), (1, 0), (2, 1)):
        for end in (first, second):
            np.minimum.at(nearest, found[:, end], sides[:, first])
    spans = (radii > _WIDE * np.median(radii)) & (radii > _SPARSE * nearest[found].max(axis=1))
    kept: Integers = found[~spans]
    return kept


def _triangle_areas(corners: Array) -> Array:
    """Return the areas of triangles, shape (m, 3, 2)."""
    (x, y), (u, v) = (corners[:, 1] - corners[:, 0]).T, (corners[:, 2] - corners[:, 0]).T
    return np.asarray(np.abs(x * v - y * u) / 2.0)


def _triangle_shares(points: Array, source: str) -> Array:
    """Return a third of the area of each node's triangles."""
    centered = points - points.mean(axis=0)
    plane = centered @ np.linalg.svd(centered, full_matrices=False)[2][:2].T if len(points) > 2 else centered
    if not len(triangles := mesh_points(plane)):
        raise UserError(
            f"the {len(points)} optical nodes of {source} span no surface: at least three, not on one line"
        )
    areas = _triangle_areas(plane[triangles])
    shares = np.bincount(triangles.ravel(), np.repeat(areas / 3.0, 3), minlength=len(points))
    if (shares <= 0.0).any():  # a node on a sliver: it keeps a little, so that no weight vanishes
        shares = np.maximum(shares, 1e-3 * shares.mean())
    return np.asarray(shares / shares.sum())
