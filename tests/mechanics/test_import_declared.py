"""What formats do not say must be declared: half of a symmetric matrix, and empty rows that are fixed."""

import h5py
import numpy as np
import pytest
import scipy.io
import scipy.linalg
import scipy.sparse
import tetrahedron
from numpy.testing import assert_array_equal

from wavequake.errors import UserError
from wavequake.mechanics.importers import import_model

K, M = tetrahedron.matrices()
CHOICE = {"units": "m,kg,s,N", "interfaces": "MOUNTS", "surface": "MIRROR"}


@pytest.fixture
def folder(tmp_path):
    tetrahedron.write_deck(tmp_path / "truss.inp")
    tetrahedron.write_dofs(tmp_path / "truss.dof")
    return tmp_path


def check(model, rtol=1e-14):
    np.testing.assert_allclose(model.stiffness.toarray(), K, rtol=rtol, atol=rtol * 1e6)
    np.testing.assert_allclose(model.mass.toarray(), M, rtol=rtol, atol=rtol)


def files(folder):
    return {"mesh": folder / "truss.inp", "dofs": folder / "truss.dof"}


def write_market(folder, half, mass=M):
    """Write half of the stiffness, the whole mass."""
    scipy.io.mmwrite(
        folder / "truss_K.mtx", scipy.sparse.coo_array(half(K)), symmetry="general", precision=17
    )
    scipy.io.mmwrite(folder / "truss_M.mtx", mass, symmetry="general", precision=17)
    return folder / "truss_K.mtx"


def write_npz(folder, half, mass=M):
    np.savez(folder / "truss.npz", stiffness=half(K), mass=mass)
    return folder / "truss.npz"


def write_hdf5(folder, half, mass=M):
    sparse = scipy.sparse.csc_array(half(K))
    with h5py.File(folder / "truss.h5", "w") as file:
        file["mass"] = mass
        for part in ("data", "indices", "indptr"):
            file[f"stiffness/{part}"] = getattr(sparse, part)
    return folder / "truss.h5"


def write_output4(folder, half, form=2, mass=M):
    """Dense columns of text; form 2 is a square matrix, 6 a symmetric one (MSC Nastran, OUTPUT4)."""
    text = ""
    for name, matrix in (("KGG", half(K)), ("MGG", mass)):
        text += f"{12:8}{12:8}{form:8}{2:8}{name:8}1P,3E23.16\n"
        for column in range(12):
            numbers = [f"{number:23.16E}" for number in matrix[:, column]]
            text += f"{column + 1:8}{1:8}{12:8}\n"
            text += "".join("".join(numbers[k : k + 3]) + "\n" for k in range(0, 12, 3))
        text += f"{13:8}{1:8}{1:8}\n{1.0:23.16E}\n"
    (folder / "truss.op4").write_text(text)
    return folder / "truss.op4"


def write_punch(folder, half, form=1):
    """Large fields; form 1 is a square matrix, 6 a symmetric one (MSC Nastran, DMIG)."""
    text = ""
    for name, matrix in (("KGG", half(K)), ("MGG", M if form == 1 else half(M))):
        text += f"{'DMIG':8}{name:8}{0:8}{form:8}{2:8}{0:8}\n"
        for column, (node, direction) in enumerate(tetrahedron.DOFS):
            text += f"{'DMIG*':8}{name:16}{node:16}{direction:16}\n"
            for row in np.flatnonzero(matrix[:, column]):
                label, way = tetrahedron.DOFS[row]
                text += f"{'*':8}{label:16}{way:16}{matrix[row, column]:16.9E}\n"
    (folder / "truss.pch").write_text(text)
    return folder / "truss.pch"


UNDECLARED = [write_market, write_npz, write_hdf5, write_output4, write_punch]


@pytest.mark.parametrize("half", [np.triu, np.tril])
@pytest.mark.parametrize("write", UNDECLARED)
def test_half_of_a_matrix_that_is_not_said_to_be_symmetric_needs_to_be_declared(folder, write, half):
    path, side = write(folder, half), {np.triu: "upper", np.tril: "lower"}[half]
    words = (
        rf"^(stiffness of |KGG of |){path.name} holds the {side} triangle only, and its format does not say "
        rf"that it is symmetric; write the whole matrix, or say triangle = '{side}'$"
    )
    with pytest.raises(UserError, match=words):
        import_model(path, **files(folder), **CHOICE)
    imported = import_model(path, **files(folder), **CHOICE, triangle=side)
    check(imported.model, rtol=1e-9)
    assert imported.notes == ()


