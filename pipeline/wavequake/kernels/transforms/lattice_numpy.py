"""The NumPy twin of ``kernels/lattice.cl``: sums over segments as they are defined, with no symmetry.

The field at the frequencies (u, v) is the sum over segments s and moments (a, b) of
exp(2πi p_s) (i g_x)^a / a! (i g_y)^b / b! exp(-2πi (u x_s + v y_s)) M_ab(u, v).
"""

import math

import numpy as np
from numpy.typing import NDArray

Real = NDArray[np.float64]
Complex = NDArray[np.complex128]


def lattice_images_numpy(places: Real, moments: Complex, scale: float, step: float, motion: Real) -> Real:
    """Return images (batch, pixels, pixels) of pistons and slopes.

    Parameters
    ----------
    places : ndarray, shape (2, S)
        Along x and y.
    moments : ndarray, shape (J, pixels, pixels)
        See `wavequake.kernels.transforms.lattice.lattice_kernel`.
    scale : float
        Length in mm that makes slopes and moments dimensionless.
    step : float
        Distance of the pixels in cycles per unit of the places.
    motion : ndarray, shape (batch, S, 3)
        Pistons in waves and slopes in waves per mm; a number that is not finite makes an image of NaN, but a
        slope where there is one moment only.
    """
    rows = np.arange(moments.shape[1])
    images = np.empty((len(motion), *moments.shape[1:]))
    for image, one in zip(images, np.where(np.isfinite(motion), motion, np.nan), strict=True):
        field = lattice_field(places, moments, step, moment_waves(one, len(moments), scale), rows)
        image[:] = field.real**2 + field.imag**2
    return images


def lattice_field(
    places: Real, moments: Complex, step: float, waves: Complex, rows: NDArray[np.intp]
) -> Complex:
    """Return rows of the field (rows, pixels) of one instant, whose `moment_waves` are (J, S)."""
    pixels = moments.shape[1]
    frequency = (np.arange(pixels) - pixels // 2) * step
    along_x = np.exp(-2j * np.pi * np.outer(places[0], frequency))
    along_y = np.exp(-2j * np.pi * np.outer(frequency[rows], places[1]))
    sums = (waves * along_y[:, None]) @ along_x  # (rows, J, pixels)
    return np.asarray((sums * moments[:, rows].swapaxes(0, 1)).sum(axis=1))


def moment_waves(motion: Real, moments: int, scale: float) -> Complex:
    """Return what each segment's moments are multiplied by (J, S): terms of the series of exp(iφ)."""
    turns = motion[:, 0] - np.rint(motion[:, 0])
    wave = np.exp(2j * np.pi * turns)
    if moments == 1:
        return np.asarray(wave[None])
    x, y = 2.0 * np.pi * scale * motion[:, 1:].T
    degree = (math.isqrt(8 * moments + 1) - 3) // 2
    with np.errstate(all="ignore"):  # slopes may be anything
        series = [
            (1j * x) ** (n - b) / math.factorial(n - b) * (1j * y) ** b / math.factorial(b)
            for n in range(degree + 1)
            for b in range(n + 1)
        ]
        return np.asarray(np.array(series) * wave)
