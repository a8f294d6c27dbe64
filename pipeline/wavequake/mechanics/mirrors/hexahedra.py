"""Quadratic hexahedra with 20 nodes: element matrices of linear elasticity, assembled; SI units.

The nodes of an element are ordered as in CalculiX (C3D20) and VTK: the 8 corners, bottom before top and each
counter-clockwise, then the middles of the bottom, top and upright edges. The degree of freedom of node k in
direction d is 3 k + d.

By default the stiffness is integrated with 2x2x2 Gauss points, which keeps thin plates from locking, and the
mass with 3x3x3: eight points would leave the mass matrix singular.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csc_array, eye_array, kron

from wavequake.errors import UserError
from wavequake.mechanics.mirrors.material import Material

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

CORNERS = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], dtype=float)
EDGES = np.array([[0, -1], [1, 0], [0, 1], [-1, 0]], dtype=float)


def _level(plane: Array, height: float) -> Array:
    return np.column_stack([plane, np.full(len(plane), height)])


# Natural coordinates of the 20 nodes.
NATURAL = np.concatenate(
    [_level(CORNERS, -1), _level(CORNERS, 1), _level(EDGES, -1), _level(EDGES, 1), _level(CORNERS, 0)]
)
# Places of the 8 nodes of the faces at the natural heights -1 and 1, in the order of CORNERS and EDGES.
BOTTOM = np.array([0, 1, 2, 3, 8, 9, 10, 11])
TOP = np.array([4, 5, 6, 7, 12, 13, 14, 15])


def serendipity(natural: Array, points: Array) -> tuple[Array, Array]:
    """Return the quadratic shape functions of nodes on the edges of a square or cube, and their gradients.

    Parameters
    ----------
    natural : ndarray, shape (k, d)
        Natural coordinates of the nodes, each -1, 0 or 1.
    points : ndarray, shape (g, d)
        Where to evaluate.

    Returns
    -------
    values : ndarray, shape (g, k)
    gradients : ndarray, shape (g, k, d)
        By natural coordinates.
    """
    node, x = natural[None], points[:, None, :]
    middle = node == 0
    corner = ~middle.any(axis=2)
    factor = np.where(middle, 1 - x**2, (1 + node * x) / 2)
    slope = np.where(middle, -2 * x, node / 2)
    # A corner has a further factor, which is zero at the middles of its edges.
    further = np.where(corner, (node * x).sum(axis=2) - (natural.shape[1] - 1), 1.0)
    values = factor.prod(axis=2) * further
    gradients = np.empty((*values.shape, natural.shape[1]))
    for axis in range(natural.shape[1]):
        others = np.delete(factor, axis, axis=2).prod(axis=2)
        gradients[:, :, axis] = others * (
            slope[:, :, axis] * further + factor[:, :, axis] * np.where(corner, node[:, :, axis], 0.0)
        )
    return values, gradients


def gauss_points(per_axis: int, dimensions: int) -> tuple[Array, Array]:
    """Return the points (g, d) and weights (g,) of the tensor-product Gauss-Legendre rule on [-1, 1]^d."""
    nodes, weights = np.polynomial.legendre.leggauss(per_axis)
    points = np.stack(np.meshgrid(*[nodes] * dimensions, indexing="ij"), axis=-1)
    products = np.stack(np.meshgrid(*[weights] * dimensions, indexing="ij"), axis=-1)
    return points.reshape(-1, dimensions), products.reshape(-1, dimensions).prod(axis=1)


def _geometry(nodes: Array, elements: Integers, per_axis: int) -> tuple[Array, Array, Array]:
    """Values (g, 20), gradients by x, y, z (e, g, 20, 3) and volumes (e, g) at the Gauss points."""
    if not np.isfinite(nodes).all():
        raise UserError(f"node {int(np.argmin(np.isfinite(nodes).all(axis=1)))} of the mesh is not finite")
    points, weights = gauss_points(per_axis, 3)
    values, natural_gradients = serendipity(NATURAL, points)
    jacobians = np.einsum("gkn,ekx->egnx", natural_gradients, nodes[elements], optimize=True)
    determinants = np.linalg.det(jacobians)
    if not (determinants > 0).all():
        worst = int(np.argmin(determinants.min(axis=1)))
        raise UserError(
            f"element {worst} of the mesh is folded or flat (its Jacobian determinant is "
            f"{determinants[worst].min():.3g}); its nodes must be distinct and in the order of C3D20"
        )
    gradients = np.linalg.solve(jacobians[:, :, None], natural_gradients[None, ..., None])[..., 0]
    return values, gradients, determinants * weights


def stiffness_matrices(nodes: Array, elements: Integers, material: Material, per_axis: int = 2) -> Array:
    """Return the stiffness matrices of all elements, shape (e, 60, 60).

    Parameters
    ----------
    nodes : ndarray, shape (N, 3)
    elements : ndarray of int, shape (e, 20)
    material : Material
    per_axis : int
        Gauss points per axis: 2 (as C3D20R of CalculiX) or 3 (as C3D20).

    Raises
    ------
    UserError
        If an element is folded.
    """
    _, gradients, volumes = _geometry(nodes, elements, per_axis)
    count, points = volumes.shape
    flat = (gradients * np.sqrt(volumes)[..., None, None]).reshape(count, points, 60)
    # products[e, i, a, j, b]: integral of dN_i/dx_a dN_j/dx_b, of which isotropic elasticity takes sums.
    products = (flat.transpose(0, 2, 1) @ flat).reshape(count, 20, 3, 20, 3)
    first, shear = material.lame
    matrices = first * products + shear * products.transpose(0, 1, 4, 3, 2)
    laplacian = shear * np.trace(products, axis1=2, axis2=4)
    for axis in range(3):
        matrices[:, :, axis, :, axis] += laplacian
    return matrices.reshape(count, 60, 60)


def mass_matrices(nodes: Array, elements: Integers, density: float, per_axis: int = 3) -> Array:
    """Return the elements' mass in one direction, shape (e, 20, 20); arguments as `stiffness_matrices`."""
    values, _, volumes = _geometry(nodes, elements, per_axis)
    return np.asarray(np.einsum("eg,gi,gj->eij", density * volumes, values, values, optimize=True))


