"""Weighted linear least squares over rays: once for all instants, and anew for an instant that lost rays."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.kernels.device.devices import NUMPY, Device
from wavequake.kernels.sums.ray_sums import ray_coefficients
from wavequake.optics.checks import alike, number, whole
from wavequake.optics.polynomials.zernike import MOST_TERMS, annular_zernike
from wavequake.prepared import prepared

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Smallest rms on the glass of combined polynomials with unit rms over the pupil (TMT: 0.59, JWST: 0.15).
_LEAST_RMS_ON_GLASS = 0.03
_FARTHEST = 2.0  # places of rays in units of the pupil's radius; beyond, they are most likely in mm
_SINGULAR = 1e-10  # smallest eigenvalue of a normal matrix, relative to its size, that is still solved


@dataclass(frozen=True)
class Fit:
    """A weighted least-squares fit of functions to values at rays.

    Attributes
    ----------
    basis : ndarray, shape (N, J)
        The functions at the rays.
    weight : ndarray, shape (N,)
    matrix : ndarray, shape (J, N)
        Values to coefficients; cannot be written.
    normal : ndarray, shape (J, J)
        basis^T W basis, from which an instant that lost rays subtracts theirs.
    """

    basis: Array
    weight: Array
    matrix: Array
    normal: Array


MORE_RAYS = "raise optics.rays"
_SPREAD_RAYS = "they lie on each other or on a line: spread them over the whole pupil"
MORE_SEGMENT_RAYS = "raise optics.rays_per_segment (or, for a sunflower, optics.rays)"


def weighted_fit(basis: Array, weight: Array, remedy: str = MORE_RAYS) -> Fit:
    """Return the fit of `basis` (N, J) with positive weights (N,); `remedy` says how there are more rays.

    Raises
    ------
    UserError
        If the rays do not determine all coefficients.
    """
    rays, terms = basis.shape
    root = np.sqrt(weight)[:, None]
    if rays >= terms:
        q, r = np.linalg.qr(root * basis)
        diagonal = np.abs(np.diag(r))
        if diagonal.min() > np.sqrt(_SINGULAR) * diagonal.max():
            normal = basis.T @ (weight[:, None] * basis)
            matrix = np.linalg.solve(r, (root * q).T)
            matrix.flags.writeable = False
            return Fit(basis, weight, matrix, normal)
    raise UserError(
        f"{rays} rays do not determine {terms} wavefront terms; {remedy}, or lower zernike_terms."
    )


def pupil_fit(x: Array, y: Array, weight: Array, terms: int, obscuration: float) -> Fit:
    """Return the fit of Noll Zernike polynomials to rays of a whole pupil; all its fields share one.

    Parameters
    ----------
    x, y, weight : ndarray, shape (N,)
        Rays in units of the pupil's radius, and positive shares of the light of any scale.
    terms : int
        Number of polynomials: up to 2016 as far as the rays tell them apart, for which an even spread needs
        2 rays per term at j = 231, 3 at 496, 4 at 990 and 5 at 2016.
    obscuration : float

    Raises
    ------
    UserError
        If the arrays are not alike, a weight is not positive or a ray far from the pupil, there are too many
        terms or too few rays, or they lie so that some combination of the polynomials nearly vanishes at
        them: its coefficient would be noise.
    """
    x, y, weight = alike("the rays in the pupil and their weights", x, y, weight)
    if not (np.isfinite(weight) & (weight > 0.0)).all():
        raise UserError("the weights of the rays must all be positive numbers")
    if not ((np.abs(x) <= _FARTHEST) & (np.abs(y) <= _FARTHEST)).all():
        raise UserError("the rays must lie in the pupil, at places in units of its radius (not mm, not NaN)")
    terms, obscuration = whole(terms, "the number of Zernike terms"), number(obscuration, "the obscuration")
    if not 1 <= terms <= MOST_TERMS:
        raise UserError(f"the number of Zernike terms is {terms}; it must be from 1 to {MOST_TERMS}")
    # A power of two changes no bits, and keeps the sum from overflowing.
    scaled = np.ldexp(weight, -np.frexp(np.max(weight, initial=0.0))[1])
    return _pupil_fit(x.tobytes(), y.tobytes(), (scaled / np.sum(scaled)).tobytes(), terms, obscuration)


@prepared(maxsize=1)
def _pupil_fit(x: bytes, y: bytes, weight: bytes, terms: int, obscuration: float) -> Fit:
    places, shares = np.stack([np.frombuffer(x), np.frombuffer(y)]), np.frombuffer(weight)
    basis = annular_zernike(places[0], places[1], terms, obscuration)
    remedy = MORE_RAYS if len(shares) < terms or _apart(places) else _SPREAD_RAYS
    fit = weighted_fit(basis, shares, remedy)
    least = _least_rms(fit)
    if least < _LEAST_RMS_ON_GLASS:
        raise UserError(
            f"{len(shares)} rays are too few for {terms} wavefront terms: a combination of them is "
            f"{1.0 / max(least, 1e-9):.2g} times larger between the rays than at them; {remedy}, or lower "
            "zernike_terms."
        )
    return fit


def _apart(places: Array) -> bool:
    """Return whether rays at `places` (2, N) are all at different ones, and not all on one line."""
    across = np.linalg.svd(places - places.mean(axis=1, keepdims=True), compute_uv=False)[-1]
    return bool(across > np.sqrt(_SINGULAR)) and np.unique(places, axis=1).shape == places.shape


def _least_rms(fit: Fit) -> float:
    """Return the smallest rms at the rays of combined polynomials with unit rms over the pupil."""
    return float(np.sqrt(max(np.linalg.eigvalsh(fit.normal)[0], 0.0)))


def tells_apart(fit: Fit, kept: Mask) -> bool:
    """Return whether polynomials with unit rms over the pupil have no combination that vanishes at some rays.

    Parameters
    ----------
    fit : Fit
    kept : ndarray of bool, shape (N,)
        Which rays; as `well_determined` asks of all.
    """
    basis, weight = fit.basis[kept], fit.weight[kept, None] / fit.weight[kept].sum()
    return _least_rms(replace(fit, normal=basis.T @ (weight * basis))) >= _LEAST_RMS_ON_GLASS


def well_determined(fit: Fit) -> Fit:
    """Return the fit of polynomials with unit rms over the pupil, if the glass tells them apart.

    Raises
    ------
    UserError
        If some combination of them nearly vanishes on the glass: its coefficients would be noise, and their
        sum of squares would say nothing of the wavefront.
    """
    least = _least_rms(fit)
    if least < _LEAST_RMS_ON_GLASS:
        raise UserError(
            f"{fit.basis.shape[1]} Zernike terms are too many for the glass of this pupil: a combination of "
            f"them is {1.0 / max(least, 1e-9):.2g} times larger beside the glass than on it; lower "
            "wavefront.zernike_terms, or raise optics.rays_per_segment. The pupil is the annulus about the "
            "telescope's axis, of which the glass must not leave out too much."
        )
    return fit


def refit(fit: Fit, kept: Mask, values: Array) -> Array:
    """Return the coefficients (J,) for one instant without its lost rays.

    Parameters
    ----------
    fit : Fit
    kept : ndarray of bool, shape (N,)
        Which rays are left.
    values : ndarray, shape (N,)
        Zero where a ray is lost.

    Returns
    -------
    ndarray, shape (J,)
        NaN if the rays that are left do not determine the coefficients.
    """
    return _refit(fit, kept, values)[0]


def _refit(fit: Fit, kept: Mask, values: Array) -> tuple[Array, Array]:
    """Return as `refit` does, and the normal matrix (J, J) of the rays that are left."""
    gone = fit.basis[~kept]
    normal = fit.normal - gone.T @ (fit.weight[~kept, None] * gone)
    if np.linalg.eigvalsh(normal)[0] < _SINGULAR * np.trace(fit.normal):
        return np.full(len(normal), np.nan), normal
    found = np.linalg.solve(normal, fit.basis.T @ (fit.weight * values))
    return np.asarray(found, dtype=np.float64), normal


def fit_instants(fit: Fit, values: Array, device: Device = NUMPY) -> Array:
    """Return coefficients (T, J) of values (T, N); lost rays (NaN) are left out of an instant's fit."""
    return _fit_instants(fit, values, device)[0]


