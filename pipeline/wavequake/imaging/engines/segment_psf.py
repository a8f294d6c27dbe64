"""Exact point spread functions of a pupil of segments, from a piston and two slopes per segment.

The field at the frequency f is the sum over segments s and exponents a, b of

    exp(2πi p_s) (2πi g_x)^a (2πi g_y)^b / (a! b!) H_sab(f),

p_s the piston in waves at the segment's center, g its slopes in waves per mm, and H_sab(f) the integral of
(x - x_s)^a (y - y_s)^b exp(-2πi f·x) over the segment's polygon. The H do not depend on the phases: a basis
holds them, and an instant costs one matrix product. Nothing supposes that segments are alike or on a lattice.

Three facts make the basis small. The field is band-limited by the extent of the pupil, so that its values on
a coarse tensor grid of nodes give all pixels by thin real products, to the precision of the numbers. The
polygons are real, so that a quarter of the nodes serves for all. And where the pupil is its own mirror image,
a quarter of the segments does (`wavequake.imaging.engines.mirror_twins`).
"""

from functools import partial
from math import factorial

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wavequake.errors import UserError
from wavequake.imaging.engines.mirror_twins import Twins, fold, unfold
from wavequake.imaging.engines.segment_basis import MOMENTS, SegmentBasis
from wavequake.imaging.engines.segment_lattice import SegmentLattice
from wavequake.imaging.engines.segment_moments import exponents
from wavequake.kernels.device.devices import NUMPY, Device
from wavequake.kernels.device.tiles import TILE
from wavequake.kernels.transforms.segment_images import segment_images

Real = NDArray[np.float64]
Floating = NDArray[np.float32] | NDArray[np.float64]

# Largest means of |u|^(n+1) over a hexagon for n = 0, 2, ..., with u linear and 1 at a corner at most.
_HEXAGON_MEANS = (0.389, 0.130, 0.0630, 0.0370, 0.0243)


def psf(
    basis: SegmentBasis,
    segment_phase: ArrayLike,
    tolerance: float = 1e-3,
    device: Device = NUMPY,
    bounds: Real | None = None,
) -> Floating:
    """Point spread functions, relative to the peak of the perfect pupil.

    The phase is exp(+2πi phase) and the kernel exp(-2πi f·x): a phase that grows with x moves the image
    to +x. Each tile of 16 instants takes the fewest moments whose bound (`truncation_error`) meets the
    tolerance, so that a tile's numbers depend on nothing else. The bound is the worst case, in which
    all segments conspire; with random slopes the real error is 10 to 60 times smaller.

    Parameters
    ----------
    basis : SegmentBasis
    segment_phase : array_like, shape (batch, S, 3) or (batch, S)
        Piston in waves at the center and slopes in x and y in waves per mm; or pistons (OPDs of rays) alone.
        An instant with a NaN gives an image of NaN.
    tolerance : float
        Largest error, relative to the perfect peak, that may come from ending the series in the slopes.
    device : Device
        A GPU makes the images; for processors BLAS does, which is as fast as OpenCL could be.
    bounds : ndarray, shape (degrees, batch), optional
        `truncation_error` of these phases, where it is known.

    Returns
    -------
    ndarray, shape (batch, pixels * pixels), float32 or float64
        Irradiance; 1 is the perfect peak. Reshaped to (batch, pixels, pixels), axis 1 is y.

    Raises
    ------
    UserError
        If the slopes are too large for the moments of the basis.
    """
    phase = np.asarray(segment_phase, dtype=np.float64)
    if phase.ndim == 2:
        phase = np.pad(phase[..., None], ((0, 0), (0, 0), (0, 2)))
    if phase.ndim != 3 or phase.shape[1:] != (basis.segments, 3):
        raise ValueError(f"segment_phase has the shape {phase.shape}, not (batch, {basis.segments}, 3)")
    batch = len(phase)
    bounds = truncation_error(basis, phase) if bounds is None else bounds
    images = np.empty((batch, basis.pixels**2), dtype=basis.matrix.dtype)
    for first in range(0, batch, TILE):
        part = phase[first : first + TILE]
        by_device = device.kind == "gpu" or (device.kind == "cpu" and basis.matrix.dtype == np.float32)
        alone = len(part) == 1 and not by_device
        tile = np.zeros((1 if alone else TILE, basis.segments, 3))  # bits depend on nothing else
        tile[: len(part)] = part
        moments = _moments_for(basis, tile, bounds[:, first : first + TILE].max(axis=1), tolerance)
        make = partial(_device_images, device=device) if by_device else _numpy_images
        images[first : first + TILE] = make(basis, tile, moments)[: len(part)]
    return images


def _numpy_images(basis: SegmentBasis, tile: Real, moments: int) -> Floating:
    return tile_images(basis, _coefficients(basis, tile, moments)).T


