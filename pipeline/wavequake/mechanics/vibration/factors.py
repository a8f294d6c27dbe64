"""Factors of large sparse symmetric matrices, real or complex, definite or not.

Small matrices go to SuperLU. Large ones are eliminated front by front in dense blocks (multifrontal method,
Duff and Reid 1983) along a nested dissection, several times as fast, with half the numbers held, and with a
cost that is known before. Where PARDISO is installed they are its own, up to twice as fast again.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import psutil  # type: ignore[import-untyped]
import scipy  # its parts load when first used
from numpy.typing import NDArray
from scipy.sparse import csc_array

from wavequake.errors import UserError
from wavequake.mechanics.vibration import pardiso
from wavequake.mechanics.vibration.dissection import Dissection, Front, dissect

Array = NDArray[np.float64]
Integers = NDArray[np.int64]
Solver = Callable[[NDArray[Any]], NDArray[Any]]

LARGE = 15_000
"""From this order on matrices are dissected."""
PANEL = 256
REFINED = 1e-10
"""Residual of a solution, as a share of the load, from which on factors are given up for SuperLU's."""
_SINGULAR = (
    "a stiffness matrix is singular; the model has parts that hang together with nothing, or "
    "constrained degrees of freedom left in it as zero rows"
)


class NotDefiniteError(UserError):
    """A matrix has an eigenvalue that is zero or negative; `row` is where elimination met it."""

    def __init__(self, row: int) -> None:
        super().__init__(_SINGULAR)
        self.row = row


@dataclass(frozen=True)
class Factors:
    """Factors of a matrix.

    Attributes
    ----------
    solve : callable
        Maps loads (n,) or (n, k) to solutions.
    elimination : callable
        Returns the pivots and the row of each.
    """

    solve: Solver
    elimination: Callable[[], tuple[Array, Integers]]

    @property
    def pivots(self) -> Array:
        """Pivots of a definite matrix, in the order of elimination."""
        return self.elimination()[0]


def factorize(matrix: csc_array, definite: bool = False) -> Factors:
    """Return the factors of a symmetric matrix.

    Parameters
    ----------
    matrix : csc_array, shape (n, n)
        Real or complex; both triangles stored.
    definite : bool
        The matrix is said to be positive definite: a large one then takes half the time. Its pivots tell.

    Raises
    ------
    UserError
        If the matrix is singular or its factors would not fit the free memory; `NotDefiniteError` if a large
        one is said to be definite and is not.
    """
    matrix = csc_array(matrix)
    if matrix.shape[0] < LARGE:
        return _superlu(matrix, 0.0 if definite else 0.01)
    matrix.sum_duplicates()
    ways = (_by_pardiso, _by_dissection) if pardiso.is_there() else (_by_dissection,)
    for way in ways:
        try:
            factors = way(matrix, definite)
            if definite:
                return factors
            load = matrix @ np.random.default_rng(0).standard_normal(matrix.shape[0])
            residual = np.abs(matrix @ factors.solve(load) - load).max()
            if residual <= REFINED * np.abs(load).max():
                return factors
        except ZeroDivisionError:  # our own says where a matrix is not definite
            pass
    # A block was singular that the whole matrix does not make so: pivots must come from everywhere.
    return _superlu(matrix, 1.0, "COLAMD")


def _by_pardiso(matrix: csc_array, definite: bool) -> Factors:
    found = pardiso.Pardiso(matrix, definite)
    _require_memory(found.memory, found.order)
    found.factorize()
    return Factors(found.solve, found.elimination)


def _by_dissection(matrix: csc_array, definite: bool) -> Factors:
    dissection = dissect(matrix)
    _require_memory(dissection.memory(matrix.dtype.itemsize), matrix.shape[0])
    return _Multifrontal(matrix, dissection, definite).factors


def _require_memory(needed: int, order: int) -> None:
    available = int(psutil.virtual_memory().available)
    if needed > available:
        raise UserError(
            f"a factorization of {order} unknowns needs {needed / 1e9:.3g} GB of memory, and "
            f"{available / 1e9:.3g} GB are free; take a coarser mesh, or a machine with more memory"
        )


