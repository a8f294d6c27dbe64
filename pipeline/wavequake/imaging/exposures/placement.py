"""Put images at their places in a larger or equal frame."""

import numpy as np
from numpy.typing import NDArray


def place(images: NDArray[np.floating], shift: NDArray[np.int64], pixels: int) -> NDArray[np.float64]:
    """Move images by whole pixels and cut them to a frame of `pixels` x `pixels` about the origin.

    Parameters
    ----------
    images : ndarray, shape (batch, n, n)
        The origin is pixel (n // 2, n // 2), axis 1 is y.
    shift : ndarray of int, shape (batch, 2)
        Motion of each image along x and y in pixels.
    pixels : int
        Size of the frame; its origin is pixel (pixels // 2, pixels // 2).

    Returns
    -------
    ndarray, shape (batch, pixels, pixels)
        What an image does not cover is 0.
    """
    batch, size = images.shape[0], images.shape[1]
    bordered = np.zeros((batch, size + 2, size + 2))
    bordered[:, 1:-1, 1:-1] = images
    frame = np.arange(pixels) - pixels // 2 + size // 2 + 1
    x, y = (np.clip(frame - shift[:, axis, None], 0, size + 1) for axis in (0, 1))
    placed: NDArray[np.float64] = bordered[np.arange(batch)[:, None, None], y[:, :, None], x[:, None, :]]
    return placed
