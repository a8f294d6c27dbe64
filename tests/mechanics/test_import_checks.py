"""Damaged, contradictory and unsuitable files are refused in one clear sentence."""

from pathlib import Path

import numpy as np
import pytest
import scipy.io
import scipy.sparse
import tetrahedron
from pydantic import ValidationError

from wavequake.errors import UserError
from wavequake.mechanics.importers import ImportedModel, import_model
from wavequake.mechanics.importers.units import si_factors

K, M = tetrahedron.matrices()
CHOICE = {"units": "m,kg,s,N", "interfaces": "MOUNTS", "surface": "MIRROR"}
DATA = Path(__file__).parents[1] / "data"


@pytest.fixture
def file(tmp_path):
    tetrahedron.write_deck(tmp_path / "truss.inp")
    tetrahedron.write_dofs(tmp_path / "truss.dof")
    tetrahedron.write_triangle(tmp_path / "truss.sti", K)
    tetrahedron.write_triangle(tmp_path / "truss.mas", M)
    return tmp_path / "truss.sti"


def refused(file, match, **change):
    with pytest.raises(UserError, match=match):
        import_model(file, **CHOICE | change)


def edit(path, old, new):
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


def in_npz(file, stiffness=K, mass=M, dofs=tetrahedron.DOFS):
    path = file.with_suffix(".npz")
    np.savez(path, stiffness=stiffness, mass=mass, dofs=dofs)
    return path


def changed(matrix, row, column, value):
    result = matrix.copy()
    result[row, column] = value
    return result


def test_line_that_is_cut_off(file):
    lines = file.read_text().splitlines()
    file.write_text("\n".join([*lines[:40], lines[40][:8]]))
    refused(file, "truss.sti, line 41 has no end: the file is cut off")
    file.write_text("\n".join([*lines[:40], lines[40][:4], ""]))
    refused(file, "truss.sti, line 41: 3 numbers expected, found '5 9'; the file may be cut off")


def test_line_that_is_no_number(file):
    edit(file, "2 2  ", "2 2  x")
    refused(file, r"truss.sti, line 3: 3 numbers expected, found '2 2  x")


def test_file_that_ends_early(file):
    lines = file.read_text().splitlines()
    file.write_text("\n".join(lines[:40]) + "\n")
    refused(file, "ends with row 4, column 9, not on the diagonal: the file is cut off")


def test_file_that_ends_early_on_the_diagonal(file):
    lines = file.read_text().splitlines()
    file.write_text("\n".join(lines[:45]) + "\n")
    refused(file, "truss.sti has 9 rows, but there are 12 degrees of freedom")


def test_position_outside_the_matrix(file):
    edit(file, "2 3  ", "2 30  ")
    refused(file, "truss.sti, line 5: row 2, column 30 lies outside the matrix of order 12")


def test_not_a_number(file):
    edit(file, file.read_text().splitlines()[4], "2 3 nan")
    refused(file, "truss.sti: entry 5 is nan")


def test_entry_given_twice(file):
    edit(file, "2 3  ", "1 3  ")
    refused(
        file, r"gives 1 entries more than once, the first at row 1, column 3 \(node 3, direction 1; node 3"
    )


def test_empty_and_missing_files(file):
    refused(file.with_name("other.sti"), "other.sti cannot be read")
    file.write_text("\n")
    refused(file, "truss.sti is empty")


def test_no_mass_beside(file):
    file.with_suffix(".mas").unlink()
    refused(file, "no mass matrix found beside truss.sti; name it with the key mass")


def test_no_dofs_beside(file):
    file.with_suffix(".dof").unlink()
    refused(file, "truss.sti does not say which degrees of freedom its rows are")


def test_no_mesh_beside(file):
    file.with_suffix(".inp").unlink()
    refused(file, "no coordinates for truss.sti")


def test_node_without_coordinates(file):
    edit(file.with_suffix(".inp"), "40, 0.5, 0.5, 1.5\n", "")
    edit(file.with_suffix(".inp"), "*ELEMENT, TYPE=C3D4, ELSET=BODY\n1, 3, 8, 21, 40\n", "")
    refused(
        file, "truss.inp has no coordinates of node 40 .degree of freedom; 3 such nodes", surface=[3, 8, 21]
    )


