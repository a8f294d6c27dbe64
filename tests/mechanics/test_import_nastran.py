"""Files that Nastran writes: superelements, and matrices among others that are neither stiffness nor mass.

Checked once by hand: the superelements of pyYeti's tests (nas2cam_extseout, BSD licence) have six rigid
motions and the mass 1.755052 t that Nastran prints for one of them.
"""

import struct

import numpy as np
import pytest
import tetrahedron
from numpy.testing import assert_allclose

from wavequake.errors import UserError
from wavequake.mechanics.importers import import_model, op4
from wavequake.mechanics.importers.mesh import read_mesh
from wavequake.mechanics.vibration.eigen import eigenmodes, mass_normalized_rigid_modes

K, M = tetrahedron.matrices()
CHOICE = {"units": "m,kg,s,N", "interfaces": [3, 8, 21], "surface": [3, 8, 21, 40]}


def dense_text(name, matrix, form=2):
    """A matrix in OUTPUT4's text: columns of three numbers a line; complex ones in pairs."""
    matrix = np.atleast_2d(matrix)
    kind = 4 if np.iscomplexobj(matrix) else 2
    rows, columns = matrix.shape
    text = f"{columns:8}{rows:8}{form:8}{kind:8}{name:8}1P,3E24.16\n"
    for number, column in enumerate(matrix.T, 1):
        values = np.ascontiguousarray(column).view(float)
        text += f"{number:8}{1:8}{len(values):8}\n"
        for start in range(0, len(values), 3):
            text += "".join(f"{value:24.16E}" for value in values[start : start + 3]) + "\n"
    return text + f"{columns + 1:8}{1:8}{1:8}\n{1.0:24.16E}\n"


