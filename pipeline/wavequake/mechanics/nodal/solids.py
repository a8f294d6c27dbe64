"""Solid elements of any mesh: shape functions and their gradients at integration points.

The shape functions of a kind span its monomials and are 1 at one node each, so that they follow from the
natural coordinates of its nodes (Zienkiewicz and Taylor, The Finite Element Method, chapter 8). The order of
nodes is that of VTK and meshio, which Abaqus and CalculiX share; Nastran's is put into it as decks are read.
"""

from dataclasses import dataclass
from itertools import product

import numpy as np

from wavequake.errors import UserError
from wavequake.mechanics.importers.entries import Array, Integers
from wavequake.mechanics.mirrors.hexahedra import NATURAL, gauss_points

_TETRA = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype=float)
_EDGES = [(0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3)]
_TRIANGLE = np.array([[0, 0], [1, 0], [0, 1]], dtype=float)
_WEDGE = np.array([[*corner, z] for z in (-1, 1) for corner in _TRIANGLE])
_WEDGE_EDGES = [(0, 1), (1, 2), (2, 0), (3, 4), (4, 5), (5, 3), (0, 3), (1, 4), (2, 5)]


def _middles(nodes: Array, edges: list[tuple[int, int]]) -> Array:
    return np.vstack([nodes, [nodes[list(edge)].mean(axis=0) for edge in edges]])


def _powers(degree: int) -> list[tuple[int, ...]]:
    """Return the monomials in x, y, z of a total degree at most."""
    return [one for one in product(range(degree + 1), repeat=3) if sum(one) <= degree]


_BRICK = list(product(range(2), repeat=3))
# Serendipity: quadratic in all variables that do not appear in the first power.
_SERENDIPITY = [one for one in product(range(3), repeat=3) if sum(p for p in one if p > 1) <= 2]
# Of a triangle times those of a line; the quadratic one without z^2 times the square ones.
_PRISM = [one for one in _BRICK if one[0] + one[1] <= 1]
_PRISM15 = [one for one in product(range(3), repeat=3) if one[0] + one[1] + max(one[2] - 1, 0) <= 2]

KINDS: dict[str, tuple[Array, list[tuple[int, ...]]]] = {
    "tetra": (_TETRA, _powers(1)),
    "tetra10": (_middles(_TETRA, _EDGES), _powers(2)),
    "hexahedron": (NATURAL[:8], _BRICK),
    "hexahedron20": (NATURAL, _SERENDIPITY),
    "wedge": (_WEDGE, _PRISM),
    "wedge15": (_middles(_WEDGE, _WEDGE_EDGES), _PRISM15),
}
"""Natural coordinates of the nodes, and the monomials that the shape functions span, by meshio's names."""


@dataclass(frozen=True)
class Integrated:
    """Elements of one kind at their integration points.

    Attributes
    ----------
    elements : ndarray of int, shape (e, k)
    values : ndarray, shape (g, k)
        Shape functions.
    gradients : ndarray, shape (e, g, k, 3)
        By x, y, z.
    volumes : ndarray, shape (e, g)
        Shares of the volume.
    """

    elements: Integers
    values: Array
    gradients: Array
    volumes: Array


def integrated(kind: str, points: Array, elements: Integers) -> Integrated:
    """Return elements (e, k) of nodes `points` (N, 3) at their integration points.

    Raises
    ------
    UserError
        If an element is folded or flat.
    """
    where, weights = _rule(kind)
    values, natural = shapes(kind, where)
    jacobians = np.einsum("gkn,ekx->egnx", natural, points[elements], optimize=True)
    determinants = np.linalg.det(jacobians)
    # Nastran takes elements that are numbered the other way round.
    whole = (determinants > 0).all(axis=1) | (determinants < 0).all(axis=1)
    if not whole.all():
        raise UserError(
            f"element {int(np.argmin(whole)) + 1} of its {kind}s is folded or flat, or its nodes are in "
            "another order"
        )
    gradients = np.linalg.solve(jacobians[:, :, None], natural[None, ..., None])[..., 0]
    return Integrated(elements, values, gradients, np.abs(determinants) * weights)


def shapes(kind: str, where: Array) -> tuple[Array, Array]:
    """Return shape functions (g, k) and their natural gradients (g, k, 3) at natural coordinates (g, 3)."""
    nodes, monomials = KINDS[kind]
    powers = np.array(monomials)
    inverse = np.linalg.inv(_monomials(nodes, powers))
    slopes = []
    for axis in range(3):
        lower = powers.copy()
        lower[:, axis] = np.maximum(lower[:, axis] - 1, 0)
        slopes.append((powers[:, axis] * _monomials(where, lower)) @ inverse)
    return _monomials(where, powers) @ inverse, np.stack(slopes, axis=-1)


def _monomials(where: Array, powers: Integers) -> Array:
    return np.asarray((where[:, None, :] ** powers).prod(axis=2))


def _rule(kind: str) -> tuple[Array, Array]:
    """Return integration points (g, 3) and weights (g,): of stiffness and of the momenta of rigid motions."""
    if kind.startswith("tetra"):
        near, far = (5.0 - np.sqrt(5.0)) / 20.0, (5.0 + 3.0 * np.sqrt(5.0)) / 20.0
        return np.full((4, 3), near) + (far - near) * np.vstack([np.zeros(3), np.eye(3)]), np.full(
            4, 1.0 / 24.0
        )
    if kind.startswith("hexahedron"):
        return gauss_points(3 if kind == "hexahedron20" else 2, 3)
    heights, lengths = gauss_points(3 if kind == "wedge15" else 2, 1)
    plane = np.full((3, 2), 1.0 / 6.0) + 0.5 * np.vstack([np.zeros(2), np.eye(2)])
    where = np.array([[*one, height] for height in heights[:, 0] for one in plane])
    return where, np.repeat(lengths, 3) / 6.0