def _scatter(matrices: Array, places: Integers, size: int) -> csc_array:
    """Sum element matrices (e, k, k) into a sparse symmetric matrix; `places` (e, k) are rows and columns."""
    rows = np.broadcast_to(places[:, :, None], matrices.shape)
    columns = np.broadcast_to(places[:, None, :], matrices.shape)
    total = coo_array((matrices.ravel(), (rows.ravel(), columns.ravel())), shape=(size, size)).tocsc()
    # The order of summation differs between the triangles: make them equal to the last bit.
    return csc_array((total + total.T) / 2)


def assemble(
    nodes: Array, elements: Integers, material: Material, stiffness_points: int = 2, mass_points: int = 3
) -> tuple[csc_array, csc_array]:
    """Return the mass and the stiffness matrix of a mesh, shape (3 N, 3 N) each.

    Parameters
    ----------
    nodes : ndarray, shape (N, 3)
    elements : ndarray of int, shape (e, 20)
    material : Material
    stiffness_points, mass_points : int
        Gauss points per axis.
    """
    dofs = (3 * elements[:, :, None] + np.arange(3)).reshape(len(elements), 60)
    stiffness = _scatter(
        stiffness_matrices(nodes, elements, material, stiffness_points), dofs, 3 * len(nodes)
    )
    scalar = _scatter(mass_matrices(nodes, elements, material.density, mass_points), elements, len(nodes))
    return csc_array(kron(scalar, eye_array(3), format="csc")), stiffness


def lumped_areas(nodes: Array, facets: Integers) -> Array:
    """Return positive shares of the area of a surface of 8-node quadrilaterals per node, shape (N,), sum 1.

    The area of a facet is shared in proportion to the diagonal of its mass matrix (Hinton, Rock, Zienkiewicz
    1976): the integrals of the shape functions themselves are negative at the corners.

    Parameters
    ----------
    nodes : ndarray, shape (N, 2)
        The nodes, projected onto the plane in which areas count.
    facets : ndarray of int, shape (f, 8)
    """
    points, weights = gauss_points(3, 2)
    values, gradients = serendipity(np.concatenate([CORNERS, EDGES]), points)
    jacobians = np.einsum("gkn,fkx->fgnx", gradients, nodes[facets], optimize=True)
    areas = np.abs(np.linalg.det(jacobians)) * weights
    diagonal = areas @ values**2
    shares = areas.sum(axis=1, keepdims=True) * diagonal / diagonal.sum(axis=1, keepdims=True)
    total = np.bincount(facets.ravel(), shares.ravel(), minlength=len(nodes))
    return np.asarray(total / total.sum())
