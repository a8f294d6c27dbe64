"""Blocks of cases: what is larger than memory is read, reduced or written one after the other."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from numpy.typing import NDArray

if TYPE_CHECKING:
    import xarray as xr

BLOCK_BYTES = 2**24  # of numbers in memory at a time
_TEXT_BYTES = 64  # of a text in memory, about
_READERS = 2  # threads


@contextmanager
def few_at_once() -> Iterator[None]:
    """Read few chunks of a store at a time, as each thread of Dask holds its own: else one per processor."""
    import dask

    with dask.config.set(num_workers=_READERS):
        yield


def blocks(arrays: "Iterable[xr.Variable]", share: float = 1.0) -> Iterator[slice]:
    """Yield all cases, in order, by slices for which the arrays together take that share of BLOCK_BYTES.

    A slice holds whole chunks of the store, or where a chunk is too large an even part of it; one case is the
    least. Arrays without cases do not count.
    """
    arrays = [one for one in arrays if "case" in one.dims]
    cases = max((one.sizes["case"] for one in arrays), default=0)
    each = sum(
        one.size * (one.dtype.itemsize if one.dtype.kind in "biuf" else _TEXT_BYTES) for one in arrays
    ) / max(cases, 1)
    chunk = max([1, *(one.chunksizes["case"][0] for one in arrays if one.chunksizes)])
    rows = max(1, int(share * BLOCK_BYTES / max(each, 1.0)))
    rows = rows // chunk * chunk if rows >= chunk else -(-chunk // -(-chunk // rows))
    for first in range(0, cases, rows):
        yield slice(first, min(first + rows, cases))


def pieces(array: "xr.Variable") -> Iterator[tuple[slice, NDArray[Any]]]:
    """Yield an array by :func:`blocks`: which rows, and their values; in one piece if it is not by case."""
    if array.dims[:1] != ("case",):
        yield slice(None), array.to_numpy()
        return
    for cases in blocks([array]):
        yield cases, array.isel(case=cases).to_numpy()
