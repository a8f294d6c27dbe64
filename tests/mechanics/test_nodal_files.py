"""Results at nodes in files of programs, against another reader, closed forms and the programs' matrices."""

import io
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from wavequake.errors import UserError
from wavequake.mechanics.importers.model import import_model
from wavequake.mechanics.nodal.modes import modes_of
from wavequake.mechanics.nodal.op2 import read_op2
from wavequake.mechanics.nodal.results import in_axes_of, read_results
from wavequake.mechanics.nodal.tables import packed, read_modes

DATA = Path(__file__).parents[1] / "data" / "nodal"


def brick():
    choice = {"units": "m,kg,s,N", "interfaces": "MOUNT", "surface": "MIRROR"}
    model = import_model(DATA.parent / "brick.sti", **choice).model
    return model, {int(number): row for row, number in enumerate(numbers_of_brick())}


def numbers_of_brick():
    """Its deck lists them in this order, which is that of the model's nodes."""
    return range(7, 207, 10)


def as_coordinates(model, rows, labels, shapes):
    """Displacements (n, p, 3) in the order of the model's degrees of freedom (n, 3 p)."""
    place = {rows[int(label)]: column for column, label in enumerate(labels)}
    columns = [place[int(node)] for node in model.dof_node]
    return shapes[:, columns, model.dof_direction]


def test_displacements_of_nastran_are_what_another_reader_finds():
    """pyNastran 1.4.1 reads the same of 52 of the .op2 files of its repository; here the last of 21 nodes."""
    found = read_results(DATA / "angle.op2", "mm", None)
    assert (found.kind, found.motions.shape) == ("case", (1, 21, 6))
    assert found.labels.tolist() == [*range(11, 20), *range(101, 113)]
    np.testing.assert_allclose(
        found.motions[0, -1], [-1.05059564e-3, -4.96730566e-4, 0, 0, 0, -0.0208812896], rtol=1e-8
    )
    np.testing.assert_allclose(found.points[:3], [[0, 0, 0], [0.010, 0, 0], [0.020, 0, 0]], atol=1e-12)


def test_a_mode_of_nastran_is_that_of_a_mass_on_a_spring():
    found = read_results(DATA / "rod_modes.op2", "m", None, ("mode",))
    np.testing.assert_allclose(found.values, np.sqrt(1e4 / 100.0) / (2 * np.pi), rtol=1e-7)
    # Normalized to a modal mass of 1, the mass of 100 moves by its inverse root.
    np.testing.assert_allclose(found.motions[0, :, :3], [[0, 0, 0.1], [0, 0, 0]], atol=1e-8)


def test_both_orders_of_bytes_hold_the_same(tmp_path):
    """The same file as a machine writes it whose numbers begin with their largest byte; letters stay."""
    data, turned, at = (DATA / "angle.op2").read_bytes(), b"", 0
    while at < len(data):
        (count,) = np.frombuffer(data, "<i4", 1, at)
        record = data[at + 4 : at + 4 + count]
        letters = count > 4 and all(32 <= byte < 127 for byte in record)
        body = record if letters else np.frombuffer(record, "<u4").byteswap().tobytes()
        turned += count.byteswap().tobytes() + body + count.byteswap().tobytes()
        at += count + 8
    (tmp_path / "angle.op2").write_bytes(turned)
    one, other = read_op2(DATA / "angle.op2"), read_op2(tmp_path / "angle.op2")
    np.testing.assert_array_equal(other.steps[0].values, one.steps[0].values)
    np.testing.assert_array_equal(other.points, one.points)


