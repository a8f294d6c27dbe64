"""Large factors by nested dissection against dense solutions, and their cost against what was forecast."""

import subprocess
import sys
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.sparse import block_diag, coo_array, csc_array, diags_array, eye_array, kron

from wavequake.errors import UserError
from wavequake.mechanics.vibration import factors, pardiso
from wavequake.mechanics.vibration.dissection import LEAF, dissect
from wavequake.mechanics.vibration.factors import NotDefiniteError, factorize
from wavequake.mechanics.vibration.forecast import forecast

GROWTH = """
import ctypes
import sys
sys.path.insert(0, "TESTS")
from test_factors import grid
from wavequake.mechanics.vibration import pardiso
from wavequake.mechanics.vibration.forecast import by_pardiso

def held(what):
    (line,) = [line for line in open("/proc/self/status") if line.startswith(what)]
    return 1024 * int(line.split()[1])

matrix = grid(int(sys.argv[1]), int(sys.argv[1]), 8)
told = by_pardiso(matrix).memory
ctypes.CDLL("libc.so.6").malloc_trim(0)
open("/proc/self/clear_refs", "w").write("5")
before = held("VmRSS")
pardiso.Pardiso(matrix, True).factorize()
print(told, held("VmHWM") - before)
""".replace("TESTS", str(Path(__file__).parent))


def path(count):
    return diags_array([-np.ones(count - 1), 2.0 * np.ones(count), -np.ones(count - 1)], offsets=[-1, 0, 1])


def grid(*counts):
    """The Laplacian of a grid with three coupled unknowns at each point."""
    total = csc_array((1, 1))
    for count in counts:
        total = kron(total, eye_array(count)) + kron(eye_array(total.shape[0]), path(count))
    coupled = np.array([[2.0, 0.5, 0.1], [0.5, 3.0, -0.4], [0.1, -0.4, 2.5]])
    return csc_array(kron(total, coupled))


@pytest.fixture(autouse=True)
def everything_is_large(monkeypatch):
    monkeypatch.setattr(factors, "LARGE", 0)
    monkeypatch.setenv(pardiso.OFF, "1")


@pytest.fixture(params=["ours", "pardiso"])
def way(request, monkeypatch):
    """Factors of our own, and those of PARDISO where it is installed."""
    if request.param == "pardiso":
        monkeypatch.delenv(pardiso.OFF)
        if not pardiso.is_there():
            pytest.skip("PARDISO is not installed: pip install mkl")
    return request.param


MATRICES = {
    "grid": grid(9, 8, 7),
    "sheet": grid(30, 21),
    "two parts": csc_array(block_diag([grid(12, 9), grid(5, 4, 4)])),
    "diagonal": csc_array(diags_array(np.linspace(1.0, 2.0, 300))),
    "small": grid(3, 3),
    "dense": csc_array(np.ones((200, 200)) + 7 * np.eye(200)),
}


@pytest.mark.parametrize("name", MATRICES)
@pytest.mark.parametrize("kind", ["definite", "indefinite", "complex"])
def test_solutions_are_those_of_dense_algebra(name, kind, way):
    matrix = MATRICES[name]
    size = matrix.shape[0]
    shift = {"definite": 0.0, "indefinite": 4.3, "complex": 4.3 - 0.2j}[kind]
    if kind != "definite" and name in ("dense", "diagonal"):
        shift = shift - 2.8
    matrix = csc_array(matrix - shift * eye_array(size))
    loads = np.random.default_rng(0).standard_normal((size, 3))
    found = factorize(matrix, definite=kind == "definite")
    wanted = np.linalg.solve(matrix.toarray(), loads)
    assert_allclose(found.solve(loads), wanted, rtol=0, atol=1e-9 * np.abs(wanted).max())
    assert_allclose(found.solve(loads[:, 0]), wanted[:, 0], rtol=0, atol=1e-9 * np.abs(wanted).max())
    assert_allclose(found.solve(1j * loads), 1j * wanted, rtol=0, atol=1e-9 * np.abs(wanted).max())


def test_pivots_have_the_determinant_and_tell_where_a_matrix_is_not_definite(way):
    matrix = MATRICES["sheet"]
    pivots, rows = factorize(matrix, definite=True).elimination()
    assert np.log(pivots).sum() == pytest.approx(np.linalg.slogdet(matrix.toarray())[1], rel=1e-12)
    assert np.array_equal(np.sort(rows), np.arange(matrix.shape[0]))
    # Elimination takes from a diagonal and adds nothing; the first row has its own.
    assert (pivots <= matrix.diagonal()[rows] * (1 + 1e-12)).all()
    assert pivots[0] == pytest.approx(matrix.diagonal()[rows[0]])
    change = csc_array(coo_array(([-50.0], ([100], [100])), shape=matrix.shape))
    with pytest.raises(NotDefiniteError) as caught:
        factorize(csc_array(matrix + change), definite=True)
    assert isinstance(caught.value, UserError)
    # The unknown itself, or one of the same block or after it.
    assert 0 <= caught.value.row < matrix.shape[0]


