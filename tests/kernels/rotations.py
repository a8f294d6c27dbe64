"""Rotations that share nothing with the package."""

import numpy as np


def rotations(angles):
    """Matrices (n, 3, 3) from the last three Euler parameters (n, 3)."""
    w, (x, y, z) = np.sqrt(1.0 - np.sum(angles**2, axis=1)), angles.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), -1, 0)
