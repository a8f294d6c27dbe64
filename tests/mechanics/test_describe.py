"""`wavequake info FILE` of files of finite-element programs: what they hold, or a sentence why not."""

from pathlib import Path

import numpy as np
import pytest

import wavequake as wq
from wavequake.errors import UserError
from wavequake.mechanics.nodal.describe import FILES

DATA = Path(__file__).parents[1] / "data"
# Counted in the files by hand (grep) or known from the programs that wrote them.
HELD = {
    "brick.inp": (
        "20 nodes, 0.2 x 0.3 x 0.01",
        "hexahedron20 1",
        "MOUNT 3",
        "AL, modulus 7e+10, poisson 0.33",
    ),
    "brick.sti": ("60 x 60, 1830 entries, half", "beside it: brick.mas, brick.dof, brick.inp"),
    "brick.mas": ("60 x 60",),
    "truss.pch": ("KAAX: 12 x 12", "MAAX: 12 x 12"),
    "truss_big_endian.op4": ("KAA: 12 x 12", "MAA: 12 x 12"),
    "truss_dense_text.op4": ("KAA: 12 x 12", "MAA: 12 x 12"),
    "nodal/hot_bricks.op2": ("1 load case: temperatures of 12 nodes, 300 to 1300", "1 x 1 x 2"),
    "nodal/rod_modes.op2": ("1 mode, 1.59155 to 1.59155 Hz",),  # sqrt(1e4 / 100) rad/s
    "nodal/brick.frd": ("10 modes, 0 to 1667.15 Hz", "1 load case: displacements of 20 nodes"),
}


@pytest.mark.parametrize("name", HELD)
def test_what_a_file_holds_is_said(name):
    said = wq.info(DATA / name)
    assert said.startswith(Path(name).name)
    for words in HELD[name]:
        assert words in said


@pytest.mark.parametrize("name", HELD)
def test_a_file_that_is_cut_off_is_a_sentence(name, tmp_path):
    data = (DATA / name).read_bytes()
    (tmp_path / Path(name).name).write_bytes(data[: len(data) // 3])
    with pytest.raises(UserError, match=Path(name).name.replace(".", r"\.")):
        wq.info(tmp_path / Path(name).name)


def written(folder):
    """Files of the other formats."""
    import h5py
    import meshio
    import scipy.io

    points = np.array([[0.0, 0, 0], [2, 0, 0], [0, 3, 0], [0, 0, 4]])
    both = {"stiffness": np.eye(12) * 2.0, "mass": np.eye(12)}
    dofs = np.array([(node, direction) for node in range(1, 5) for direction in (1, 2, 3)])
    np.savez(folder / "k.npz", **both, dofs=dofs, nodes=points)
    with h5py.File(folder / "k.h5", "w") as file:
        for name, matrix in both.items():
            file[name] = matrix
    scipy.io.mmwrite(folder / "k.mtx", scipy.sparse.csc_array(np.eye(12)))
    np.savez(folder / "n.npz", nodes_mm=points, displacements_um=np.ones((2, 4, 3)), time_s=[0.0, 0.5])
    np.savetxt(folder / "n.txt", np.hstack([points, points]))
    (folder / "n.csv").write_text("x_mm,y_mm,z_mm,temperature_c\n0,0,0,20\n1,0,0,23\n")
    (folder / "m.csv").write_text("mode,frequency_hz,node,x_mm,y_mm,z_mm,dx,dy,dz\n1,7.5,3,0,0,0,1,0,0\n")
    mesh = meshio.Mesh(points, [("tetra", [[0, 1, 2, 3]])])
    for name, form in (("t.vtu", "vtu"), ("t.vtk", "vtk"), ("t.msh", "gmsh")):
        mesh.write(folder / name, file_format=form)
    (folder / "t.bdf").write_text(
        "GRID,1,,0.,0.,0.\nGRID,2,,2.,0.,0.\nGRID,3,,0.,3.,0.\nGRID,4,,0.,0.,4.\nCTETRA,1,5,1,2,3,4\n"
        "PSOLID,5,6\nMAT1,6,7.+4,,.33,2.7-9,2.3-5\nENDDATA\n"
    )


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("k.npz", ("stiffness: 12 x 12", "mass: 12 x 12", "12 directions of 4 nodes", "4 nodes, 2 x 3 x 4")),
        ("k.h5", ("stiffness: 12 x 12", "no mass, rows or mesh of that name")),
        ("k.mtx", ("12 x 12, 12 entries",)),
        ("n.npz", ("2 instants, 0 to 0.5 s: displacements of 4 nodes",)),
        ("n.txt", ("1 load case: displacements of 4 nodes, 0 to 4", "2 x 3 x 4")),
        ("n.csv", ("1 load case: temperatures of 2 nodes, 20 to 23",)),
        ("m.csv", ("table of 1 mode, 7.5 to 7.5 Hz",)),
        ("t.vtu", ("4 nodes, 2 x 3 x 4", "tetra 1")),
        ("t.vtk", ("tetra 1",)),
        ("t.msh", ("tetra 1",)),
        ("t.bdf", ("element sets: 5 1", "MAT1 6, modulus 70000, poisson 0.33, density 2.7e-09")),
    ],
)
def test_other_formats(name, words, tmp_path):
    written(tmp_path)
    said = wq.info(tmp_path / name)
    for one in words:
        assert one in said


def test_glasses_of_a_catalogue(tmp_path):
    """1.5168 is n_d of N-BK7, whose Sellmeier coefficients (Schott) these are."""
    numbers = "1.03961212 0.00600069867 0.231792344 0.0200179144 1.01046945 103.560653"
    (tmp_path / "own.agf").write_text(f"NM CROWN 2 0 1.5168 64.17\nCD {numbers}\nLD 0.31 2.3\n")
    assert wq.info(tmp_path / "own.agf").split()[-2:] == ["CROWN", "1.516800"]


def test_what_is_no_such_file_is_a_sentence(tmp_path):
    for suffix in FILES:
        with pytest.raises(UserError, match=r"none\."):
            wq.info(tmp_path / f"none{suffix}")
        (tmp_path / f"noise{suffix}").write_bytes(bytes(range(256)) * 40)
        if suffix not in (".full", ".rst", ".rth"):  # whose reader may be missing
            with pytest.raises(UserError, match="noise"):
                wq.info(tmp_path / f"noise{suffix}")