def _superlu(matrix: csc_array, threshold: float, order: str = "MMD_AT_PLUS_A") -> Factors:
    try:
        # Three to five times as fast as the defaults of SciPy, which are made for unsymmetric matrices.
        factors = scipy.sparse.linalg.splu(
            matrix, permc_spec=order, diag_pivot_thresh=threshold, options={"SymmetricMode": threshold < 1.0}
        )
    except RuntimeError as error:
        raise UserError(_SINGULAR) from error

    def elimination() -> tuple[Array, Integers]:
        return factors.U.diagonal(), np.argsort(factors.perm_c).astype(np.int64)

    return Factors(factors.solve, elimination)


class _Multifrontal:
    """Block factors F11 and F12 of each front; of a definite matrix L11 and F12^T L11^-T."""

    def __init__(self, matrix: csc_array, dissection: Dissection, definite: bool) -> None:
        self.dissection, self.definite = dissection, definite
        self.matrix = matrix
        self.blocks: list[tuple[Any, ...]] = []
        place = np.empty(matrix.shape[0], dtype=np.int64)
        place[dissection.order] = np.arange(matrix.shape[0])
        passed: dict[int, NDArray[Any]] = {}
        for index, front in enumerate(dissection.fronts):
            own = front.last - front.first
            dense = self._assembled(front, place)
            for child in front.children:
                extend(dense, passed.pop(child), dissection.fronts[child].border, front)
            rest = self._eliminate(dense, own, front)
            if len(front.border):
                passed[index] = rest
        self.factors = Factors(self.solve if definite else self.refined, self.elimination)

    def _assembled(self, front: Front, place: Integers) -> NDArray[Any]:
        own = front.last - front.first
        dense = np.zeros((own + len(front.border),) * 2, dtype=self.matrix.dtype, order="F")
        variables = self.dissection.order[front.first : front.last]
        begin, end = (self.matrix.indptr[variables + step].astype(np.int64) for step in (0, 1))
        counts = end - begin
        entries = np.arange(counts.sum()) + np.repeat(begin - np.cumsum(counts) + counts, counts)
        rows = place[self.matrix.indices[entries]]
        columns = np.repeat(np.arange(own), counts)
        kept = rows >= front.first
        dense[_local(rows[kept], front), columns[kept]] = self.matrix.data[entries[kept]]
        return dense

    def _eliminate(self, dense: NDArray[Any], own: int, front: Front) -> NDArray[Any]:
        """Keep the factors of a front (its lower triangle counts), return what is left of its border."""
        if self.definite:
            lower, below, rest, info = eliminate_definite(dense, own)
            if info:
                raise NotDefiniteError(int(self.dissection.order[front.first + info - 1]))
            self.blocks.append((lower, below))
            return rest
        pivot, below, rest = _parts(dense, own)
        pivot = np.tril(pivot) + np.tril(pivot, -1).T
        getrf, getrs = scipy.linalg.lapack.get_lapack_funcs(("getrf", "getrs"), (pivot,))
        block, swaps, info = getrf(pivot, overwrite_a=1)
        if info or not np.abs(np.diag(block)).min() > 1e-14 * np.abs(np.diag(block)).max():
            raise ZeroDivisionError
        if len(below):
            moved = getrs(block, swaps, below.T)[0]
            for column in range(0, len(rest), PANEL):  # its lower triangle only
                rest[column:, column : column + PANEL] -= below[column:] @ moved[:, column : column + PANEL]
        self.blocks.append((block, swaps, below))
        return rest

    def solve(self, load: NDArray[Any]) -> NDArray[Any]:
        """Return the solutions of loads (n,) or (n, k)."""
        return self._substituted(load, self._forward_definite, self._back_definite)

    def refined(self, load: NDArray[Any]) -> NDArray[Any]:
        """Return the solutions, with one step of refinement: pivots came from their own blocks only."""
        found = self._substituted(load, self._forward, self._back)
        rest = self._substituted(load - self.matrix @ found, self._forward, self._back)
        return np.asarray(found + rest)

    def _substituted(self, load: NDArray[Any], forward: Any, back: Any) -> NDArray[Any]:
        values: NDArray[Any] = np.asfortranarray(load.reshape(len(load), -1)[self.dissection.order])
        if np.iscomplexobj(values) and not np.iscomplexobj(self.matrix.data):
            real, imaginary = (self._substituted(part, forward, back) for part in (load.real, load.imag))
            return np.asarray(real + 1j * imaginary)
        values = values.astype(self.matrix.dtype)
        for front, block in zip(self.dissection.fronts, self.blocks, strict=True):
            forward(values, front, block)
        for front, block in zip(self.dissection.fronts[::-1], self.blocks[::-1], strict=True):
            back(values, front, block)
        result: NDArray[Any] = np.empty_like(values)
        result[self.dissection.order] = values
        return result.reshape(load.shape)

    @staticmethod
    def _forward_definite(values: NDArray[Any], front: Front, block: tuple[Any, ...]) -> None:
        own = scipy.linalg.blas.dtrsm(1.0, block[0], values[front.first : front.last], lower=1)
        values[front.first : front.last] = own
        if len(front.border):
            values[front.border] -= block[1] @ own

    @staticmethod
    def _back_definite(values: NDArray[Any], front: Front, block: tuple[Any, ...]) -> None:
        own = values[front.first : front.last]
        if len(front.border):
            own = own - block[1].T @ values[front.border]
        values[front.first : front.last] = scipy.linalg.blas.dtrsm(1.0, block[0], own, lower=1, trans_a=1)

    @staticmethod
    def _forward(values: NDArray[Any], front: Front, block: tuple[Any, ...]) -> None:
        getrs = scipy.linalg.lapack.get_lapack_funcs("getrs", (block[0],))
        own = getrs(block[0], block[1], values[front.first : front.last])[0]
        values[front.first : front.last] = own
        if len(front.border):
            values[front.border] -= block[2] @ own

    @staticmethod
    def _back(values: NDArray[Any], front: Front, block: tuple[Any, ...]) -> None:
        if len(front.border):
            getrs = scipy.linalg.lapack.get_lapack_funcs("getrs", (block[0],))
            coupled = block[2].T @ values[front.border]
            values[front.first : front.last] -= getrs(block[0], block[1], coupled)[0]

    def elimination(self) -> tuple[Array, Integers]:
        """Return the pivots of a definite matrix and their rows."""
        pivots = [np.diag(block[0]) ** 2 for block in self.blocks]
        return np.concatenate(pivots), self.dissection.order