def test_dof_listed_twice(file):
    edit(file.with_suffix(".dof"), "8.2", "8.1")
    refused(file, "lists node 8, direction 1 twice")


@pytest.mark.parametrize("units", [None, ""])
def test_units_are_never_guessed(file, units):
    refused(file, "units of truss.sti are not declared; say for example units = 'm,kg,s,N'", units=units)


@pytest.mark.parametrize(
    ("units", "match"),
    [
        ("mm,kg,s,N", r"do not fit together: kg mm/s\^2 is 0.001 N, and N is 1 N"),
        ("m,kg,s", "length, mass, time and force are needed"),
        ("yd,kg,s,N", "'yd' is no unit of length, known are m, cm, mm"),
    ],
)
def test_units_that_do_not_fit(units, match):
    with pytest.raises(UserError, match=match):
        si_factors(units)


@pytest.mark.parametrize("units", ["m,kg,s,N", "mm,t,s,N", "mm,kg,ms,kN", "in,slinch,s,lbf", "ft,slug,s,lbf"])
def test_coherent_systems(units):
    length, mass, stiffness = si_factors(units)
    time = 1e-3 if ",ms," in units else 1.0
    assert stiffness == pytest.approx(mass / time**2, rel=1e-9)  # k/m is 1/time^2 in any coherent system
    assert length > 0


def test_unknown_node_set_names_the_nearest(file):
    refused(file, "no node set 'MIROR' .surface., did you mean MIRROR", surface="MIROR")


def test_unknown_node_number(file):
    refused(file, "no coordinates of node 5 .interfaces", interfaces=[3, 5])


def test_empty_choice(file):
    refused(file, "surface is empty", surface=[])


def test_unsymmetric_matrix_says_where_and_how_much(file):
    path = in_npz(file, stiffness=changed(K, 1, 5, K[1, 5] + 1e4))
    refused(
        path,
        r"not symmetric: the entries at \(node 3, direction 2\) x \(node 8, direction 3\)|8, direction 3",
    )


def test_round_off_between_the_triangles_is_evened_out(file):
    path = in_npz(file, stiffness=changed(K, 1, 5, K[1, 5] + 1e-5))
    stiffness = import_model(path, **CHOICE).model.stiffness
    assert (stiffness != stiffness.T).nnz == 0


def test_unsymmetric_square_of_abaqus(file):
    dofs = tetrahedron.DOFS
    wrong = changed(K, 1, 5, K[1, 5] + 1e4)
    for name, matrix in (("t_STIF1.mtx", wrong), ("t_MASS1.mtx", M)):
        lines = [
            f"{dofs[i][0]},{dofs[i][1]},{dofs[j][0]},{dofs[j][1]},{matrix[i, j]!r}".replace("np.float64(", "")
            for i in range(12)
            for j in range(12)
        ]
        file.with_name(name).write_text("\n".join([*lines, ""]).replace(")", ""))
    refused(file.with_name("t_STIF1.mtx"), "t_STIF1.mtx is not symmetric", mesh=file.with_suffix(".inp"))


def test_wrong_number_of_columns_of_abaqus(file):
    file.with_name("a_K.mtx").write_text("1,1,2,2\n")
    refused(file.with_name("a_K.mtx"), "line 1: 4 numbers, but a matrix of Abaqus has 5")


@pytest.mark.parametrize("how", ["zero rows", "penalty"])
def test_fixed_degrees_of_freedom_are_left_out_with_a_note(file, how):
    fixed = np.arange(9, 12)  # node 40
    stiffness, mass = K.copy(), M.copy()
    for matrix in (stiffness, mass):
        matrix[fixed] = 0.0
        matrix[:, fixed] = 0.0
    if how == "penalty":
        stiffness[fixed, fixed] = 1e36
    drop = {"zero_rows": "drop"} if how == "zero rows" else {}
    imported = import_model(in_npz(file, stiffness, mass), **CHOICE | {"surface": [3, 8, 21]}, **drop)
    assert imported.model.order == 9
    assert np.array_equal(imported.model.stiffness.toarray(), K[:9, :9])
    assert imported.notes == ("3 fixed degrees of freedom were left out (nodes 40)",)
    refused(in_npz(file, stiffness, mass), "node 40 of surface is fixed in x", **drop)


