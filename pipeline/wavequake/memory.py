"""Tell the C library to keep the memory of freed arrays for the next ones."""

import ctypes
from contextlib import suppress
from functools import lru_cache

# Of glibc's malloc.h; the largest array that it keeps, and what of freed memory it keeps in all.
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
_LARGEST_ARRAY, _KEPT = 32 << 20, 256 << 20


@lru_cache(maxsize=1)
def keep_freed_memory() -> None:
    """Have this process keep freed memory; without glibc nothing changes.

    By itself, and always in Dask's workers, which set MALLOC_TRIM_THRESHOLD_, glibc returns arrays of 128 KiB
    or more to the system, so that it must find and clear new pages for the next array: on virtual machines
    that takes longer than computing it.
    """
    with suppress(AttributeError, OSError, TypeError):  # what systems without glibc raise
        library = ctypes.CDLL(None)
        library.mallopt(_MMAP_THRESHOLD, _LARGEST_ARRAY)
        library.mallopt(_TRIM_THRESHOLD, _KEPT)
