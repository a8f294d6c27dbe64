"""Phases of a sampled pupil from what a wavefront is known by: Zernike terms, rays or segments."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.imaging.pupils.pupil_function import PupilGrid
from wavequake.kernels.device.tiles import TILE
from wavequake.optics.polynomials.zernike import annular_zernike

Real = NDArray[np.float64]

# Rays per fitted term: fewer let a fit swing between the rays.
_RAYS_PER_TERM = 2


@dataclass(frozen=True)
class RayPhase:
    """A wavefront that was fitted to rays.

    Attributes
    ----------
    phase : ndarray, shape (batch, m)
        rad at the pupil's patches; NaN for an instant that has too few rays.
    residual : ndarray, shape (batch,)
        Root mean square over the rays of what the fit leaves, waves. A residual of e waves that is finer
        than the rays takes about (2π e)² of the image's peak.
    """

    phase: Real
    residual: Real


def zernike_phase(grid: PupilGrid, coefficients: Real, obscuration: float = 0.0) -> Real:
    """Return the phases of wavefronts that are sums of annular Zernike polynomials.

    Parameters
    ----------
    grid : PupilGrid
    coefficients : ndarray, shape (batch, J)
        Noll terms j = 1..J in waves.
    obscuration : float
        Inner over outer radius of the polynomials.

    Returns
    -------
    ndarray, shape (batch, m)
        2 pi OPD / wavelength at the pupil's patches, rad.
    """
    coefficients = np.asarray(coefficients, dtype=np.float64)
    if coefficients.ndim != 2 or not coefficients.shape[1]:
        raise UserError(f"Zernike coefficients have the shape (batch, terms), not {coefficients.shape}")
    modes = annular_zernike(grid.x, grid.y, coefficients.shape[1], obscuration)
    phase = np.empty((len(coefficients), grid.x.size))
    for first in range(0, len(coefficients), TILE):  # products of one shape: bits do not depend on the batch
        part = 2.0 * np.pi * coefficients[first : first + TILE]
        tile = np.pad(part, ((0, TILE - len(part)), (0, 0)))
        phase[first : first + TILE] = (tile @ modes.T)[: len(part)]
    return phase


def ray_phase(grid: PupilGrid, x: Real, y: Real, opd: Real, terms: int, obscuration: float = 0.0) -> RayPhase:
    """Fit annular Zernike polynomials to scattered rays and return the phases of the fit.

    A smooth wavefront is reproduced to its own content beyond the terms, which the residual tells.
    Wavefronts with steps (segments) are better imaged by `wavequake.imaging.engines.segment_basis.ray_basis`.

    Parameters
    ----------
    grid : PupilGrid
    x, y : ndarray, shape (R,)
        Places of the rays in units of the pupil's outer radius.
    opd : ndarray, shape (batch, R)
        Optical path differences in waves; NaN for a ray that is lost.
    terms : int
        Number of Noll terms; at least two rays for each are needed.
    obscuration : float
        Inner over outer radius of the polynomials.

    Raises
    ------
    UserError
        If the shapes do not fit, there are fewer than two rays per term, or the rays cannot tell the terms
        apart.
    """
    opd = np.asarray(opd, dtype=np.float64)
    if opd.ndim != 2 or x.shape != (opd.shape[1],) or y.shape != x.shape:
        raise UserError(f"rays at {x.shape} and {y.shape} need OPDs of shape (batch, rays), not {opd.shape}")
    if x.size < _RAYS_PER_TERM * terms:
        raise UserError(
            f"{x.size} rays cannot carry {terms} Zernike terms: trace at least {_RAYS_PER_TERM * terms}"
        )
    basis = annular_zernike(x, y, terms, obscuration)
    coefficients = np.full((len(opd), terms), np.nan)
    residual = np.full(len(opd), np.nan)
    patterns, members = np.unique(np.isfinite(opd), axis=0, return_inverse=True)
    for number, kept in enumerate(patterns):  # instants that lose the same rays share a factorization
        if kept.sum() < _RAYS_PER_TERM * terms:
            continue
        u, singular, vt = np.linalg.svd(basis[kept], full_matrices=False)
        if singular[-1] < 1e-8 * singular[0]:
            raise UserError(
                f"{kept.sum()} rays do not tell {terms} Zernike terms apart: spread them or fit less"
            )
        inverse = (vt.T / singular) @ u.T
        chosen = np.flatnonzero(members.ravel() == number)
        known = opd[np.ix_(chosen, np.flatnonzero(kept))]
        coefficients[chosen] = (inverse @ known[..., None])[..., 0]
        left = known - (basis[kept] @ coefficients[chosen][..., None])[..., 0]
        residual[chosen] = np.sqrt(np.mean(left**2, axis=1))
    return RayPhase(zernike_phase(grid, coefficients, obscuration), residual)


def segment_phase(grid: PupilGrid, centers: Real, motion: Real, radius: float, reach: float = 0.0) -> Real:
    """Return the phases of a pupil whose pieces are segments with piston, tip and tilt, and a figure.

    Parameters
    ----------
    grid : PupilGrid
    centers : ndarray, shape (S, 2)
        Points to which pistons belong and about which slopes turn, mm.
    motion : ndarray, shape (batch, S, 3) or (batch, S, K)
        Piston in waves, slopes along x and y in waves per mm, then Noll terms j = 4..K in waves.
    radius : float
        The grid's unit of length in mm.
    reach : float
        Radius in mm of the circle, about a segment's center, of its Noll terms.

    Returns
    -------
    ndarray, shape (batch, m)

    Raises
    ------
    UserError
        If the numbers of segments differ.
    """
    motion = np.asarray(motion, dtype=np.float64)
    fits = motion.ndim == 3 and motion.shape[1] == len(centers) and motion.shape[2] >= 3
    if not fits or grid.piece.max() >= len(centers):
        raise UserError(
            f"a pupil of {grid.piece.max() + 1} segments and {len(centers)} centers needs motions of shape "
            f"(batch, {len(centers)}, 3), not {motion.shape}"
        )
    if motion.shape[2] > 3 and not reach > 0.0:
        raise UserError(f"the Noll terms of segments need the radius of their circle above 0, not {reach:g}")
    arm_x, arm_y = (radius * at - centers[grid.piece, k] for k, at in enumerate((grid.x, grid.y)))
    piston, slope_x, slope_y = np.moveaxis(motion[:, grid.piece, :3], 2, 0)
    waves = piston + slope_x * arm_x + slope_y * arm_y
    if motion.shape[2] > 3:
        modes = annular_zernike(arm_x / reach, arm_y / reach, motion.shape[2]).T
        for j in range(3, motion.shape[2]):
            waves += motion[:, grid.piece, j] * modes[j]
    return np.asarray(2.0 * np.pi * waves)