def fit_with_plane(fit: Fit, values: Array, device: Device = NUMPY) -> tuple[Array, Array]:
    """Return coefficients (T, J), and those (T, 2) of j = 2 and 3 where the plane is fitted by itself.

    Polynomials are not orthogonal at rays: the best plane is another one than that of a fit of more terms.

    Parameters
    ----------
    fit : Fit
        Of Noll Zernike polynomials, of which the first three are the plane.
    values : ndarray, shape (T, N)
        Lost rays (NaN) are left out of an instant's fit.
    device : Device
    """
    coefficients, normals = _fit_instants(fit, values, device)
    plane = _plane(fit.normal, coefficients)
    for instant, normal in normals.items():  # NaN stays what too few rays do not determine
        plane[instant] = _plane(normal, coefficients[instant])
    return coefficients, plane


def _plane(normal: Array, coefficients: Array) -> Array:
    """Return the slopes (..., 2) of the best plane, which takes a part of the other coefficients (..., J)."""
    others = np.linalg.solve(normal[:3, :3], normal[:3, 3:])[1:]
    # A sum of each instant by itself, whose bits do not depend on the others.
    slopes: Array = coefficients[..., 1:3] + np.sum(coefficients[..., None, 3:] * others, axis=-1)
    return slopes


def _fit_instants(fit: Fit, values: Array, device: Device) -> tuple[Array, dict[int, Array]]:
    """Return coefficients (T, J), and the normal matrices of instants that lost rays but not too many."""
    coefficients, lost = ray_coefficients(fit.matrix, values, device)
    normals = {}
    for instant in np.flatnonzero(lost):
        at_rays = values[instant]  # which may lie on a device
        ok = np.isfinite(at_rays)
        coefficients[instant], normal = _refit(fit, ok, np.where(ok, at_rays, 0.0))
        if np.isfinite(coefficients[instant, 0]):
            normals[int(instant)] = normal
    return coefficients, normals