@pytest.mark.parametrize("write", UNDECLARED)
def test_the_other_half_than_declared_is_refused(folder, write):
    path = write(folder, np.triu)
    with pytest.raises(UserError, match=rf"{path.name} holds the upper triangle, but triangle = 'lower'"):
        import_model(path, **files(folder), **CHOICE, triangle="lower")


@pytest.mark.parametrize(
    ("write", "half"),
    [
        (write_output4, np.triu),
        (write_output4, np.tril),
        (write_output4, np.asarray),
        (write_punch, np.triu),
        (write_punch, np.tril),
    ],
)
def test_formats_that_say_symmetric_may_hold_one_half(folder, write, half):
    check(import_model(write(folder, half, form=6), **files(folder), **CHOICE).model, rtol=1e-9)


def test_a_whole_matrix_is_taken_as_it_is_where_a_triangle_is_declared(folder):
    check(import_model(write_npz(folder, np.asarray), **files(folder), **CHOICE, triangle="upper").model)


def test_a_diagonal_mass_is_no_triangle(folder):
    lumped = np.diag(M.sum(axis=0))
    np.savez(folder / "truss.npz", stiffness=K, mass=lumped)
    model = import_model(folder / "truss.npz", **files(folder), **CHOICE).model
    assert_array_equal(model.mass.toarray(), lumped)


def without(matrix, rows):
    matrix = matrix.copy()
    matrix[rows], matrix[:, rows] = 0.0, 0.0
    return matrix


FIXED = np.array([9, 11])  # node 40, directions 1 and 3
NO_NODE_40 = CHOICE | {"surface": [3, 8, 21]}


@pytest.mark.parametrize("write", [write_npz, write_hdf5, write_market, write_output4])
def test_empty_rows_need_to_be_declared(folder, write):
    def fixed(matrix):
        return without(matrix, FIXED)

    path = write(folder, fixed, mass=fixed(M))
    words = (
        r"^2 degrees of freedom have empty rows in stiffness and mass, the first at node 40, direction 1 "
        r"\(nodes 40\); if they are fixed say zero_rows = 'drop', otherwise their elements are missing$"
    )
    with pytest.raises(UserError, match=words):
        import_model(path, **files(folder), **NO_NODE_40)
    imported = import_model(path, **files(folder), **NO_NODE_40, zero_rows="drop")
    kept = np.delete(np.arange(12), FIXED)
    assert_array_equal(imported.model.stiffness.toarray(), K[np.ix_(kept, kept)])
    assert imported.notes == ("2 fixed degrees of freedom were left out (nodes 40)",)


def test_a_long_list_of_empty_rows_is_cut(folder):
    count = 12
    points = np.vstack([tetrahedron.POINTS, np.arange(3.0 * count).reshape(count, 3)])
    table = [(node + 1, direction) for node in range(4 + count) for direction in (1, 2, 3)]
    empty = np.zeros((3 * count, 3 * count))
    wide = [scipy.linalg.block_diag(part, empty) for part in (K, M)]
    np.savez(folder / "wide.npz", stiffness=wide[0], mass=wide[1], dofs=table, nodes=points)
    with pytest.raises(UserError, match=r"^36 degrees .* node 5, direction 1 \(nodes 5, 6, 7, 8, 9 \.\.\.\)"):
        import_model(folder / "wide.npz", units="m,kg,s,N", interfaces=[1, 2, 3], surface=[1, 2, 4])


def test_calculix_needs_no_declaration(folder):
    for name, matrix in (("truss.sti", K), ("truss.mas", M)):
        tetrahedron.write_triangle(folder / name, without(matrix, FIXED))
    imported = import_model(folder / "truss.sti", **NO_NODE_40)
    assert imported.model.order == 10
    assert imported.notes == ("2 fixed degrees of freedom were left out (nodes 40)",)


def test_a_row_beyond_physics_is_fixed_without_declaration(folder):
    stiffness, mass = without(K, FIXED), without(M, FIXED)
    stiffness[FIXED, FIXED] = 1e36  # as Abaqus writes
    np.savez(folder / "truss.npz", stiffness=stiffness, mass=mass)
    assert import_model(folder / "truss.npz", **NO_NODE_40).model.order == 10


def test_empty_rotations_of_solid_models_are_left_out(folder):
    dofs = np.vstack([tetrahedron.DOFS, [(3, 4), (3, 5), (3, 6)]])
    wide = {name: np.pad(matrix, (0, 3)) for name, matrix in (("stiffness", K), ("mass", M))}
    np.savez(folder / "truss.npz", **wide, dofs=dofs)
    imported = import_model(folder / "truss.npz", **CHOICE)
    assert imported.model.order == 12
    assert imported.notes == ("3 empty rotations were left out (nodes 3)",)
