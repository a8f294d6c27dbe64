"""Point spread functions of segments that are bent, too: Zernike terms on each segment.

Over a segment the wave exp(iφ) is smooth. Its best polynomial of degree 8 (least squares over the segment's
glass) is what the moments of `wavequake.imaging.engines.segment_basis` turn into an image, as they do with
the series of a tilted segment. What the polynomial leaves is known at the points of the fit: its mean over
the glass bounds the error of the field, at worst all segments conspiring, and with it that of the image.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import DTypeLike, NDArray

from wavequake.errors import UserError
from wavequake.imaging.engines.segment_basis import MOMENTS, SegmentBasis, segment_basis
from wavequake.imaging.engines.segment_moments import exponents, glass_rule
from wavequake.imaging.engines.segment_psf import tile_images
from wavequake.imaging.pupils.outlines import Outline
from wavequake.kernels.device.tiles import TILE
from wavequake.optics.polynomials.zernike import annular_zernike

Real = NDArray[np.float64]
Floating = NDArray[np.float32] | NDArray[np.float64]

# Points along each side of the triangles that make a segment: 150 on a hexagon, for 45 coefficients.
_POINTS = 5


@dataclass(frozen=True)
class SegmentFigure:
    """What all images of one pupil of bent segments have in common.

    Attributes
    ----------
    basis : SegmentBasis
    modes : ndarray, shape (S, Q, K)
        Noll terms j = 1..K at points of each segment.
    weight : ndarray, shape (S, Q)
        Share of the pupil's light that a point stands for.
    fit, monomials : ndarray, shape (S, J, Q), (S, Q, J)
        From values at the points to coefficients of monomials, and back.
    """

    basis: SegmentBasis
    modes: Real
    weight: Real
    fit: Real
    monomials: Real


def segment_figure(
    corners: Real,
    centers: Real,
    pixels: int,
    sampling: float,
    diameter: float,
    terms: int = 11,
    moments: int = 45,
    dtype: DTypeLike = np.complex128,
    shadows: Outline | None = None,
) -> SegmentFigure:
    """Prepare the images of a pupil of bent segments.

    Parameters
    ----------
    corners, centers, pixels, sampling, diameter, dtype, shadows
        As for `wavequake.imaging.engines.segment_basis.segment_basis`.
    terms : int
        Number K of Noll terms on a segment. They are those of a circle about its center, whose radius is the
        largest distance of any segment's corner from its center (`basis.slope_scale`).
    moments : {6, 15, 28, 45}
        Polynomials of degree 2, 4, 6 or 8.

    Raises
    ------
    UserError
        If there are no terms, or as for `segment_basis`.
    """
    basis = segment_basis(corners, centers, pixels, sampling, diameter, moments, dtype, shadows)
    points, weights = glass_rule(np.asarray(corners, dtype=np.float64), _POINTS)
    local = (points - np.asarray(centers, dtype=np.float64)[:, None]) / basis.slope_scale
    x, y = local[..., 0], local[..., 1]
    modes = annular_zernike(x.ravel(), y.ravel(), terms).reshape(*x.shape, terms)
    degree = 2 * MOMENTS.index(moments)
    monomials = np.stack([x**a * y**b for a, b in exponents(degree)], axis=-1)
    # A repeated corner makes triangles without area, whose points do not count.
    root = np.sqrt(np.maximum(weights, 0.0))
    fit = np.asarray(np.linalg.pinv(root[..., None] * monomials, rcond=1e-13) * root[:, None], np.float64)
    return SegmentFigure(basis, modes, np.maximum(weights, 0.0) / basis.peak, fit, monomials)


def figure_psf(figure: SegmentFigure, coefficients: Real, tolerance: float = 1e-3) -> Floating:
    """Return point spread functions (batch, pixels²), relative to the peak of the perfect pupil.

    Parameters
    ----------
    figure : SegmentFigure
    coefficients : ndarray, shape (batch, S, K)
        Noll terms j = 1..K of each segment in waves: piston, tilts, focus, ... A phase that grows with x
        moves the image to +x. An instant with a NaN gives an image of NaN.
    tolerance : float
        Largest bound (`figure_error`) that is allowed.

    Raises
    ------
    UserError
        If the shape is wrong, or a segment is bent too much for polynomials of this degree.
    """
    coefficients = _checked(figure, coefficients)
    basis, batch = figure.basis, len(coefficients)
    images = np.empty((batch, basis.pixels**2), dtype=basis.matrix.dtype)
    for first in range(0, batch, TILE):
        factors, errors = _fitted(figure, coefficients[first : first + TILE])
        if (errors > tolerance).any():
            worst = float(np.nanmax(errors))
            raise UserError(
                f"polynomials of {basis.moments} moments leave up to {worst:.2g} of the image's peak of bent "
                f"segments ({tolerance:g} is allowed): use more moments, bend less, or sample the pupil"
            )
        scaled = np.empty(factors.shape, dtype=basis.matrix.dtype)
        scaled[...] = factors / basis.peak
        made = tile_images(basis, scaled)
        images[first : first + TILE] = made.T[: batch - first]
    return images


def figure_error(figure: SegmentFigure, coefficients: Real) -> Real:
    """Bound the error of images (batch,) that polynomials make, relative to the perfect peak.

    Raises
    ------
    UserError
        If the coefficients have the wrong shape.
    """
    coefficients = _checked(figure, coefficients)
    bounds = np.empty(len(coefficients))
    for first in range(0, len(coefficients), TILE):
        _, errors = _fitted(figure, coefficients[first : first + TILE])
        bounds[first : first + TILE] = errors[: len(coefficients) - first]
    return bounds


def terms_of_motion(motion: Real, radius: float) -> Real:
    """Return the Noll terms (batch, S, K) of motions (batch, S, K).

    Parameters
    ----------
    motion : ndarray, shape (batch, S, K)
        Piston in waves, slopes along x and y in waves per mm, then Noll terms j = 4..K in waves.
    radius : float
        Of the circle of the terms, mm.
    """
    found = np.array(motion, dtype=np.float64)
    found[..., 1:3] *= 0.5 * radius
    return found


def _checked(figure: SegmentFigure, coefficients: Real) -> Real:
    coefficients = np.asarray(coefficients, dtype=np.float64)
    segments, _, terms = figure.modes.shape
    if coefficients.ndim != 3 or coefficients.shape[1:] != (segments, terms):
        raise UserError(
            f"{segments} segments of {terms} terms need coefficients of shape (batch, {segments}, {terms}), "
            f"not {coefficients.shape}"
        )
    return coefficients


def _fitted(figure: SegmentFigure, coefficients: Real) -> tuple[Real, Real]:
    """Return polynomials (J, S, 2, 16) of a tile's waves, and bounds (16,) of the images' errors."""
    segments, points, terms = figure.modes.shape
    tile = np.zeros((segments, terms, TILE))
    tile[..., : len(coefficients)] = np.moveaxis(coefficients, 0, -1)
    phase = figure.modes @ tile
    phase -= np.rint(phase)
    phase *= 2.0 * np.pi
    waves = np.concatenate([np.cos(phase), np.sin(phase)], axis=-1)  # real products are cheaper
    polynomials = figure.fit @ waves
    left = waves - figure.monomials @ polynomials
    left = np.hypot(left[..., :TILE], left[..., TILE:])
    # Q points tell J coefficients apart: what these swallow of the error is put back.
    moments = figure.monomials.shape[2]
    field = (figure.weight[..., None] * left).sum(axis=(0, 1)) / np.sqrt(1.0 - moments / points)
    field = np.where(np.isfinite(field), field, 0.0)  # such an instant has no image, whatever is allowed
    factors = polynomials.transpose(1, 0, 2).reshape(moments, segments, 2, TILE)
    return factors, np.asarray(field * (2.0 + field))
