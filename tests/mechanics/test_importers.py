"""Every file format gives the matrices of one truss whose closed form is known."""

import csv
import os
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
import scipy.io
import scipy.linalg
import scipy.sparse
import tetrahedron
from numpy.testing import assert_allclose, assert_array_equal

from wavequake.errors import UserError
from wavequake.mechanics.importers import ImportedModel, import_model, load_model
from wavequake.mechanics.mirrors.models import CircularMirror, circular_mirror
from wavequake.mechanics.model import rigid_modes

DATA = Path(__file__).parents[1] / "data"
K, M = tetrahedron.matrices()
CHOICE = {"units": "m,kg,s,N", "interfaces": "MOUNTS", "surface": "MIRROR"}


@pytest.fixture
def folder(tmp_path):
    tetrahedron.write_deck(tmp_path / "truss.inp")
    tetrahedron.write_dofs(tmp_path / "truss.dof")
    return tmp_path


def check(model, rtol=1e-14):
    assert_allclose(model.stiffness.toarray(), K, rtol=rtol, atol=rtol * 1e6)
    assert_allclose(model.mass.toarray(), M, rtol=rtol, atol=rtol)
    assert_array_equal(model.nodes, tetrahedron.POINTS)
    assert_array_equal(model.dof_node, np.repeat(np.arange(4), 3))
    assert_array_equal(model.dof_direction, np.tile(np.arange(3), 4))
    assert_array_equal(model.interfaces, [0, 1, 2])
    assert_array_equal(model.surface_nodes, [3, 0, 1])


def files(folder):
    return {"mesh": folder / "truss.inp", "dofs": folder / "truss.dof"}


def abaqus_lines(matrix, side):
    dofs = tetrahedron.DOFS
    pairs = {
        "lower": np.argwhere(np.tri(12, dtype=bool)),
        "upper": np.argwhere(np.tri(12, dtype=bool).T),
        "square": np.argwhere(np.ones((12, 12), dtype=bool)),
    }[side]
    return "** matrix\n*MATRIX INPUT, NAME=A\n" + "".join(
        f"{dofs[i][0]},{dofs[i][1]}, {dofs[j][0]},{dofs[j][1]}, {matrix[i, j]:.17e}\n" for i, j in pairs
    )


def test_calculix(folder):
    tetrahedron.write_triangle(folder / "truss.sti", K)
    tetrahedron.write_triangle(folder / "truss.mas", M)
    imported = import_model(folder / "truss.sti", **CHOICE)
    check(imported.model)
    assert imported.notes == ()


@pytest.mark.parametrize("side", ["lower", "upper", "square"])
def test_abaqus_matrix_input(folder, side):
    (folder / "truss_STIF2.mtx").write_text(abaqus_lines(K, side))
    (folder / "truss_MASS2.mtx").write_text(abaqus_lines(M, side))
    check(import_model(folder / "truss_STIF2.mtx", mesh=folder / "truss.inp", **CHOICE).model)


def test_fortran_exponents(folder):
    for name, matrix in (("truss_STIF2.mtx", K), ("truss_MASS2.mtx", M)):
        (folder / name).write_text(abaqus_lines(matrix, "lower").replace("e", "D"))
    check(import_model(folder / "truss_STIF2.mtx", mesh=folder / "truss.inp", **CHOICE).model)


def test_abaqus_coordinate(folder):
    for name, matrix in (("truss_K.mtx", K), ("truss_M.mtx", M)):
        (folder / name).write_text(
            "".join(f"{i + 1}, {j + 1}, {matrix[i, j]:.17e}\n" for i in range(12) for j in range(i + 1))
        )
    check(import_model(folder / "truss_K.mtx", **files(folder), **CHOICE).model)


@pytest.mark.parametrize("symmetry", ["general", "symmetric"])
@pytest.mark.parametrize("storage", [scipy.sparse.coo_array, np.asarray])
def test_matrix_market(folder, symmetry, storage):
    scipy.io.mmwrite(folder / "truss_K.mtx", storage(K), symmetry=symmetry, precision=17)
    scipy.io.mmwrite(folder / "mass.mtx", storage(M), symmetry=symmetry, precision=17)
    imported = import_model(folder / "truss_K.mtx", mass=folder / "mass.mtx", **files(folder), **CHOICE)
    check(imported.model)
    assert imported.notes == ()


OUTPUT4 = sorted(path.name for path in DATA.glob("truss_*.op4"))


def test_output4_files_are_there():
    assert len(OUTPUT4) == 7


# The OUTPUT4 and punch files were written by pyYeti 1.4.7 from the matrices of tetrahedron.py.
@pytest.mark.parametrize("name", OUTPUT4)
def test_nastran_output4(folder, name):
    check(import_model(DATA / name, **files(folder), **CHOICE).model)


def test_nastran_punch(folder):
    check(import_model(DATA / "truss.pch", mesh=folder / "truss.inp", **CHOICE).model, rtol=1e-9)