@pytest.mark.parametrize("direction", [7, -1])
def test_unknown_directions_are_refused(file, direction):
    dofs = tetrahedron.DOFS.copy()
    dofs[4] = 8, direction
    refused(in_npz(file, dofs=dofs), f"node 8, direction {direction} is none: directions are 1 to 3")


def test_surface_nodes_need_their_three_displacements(file):
    dofs = tetrahedron.DOFS.copy()
    dofs[4] = 8, 5
    refused(in_npz(file, dofs=dofs), "node 8 of surface is fixed in y or belongs to no element")


def test_massless_node(file):
    mass = M.copy()
    mass[3:6] = 0.0
    mass[:, 3:6] = 0.0
    imported = import_model(in_npz(file, mass=mass), **CHOICE)
    assert imported.notes == (
        "3 degrees of freedom have no mass (the first: node 8, direction 1) but a stiffness",
    )
    refused(in_npz(file, mass=0 * mass), "no degree of freedom has a mass")
    mass[3, 0] = mass[0, 3] = 0.1
    refused(in_npz(file, mass=mass), "indefinite at node 8, direction 1")


def reduced_integration():
    """Bars integrated at their middle: m/4 [[1, 1], [1, 1]]. A tree of three of them leaves a null vector."""
    mass = np.zeros((12, 12))
    for pair in ((0, 1), (1, 2), (2, 3)):
        rows = np.concatenate([3 * node + np.arange(3) for node in pair])
        mass[np.ix_(rows, rows)] += np.kron(np.ones((2, 2)), np.eye(3)) / 4
    assert np.linalg.matrix_rank(mass) == 9
    return mass


def test_a_singular_mass_is_noted_where_the_stiffness_holds(file):
    imported = import_model(in_npz(file, mass=reduced_integration()), **CHOICE)
    assert len(imported.notes) == 1
    assert "is singular (at node" in imported.notes[0]


def test_a_motion_with_neither_mass_nor_stiffness_is_refused(file):
    """The null vector of the mass, (1, -1, 1, -1) in x, made one of the stiffness as well."""
    null = np.kron([1.0, -1.0, 1.0, -1.0], [1.0, 0.0, 0.0]) / 2
    keep = np.eye(12) - np.outer(null, null)
    refused(
        in_npz(file, keep @ K @ keep, reduced_integration()),
        r"singular together: a motion of node .*, direction 1 has neither mass nor stiffness",
    )


def test_indefinite_mass(file):
    mass = M + np.kron(np.diag([1.0, -0.4], 2)[:4, :4] + np.diag([1.0, -0.4], 2)[:4, :4].T, np.eye(3)) * 9
    assert np.linalg.eigvalsh(mass)[0] < 0.0
    refused(in_npz(file, mass=mass), "mass .* is indefinite: a motion of node .* has a negative mass")


def test_mass_of_c3d20r_from_calculix():
    imported = import_model(
        DATA / "brick.sti", mass=DATA / "brick_reduced.mas", **CHOICE | {"interfaces": "MOUNT"}
    )
    assert "brick_reduced.mas is singular" in imported.notes[0]


def test_node_attached_to_nothing(file):
    stiffness = K.copy()
    stiffness[3:6] = 0.0
    stiffness[:, 3:6] = 0.0
    refused(in_npz(file, stiffness), "node 8, direction 1 has mass but no stiffness")


def test_negative_diagonal(file):
    refused(in_npz(file, changed(K, 3, 3, -1.0)), "the stiffness at node 8, direction 1 is negative")


def test_everything_fixed(file):
    refused(in_npz(file, 0 * K, 0 * M), "every degree of freedom is fixed or empty")


def test_not_square(file):
    refused(in_npz(file, K[:, :5]), r"stiffness of truss.npz has the shape \(12, 5\)")


def test_complex_matrix(file):
    refused(in_npz(file, scipy.sparse.coo_array(K).toarray() * 1j), "complex, a real matrix is needed")


