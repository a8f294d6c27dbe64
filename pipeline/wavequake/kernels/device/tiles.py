"""Tiles of 16 instants: the one batch shape of kernels and matrix products.

Every case occupies whole tiles of its own, padded with the rest state, so that the bits of a case cannot
depend on the number of cases in a chunk, on its neighbors or on its place in the batch. Arrays in tile layout
have shape (tile, ..., 16): the instant is the last, contiguous axis, which is the vector lane on a CPU and
the fastest work-item on a GPU.
"""

import numpy as np
from numpy.typing import NDArray

TILE = 16


def padded(instants: int) -> int:
    """Return `instants` rounded up to whole tiles."""
    return -(-instants // TILE) * TILE


def to_tiles(batch_first: NDArray[np.float64]) -> NDArray[np.float64]:
    """Bring an array (batch, ...) into tile layout (batch / 16, ..., 16), contiguous.

    Raises
    ------
    ValueError
        If the batch is not a whole number of tiles.
    """
    batch = batch_first.shape[0]
    if batch % TILE:
        raise ValueError(f"the batch of {batch} instants is not a whole number of tiles of {TILE}")
    tiles = batch_first.reshape(batch // TILE, TILE, *batch_first.shape[1:])
    return np.ascontiguousarray(np.moveaxis(tiles, 1, -1), dtype=np.float64)


def from_tiles(tiles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Bring an array in tile layout (tile, ..., 16) back to (batch, ...), contiguous."""
    batch_second = np.moveaxis(tiles, -1, 1)
    return np.ascontiguousarray(batch_second.reshape(-1, *batch_second.shape[2:]))