def fit_tile(fit: Fit, values: Array, ok: Mask | None) -> Array:
    """Return coefficients (J, n) of values (N, n), of which `ok` (N, n) are known, or all: of a tile."""
    known = values if ok is None else np.where(ok, values, 0.0)
    coefficients: Array = fit.matrix @ known
    if ok is None:
        return coefficients
    for lane in np.flatnonzero(~ok.all(axis=0)):
        coefficients[:, lane] = refit(fit, ok[:, lane], known[:, lane])
    return coefficients


def segment_planes(
    x: Array, y: Array, weight: Array, segment: NDArray[np.int64], centers: Array
) -> tuple[Array, Mask]:
    """Fit a plane on every segment: piston at the center and slopes.

    The 3 x 3 normal equations of all segments are solved at once, in coordinates scaled to the rms radius of
    each segment's rays. A ray of weight zero is as good as absent.

    Parameters
    ----------
    x, y, weight : ndarray, shape (N,)
        Rays; lengths in mm.
    segment : ndarray of int, shape (N,)
        Which segment each ray meets.
    centers : ndarray, shape (S, 2)
        Where the piston is taken, mm.

    Returns
    -------
    rows : ndarray, shape (3, N)
        What a unit value at a ray adds to piston (1), slope in x and slope in y (1/mm) of its segment.
    solved : ndarray of bool, shape (S,)
        False for a segment whose rays do not determine a plane; its rows mean nothing.
    """
    count = len(centers)
    offset = np.stack([x, y]) - centers[segment].T
    total = np.bincount(segment, weight, count)
    spread = np.bincount(segment, weight * np.sum(offset**2, axis=0), count)
    scale = np.sqrt(np.divide(spread, total, out=np.ones(count), where=(total > 0.0) & (spread > 0.0)))
    design = np.concatenate([np.ones((1, len(x))), offset / scale[segment]])
    normal = np.empty((count, 3, 3))
    for i in range(3):
        for j in range(i + 1):
            normal[:, i, j] = np.bincount(segment, weight * design[i] * design[j], count)
            normal[:, j, i] = normal[:, i, j]
    eigenvalues = np.linalg.eigvalsh(normal)
    solved: Mask = eigenvalues[:, 0] > _SINGULAR * np.maximum(eigenvalues[:, 2], np.finfo(float).tiny)
    normal[~solved] = np.eye(3)
    inverse = np.linalg.inv(normal)
    inverse[:, 1:] /= scale[:, None, None]
    rows: Array = np.sum(inverse[segment] * (weight * design).T[:, None, :], axis=2).T
    return rows, solved
