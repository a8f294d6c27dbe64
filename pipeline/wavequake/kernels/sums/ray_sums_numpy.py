"""The NumPy twin of ``kernels/ray_sums.cl``: coefficients and moments of wavefronts."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Instants per matrix product: a constant shape, so that the bits of an instant do not depend on its batch.
_TILE = 16


def times_instants(matrix: Array, values: Array) -> Array:
    """Return the products (T, J) of a matrix (J, N) and values (T, N); the bits do not depend on T."""
    instants, count = values.shape
    padded = np.zeros((-(-instants // _TILE) * _TILE, count))
    padded[:instants] = values
    tiles = padded.reshape(-1, _TILE, count).transpose(0, 2, 1)
    products: Array = np.matmul(matrix, tiles).transpose(0, 2, 1).reshape(len(padded), len(matrix))
    return np.ascontiguousarray(products[:instants])  # of one tile it is a view, whose rows sum to other bits


def coefficients_numpy(matrix: Array, values: Array) -> tuple[Array, NDArray[np.intp]]:
    """Return the products (T, J) of a matrix (J, N) and values (T, N), and how many are lost (T,)."""
    known = np.isfinite(values)
    lost = values.shape[1] - np.count_nonzero(known, axis=1)
    return times_instants(matrix, np.where(known, values, 0.0)), lost


def moments_numpy(opd: Array, x: Array, y: Array, weight: Array, slopes: Array, planes: Array) -> Array:
    """Return moments (T, 8), see `wavequake.kernels.sums.ray_sums.ray_moments`."""
    known = np.isfinite(opd) & np.isfinite(x) & np.isfinite(y)
    found = np.empty((len(opd), 8))
    found[:, 0] = np.count_nonzero(known, axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        light = np.where(known, weight, 0.0)
        light /= np.sum(light, axis=1)[:, None]
        flat = opd - planes[:, :1] * slopes[0] - planes[:, 1:] * slopes[1]
        opd, flat, x, y = (np.where(known, values, 0.0) for values in (opd, flat, x, y))
        for column, values in ((1, opd), (2, flat)):
            mean = np.sum(light * values, axis=1, keepdims=True)
            found[:, column] = np.sqrt(np.sum(light * np.square(values - mean), axis=1))
        largest = np.max(np.where(known, flat, -np.inf), axis=1, initial=-np.inf)
        smallest = np.min(np.where(known, flat, np.inf), axis=1, initial=np.inf)
        found[:, 3] = np.where(largest >= smallest, largest - smallest, np.nan)
        phase = 2.0 * np.pi * flat
        waves = [np.sum(light * part(phase), axis=1) for part in (np.cos, np.sin)]
        found[:, 4] = waves[0] ** 2 + waves[1] ** 2
        found[:, 5:7] = np.stack([np.sum(light * values, axis=1) for values in (x, y)], axis=1)
        square = np.square(x - found[:, 5:6]) + np.square(y - found[:, 6:7])
        found[:, 7] = np.sqrt(np.sum(light * square, axis=1))
    return found