def test_modes_of_calculix_fit_its_matrices():
    """M-orthonormal, and K-orthogonal with the squared frequencies, to the six digits of the file."""
    model, rows = brick()
    found = read_results(DATA / "brick.frd", "m", None, ("mode",))
    assert found.motions.shape == (10, 20, 3)
    expected = np.loadtxt(DATA.parent / "brick_frequencies.csv", skiprows=1)[:4]
    np.testing.assert_allclose(found.values[6:], expected, rtol=1e-6)
    shapes = as_coordinates(model, rows, found.labels, found.motions)[6:]
    np.testing.assert_allclose(shapes @ model.mass @ shapes.T, np.eye(4), atol=2e-5)
    omega = 2 * np.pi * found.values[6:]
    stiffness = shapes @ model.stiffness @ shapes.T / np.outer(omega, omega)
    np.testing.assert_allclose(stiffness, np.eye(4), atol=2e-5)


def test_displacements_of_calculix_are_in_balance_with_the_load():
    model, rows = brick()
    found = read_results(DATA / "brick.frd", "m", None)
    assert found.kind == "case"
    force = model.stiffness @ as_coordinates(model, rows, found.labels, found.motions)[0]
    # Six digits of displacements as large as 1e-4 m and stiffnesses of 1e9 N/m leave some newtons; work none.
    at = [k for k in range(60) if (model.dof_node[k], model.dof_direction[k]) == (rows[47], 2)]
    moved = found.motions[0, found.labels.tolist().index(47), 2]
    work = as_coordinates(model, rows, found.labels, found.motions)[0] @ force
    assert len(at) == 1
    np.testing.assert_allclose(work, 10.0 * moved, rtol=1e-4)
    held = np.isin(found.labels, [7, 17, 107])
    np.testing.assert_array_equal(found.motions[0, held], 0.0)


def arrays_of(data):
    with np.load(io.BytesIO(data)) as file:
        return dict(file)


def test_units_and_modal_masses_change_shapes_as_they_must(tmp_path):
    """The same oscillator in other units: its mass of 4 moves by 1 / sqrt(4) per root of modal mass."""
    plain = arrays_of(modes_of(DATA / "rod_modes.op2", "m,kg,s,N"))
    np.testing.assert_allclose(plain["shapes"][0, 0], [0, 0, 0.1], atol=1e-8)
    tonnes = arrays_of(modes_of(DATA / "rod_modes.op2", "mm,t,s,N", damping=0.02, nodes=[8, 7]))
    np.testing.assert_allclose(tonnes["shapes"][0, 1], [0, 0, 0.1 / np.sqrt(1000.0)], atol=1e-9)
    np.testing.assert_allclose(tonnes["nodes_mm"], [[0.02, 0, 0], [0.02, 0, 0.01]], atol=1e-9)
    assert (tonnes["names"].tolist(), tonnes["damping_ratios"].tolist()) == (["8", "7"], [0.02])
    doubled = arrays_of(modes_of(DATA / "rod_modes.op2", "m,kg,s,N", masses=[4.0]))
    np.testing.assert_allclose(doubled["shapes"], plain["shapes"] / 2.0, rtol=1e-12)


MODES = """# two modes
mode,frequency_hz,damping_ratio,node,x_mm,y_mm,z_mm,dx,dy,dz
1,20,0.01,7,0,0,0,0.5,0,0
1,20,0.01,3,1,2,3,0,0.25,0
2,30.5,0.02,3,1,2,3,1,2,3
2,30.5,0.02,7,0,0,0,4,5,6
"""


def test_a_table_of_modes(tmp_path):
    path = tmp_path / "modes.csv"
    path.write_text(MODES)
    labels, points, frequencies, ratios, shapes = read_modes(path)
    assert (labels.tolist(), frequencies.tolist(), ratios.tolist()) == ([3, 7], [20.0, 30.5], [0.01, 0.02])
    np.testing.assert_array_equal(points, [[1e-3, 2e-3, 3e-3], [0, 0, 0]])
    np.testing.assert_array_equal(shapes, [[[0, 0.25, 0], [0.5, 0, 0]], [[1, 2, 3], [4, 5, 6]]])
    assert arrays_of(modes_of(path, None))["names"].tolist() == ["3", "7"]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (MODES.replace("dz", "dw"), "the column 'dz' is missing"),
        (MODES.replace("2,30.5,0.02,7", "2,30.5,0.02,3"), "one for each node in each mode"),
        (MODES.replace("2,30.5,0.02,7", "2,31.5,0.02,7"), "frequency of a mode is not the same"),
        (MODES.replace("1,2,3,1,2,3", "1,2,4,1,2,3"), "place of a node is not the same in all modes"),
        (MODES.replace("0.5", "much"), "numbers expected"),
        (MODES.replace(",0.5,", ",inf,"), "dx is inf"),
    ],
)
def test_bad_tables_of_modes_are_refused(tmp_path, text, words):
    path = tmp_path / "modes.csv"
    path.write_text(text)
    with pytest.raises(UserError, match=words):
        modes_of(path, None)