def _local(places: Integers, front: Front) -> Integers:
    """Return rows of a front's dense block, from places in the order of elimination."""
    own = front.last - front.first
    inside = np.searchsorted(front.border, places) + own
    return np.where(places < front.last, places - front.first, inside)


def _parts(dense: NDArray[Any], own: int) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    parts = (dense[:own, :own], dense[own:, :own], dense[own:, own:])
    pivot, below, rest = (np.asfortranarray(part) for part in parts)
    return pivot, below, rest


def eliminate_definite(dense: Array, own: int) -> tuple[Array, Array, Array, int]:
    """Return L11, L21 and what is left of a front (its lower triangle), and the row of a failure (or 0)."""
    pivot, below, rest = _parts(dense, own)
    lower, info = scipy.linalg.lapack.dpotrf(pivot, lower=1, overwrite_a=1)
    if not info and len(below):
        below = scipy.linalg.blas.dtrsm(1.0, lower, below, side=1, lower=1, trans_a=1, overwrite_b=1)
        rest = scipy.linalg.blas.dsyrk(-1.0, below, beta=1.0, c=rest, lower=1, overwrite_c=1)
    return lower, below, rest, int(info)


def extend(dense: NDArray[Any], part: NDArray[Any], border: Integers, front: Front) -> None:
    """Add the lower triangle that a child passes on."""
    rows = _local(border, front)
    for column, row in enumerate(rows):  # a third of the time of indexing both at once
        dense[:, row][rows[column:]] += part[column:, column]