def dense_binary(name, matrix, form=2):
    matrix = np.atleast_2d(matrix)
    kind = 4 if np.iscomplexobj(matrix) else 2
    rows, columns = matrix.shape

    def record(data):
        return struct.pack("<i", len(data)) + data + struct.pack("<i", len(data))

    found = record(struct.pack("<4i", columns, rows, form, kind) + name.ljust(8).encode())
    for number, column in enumerate(matrix.T, 1):
        data = np.ascontiguousarray(column).tobytes()
        found += record(struct.pack("<3i", number, 1, len(data) // 4) + data)
    return found + record(struct.pack("<3i", columns + 1, 1, 2) + struct.pack("<d", 1.0))


@pytest.mark.parametrize("write", [dense_text, dense_binary])
def test_loads_and_recovery_matrices_are_passed_over(write, tmp_path):
    parts = [
        write("PA", np.arange(12.0)[:, None]),
        write("VAX", np.arange(30.0).reshape(5, 6) * (1 + 2j)),
        write("KAA", K, 6),
        write("K4AA", 0.02 * K, 6),
        write("MAA", M, 6),
    ]
    path = tmp_path / "truss.op4"
    if write is dense_text:
        path.write_text("".join(parts))
    else:
        path.write_bytes(b"".join(parts))
    assert sorted(op4.read_matrices(path).matrices) == ["K4AA", "KAA", "MAA"]
    tetrahedron.write_deck(tmp_path / "truss.inp")
    tetrahedron.write_dofs(tmp_path / "truss.dof")
    model = import_model(path, **CHOICE).model
    assert_allclose(model.stiffness.toarray(), K, rtol=1e-15)
    assert_allclose(model.mass.toarray(), M, rtol=1e-15)


def test_a_file_of_other_matrices_says_what_it_holds(tmp_path):
    path = tmp_path / "loads.op4"
    path.write_text(dense_text("PA", np.arange(12.0)[:, None]))
    with pytest.raises(UserError, match="the matrix PA has 12 rows and 1 columns, not square"):
        op4.read_matrices(path)


def test_cards_of_other_matrices_are_passed_over(tmp_path):
    tetrahedron.write_deck(tmp_path / "truss.inp")
    lines = [f"DMIG    VAX            0{9:8}{2:8}{0:8}        {1:8}", "DMIG*   VAX     " + f"{1:16}{0:16}"]
    lines.append(f"*       {3:16}{1:16}{1.5:16.9E}")
    for name, matrix in (("KAAX", K), ("MAAX", M)):
        lines.append(f"DMIG    {name:8}{0:8}{6:8}{2:8}{0:8}")
        for column, (node, direction) in enumerate(tetrahedron.DOFS):
            lines.append(f"DMIG*   {name:16}{node:16}{direction:16}")
            for row in range(column, 12):
                other, along = tetrahedron.DOFS[row]
                lines.append(f"*       {other:16}{along:16}{matrix[row, column]:16.9E}")
    (tmp_path / "truss.pch").write_text("\n".join(lines) + "\n")
    model = import_model(tmp_path / "truss.pch", **CHOICE).model
    assert_allclose(model.stiffness.toarray(), K, rtol=1e-8, atol=1e-3)


AXES = "CORD2R*               10               0 0.100000000E+01 0.000000000E+00\n" + (
    "*        0.000000000E+00 0.100000000E+01 0.000000000E+00 0.100000000E+01\n"
    "*        0.100000000E+01 0.100000000E+01 0.000000000E+00\n"
)
# Its z is the global one, its x the global y, so its y is minus the global x.
TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def write_superelement(folder, axes=AXES, grids=tetrahedron.NUMBERS):
    """The truss with two modes of what hangs on it, point 8 in axes of its own."""
    rng = np.random.default_rng(0)
    coupling = 0.1 * rng.standard_normal((12, 2))
    stiffness = np.block([[K, np.zeros((12, 2))], [np.zeros((2, 12)), np.diag([4e6, 9e6])]])
    mass = np.block([[M, coupling], [coupling.T, np.eye(2)]])
    turn = np.eye(14)
    turn[3:6, 3:6] = TURN  # from its axes to the global ones
    parts = [dense_text("KXX", turn.T @ stiffness @ turn, 6), dense_text("MXX", turn.T @ mass @ turn, 6)]
    (folder / "truss.op4").write_text("".join([*parts, dense_text("PX", np.ones((14, 1)))]))
    cards = ["$ rows", "EXTRN          3     123       8     123      21     123      40     123"]
    cards += ["              91       0      92       0", axes.rstrip("\n")]
    for number, (x, y, z) in zip(tetrahedron.NUMBERS, tetrahedron.POINTS, strict=True):
        if number in grids:
            cards.append(f"GRID*   {number:16}{0:16}{x:16.9E}{y:16.9E}")
            cards.append(f"*       {z:16.9E}{10 if number == 8 else 0:16}{0:16}{0:16}")
    (folder / "truss.pch").write_text("\n".join(cards) + "\n")
    return stiffness, mass


def test_a_superelement_brings_its_rows_points_and_modes(tmp_path):
    stiffness, mass = write_superelement(tmp_path)
    model = import_model(tmp_path / "truss.op4", **CHOICE).model
    assert_allclose(model.stiffness.toarray(), stiffness, atol=1e-9)
    assert_allclose(model.mass.toarray(), mass, atol=1e-12)
    assert np.array_equal(model.dof_node[-2:], [-1, -1])
    assert_allclose(model.nodes, tetrahedron.POINTS)
    rigid = mass_normalized_rigid_modes(model)
    assert rigid.shape == (14, 6)
    assert np.abs(rigid[-2:]).max() < 1e-12  # modes with the boundary at rest stay at rest
    squared = np.linalg.eigvals(np.linalg.solve(mass, stiffness)).real
    wanted = np.sqrt(np.sort(squared)[6:]) / (2 * np.pi)
    assert_allclose(eigenmodes(model, 14)[0][6:], wanted, rtol=1e-9)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"axes": ""}, "point 8 moves in the axes 10, which are no CORD2R"),
        ({"grids": (3, 8, 21)}, "no GRID card of point 40"),
        ({"axes": AXES.replace("0 0.1", "7 0.1", 1)}, "nodes stand in the axes 7, which no CORD2R"),
        ({"axes": AXES.replace("0.100000000E+01", "0.1000x0000E+01")}, "is not a number"),
        ({"axes": AXES.partition("\n")[0]}, "CORD2R 10 needs three points"),
        ({"axes": AXES + "EXTRN          3"}, "point 3 has no components"),
        ({"axes": AXES + "GRID           x       0"}, "'X' is not the number of a point"),
    ],
)
def test_superelements_that_cannot_be_read(change, match, tmp_path):
    write_superelement(tmp_path, **change)
    with pytest.raises(UserError, match=match):
        import_model(tmp_path / "truss.op4", **CHOICE)


def test_a_punch_file_that_ends_within_a_number_is_cut_off(tmp_path):
    write_superelement(tmp_path)
    text = (tmp_path / "truss.pch").read_text()
    (tmp_path / "truss.pch").write_text(text[: text.rindex("E+")])  # of a coordinate, which is a number still
    with pytest.raises(UserError, match=r"truss\.pch, line .* has no end: the file is cut off"):
        import_model(tmp_path / "truss.op4", **CHOICE)


def test_properties_are_numbers(tmp_path):
    """07 is 7, as a number that a card begins with zeros."""
    nodes = [f"GRID,{k},,{x},{y},{z}" for k, (x, y, z) in enumerate(np.vstack([np.zeros(3), np.eye(3)]), 1)]
    rows = [*nodes, "CTETRA,1,07,1,2,3,4", "CTETRA,2,7,1,2,3,4", "CTETRA,3,70,1,2,3,4", "ENDDATA", ""]
    (tmp_path / "mesh.bdf").write_text("\n".join(rows))
    found = read_mesh(tmp_path / "mesh.bdf").element_sets
    assert {name: numbers.tolist() for name, numbers in found.items()} == {"7": [1, 2], "70": [3]}