def _device_images(basis: SegmentBasis, tile: Real, moments: int, device: Device) -> Floating:
    powers = np.array(exponents(2 * MOMENTS.index(moments)))
    tables = (basis.matrix, basis.interpolation, basis.twins, basis.shares, powers)
    twin = partial(_numpy_images, basis, tile, moments)
    return segment_images(device, tile, *tables, basis.slope_scale, basis.peak, twin)


def amplitude_images(basis: SegmentBasis, amplitude: ArrayLike) -> Floating:
    """Return images of rays or segments with complex amplitudes, as `psf` does of phases alone.

    Parameters
    ----------
    basis : SegmentBasis
        Its first moments count: those of rays, or of segments without slopes.
    amplitude : array_like, shape (batch, S)
        Complex amplitude of each; 1 everywhere is the perfect pupil.

    Returns
    -------
    ndarray, shape (batch, pixels * pixels), float32 or float64
        Irradiance; 1 is the perfect peak.
    """
    fields = np.asarray(amplitude, dtype=np.complex128) / basis.peak
    if fields.ndim != 2 or fields.shape[1] != basis.segments:
        raise ValueError(f"amplitude has the shape {fields.shape}, not (batch, {basis.segments})")
    images = np.empty((len(fields), basis.pixels**2), dtype=basis.matrix.dtype)
    for first in range(0, len(fields), TILE):
        part = fields[first : first + TILE]
        factors = np.zeros((1, basis.segments, 2, TILE), dtype=basis.matrix.dtype)
        factors[0, :, 0, : len(part)], factors[0, :, 1, : len(part)] = part.real.T, part.imag.T
        images[first : first + TILE] = tile_images(basis, factors).T[: len(part)]
    return images


def truncation_error(basis: SegmentBasis | SegmentLattice, segment_phase: Real) -> Real:
    """Bound the error of the image, relative to the perfect peak, that ending the series in the slopes makes.

    What follows degree n in the series of exp(iφ) is at most |φ|^(n+1) / (n+1)!. Its mean over the
    glass bounds the error δ of the field, and δ (2 + δ) that of the image. The means are those of each
    segment's own polygon.

    Parameters
    ----------
    basis : SegmentBasis or SegmentLattice
    segment_phase : ndarray, shape (batch, S, 3)
        As for `psf`; slopes that are not finite are left out.

    Returns
    -------
    ndarray, shape (degrees, batch)
        For 1, 6, 15, ... moments, as many as the basis holds.
    """
    along_x, along_y = segment_phase[..., 1], segment_phase[..., 2]
    squares = np.where(np.isfinite(along_x + along_y), along_x**2 + along_y**2, 0.0)
    powers, field = np.sqrt(squares), np.empty((len(basis.remainders), len(squares)))
    for place, remainders in enumerate(basis.remainders):
        field[place] = np.einsum("bs,s->b", powers, np.broadcast_to(remainders, squares.shape[1:]))
        powers *= squares
    return np.asarray(field * (2.0 + field))


def moments_needed(corner_phase: float, tolerance: float) -> int:
    """Return the number of moments that keeps the image error of a pupil of hexagons below a tolerance.

    Parameters
    ----------
    corner_phase : float
        Largest phase in rad that slopes make between a segment's center and a corner: 2π times the slope in
        waves per mm times the circumscribed radius in mm. All segments are supposed to reach it.
    tolerance : float
        Error relative to the perfect peak.

    Raises
    ------
    UserError
        If even 45 moments are too few.

    Notes
    -----
    The function takes the worst case, in which all segments tilt alike. Largest errors of the image
    measured on the 492 segments of the TMT against exact transforms, by rms phase at the corner and
    number of moments, with random normal slopes in x and in y, random pistons, and 64 x 64 points at
    0.25 wavelength / diameter (`truncation_error` gave 10 to 60 times these numbers):

    =========  ======  ======  ======  ======  ======
    rms phase     1       6      15      28      45
    =========  ======  ======  ======  ======  ======
    0.114 rad  4.4e-3  7.9e-6  1.1e-8   1e-11   1e-14
    0.228 rad  1.7e-2  1.1e-4  5.9e-7  2.7e-9   1e-11
    0.457 rad  7.2e-2  2.1e-3  4.3e-5  6.5e-7  7.5e-9
    0.914 rad  2.4e-1  2.6e-2  2.3e-3  1.5e-4  8.1e-6
    1.828 rad  5.9e-1  1.7e-1  9.0e-2  2.4e-2  5.6e-3
    =========  ======  ======  ======  ======  ======
    """
    if not (np.isfinite(corner_phase) and corner_phase >= 0.0):
        raise UserError(
            f"the phase at a segment's corner must be at least 0 rad and finite, not {corner_phase}"
        )
    if not tolerance > 0.0:
        raise UserError(f"the tolerance of an image must be above 0, not {tolerance}")
    for index, moments in enumerate(MOMENTS):
        field = _HEXAGON_MEANS[index] * corner_phase ** (2 * index + 1) / factorial(2 * index + 1)
        if field * (2.0 + field) <= tolerance:
            return moments
    raise UserError(
        f"slopes of {corner_phase:.3g} rad at the segments' corners need more than {MOMENTS[-1]} moments "
        f"for an image error of {tolerance:g}: reduce the motion or raise the tolerance"
    )


