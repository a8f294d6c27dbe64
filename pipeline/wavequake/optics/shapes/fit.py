"""From displacements of a surface's nodes to Zernike coefficients of its figure (Störkle 2018, 4.2.2).

A node at (x, y) of the undeformed surface z_ref that moves by u stands ``u_z - (z_ref(x + u_x, y + u_y) -
z_ref(x, y))`` above the undeformed surface. These heights, or their linear part ``u_z - grad z_ref . u_xy``,
are fitted by weighted least squares (Eq. 4.8 to 4.10), by one QR factorization for all instants. The linear
fit of modes times their amplitudes is the fit of the motion: the modal way costs one small matrix product.

Lengths in mm in the surface's frame, displacements (batch, p, 3), rotations in rad about the vertex.
"""

from dataclasses import dataclass

import numpy as np
import scipy  # its parts load when first used
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.optics.polynomials.zernike import annular_zernike
from wavequake.optics.segments.kinematics import cardan
from wavequake.optics.shapes.sag import shape_sag
from wavequake.optics.shapes.shapes import GridDeformation, Shape

Array = NDArray[np.float64]

BLOCK = 64
"""Instants per matrix product; padded with zeros, so that no instant's bits depend on the others."""

ILL_CONDITIONED = 1e6
"""Condition number of the weighted polynomials from which on their coefficients mean nothing."""

_OUTSIDE = 1e-6  # of the pupil radius: round-off of a mesh, not a node beside the pupil
_GLOBAL_SPLINE = 3000  # nodes up to which one thin plate spans all of them


@dataclass(frozen=True)
class SurfaceFit:
    """A weighted least-squares fit of Zernike polynomials at the nodes of one surface.

    Attributes
    ----------
    nodes : ndarray, shape (p, 3)
        On the undeformed surface, mm.
    shape : Shape
        The undeformed surface.
    slopes : ndarray, shape (p, 2)
        Its derivatives in x and y at the nodes.
    weights : ndarray, shape (p,)
        Shares of the area, sum 1.
    basis : ndarray, shape (p, terms)
        Noll polynomials j = 1.. at the nodes.
    projection : ndarray, shape (terms, p)
        Heights to coefficients.
    condition : float
        Condition number of the weighted polynomials.
    rigid : ndarray, shape (3 p, 6)
        Displacements under unit rigid motions dx, dy, dz, rx, ry, rz about the vertex.
    pose_projection : ndarray, shape (6, 3 p)
        Displacements to the best rigid motion.
    """

    nodes: Array
    shape: Shape
    slopes: Array
    weights: Array
    basis: Array
    projection: Array
    condition: float
    rigid: Array
    pose_projection: Array


def surface_fit(
    nodes_xy: Array, weights: Array, terms: int, radius: float, obscuration: float, shape: Shape
) -> SurfaceFit:
    """Prepare the fit of Noll Zernike polynomials j = 1..terms to the figure of a surface.

    Parameters
    ----------
    nodes_xy : ndarray, shape (p, 2)
        Undeformed nodes, mm.
    weights : ndarray, shape (p,)
        Positive shares of the area (Störkle 2018, W of Eq. 4.10); any scale.
    terms : int
        231 are practical on a circle, 105 on an annulus.
    radius, obscuration : float
        Outer radius of the pupil in mm and inner over outer radius.
    shape : Shape
        The undeformed surface.

    Raises
    ------
    UserError
        For no nodes or fewer nodes than terms, nodes outside the pupil or beyond the shape, weights that are
        not positive, and nodes that do not tell the polynomials apart (with the condition number).
    """
    _require(nodes_xy, weights, terms, radius, obscuration)
    x, y = nodes_xy.T
    z, slope_x, slope_y = shape_sag(shape, x, y)
    beyond = ~np.isfinite(z + slope_x + slope_y)
    if beyond.any():
        raise UserError(f"{beyond.sum()} of {len(x)} optical nodes lie where the surface does not reach")
    weights = weights / weights.sum()
    basis = annular_zernike(x / radius, y / radius, terms, obscuration)
    projection, condition = _least_squares(basis, weights)
    if condition > ILL_CONDITIONED:
        raise UserError(
            f"the fit of {terms} Zernike terms to {len(x)} optical nodes is ill-conditioned (condition "
            f"number {condition:.1e}); take at most {max(len(x) // 4, 1)} terms, or a finer mesh"
        )
    nodes = np.column_stack([x, y, z])
    rigid = _rigid(nodes)
    scale = np.array([1.0, 1.0, 1.0, radius, radius, radius])  # rotations as displacements of the rim
    pose, pose_condition = _least_squares(rigid / scale, np.repeat(weights, 3))
    if pose_condition > ILL_CONDITIONED:
        raise UserError("the optical nodes lie on one line, so that their rotation about it is unknown")
    slopes = np.column_stack([slope_x, slope_y])
    return SurfaceFit(
        nodes, shape, slopes, weights, basis, projection, condition, rigid, pose / scale[:, None]
    )