def test_npz_without_matrices(file):
    np.savez(file.with_suffix(".npz"), a=1.0)
    refused(file.with_suffix(".npz"), "holds no matrix called stiffness or mass, only a")


def test_no_npz_and_no_hdf5(file):
    for suffix in (".npz", ".h5", ".op4", ".pch"):
        file.with_suffix(suffix).write_text("something else\nand more of it\n" * 9)
        refused(file.with_suffix(suffix), f"truss{suffix}")


def test_unknown_suffix(file):
    refused(file.with_suffix(".rst"), "no reader for .rst, known are .mtx, .sti")


@pytest.mark.parametrize("size", [300, 2000])
@pytest.mark.parametrize("name", ["truss_bigmat_binary.op4", "truss_dense_text.op4"])
def test_output4_cut_off(file, name, size):
    path = file.with_name("cut.op4")
    path.write_bytes((DATA / name).read_bytes()[:size])
    refused(path, "cut.op4 is no OUTPUT4 file, or is cut off")


def test_punch_cut_off(file):
    path = file.with_suffix(".pch")
    path.write_text((DATA / "truss.pch").read_text()[:-9])
    refused(path, "truss.pch, line 116 has no end: the file is cut off")
    path.write_text((DATA / "truss.pch").read_text()[:-17] + "\n")
    refused(path, "truss.pch: '' is not a number; the file may be cut off")


def test_complex_dmig(file):
    path = file.with_suffix(".pch")
    path.write_text((DATA / "truss.pch").read_text().replace("6       2       0", "6       4       0"))
    refused(path, r"KAAX is complex \(TIN 4\)")


@pytest.mark.parametrize("storage", [scipy.sparse.coo_array, np.asarray])
def test_matrix_market_with_other_lines_than_announced(file, storage):
    path = file.with_name("t_K.mtx")
    scipy.io.mmwrite(path, storage(K), precision=17)
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines[:3], "", *lines[3:]]) + "\n")
    import_model(
        path,
        mass=file.with_suffix(".mas"),
        dofs=file.with_suffix(".dof"),
        **CHOICE,
        mesh=file.with_suffix(".inp"),
    )
    for body in (lines[:-3], [*lines, *lines[-9:]]):
        path.write_text("\n".join(body) + "\n")
        refused(path, r"t_K.mtx is no complete Matrix Market file: it announces \d+ entries and has")
    path.write_text("\n".join(lines))
    refused(path, r"t_K.mtx, line \d+ has no end: the file is cut off")


@pytest.mark.parametrize("name", ["truss.sti", "truss.mas"])
def test_zero_bytes(file, name):
    path = file.with_name(name)
    path.write_bytes(path.read_bytes().replace(b"00", b"0\0", 1))
    refused(file, f"{name} holds zero bytes: it is no text file, or it is damaged")


def test_ambiguous_names(file):
    path = file.with_suffix(".pch")
    path.write_text((DATA / "truss.pch").read_text().replace("MAAX", "BAAX"))
    refused(path, "holds KAAX, BAAX: exactly one must be the mass")


@pytest.mark.parametrize(
    "wrong", [{"files": "x"}, {"units": None}, {"damping_beta": -1.0}, {"interfaces": 3}, {"surface": [1.5]}]
)
def test_section_of_a_study_is_strict(wrong):
    right = {"file": "a.sti", "units": "m,kg,s,N", "interfaces": ["A", 3], "surface": "B"}
    ImportedModel(**right)
    with pytest.raises(ValidationError):
        ImportedModel(**right | wrong)


@pytest.mark.parametrize("name", sorted(path.name for path in DATA.glob("truss_*.op4")))
def test_damaged_output4_is_refused_or_read_but_never_hangs(file, name):
    good = (DATA / name).read_bytes()
    path = file.with_name("bad.op4")
    rng = np.random.default_rng(11)
    for place in rng.integers(0, len(good), 40):
        path.write_bytes(good[:place] + rng.bytes(1) + good[place + 1 :])
        try:
            import_model(path, dofs=file.with_suffix(".dof"), mesh=file.with_suffix(".inp"), **CHOICE)
        except UserError:
            continue