def test_nastran_small_fields(folder):
    def card(*fields):
        return fields[0].ljust(8) + "".join(str(part).rjust(8) for part in fields[1:]) + "\n"

    text = "$ comment\n"
    for name, matrix in (("KGG", np.rint(K)), ("MGG", np.rint(100 * M))):
        text += card("DMIG", name.ljust(8), 0, 6, 1, 0)
        for column, (node, direction) in enumerate(tetrahedron.DOFS):
            rows = [(*tetrahedron.DOFS[row], value(matrix[row, column])) for row in range(column, 12)]
            text += card("DMIG", name.ljust(8), node, direction, "", *rows[0])
            for pair in zip(rows[1::2], [*rows[2::2], ("", "", "")], strict=False):
                text += card("*"[:0], *pair[0], "", *pair[1])
    (folder / "truss.pch").write_text(text)
    model = import_model(folder / "truss.pch", **CHOICE).model
    assert_allclose(model.stiffness.toarray(), np.rint(K), rtol=1e-3, atol=1.0)
    assert_array_equal(model.mass.toarray(), np.rint(100 * M))


def value(number):
    """A real in eight characters with the exponent as Nastran shortens it: 2.2238+6."""
    mantissa, exponent = f"{number:.3E}".split("E")
    return f"{mantissa}{int(exponent):+d}"


def test_npz_with_everything(tmp_path):
    np.savez(
        tmp_path / "truss.npz",
        stiffness=K,
        mass=M,
        dofs=tetrahedron.DOFS,
        nodes=tetrahedron.POINTS,
        node_numbers=tetrahedron.NUMBERS,
    )
    nodes = {"interfaces": [3, 8, 21], "surface": (40, 3, 8)}
    check(import_model(tmp_path / "truss.npz", units="m,kg,s,N", **nodes).model)


def test_sparse_npz_one_matrix_each(folder):
    scipy.sparse.save_npz(folder / "truss_K.npz", scipy.sparse.csc_array(K))
    scipy.sparse.save_npz(folder / "truss_M.npz", scipy.sparse.csr_array(M))
    check(import_model(folder / "truss_K.npz", **files(folder), **CHOICE).model)


def test_hdf5_dense_and_sparse(folder):
    sparse = scipy.sparse.csc_array(K)
    with h5py.File(folder / "truss.h5", "w") as file:
        file["mass"] = M
        for part in ("data", "indices", "indptr"):
            file[f"stiffness/{part}"] = getattr(sparse, part)
    check(import_model(folder / "truss.h5", **CHOICE).model)


@pytest.fixture
def stub(tmp_path, monkeypatch):
    """Put a package in the place of ansys-mapdl-reader whose `load_km` has this body."""

    def make(body):
        package = tmp_path / "stub" / "ansys" / "mapdl"
        package.mkdir(parents=True)
        for place in (package, package.parent):
            (place / "__init__.py").touch()
        (package / "reader.py").write_text(
            "import json, os, sys\nimport numpy as np\nimport scipy.sparse\n"
            "class File:\n    def __init__(self, path):\n        self.path = path\n"
            f"    def load_km(self, as_sparse, sort):\n        {body}\nread_binary = File\n"
        )
        forget()
        monkeypatch.syspath_prepend(tmp_path / "stub")
        monkeypatch.setenv("PYTHONPATH", str(tmp_path / "stub"), prepend=os.pathsep)

    def forget():
        for name in [name for name in sys.modules if name.split(".")[0] == "ansys"]:
            del sys.modules[name]

    yield make
    forget()


def test_ansys_reader_returns_upper_triangles_and_counts_directions_from_zero(folder, stub):
    stub(
        "found = np.load(self.path); "
        "return found['dofs'], *(scipy.sparse.csc_matrix(found[one]) for one in 'KM')"
    )
    with open(folder / "truss.full", "wb") as file:
        np.savez(file, dofs=tetrahedron.DOFS - [0, 1], K=np.triu(K), M=np.triu(M))
    check(import_model(folder / "truss.full", **CHOICE).model)


# Goes on for ever if nobody limits its time, and else for a second of what it is given.
LOOPS = (
    "import resource, time; limit, most = resource.getrlimit(resource.RLIMIT_CPU); "
    "second = int(time.process_time()) + 1; "
    "0 < limit < 10 and resource.setrlimit(resource.RLIMIT_CPU, (min(limit, second), most)); "
    "exec('while True: pass')"
)


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ("raise KeyError('ptrSTF')", r"\.full file: 'ptrSTF'$"),
        ("print('hello'); os.abort()", r"its reader was ended by SIGABRT$"),
        ("import ctypes; ctypes.string_at(8)", r"its reader was ended by SIGSEGV$"),
        ("return np.zeros(10**9)", "allocate"),
        (LOOPS, r"its reader was ended by SIGXCPU$"),
        ("return [[1, 0]], None, None", "it holds no stiffness$"),
        (
            "bad = scipy.sparse.csc_matrix(np.eye(3)); bad.indices[1] = 7; return np.ones((3, 2)), bad, bad",
            "entries outside|indices|index",
        ),
        ("return [[1, 0]], *[scipy.sparse.csc_matrix(np.eye(3))] * 2", "3 rows, but there are 1 degrees"),
    ],
)
def test_an_ansys_reader_that_fails_takes_nobody_with_it(folder, stub, monkeypatch, body, words):
    monkeypatch.setenv("WAVEQUAKE_MOST_MB", "500")
    stub(body)
    (folder / "truss.full").write_bytes(b"stub")
    with pytest.raises(UserError, match=words):
        import_model(folder / "truss.full", **CHOICE)