def heights(fit: SurfaceFit, displacements: Array, linear: bool = True) -> Array:
    """Return how far the nodes stand above the undeformed surface, mm, shape (batch, p).

    Parameters
    ----------
    fit : SurfaceFit
    displacements : ndarray, shape (batch, p, 3)
        mm.
    linear : bool
        Neglect what is quadratic in the displacements. Otherwise z_deform of Störkle 2018, Eq. 4.8, with the
        undeformed surface taken at the displaced x and y (DeformOnlyTrafo).

    Raises
    ------
    UserError
        If the displacements do not fit the nodes or are not finite, or a node moves beyond the shape.
    """
    _require_displacements(fit, displacements)
    result = np.empty(displacements.shape[:2])
    for start in range(0, len(displacements), BLOCK):  # a block stays in the cache
        u_x, u_y, u_z = np.moveaxis(displacements[start : start + BLOCK], 2, 0)
        if linear:
            above = u_z - fit.slopes[:, 0] * u_x - fit.slopes[:, 1] * u_y
        else:
            x, y, z = fit.nodes.T
            above = u_z - (shape_sag(fit.shape, x + u_x, y + u_y)[0] - z)
        result[start : start + BLOCK] = above
    if not np.isfinite(result).all():
        raise UserError("a displaced optical node lies where the undeformed surface does not reach")
    return result


def coefficients(fit: SurfaceFit, above: Array) -> Array:
    """Return the Zernike coefficients of `heights`, mm, shape (batch, terms) (Störkle 2018, Eq. 4.10)."""
    return _product(fit.projection, above)


def apply(fit: SurfaceFit, displacements: Array, linear: bool = True) -> Array:
    """Return the Zernike coefficients of displacements (batch, p, 3), mm, shape (batch, terms).

    With modes as the batch and `linear` this is the modal map: amplitudes (time, modes) times it are the
    coefficients at every instant.

    Raises
    ------
    UserError
        As `heights`.
    """
    return coefficients(fit, heights(fit, displacements, linear))


def separate_pose(fit: SurfaceFit, displacements: Array, linear: bool = True) -> tuple[Array, Array]:
    """Split displacements into the best rigid motion and what is left of them in the moved frame.

    Parameters
    ----------
    fit : SurfaceFit
    displacements : ndarray, shape (batch, p, 3)
        mm.
    linear : bool
        Subtract the rigid motion; otherwise turn the displaced nodes back by the full rotation.

    Returns
    -------
    poses : ndarray, shape (batch, 6)
        dx, dy, dz in mm and Cardan angles rx, ry, rz in rad about the vertex: small motions.
    rest : ndarray, shape (batch, p, 3)

    Raises
    ------
    UserError
        If the displacements do not fit the nodes or are not finite.
    """
    _require_displacements(fit, displacements)
    poses = _product(fit.pose_projection, displacements.reshape(len(displacements), -1))
    if linear:
        return poses, displacements - _product(fit.rigid, poses).reshape(displacements.shape)
    back = fit.nodes + displacements - poses[:, None, :3]
    return poses, np.matmul(back, cardan(poses[:, 3:])) - fit.nodes


def relative_residual(fit: SurfaceFit, above: Array, fitted: Array) -> Array:
    """Return rms(fit - heights) / rms(heights) over the surface, shape (batch,) (Störkle 2018, Eq. 4.11).

    The rms is weighted by area; 0 where nothing is deformed.
    """
    left, whole = (np.sqrt(np.square(part) @ fit.weights) for part in (residual(fit, above, fitted), above))
    return np.divide(left, whole, out=np.zeros_like(whole), where=whole > 0.0)


def residual(fit: SurfaceFit, above: Array, fitted: Array) -> Array:
    """Return the heights at the nodes that the polynomials leave, mm, shape (batch, p)."""
    return above - _product(fit.basis, fitted)


def residual_grid(fit: SurfaceFit, left: Array, grid: GridDeformation) -> Array:
    """Interpolate heights that the polynomials leave on a grid, so that nothing is lost.

    Thin-plate splines go exactly through the heights at the nodes and on smoothly beyond the rim.

    Parameters
    ----------
    fit : SurfaceFit
    left : ndarray, shape (batch, p)
        Of `residual`, mm.
    grid : GridDeformation

    Returns
    -------
    ndarray, shape (batch, rows, columns)
        mm; rows along y, centered about the vertex.

    Raises
    ------
    UserError
        If the grid does not cover the nodes.
    """
    half_x, half_y = grid.dx * (grid.columns - 1) / 2.0, grid.dy * (grid.rows - 1) / 2.0
    reach = np.abs(fit.nodes[:, :2]).max(axis=0)
    if reach[0] > half_x or reach[1] > half_y:
        raise UserError(
            f"the residual grid reaches to x = {half_x:g} and y = {half_y:g} mm, the optical nodes to "
            f"{reach[0]:g} and {reach[1]:g} mm"
        )
    from scipy.interpolate import RBFInterpolator  # a quarter of a second, and few ask for grids

    x = np.linspace(-half_x, half_x, grid.columns)
    y = np.linspace(-half_y, half_y, grid.rows)
    places = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    near = None if len(fit.nodes) <= _GLOBAL_SPLINE else 100
    spline = RBFInterpolator(fit.nodes[:, :2], left.T, kernel="thin_plate_spline", neighbors=near)
    return np.ascontiguousarray(spline(places).T).reshape(len(left), grid.rows, grid.columns)