def test_blocks_that_are_singular_by_themselves_are_no_obstacle(way):
    """Springs between points and Lagrange multipliers: no pivot of the latter comes from its own block."""
    half = grid(8, 8)
    size = half.shape[0]
    saddle = csc_array(kron(np.array([[0.0, 1.0], [1.0, 0.0]]), half))
    load = np.random.default_rng(1).standard_normal(2 * size)
    wanted = np.linalg.solve(saddle.toarray(), load)
    assert_allclose(factorize(saddle).solve(load), wanted, rtol=0, atol=1e-9 * np.abs(wanted).max())


@pytest.mark.parametrize("definite", [True, False])
def test_singular_matrices_are_refused(definite, way):
    free = csc_array(grid(20, 20) * 0.0)
    with pytest.raises(UserError, match="singular"):
        factorize(free, definite=definite)


@pytest.mark.parametrize("name", MATRICES)
def test_an_order_of_elimination_has_all_couplings_in_its_fronts(name):
    """Symbolic elimination, row by row, fills nothing outside them."""
    matrix = MATRICES[name]
    plan = dissect(matrix)
    assert np.array_equal(np.sort(plan.order), np.arange(matrix.shape[0]))
    assert plan.fronts[-1].last == matrix.shape[0]
    inverse = np.argsort(plan.order)
    rows, columns = matrix.nonzero()
    after = [set() for _ in plan.order]
    for row, column in zip(inverse[rows], inverse[columns], strict=True):
        if row > column:
            after[column].add(int(row))
    owner = np.repeat(np.arange(len(plan.fronts)), [front.last - front.first for front in plan.fronts])
    for place, coupled in enumerate(after):
        front = plan.fronts[owner[place]]
        assert coupled <= set(range(place + 1, front.last)) | set(front.border.tolist())
        if coupled:  # what elimination of this unknown couples
            first = min(coupled)
            after[first] |= coupled - {first}


def test_factors_hold_as_many_numbers_as_forecast():
    for name in ("grid", "sheet", "two parts"):
        matrix = MATRICES[name]
        plan = dissect(matrix)
        found = factors._Multifrontal(matrix, plan, True)
        held = sum(part.size for block in found.blocks for part in block)
        assert held == plan.entries
        assert plan.entries <= plan.peak


def test_memory_is_that_of_the_forecast():
    """On three sizes, traced as it is allocated; small ones have more of what is not numbers."""
    for count in (12, 20, 28):
        matrix = grid(count, count, 4)
        plan = dissect(matrix)
        tracemalloc.start()
        kept = factors._Multifrontal(matrix, plan, True)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert kept.blocks
        assert forecast(matrix).memory == pytest.approx(peak, rel=0.2)


def test_memory_of_pardiso_is_that_of_the_forecast(way):
    """On three sizes, by what the whole process grows; the largest has 48,600 unknowns."""
    if way == "ours":
        pytest.skip("its own memory is measured above")
    for count in (26, 34, 45):
        done = subprocess.run([sys.executable, "-c", GROWTH, str(count)], capture_output=True, text=True)
        told, grown = map(float, done.stdout.split())
        assert told == pytest.approx(grown, rel=0.2)


def test_forecast_counts_entries_and_operations():
    dense = MATRICES["dense"]  # one block: n^2 numbers held, n^3 / 3 operations
    small = csc_array(dense[:90][:, :90])
    plan = dissect(small)
    assert plan.entries == 90**2
    assert plan.operations(True) == pytest.approx(90**3 / 3)
    told = str(forecast(small))
    assert told.startswith("a factorization of 90 unknowns (0.0081 million entries) holds 0.0081 million")


def test_what_does_not_fit_the_memory_is_refused_with_what_it_needs(monkeypatch, way):
    class Memory:
        available = 10_000

    monkeypatch.setattr(factors.psutil, "virtual_memory", Memory)
    with pytest.raises(UserError, match=r"1512 unknowns needs 0\.\d+ GB of memory, and 1e-05 GB are free"):
        factorize(MATRICES["grid"])


def test_dissection_fills_as_theory_says():
    """A square of n x n points has 31/4 n^2 log2 n entries, a band of it n^3 (George 1973)."""
    sizes = np.array([40, 80, 160])
    entries = []
    for size in sizes:
        plain = csc_array(kron(path(size), eye_array(size)) + kron(eye_array(size), path(size)))
        entries.append(dissect(plain).entries)
    theory = 7.75 * sizes**2 * np.log2(sizes)
    assert (np.array(entries) < 1.6 * (theory + LEAF * sizes**2)).all()
    assert entries[2] / entries[1] < 5.0  # a band has 8
