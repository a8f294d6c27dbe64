"""Factors by PARDISO of Intel's Math Kernel Library, where its package is installed (``pip install mkl``).

Up to twice as fast as our own with less memory, also on other makers' processors. One thread, so that
bits do not depend on how many there are. Arguments: oneMKL developer reference, section "oneMKL PARDISO".
"""

import ctypes
import os
import sys
import weakref
from collections.abc import Callable
from importlib import metadata
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array, tril

from wavequake.prepared import prepared

OFF = "WAVEQUAKE_NO_PARDISO"
"""Environment variable: if it is set, PARDISO is not used."""
_DEFINITE, _INDEFINITE, _COMPLEX = 2, -2, 6
_ANALYSE, _FACTORIZE, _SOLVE, _RELEASE = 11, 22, 33, -1
_SEQUENTIAL = 1


@prepared(maxsize=1)
def _library() -> Any:
    """Return the library, or None."""
    try:
        files = metadata.files("mkl") or ()
    except metadata.PackageNotFoundError:
        return None
    for file in files:
        if file.name.startswith(("libmkl_rt.so", "mkl_rt.", "libmkl_rt.dylib")):
            try:
                library = ctypes.CDLL(str(file.locate()), mode=getattr(os, "RTLD_LAZY", 0))
            except OSError:
                continue
            library.MKL_Set_Threading_Layer(ctypes.c_int(_SEQUENTIAL))
            return library
    return None


def is_there() -> bool:
    """Return whether PARDISO is installed and wanted."""
    return not os.environ.get(OFF) and sys.maxsize > 2**32 and _library() is not None


class Pardiso:
    """Analysis of a symmetric matrix, and its factors after `factorize`.

    Parameters
    ----------
    matrix : csc_array, shape (n, n)
        Both triangles stored, without duplicates; real or complex.
    definite : bool
        It is positive definite.

    Attributes
    ----------
    memory, copies, factors : int
        Bytes that PARDISO takes at the most, bytes of the triangle that it is given, numbers in the factors.
    operations : float
        Multiplications and additions that they take (PARDISO counts both).

    Raises
    ------
    ZeroDivisionError
        If the matrix is structurally singular.
    """

    def __init__(self, matrix: csc_array, definite: bool) -> None:
        self.order = matrix.shape[0]
        # Columns of the lower triangle are rows of the upper one, which is what is asked for.
        lower = csc_array(tril(matrix, format="csc"))
        lower.sort_indices()
        self._starts = (lower.indptr + 1).astype(np.int32)
        self._places = (lower.indices + 1).astype(np.int32)
        is_complex = np.iscomplexobj(lower.data)
        self._entries = np.ascontiguousarray(lower.data, dtype=np.complex128 if is_complex else np.float64)
        self._kind = _COMPLEX if is_complex else _DEFINITE if definite else _INDEFINITE
        self._handle = np.zeros(64, dtype=np.int64)
        self._options = np.zeros(64, dtype=np.int32)
        self._options[0] = 1  # the others are given here
        self._options[1] = 2  # nested dissection (METIS)
        self._options[4] = 2  # says in which order
        self._options[7] = 0 if definite else 2  # steps of refinement
        self._options[9] = 13 if definite else 8  # disturbs pivots below 10^-this
        self._options[10] = self._options[12] = 0 if definite else 1  # scaling, matching
        self._options[17] = self._options[18] = -1  # counts numbers and operations
        self._options[20] = 1  # pivots of 1 and 2
        self._options[55] = 1  # keeps the diagonal
        nothing = np.zeros(1, dtype=self._entries.dtype)
        self._rank = np.zeros(self.order, dtype=np.int32)
        call = _caller(self._handle, self._kind, self.order, self._options, self._rank)
        arrays = self._entries, self._starts, self._places
        weakref.finalize(self, call, _RELEASE, *arrays, nothing, nothing, 1)
        self._call: Callable[..., int] = call
        self._arguments = *arrays, nothing, nothing, 1
        if call(_ANALYSE, *self._arguments):
            raise ZeroDivisionError
        peak, kept, factors = (int(kilobytes) for kilobytes in self._options[14:17])
        self.memory = 1024 * max(peak, kept + factors)
        self.copies = self._entries.nbytes + self._places.nbytes + self._starts.nbytes
        self.factors = int(self._options[17])
        self.operations = 0.5e6 * float(self._options[18])

    def factorize(self) -> None:
        """Compute the factors.

        Raises
        ------
        ZeroDivisionError
            If there are none: a pivot is zero, or of a definite matrix negative.
        """
        if self._call(_FACTORIZE, *self._arguments) or self._options[13]:  # pivots that were disturbed
            raise ZeroDivisionError

    def elimination(self) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Return the pivots (n,) of a definite matrix and their rows."""
        found = np.zeros(self.order)
        other, code = np.zeros(self.order), ctypes.c_int(0)
        _library().pardiso_getdiag(
            _pointer(self._handle), _pointer(found), _pointer(other), _integer(1), ctypes.byref(code)
        )
        return found, self._rank.astype(np.int64) - 1

    def solve(self, load: NDArray[Any]) -> NDArray[Any]:
        """Return the solutions of loads (n,) or (n, k)."""
        load = np.asarray(load)
        if np.iscomplexobj(load) and self._kind != _COMPLEX:
            return np.asarray(self.solve(load.real) + 1j * self.solve(load.imag))
        columns = np.array(load.reshape(self.order, -1), dtype=self._entries.dtype, order="F")
        if not columns.shape[1]:
            return columns.reshape(load.shape)
        found = np.zeros_like(columns, order="F")
        arrays = self._entries, self._starts, self._places
        if self._call(_SOLVE, *arrays, columns, found, columns.shape[1]):
            raise ZeroDivisionError
        return np.ascontiguousarray(found).reshape(load.shape)


def _caller(
    handle: NDArray[Any], kind: int, order: int, options: NDArray[Any], rank: NDArray[Any]
) -> Callable[..., int]:
    """Return the call of PARDISO for one matrix: phase, its entries, loads, solutions, how many; its code."""
    library = _library()

    def call(
        phase: int,
        entries: NDArray[Any],
        starts: NDArray[Any],
        places: NDArray[Any],
        loads: NDArray[Any],
        found: NDArray[Any],
        count: int,
    ) -> int:
        code = ctypes.c_int(0)
        library.pardiso(
            _pointer(handle),
            *map(_integer, (1, 1, kind, phase, order)),
            *map(_pointer, (entries, starts, places, rank)),
            _integer(count),
            _pointer(options),
            _integer(0),
            _pointer(loads),
            _pointer(found),
            ctypes.byref(code),
        )
        return code.value

    return call


def _pointer(values: NDArray[Any]) -> ctypes.c_void_p:
    return values.ctypes.data_as(ctypes.c_void_p)


def _integer(value: int) -> Any:
    return ctypes.byref(ctypes.c_int(value))