def test_ansys_without_its_reader(folder, monkeypatch):
    monkeypatch.setitem(sys.modules, "ansys", None)
    with pytest.raises(UserError, match="pip install ansys-mapdl-reader"):
        import_model(folder / "truss.full", **CHOICE)


def test_ansys_example_file():
    reader = pytest.importorskip("ansys.mapdl.reader", reason="ansys-mapdl-reader is not installed")
    from wavequake.mechanics.importers.ansys import read_matrices
    from wavequake.mechanics.importers.checks import assemble, free_dofs

    contents = read_matrices(Path(reader.__file__).parent / "examples" / "file.full")
    notes = []
    stiffness, mass = (assemble(part, contents.dofs) for part in contents.matrices.values())
    # The example has 321 nodes, 21 of them clamped; the rest moves.
    assert len(free_dofs(stiffness, mass, contents.dofs, notes, drop=contents.keeps_fixed)) == 900


def test_calculix_plate_is_found_beside_its_stiffness():
    section = ImportedModel(file="plate.sti", units="m,kg,s,N", interfaces="INTERFACES", surface="SURFACE")
    imported = load_model(section, DATA)
    model = imported.model
    assert model.order == len((DATA / "plate.dof").read_text().split())
    assert model.damping.stiffness == 5e-6
    total = np.tile(np.eye(3), (len(model.nodes), 1))
    # pi/4 (1 m)^2 20 mm 2700 kg/m^3, less what the straight edges of few elements cut off.
    assert_allclose(total.T @ model.mass @ total, np.eye(3) * 42.4, rtol=0.02, atol=1e-9)
    rigid = rigid_modes(model.nodes, np.zeros(3))
    assert abs(model.stiffness @ rigid).max() < 1e-9 * abs(model.stiffness).max()
    assert model.surface_weights.min() > 0.0
    assert_allclose(model.surface_weights.sum(), 1.0, rtol=1e-14)


def test_calculix_plate_is_our_plate():
    section = ImportedModel(file="plate.sti", units="m,kg,s,N", interfaces="INTERFACES", surface="SURFACE")
    model = load_model(section, DATA).model
    own = circular_mirror(CircularMirror(focal_length=np.inf, mount_radius=0.5, core=1, rings=1))
    for name in ("stiffness", "mass"):
        theirs, ours = getattr(model, name), getattr(own, name)
        assert abs(theirs - ours).max() < 1e-12 * abs(ours).max()
    assert_array_equal(model.interfaces, own.interfaces)
    assert_array_equal(model.surface_nodes, own.surface_nodes)
    assert_allclose(model.surface_weights, own.surface_weights, rtol=1e-9)


# brick.*: one C3D20 of 0.2 x 0.3 x 0.01 m (70 GPa, 0.33, 2700 kg/m^3), stored and solved by CalculiX 2.20;
# brick_reduced.mas is the mass of the same element as C3D20R.
def test_frequencies_are_those_that_calculix_prints():
    section = ImportedModel(file="brick.sti", units="m,kg,s,N", interfaces=[7, 17, 27], surface="MIRROR")
    model = load_model(section, DATA).model
    squares = scipy.linalg.eigvalsh(model.stiffness.toarray(), model.mass.toarray())[6:]
    with open(DATA / "brick_frequencies.csv") as file:
        printed = np.array([float(row["frequency_Hz"]) for row in csv.DictReader(file)])
    assert_allclose(np.sqrt(squares[: len(printed)]) / (2 * np.pi), printed, rtol=5e-7)  # 7 digits


def test_units_scale_matrices_and_coordinates(folder):
    tetrahedron.write_triangle(folder / "truss.sti", K / 1e3)  # N/mm
    tetrahedron.write_triangle(folder / "truss.mas", M / 1e3)  # t
    deck = (folder / "truss.inp").read_text()
    for number, point in zip(tetrahedron.NUMBERS, tetrahedron.POINTS, strict=True):
        old = next(line for line in deck.splitlines() if line.startswith(f"{number}, ") and "." in line)
        deck = deck.replace(old, f"{number}, " + ", ".join(map(str, point * 1e3)))
    (folder / "truss.inp").write_text(deck)
    check(import_model(folder / "truss.sti", **CHOICE | {"units": "mm,t,s,N"}).model)