def test_what_is_missing_is_said(tmp_path):
    for file, unit, kinds, words in (
        ("angle.op2", None, ("case",), "does not say its unit of length"),
        ("angle.op2", "mm", ("mode",), "holds load cases, but modes are needed"),
        ("brick.txt", "mm", ("case",), "brick.txt"),
        ("brick.stl", "mm", ("case",), "no reader of nodal results for .stl"),
    ):
        with pytest.raises(UserError, match=words):
            read_results(DATA / file, unit, None, kinds)
    with pytest.raises(UserError, match="has 1 modes, but damping_ratios has 2 numbers"):
        modes_of(DATA / "rod_modes.op2", "m,kg,s,N", damping=[0.1, 0.2])
    with pytest.raises(UserError, match="has no node 12"):
        modes_of(DATA / "rod_modes.op2", "m,kg,s,N", nodes=[12])
    path = tmp_path / "nodes.npz"
    path.write_bytes(packed(True, np.array([0.0]), np.eye(3), np.ones((1, 3, 3))))
    with pytest.raises(UserError, match=r"says its units itself; leave unit = 'mm' out"):
        read_results(path, "mm", None)


def test_displacements_in_axes_of_their_own_are_turned(tmp_path):
    deck, labels = tmp_path / "mesh.bdf", read_op2(DATA / "angle.op2").steps[0].labels
    angle = dict(zip(labels.tolist(), np.linspace(10.0, 300.0, len(labels)), strict=True))
    axes = "CORD2C,7,,0.,0.,5.,0.,0.,6.\n,1.,0.,5.\n"

    def motions(own, file_axes=True):
        grids = (f"GRID,{node},7,2.,{angle[node]},{node}.,{own}" for node in labels)
        deck.write_text("BEGIN BULK\n" + axes + "\n".join(grids) + "\nENDDATA\n")
        written = in_axes_of(replace(read_op2(DATA / "angle.op2"), own_axes=file_axes), deck)
        return np.stack([step.values for step in written.steps])

    plain, turned = motions(""), motions("7")
    np.testing.assert_array_equal(plain, motions("7", file_axes=False))  # a table in the basic axes
    points = read_results(DATA / "angle.op2", "mm", deck).points
    for k, node in enumerate(labels.tolist()):
        c, s = np.cos(np.deg2rad(angle[node])), np.sin(np.deg2rad(angle[node]))
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        np.testing.assert_allclose(points[k], [2e-3 * c, 2e-3 * s, 1e-3 * (node + 5)], atol=1e-12)
        for first in range(0, plain.shape[2], 3):
            wanted = plain[:, k, first : first + 3] @ turn.T
            np.testing.assert_allclose(turned[:, k, first : first + 3], wanted, atol=1e-12)
    with pytest.raises(UserError, match=r"point \d+ moves in axes \(GRID, field CD\) that no CORD2R"):
        motions("9")


def test_cut_off_files_are_refused(tmp_path):
    for name in ("angle.op2", "rod_modes.op2", "brick.frd"):
        data = (DATA / name).read_bytes()
        path = tmp_path / name
        for part in (0.3, 0.6, 0.95):
            path.write_bytes(data[: int(part * len(data))])
            with pytest.raises(UserError, match=name):
                read_results(path, "mm", None, ("time", "case", "mode"))
