"""The modal model of a segmented telescope: wavefronts of small motions without tracing a ray.

What is linear in the optical path difference (OPD) of the rays (Zernike coefficients, line of sight,
centroid) is one matrix product per batch of motions (Störkle 2018, Eq. 4.21), and the mean square of the OPD
over the rays a quadratic form per segment, so that no ray is ever formed. Second derivatives bound the error
for motions of a given size. `modal_derivatives.modal_model` makes the model.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

RIGID = 6  # local degrees of freedom 0 to 5 are dx ... rz, and 5 + j is the figure's Noll term j
COMMON = 4  # M2's rx and ry, field x and y: what moves all rays


class Layout(NamedTuple):
    """Where the linear outputs stand in a row."""

    zernike: slice
    los: slice
    centroid: slice
    mean: int
    plane: slice
    static: int
    cross: slice
    width: int


def layout_of(terms: int) -> Layout:
    """Return where the outputs of J Zernike terms stand."""
    return Layout(
        zernike=slice(0, terms),
        los=slice(terms, terms + 2),
        centroid=slice(terms + 2, terms + 4),
        mean=terms + 4,
        plane=slice(terms + 5, terms + 8),
        static=terms + 8,
        cross=slice(terms + 9, terms + 9 + COMMON),
        width=terms + 9 + COMMON,
    )


@dataclass(frozen=True)
class ModalModel:
    """What the numbers of a wavefront follow from, for motions q (D, S) and common motions g (4,); mm, rad.

    Attributes
    ----------
    dofs : tuple of int, length D
        Local degrees of freedom of the segments: 0 to 5 for dx ... rz, 5 + j for Noll term j of the figure.
    terms : int
        Number J of Zernike terms.
    rest : ndarray, shape (P,)
        Outputs at rest: J Zernike coefficients in waves, then zeros for line of sight and centroid, the mean
        OPD, the coefficients of its plane in waves, and what the quadratic form needs.
    columns : ndarray, shape (D S + 4, P)
        Their derivatives.
    square : ndarray, shape (D, D, S)
        Mean square over the rays, in waves^2, that q_i q_j of a segment adds; zero below the diagonal.
    common : ndarray, shape (4, 4)
        The same of the common motions.
    rest_square : float
        Mean square of the OPD at rest.
    plane_normal : ndarray, shape (3, 3)
        Mean square of a plane is c^T N c.
    curvature : ndarray, shape (D + 4, D + 4)
        Rms over the rays of the second derivatives of the OPD, waves.
    clearance : float
        Distance in mm of the ray nearest to the edge of its segment.
    radius : float
        Of the largest segment, mm.
    """

    dofs: tuple[int, ...]
    terms: int
    rest: Array
    columns: Array
    square: Array
    common: Array
    rest_square: float
    plane_normal: Array
    curvature: Array
    clearance: float
    radius: float


@dataclass(frozen=True)
class Forms:
    """Wavefronts by their linear and quadratic parts, so that a motion can be scaled afterwards.

    Attributes
    ----------
    linear : ndarray, shape (..., P)
        Change of the outputs; proportional to the motion.
    quadratic : ndarray, shape (...)
        Mean square of the change of the OPD, waves^2; proportional to the square of the motion.
    """

    linear: Array
    quadratic: Array


@dataclass(frozen=True)
class ModalWavefront:
    """As `wavefront.Wavefront`: the numbers that the modal model knows, in waves and mm.

    Line of sight and centroid are relative to rest.
    """

    zernike: Array
    rms: Array
    rms_raw: Array
    rms_flat: Array
    los: Array
    centroid: Array


def forms(model: ModalModel, motions: Array, rows: int) -> Forms:
    """Return the linear and quadratic parts of the wavefronts of a batch of motions.

    Parameters
    ----------
    model : ModalModel
    motions : ndarray, shape (B, D S + 4)
        Of all segments in each local degree of freedom, then the common ones; mm and rad.
    rows : int
        B is a whole number of tiles of this many rows. Products have constant shapes, so that the bits of a
        row depend on its place in its tile and on nothing else.
    """
    tiles = motions.reshape(-1, rows, motions.shape[1])
    linear = np.matmul(tiles, model.columns).reshape(len(motions), -1)
    count, segments = len(model.dofs), model.square.shape[2]
    local, common = tiles[..., :-COMMON], motions[:, -COMMON:]
    parts = [local[..., i * segments : (i + 1) * segments] for i in range(count)]
    quadratic = np.zeros(len(motions))
    for i in range(count):
        for j in range(i, count):
            quadratic += np.matmul(parts[i] * parts[j], model.square[i, j, :, None]).ravel()
    cross = linear[:, layout_of(model.terms).cross]
    own = np.sum(common[:, :, None] * model.common * common[:, None, :], axis=(1, 2))
    return Forms(linear, quadratic + 2.0 * np.sum(common * cross, axis=1) + own)


def scaled(found: Forms, history: Array) -> Forms:
    """Return motions (B, ...) that follow a common history (n,), as forms of shape (B, n, ...)."""
    return Forms(found.linear[:, None, :] * history[:, None], found.quadratic[:, None] * history**2)


def wavefronts(model: ModalModel, found: Forms) -> ModalWavefront:
    """Return the numbers of the wavefronts, shape (..., ) and (..., J) or (..., 2)."""
    places, linear = layout_of(model.terms), found.linear
    zernike = model.rest[places.zernike] + linear[..., places.zernike]
    plane = model.rest[places.plane] + linear[..., places.plane]
    mean = model.rest[places.mean] + linear[..., places.mean]
    square = model.rest_square + 2.0 * linear[..., places.static] + found.quadratic
    of_plane = _form(plane, model.plane_normal)
    return ModalWavefront(
        zernike=zernike,
        rms=np.sqrt(np.einsum("...j,...j->...", zernike[..., 3:], zernike[..., 3:])),
        rms_raw=np.sqrt(np.maximum(square - mean**2, 0.0)),
        rms_flat=np.sqrt(np.maximum(square - of_plane, 0.0)),
        los=linear[..., places.los],
        centroid=linear[..., places.centroid],
    )


def _form(vectors: Array, matrix: Array) -> Array:
    """Return v^T A v of vectors (..., n) by a small symmetric matrix; bits depend on each vector alone."""
    parts = np.moveaxis(vectors, -1, 0)
    total = np.zeros(vectors.shape[:-1])
    for i, one in enumerate(parts):
        total += matrix[i, i] * one * one
        for j in range(i):
            total += 2.0 * matrix[i, j] * one * parts[j]
    return total


def amplitudes(model: ModalModel, motions: Array) -> Array:
    """Return the largest size (B, D + 4) of each kind of motion over the segments; mm and rad."""
    segments = model.square.shape[2]
    local = np.abs(motions[:, :-COMMON]).reshape(len(motions), len(model.dofs), segments).max(axis=2)
    return np.concatenate([local, np.abs(motions[:, -COMMON:])], axis=1)


def error_bound(model: ModalModel, sizes: Array) -> Array:
    """Return a bound (B,) of the rms over the rays, in waves, of what the model leaves out.

    It is that of the second-order term, by the triangle inequality, for motions of `amplitudes` (B, D + 4),
    and infinite where a ray may leave its segment. Third order is to second order as that is to the first.
    """
    bound = 0.5 * np.sum(sizes[:, :, None] * model.curvature * sizes[:, None, :], axis=(1, 2))
    per_unit = [1.0 if dof < 3 or dof >= RIGID else model.radius for dof in model.dofs]
    field = sizes[:, -2:].sum(axis=1) * model.radius
    wander = sizes[:, :-COMMON] @ np.array(per_unit) + field
    return np.where(wander < model.clearance, bound, np.inf)