def strehl_exact(areas: Real, piston_waves: Real) -> Real:
    """Return the irradiance at the origin for pistons alone: |Σ A exp(2πi p)|² / (Σ A)².

    Parameters
    ----------
    areas : ndarray, shape (S,)
        Areas of the segments, in any unit.
    piston_waves : ndarray, shape (..., S)
        Pistons in waves.

    Returns
    -------
    ndarray, shape (...)
    """
    field = (areas * np.exp(2j * np.pi * np.asarray(piston_waves))).sum(axis=-1) / np.sum(areas)
    return np.asarray(field.real**2 + field.imag**2)


def shift_phase(segment_phase: Real, shift: ArrayLike, centers: Real, diameter: float) -> Real:
    """Add the plane of phase that moves an image.

    Parameters
    ----------
    segment_phase : ndarray, shape (batch, S, 3)
        Piston in waves and slopes in waves per mm.
    shift : array_like, shape (2,) or (batch, 2)
        Motion of the image along x and y in units of wavelength / `diameter`.
    centers : ndarray, shape (S, 2)
        Centers of the segments in mm.
    diameter : float
        Diameter in mm.

    Returns
    -------
    ndarray, shape (batch, S, 3)
    """
    slopes = np.broadcast_to(np.asarray(shift, dtype=np.float64) / diameter, (len(segment_phase), 2))
    moved = np.array(segment_phase, dtype=np.float64)
    moved[..., 0] += slopes @ np.asarray(centers, dtype=np.float64).T
    moved[..., 1:] += slopes[:, None]
    return moved


def tile_images(basis: SegmentBasis, factors: Floating) -> Floating:
    """Return the images (pixels², n) of one tile: products of constant shape, instants in the columns.

    Parameters
    ----------
    basis : SegmentBasis
    factors : ndarray, shape (J, S, 2, n)
        What the first J moments of the segments count in the field, real and imaginary parts.
    """
    moments, nodes = len(factors), basis.interpolation.shape[1]
    powers = np.array(exponents(2 * MOMENTS.index(moments)))
    folded = fold(Twins(basis.twins, basis.shares), powers, factors.reshape(moments, basis.segments, -1))
    product = basis.matrix[:, :, : folded.shape[1]] @ folded
    field = unfold(product.reshape(4, nodes // 2, nodes // 2, *factors.shape[2:]))
    rows = basis.interpolation @ field.reshape(nodes, -1)
    pixels = (basis.interpolation @ rows.reshape(basis.pixels, nodes, -1)).reshape(-1, *factors.shape[2:])
    return np.asarray(pixels[:, 0] ** 2 + pixels[:, 1] ** 2)


def _coefficients(basis: SegmentBasis, tile: Real, moments: int) -> Floating:
    """Factors (J, S, 2, n) of the moments: exp(2πi p) (i gx)^a (i gy)^b / (a! b! peak), real, imaginary."""
    piston, slope_x, slope_y = tile.transpose(2, 1, 0)
    phase = 2.0 * np.pi * (piston - np.rint(piston))
    cosine, sine = np.cos(phase) / basis.peak, np.sin(phase) / basis.peak
    turned = np.stack([cosine, sine], axis=1), np.stack([-sine, cosine], axis=1)  # times 1 and times i
    gx, gy = 2.0 * np.pi * basis.slope_scale * slope_x, 2.0 * np.pi * basis.slope_scale * slope_y
    degree = 2 * MOMENTS.index(moments)
    along_x, along_y = [np.ones_like(gx)], [np.ones_like(gy)]  # gx^a / a! and gy^b / b!
    for n in range(1, degree + 1):
        along_x.append(along_x[-1] * gx / n)
        along_y.append(along_y[-1] * gy / n)
    factors = np.empty((moments, basis.segments, 2, len(tile)), dtype=basis.matrix.dtype)
    for index, (a, b) in enumerate(exponents(degree)):
        real = along_x[a] * along_y[b] * (-1.0 if (a + b) % 4 >= 2 else 1.0)
        np.multiply(turned[(a + b) % 2], real[:, None], out=factors[index], casting="same_kind")
    return factors


def _moments_for(basis: SegmentBasis, tile: Real, errors: Real, tolerance: float) -> int:
    fitting = np.flatnonzero(errors <= tolerance)
    if fitting.size:
        return MOMENTS[fitting[0]]
    steepest = float(np.nanmax(np.hypot(tile[..., 1], tile[..., 2])))
    raise UserError(
        f"segments tilted by up to {steepest:.3g} waves/mm are too steep to be imaged by {basis.moments} "
        f"moments: up to {errors[-1]:.2g} of the peak may be wrong, {tolerance:g} is allowed; use more "
        "moments or less motion, or leave images out (imaging.enabled=false)"
    )
