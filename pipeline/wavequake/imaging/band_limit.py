"""Few nodes that carry a band-limited function over an interval."""

import numpy as np
from numpy.typing import NDArray

Complex = NDArray[np.complex128]
Real = NDArray[np.float64]

# The nodes are arcsine-stretched Chebyshev points (Kosloff and Tal-Ezer 1993), at 1 evenly spaced, at 0 not
# stretched; this value needs the fewest nodes for images 10 to 40 wavelengths / diameter wide.
_STRETCH = 0.85
# Largest sum of the absolute weights of a point, by which interpolation multiplies rounding errors.
_LARGEST_GAIN = 12.0


def waves(frequency: Real, x: Real) -> Complex:
    """Return the outer waves exp(-2πi f x), shape (f, x), their phases reduced before they are rounded."""
    cycles = np.outer(frequency, x)
    return np.asarray(np.exp(-2j * np.pi * (cycles - np.rint(cycles))))


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
