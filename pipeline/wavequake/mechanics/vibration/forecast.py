"""What factors of a large matrix will cost, said before they are computed."""

import time
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csc_array, diags_array, eye_array, kron

from wavequake.mechanics.vibration import pardiso
from wavequake.mechanics.vibration.dissection import Front, dissect
from wavequake.mechanics.vibration.factors import eliminate_definite, extend
from wavequake.prepared import prepared

# Fronts that are timed, blocks and borders: the large one is bound by arithmetic, the small one by memory.
_TIMED = ((800, 1200), (110, 350))

# Points along a side of the cubes, with three unknowns each, of which PARDISO's factors are timed.
_CUBES = (9, 14)

_BESIDE = 1.3
"""What gathering entries in new memory adds to these blocks, measured at 20, 25 and 50 thousand unknowns."""


@dataclass(frozen=True)
class Forecast:
    """Cost of one factorization of a positive definite matrix.

    Attributes
    ----------
    order, entries : int
        Rows, and entries that are not zero, of the matrix.
    factors : int
        Numbers that the factors hold.
    memory : int
        Most bytes that are held at one time, factors included.
    operations : float
        Multiplications and additions.
    seconds : float
        Processor time of one thread of this machine.
    """

    order: int
    entries: int
    factors: int
    memory: int
    operations: float
    seconds: float

    @property
    def size(self) -> str:
        """A sentence of what is the same on every machine."""
        return (
            f"a factorization of {self.order} unknowns ({self.entries / 1e6:.3g} million entries) holds "
            f"{self.factors / 1e6:.3g} million numbers, {self.memory / 1e9:.2g} GB, and takes "
            f"{self.operations / 1e9:.2g} billion operations"
        )

    def __str__(self) -> str:
        return f"{self.size}, about {self.seconds:.2g} s of one processor"


def forecast(matrix: csc_array) -> Forecast:
    """Return what the factors of a positive definite matrix cost, by PARDISO where it is installed."""
    return by_pardiso(matrix) if pardiso.is_there() else by_dissection(matrix)


def by_pardiso(matrix: csc_array) -> Forecast:
    """Return what PARDISO's factors cost.

    Its analysis says what it will ask for at the most; the time follows from two small matrices here.
    """
    start = time.process_time()
    found = pardiso.Pardiso(matrix, True)
    order = time.process_time() - start
    arithmetic, traffic = _pardiso_rates()
    seconds = order + arithmetic * found.operations + traffic * found.factors
    return Forecast(
        matrix.shape[0], matrix.nnz, found.factors, found.memory + found.copies, found.operations, seconds
    )


def by_dissection(matrix: csc_array) -> Forecast:
    """Return what our own factors cost.

    The memory follows from the order of elimination and is exact; the time from that of two blocks here.
    """
    start = time.process_time()
    plan = dissect(matrix)
    order = time.process_time() - start
    arithmetic, traffic = _rates()
    operations = plan.operations(True)
    moved = float(sum((front.last - front.first + len(front.border)) ** 2 for front in plan.fronts))
    seconds = order + _BESIDE * (arithmetic * operations + traffic * moved)
    return Forecast(matrix.shape[0], matrix.nnz, plan.entries, plan.memory(8), operations, seconds)


@prepared(maxsize=1)
def _pardiso_rates() -> tuple[float, float]:
    """Return PARDISO's seconds per operation and per number of the factors, from two that are timed."""
    costs, sizes = [], []
    for count in _CUBES:
        line = diags_array(
            [-np.ones(count - 1), 2.0 * np.ones(count), -np.ones(count - 1)], offsets=[-1, 0, 1]
        )
        grid = csc_array((1, 1))
        for _ in range(3):
            grid = kron(grid, eye_array(count)) + kron(eye_array(grid.shape[0]), line)
        cube = csc_array(kron(grid, np.eye(3) + 0.1))
        best = np.inf
        for _ in range(3):
            found = pardiso.Pardiso(cube, True)
            start = time.process_time()
            found.factorize()
            best = min(best, time.process_time() - start)
        costs.append(best)
        sizes.append((found.operations, float(found.factors)))
    arithmetic, traffic = np.linalg.solve(np.array(sizes), np.array(costs))
    return max(float(arithmetic), 0.0), max(float(traffic), 0.0)


@prepared(maxsize=1)
def _rates() -> tuple[float, float]:
    """Return seconds per operation and per number of a front, from two fronts that are timed."""
    costs, sizes = [], []
    for own, border in _TIMED:
        total = own + border
        front = Front(0, own, np.arange(own, total), ())
        dense = np.asfortranarray(np.eye(total) * total + 1.0)
        rest, best = np.zeros((border, border), order="F"), np.inf
        for _ in range(3):
            block = dense.copy(order="F")
            start = time.process_time()
            block = np.zeros((total, total), order="F") + block
            extend(block, rest, np.arange(own, total), front)
            eliminate_definite(block, own)
            best = min(best, time.process_time() - start)
        costs.append(best)
        sizes.append((own**3 / 3 + own**2 * border + own * border**2, float(total) ** 2))
    arithmetic, traffic = np.linalg.solve(np.array(sizes), np.array(costs))
    return max(float(arithmetic), 0.0), max(float(traffic), 0.0)