def normalized_modes(modes: Array) -> tuple[Array, Array]:
    """Return modes with unit rms of the nodes' displacements, and the rms they had (Störkle 2018, Eq. 2.12).

    Parameters
    ----------
    modes : ndarray, shape (modes, nodes, 3)

    Raises
    ------
    UserError
        If a mode is zero everywhere or not finite.
    """
    rms = np.sqrt(np.square(modes).sum(axis=(1, 2)) / modes.shape[1])
    bad = np.flatnonzero(~(np.isfinite(rms) & (rms > 0.0)))
    if len(bad):
        raise UserError(
            f"mode {bad[0] + 1} has an rms displacement of {rms[bad[0]]}; it cannot be normalized"
        )
    return modes / rms[:, None, None], rms


def _require(nodes_xy: Array, weights: Array, terms: int, radius: float, obscuration: float) -> None:
    count = len(nodes_xy)
    if count == 0:
        raise UserError("the optical surface has no nodes")
    if count < max(terms, 3):
        raise UserError(
            f"{count} optical nodes do not determine {terms} Zernike terms; about four per term do"
        )
    if weights.shape != (count,) or not (weights > 0.0).all() or not np.isfinite(weights).all():
        raise UserError(f"the weights of the {count} optical nodes must be {count} positive numbers")
    if not (radius > 0.0 and np.isfinite(radius)):
        raise UserError(f"the pupil radius of the surface fit is {radius} mm, it must be positive")
    if not np.isfinite(nodes_xy).all():
        raise UserError("an optical node has no finite coordinates")
    distance = np.hypot(*nodes_xy.T) / radius
    for bad, where in (
        (distance > 1.0 + _OUTSIDE, f"outside the pupil radius {radius:g} mm"),
        (distance < obscuration - _OUTSIDE, f"inside the inner pupil radius {obscuration * radius:g} mm"),
    ):
        if bad.any():
            worst = distance[bad].max() if distance[bad].max() > 1.0 else distance[bad].min()
            raise UserError(
                f"{int(bad.sum())} of {count} optical nodes lie {where}, the farthest at "
                f"{worst * radius:g} mm"
            )


def _require_displacements(fit: SurfaceFit, displacements: Array) -> None:
    shape = (len(fit.nodes), 3)
    if displacements.ndim != 3 or displacements.shape[1:] != shape:
        raise UserError(
            f"displacements have the shape {displacements.shape}, (batch, {shape[0]}, 3) is needed"
        )
    if not np.isfinite(displacements.sum()):
        raise UserError("a displacement of an optical node is not finite")


def _least_squares(basis: Array, weights: Array) -> tuple[Array, float]:
    """Return the matrix (terms, points) from values to coefficients, and the condition number."""
    root = np.sqrt(weights)[:, None]
    q, r = scipy.linalg.qr(root * basis, mode="economic")
    singular = np.linalg.svd(r, compute_uv=False)
    if singular[-1] <= np.finfo(float).eps * singular[0]:
        return np.zeros_like(basis.T), np.inf
    return np.ascontiguousarray(scipy.linalg.solve_triangular(r, (root * q).T)), float(
        singular[0] / singular[-1]
    )


def _rigid(nodes: Array) -> Array:
    """Return the displacements under unit rigid motions about the origin, shape (3 p, 6)."""
    turns = np.cross(np.eye(3)[None], nodes[:, None, :]).transpose(0, 2, 1)
    shifts = np.broadcast_to(np.eye(3), turns.shape)
    return np.concatenate([shifts, turns], axis=2).reshape(-1, 6)


def _product(matrix: Array, rows: Array) -> Array:
    """Apply a matrix (m, n) to each of the rows (batch, n), in blocks of `BLOCK`, the last one padded.

    The instants are the columns of the product, whose bits do not depend on their place among others.
    """
    result = np.empty((len(rows), len(matrix)))
    columns = np.zeros((matrix.shape[1], BLOCK))
    for start in range(0, len(rows), BLOCK):
        part = rows[start : start + BLOCK]
        columns[:, : len(part)] = part.T
        result[start : start + BLOCK] = (matrix @ columns)[:, : len(part)].T
    return result
