"""Few nodes that carry a band-limited field over an image."""

import numpy as np
from numpy.typing import DTypeLike, NDArray

from wavequake.errors import UserError

Complex = NDArray[np.complex128]
Real = NDArray[np.float64]
Floating = NDArray[np.float32] | NDArray[np.float64]

# Error of the interpolation from nodes to pixels, for a wave of unit amplitude.
_TOLERANCE = {np.dtype(np.complex64): 1e-7, np.dtype(np.complex128): 1e-13}

# The nodes are arcsine-stretched Chebyshev points (Kosloff and Tal-Ezer 1993), at 1 evenly spaced, at 0 not
# stretched; this value needs the fewest nodes for images 10 to 40 wavelengths / diameter wide.
_STRETCH = 0.85
# Largest sum of the absolute weights of a point, by which interpolation multiplies rounding errors.
_LARGEST_GAIN = 12.0


def waves(frequency: Real, x: Real) -> Complex:
    """Return the outer waves exp(-2πi f x), shape (f, x), their phases reduced before they are rounded."""
    cycles = np.outer(frequency, x)
    return np.asarray(np.exp(-2j * np.pi * (cycles - np.rint(cycles))))


def middle_of(points: Real) -> Real:
    """Return the middle (2,) of the box around points (n, 2)."""
    return np.asarray(0.5 * (points.min(axis=0) + points.max(axis=0)))


def image_nodes(
    pupil: Real, pixels: int, sampling: float, diameter: float, dtype: DTypeLike
) -> tuple[Real, Floating]:
    """Nodes along an axis of an image, and the interpolation from them to its points.

    Parameters
    ----------
    pupil : ndarray, shape (n, 2)
        Points in mm between which the pupil lies, their box centered on the origin.
    pixels : int
        Points along the axis; point pixels // 2 is the origin.
    sampling : float
        Distance of the points in units of wavelength / `diameter`.
    diameter : float
        Length in mm.
    dtype : complex64 or complex128
        Precision of the field.

    Returns
    -------
    nodes : ndarray, shape (M,)
        Frequencies in cycles per mm, ascending, even in number and symmetric about 0.
    weights : ndarray, shape (pixels, M), float32 or float64

    Raises
    ------
    UserError
        If the grid, diameter or dtype is impossible.
    """
    if pixels < 2:
        raise UserError(f"an image needs at least 2 x 2 points, not {pixels} x {pixels}")
    if not (np.isfinite(sampling) and sampling > 0.0):
        raise UserError(f"the sampling of an image must be above 0 wavelengths/diameter, not {sampling}")
    if not (np.isfinite(diameter) and diameter > 0.0):
        raise UserError(f"the diameter of the pupil must be a length above 0 mm, not {diameter}")
    if np.dtype(dtype) not in _TOLERANCE:
        raise UserError(f"an image basis is complex64 or complex128, not {np.dtype(dtype)}")
    frequencies = (np.arange(pixels, dtype=np.float64) - pixels // 2) * (sampling / diameter)
    half_band = 0.5 * float(np.ptp(pupil, axis=0).max())
    nodes, weights = band_limited_nodes(frequencies, half_band, _TOLERANCE[np.dtype(dtype)])
    return nodes, weights.astype(np.float32) if np.dtype(dtype) == np.complex64 else weights


def band_limited_nodes(points: Real, half_band: float, tolerance: float) -> tuple[Real, Real]:
    """Find the fewest nodes from which functions with frequencies |u| <= half_band are interpolated.

    A function of t on an interval of length T with frequencies up to B has little more than 2 B T degrees of
    freedom. The number of nodes rises from there until the least-squares weights reproduce every wave
    exp(2πi u t) to the tolerance and are small.

    Parameters
    ----------
    points : ndarray, shape (n,)
        Where the function is wanted.
    half_band : float
        Largest frequency, in cycles per unit of the points.
    tolerance : float
        Largest error at any point, for a wave of unit amplitude; the rounding of phases sets a floor.

    Returns
    -------
    nodes : ndarray, shape (m,)
        Ascending, even in number and symmetric about 0; they span the largest |point| on both sides.
    weights : ndarray, shape (n, m)
        Real matrix that takes values at the nodes to the points.
    """
    span = float(np.abs(points).max())
    tolerance = max(tolerance, 1e-15 * 2.0 * np.pi * span * half_band)  # rounding of the phases themselves
    u, share = np.polynomial.legendre.leggauss(60 + int(2.0 * np.pi * span * half_band))
    u, share = 0.5 * half_band * (u + 1.0), np.sqrt(share)
    checks = half_band * np.linspace(0.0, 1.0, 4 * u.size)
    count = 2 * int(2.0 * span * half_band / 2.0 + 1.0)
    while True:
        nodes = _stretched_chebyshev(count, span)
        at_nodes, at_points = (_cosines_and_sines(t, u, share) for t in (nodes, points))
        weights = np.asarray(np.linalg.lstsq(at_nodes.T, at_points.T, rcond=1e-15)[0].T, dtype=np.float64)
        error = np.abs(weights @ waves(nodes, checks) - waves(points, checks)).max()
        if error <= tolerance and np.abs(weights).sum(axis=1).max() <= _LARGEST_GAIN:
            return nodes, weights
        count += 2


def _stretched_chebyshev(count: int, span: float) -> Real:
    angles = np.pi * (np.arange(count) + 0.5) / count
    nodes = -np.arcsin(_STRETCH * np.cos(angles))
    nodes = 0.5 * (nodes - nodes[::-1])  # symmetric to the last bit
    return np.asarray(span / nodes[-1] * nodes)


def _cosines_and_sines(t: Real, u: Real, share: Real) -> Real:
    phase = 2.0 * np.pi * np.outer(t, u)
    return np.hstack([np.cos(phase) * share, np.sin(phase) * share])
