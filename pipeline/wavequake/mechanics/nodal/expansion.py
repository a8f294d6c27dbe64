"""From temperatures of the nodes of a body to their displacements: linear thermal expansion, SI units.

Nothing strains the body from outside: its supports are kinematic, as those of mirrors are. Of one isotropic
material, Young's modulus cancels; of several, their ratios count. Stiffness times displacements is the load
of the expansion, the integral of B^T D alpha (T - T0) (Zienkiewicz and Taylor, The Finite Element Method,
ch. 2).
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import scipy  # its parts load when first used
from scipy.sparse import coo_array, csc_array

from wavequake.errors import UserError
from wavequake.mechanics.importers.entries import Array, Integers
from wavequake.mechanics.model import rigid_modes
from wavequake.mechanics.nodal.solids import KINDS, Integrated, integrated
from wavequake.mechanics.vibration.factors import factorize

_LOOSE = 1e-13


@dataclass(frozen=True)
class Material:
    """Coefficient of expansion (1/K), Poisson's ratio, Young's modulus and density.

    The last two count by their ratios, in any unit.
    """

    expansion: float
    poisson: float = 0.33
    modulus: float = 1.0
    density: float = 1.0


@dataclass(frozen=True)
class Solid:
    """A body of solid elements.

    Attributes
    ----------
    source : str
        Its file, for messages.
    points : ndarray, shape (N, 3)
        m.
    cells : mapping of str to ndarray of int, shape (e, k)
        Nodes, from 0, of the elements of each kind of `wavequake.mechanics.nodal.solids.KINDS`.
    layers : mapping of str to ndarray of int, shape (e,)
        Which material each is of, from 0; without it all are of the first.
    """

    source: str
    points: Array
    cells: Mapping[str, Integers]
    layers: Mapping[str, Integers] | None = None

    @property
    def nodes(self) -> Integers:
        """Nodes of elements, ascending."""
        return np.unique(np.concatenate([elements.ravel() for elements in self.cells.values()]))


def expanded(
    body: Solid, warmer: Array, materials: Sequence[Material], held: Integers | None = None
) -> Array:
    """Return the displacements of nodes of a body whose temperature changes, shape (n, N, 3), m.

    Parameters
    ----------
    body : Solid
        Nodes of no element do not move.
    warmer : ndarray, shape (n, N)
        Temperatures less that at which the body has its shape, K.
    materials : sequence of Material
        As ``body.layers`` counts them.
    held : ndarray of int, optional
        Nodes whose mean rigid motion is none: kinematic supports. Without them the body floats: neither its
        center of mass moves nor does it turn in the mean.

    Raises
    ------
    UserError
        If an element is folded, the body is in several pieces, or `held` do not hold it.
    """
    parts = list(_parts(body, materials))
    stiffest = max(material.modulus for material, _ in parts)
    size, nodes = body.points.size, body.nodes
    stiffness = csc_array((size, size))
    loads = np.zeros((len(body.points), 3, len(warmer)))
    for material, part in parts:
        modulus = material.modulus / stiffest
        stiffness = stiffness + modulus * _stiffness(part, material.poisson, size)
        at_points = np.einsum("gk,nek->neg", part.values, warmer[:, part.elements], optimize=True)
        # D alpha dT in all three directions is 3 lambda + 2 mu = E / (1 - 2 nu) times the free strain.
        strained = modulus * material.expansion / (1.0 - 2.0 * material.poisson) * at_points * part.volumes
        forces = np.einsum("neg,egkx->ekxn", strained, part.gradients, optimize=True)
        np.add.at(loads, part.elements, forces)
    rigid = rigid_modes(body.points, body.points[nodes].mean(axis=0))
    moving = (3 * nodes[:, None] + np.arange(3)).ravel()
    fixed = moving[_six(rigid[moving])]
    free = np.setdiff1d(moving, fixed)
    try:
        factors = factorize(csc_array(stiffness[free][:, free]), definite=True)
    except UserError:
        factors = None
    if factors is None or not factors.pivots.min() > _LOOSE * factors.pivots.max():
        raise UserError(f"the elements of {body.source} are not one body: some part is loose")
    moved = np.zeros((size, len(warmer)))
    moved[free] = factors.solve(np.ascontiguousarray(loads.reshape(size, -1)[free]))
    moved[moving] -= rigid[moving] @ _rigid_part(body, parts, rigid, moved, held)
    return np.ascontiguousarray(moved.T).reshape(len(warmer), -1, 3)


def _parts(body: Solid, materials: Sequence[Material]) -> Iterator[tuple[Material, Integrated]]:
    """Yield the elements of each kind and material."""
    for kind, elements in body.cells.items():
        layer = np.zeros(len(elements), dtype=np.int64) if body.layers is None else body.layers[kind]
        for number in np.unique(layer):
            yield materials[number], _integrated(body, kind, elements[layer == number])


def _integrated(body: Solid, kind: str, elements: Integers) -> Integrated:
    try:
        return integrated(kind, body.points, elements)
    except UserError as error:
        raise UserError(f"{body.source}: {error}") from None


def _stiffness(part: Integrated, poisson: float, size: int) -> csc_array:
    """Return the stiffness (3 N, 3 N) of elements of a modulus of 1."""
    shear = 0.5 / (1.0 + poisson)
    first = 2.0 * shear * poisson / (1.0 - 2.0 * poisson)
    count, points, nodes, _ = part.gradients.shape
    flat = (part.gradients * np.sqrt(part.volumes)[..., None, None]).reshape(count, points, 3 * nodes)
    products = (flat.transpose(0, 2, 1) @ flat).reshape(count, nodes, 3, nodes, 3)
    matrices = first * products + shear * products.transpose(0, 1, 4, 3, 2)
    laplacian = shear * np.trace(products, axis1=2, axis2=4)
    for axis in range(3):
        matrices[:, :, axis, :, axis] += laplacian
    places = (3 * part.elements[:, :, None] + np.arange(3)).reshape(count, 3 * nodes)
    rows = np.broadcast_to(places[:, :, None], (count, 3 * nodes, 3 * nodes))
    columns = np.broadcast_to(places[:, None, :], rows.shape)
    return csc_array(coo_array((matrices.ravel(), (rows.ravel(), columns.ravel())), shape=(size, size)))


def _six(rigid: Array) -> Integers:
    """Return six rows whose clamping holds a body in a statically determinate way."""
    _, rows = scipy.linalg.qr(rigid.T, mode="r", pivoting=True)
    return np.asarray(rows[:6])


def _rigid_part(
    body: Solid,
    parts: list[tuple[Material, Integrated]],
    rigid: Array,
    moved: Array,
    held: Integers | None,
) -> Array:
    """Return the rigid motion (6, n) of displacements (3 N, n): of what is held, or of the whole mass."""
    if held is not None:
        rows = (3 * held[:, None] + np.arange(3)).ravel()
        if np.linalg.matrix_rank(rigid[rows]) < 6:
            raise UserError(f"the {len(held)} nodes of {body.source} that are held leave it free to turn")
        return np.asarray(np.linalg.lstsq(rigid[rows], moved[rows])[0])
    square, seen = np.zeros((6, 6)), np.zeros((6, moved.shape[1]))
    for moments, motion in _momenta(parts, rigid, moved):
        square += moments
        seen += motion
    return np.asarray(np.linalg.solve(square, seen))


def _momenta(
    parts: list[tuple[Material, Integrated]], rigid: Array, moved: Array
) -> Iterator[tuple[Array, Array]]:
    """Yield what each kind of elements adds to the momenta of rigid motions and of displacements."""
    modes, steps = rigid.reshape(-1, 3, 6), moved.reshape(-1, 3, moved.shape[1])
    for material, part in parts:
        shapes = np.einsum("gk,ekxr->egxr", part.values, modes[part.elements], optimize=True)
        weighted = material.density * shapes * part.volumes[..., None, None]
        motion = np.einsum("gk,ekxn->egxn", part.values, steps[part.elements], optimize=True)
        yield (
            np.einsum("egxr,egxs->rs", weighted, shapes, optimize=True),
            np.einsum("egxr,egxn->rn", weighted, motion, optimize=True),
        )


def solid_of(source: str, labels: Integers, points: Array, cells: Mapping[str, Integers]) -> Solid:
    """Return the solid elements of a mesh, by node numbers.

    Raises
    ------
    UserError
        If it has none, or an element names a node that it has not.
    """
    order = np.argsort(labels)
    found = {}
    for kind, elements in cells.items():
        if kind in KINDS:
            place = np.minimum(np.searchsorted(labels, elements, sorter=order), len(labels) - 1)
            found[kind] = order[place]
            if len(missing := elements[labels[found[kind]] != elements]):
                raise UserError(f"{source}: elements name the node {missing[0]}, which it does not have")
    if not found:
        held = ", ".join(cells) or "none"
        raise UserError(
            f"{source} has no solid elements ({held}), so temperatures give no displacements: name by mesh a "
            f"deck with elements ({', '.join(KINDS)}), or let the program that has them compute displacements"
        )
    return Solid(source, points, found)
