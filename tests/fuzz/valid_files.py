"""Small valid files of every kind that readers of users' files take."""

import io
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

import numpy as np

DATA = Path(__file__).parents[1] / "data"


def data(*names: str) -> tuple[Callable[[], bytes], ...]:
    return tuple((DATA / name).read_bytes for name in names)


def text(content: str) -> tuple[Callable[[], bytes], ...]:
    return (content.encode,)


def head(name: str, lines: int) -> Callable[[], bytes]:
    return lambda: b"".join((DATA / name).read_bytes().splitlines(keepends=True)[:lines])


def bundled(name: str) -> Callable[[], bytes]:
    from wavequake.files import folder

    return (folder("workflows") / f"{name}.toml").read_bytes


@lru_cache
def telescope():
    from wavequake.optics.segments.layout import tmt18_segments

    return tmt18_segments()


def corner_table() -> bytes:
    names = telescope().names
    rows = [f"{names[k]},{1 + k % 6},{1e-4 * k},-2e-4" for k in range(4)]
    return "\n".join(["segment,corner,dx_mm,dy_mm", *rows, ""]).encode()


def controller_npz() -> bytes:
    a = np.array([[0.9, 0.2], [-0.2, 0.9]])
    return packed(A=a, B=np.ones((2, 1)), C=np.ones((1, 2)), D=np.eye(1), sample_time_s=0.002)


def squares() -> tuple[np.ndarray, np.ndarray]:
    stiffness = 4.0 * np.eye(6) - np.eye(6, k=1) - np.eye(6, k=-1)
    return stiffness, np.eye(6)


def dense_npz() -> bytes:
    stiffness, mass = squares()
    nodes = np.array([[node, direction] for node in (1, 2) for direction in (1, 2, 3)])
    return packed(stiffness=stiffness, mass=mass, dofs=nodes, nodes=np.eye(2, 3), node_numbers=[1, 2])


def packed(**arrays: object) -> bytes:
    out = io.BytesIO()
    np.savez(out, **arrays)
    return out.getvalue()


def sparse_npz() -> bytes:
    from scipy.sparse import csc_array

    parts = {}
    for name, matrix in zip(("stiffness", "mass"), map(csc_array, squares()), strict=True):
        parts |= {f"{name}_{part}": getattr(matrix, part) for part in ("data", "indices", "indptr")}
    return packed(**parts)


def scipy_npz() -> bytes:
    from scipy.sparse import csr_array, save_npz

    out = io.BytesIO()
    save_npz(out, csr_array(squares()[0]))
    return out.getvalue()


def hdf5() -> bytes:
    import h5py

    out = io.BytesIO()
    with h5py.File(out, "w") as file:
        file["stiffness"], file["mass"] = squares()
        file.create_dataset("nodes", data=np.eye(2, 3), compression="gzip", chunks=True)
        file["note"] = "text"
    return out.getvalue()


def market() -> bytes:
    from scipy.io import mmwrite
    from scipy.sparse import coo_array

    out = io.BytesIO()
    mmwrite(out, coo_array(squares()[0]))
    return out.getvalue()


def through_meshio(suffix: str, **options: object) -> Callable[[], bytes]:
    def make() -> bytes:
        import tempfile

        import meshio

        points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]])
        solid = meshio.Mesh(points, [("tetra", [[0, 1, 2, 3], [1, 2, 3, 4]])])
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / f"mesh{suffix}"
            meshio.write(file, solid, **options)
            return file.read_bytes()

    return make


def gmsh(**options: object) -> Callable[[], bytes]:
    return through_meshio(".msh", file_format="gmsh", **options)


def history_npz() -> bytes:
    time = np.linspace(0.0, 1.0, 5)
    heights = np.random.default_rng(1).normal(size=(5, 4, 4))
    return packed(**{"time_s": time, "M1.dx_um": time, "M1.grid_nm": heights, "M1.grid_spacing_mm": 10.0})


def telemetry_table() -> dict[str, object]:
    values = np.random.default_rng(2).normal(size=(520, 2)).round(3)
    return {"time_s": np.arange(520) / 100, "M2.dx_um": values[:, 0], "line_of_sight.x_mas": values[:, 1]}


def telemetry_csv() -> bytes:
    table = telemetry_table()
    rows = "".join(f"{t:.2f},{a:.3f},{b:.3f}\n" for t, a, b in zip(*table.values(), strict=True))
    note = "# what a damage to the rows would mostly be: a gap in time\n" * 400
    return (note + ",".join(table) + "\n" + rows).encode()


def telemetry_npz() -> bytes:
    return packed(**telemetry_table())


def telemetry_fits() -> bytes:
    from astropy.io import fits

    out = io.BytesIO()
    columns = [fits.Column(name, "D", array=values) for name, values in telemetry_table().items()]
    fits.HDUList([fits.PrimaryHDU(), fits.BinTableHDU.from_columns(columns)]).writeto(out)
    return out.getvalue()


def npy() -> bytes:
    out = io.BytesIO()
    np.save(out, np.arange(24.0).reshape(4, 6))
    return out.getvalue()


def matrices_npz() -> bytes:
    stiffness, mass = squares()
    return packed(mass=mass, stiffness=stiffness, nodes_mm=np.eye(2, 3), inputs=np.eye(6), names=["a", "b"])


def turning_npz() -> bytes:
    stiffness, mass = squares()
    arrays = {"mass": mass, "stiffness": stiffness, "damping": 0.01 * stiffness, "nodes_mm": np.eye(2, 3)}
    return packed(**arrays, inputs=np.eye(6), turns=np.eye(6))


def modes_npz() -> bytes:
    shapes = np.arange(24.0).reshape(2, 2, 6)
    return packed(
        frequencies_hz=[3.0, 5.0], damping_ratios=0.01, nodes_mm=np.eye(2, 3), shapes=shapes, names=["a", "b"]
    )


def nodal_npz() -> bytes:
    shifts = np.arange(30.0).reshape(2, 5, 3)
    return packed(nodes_mm=np.eye(5, 3), displacements_um=shifts, time_s=[0.0, 1.0])


def nodal_rows(head: str, steps: tuple[str, ...]) -> str:
    rows = [f"{step},{node},{node}.5,0,{node % 3},0.1,-0.{node},0.3" for step in steps for node in range(9)]
    return "\n".join([head, *rows, ""])


def loads_npz() -> bytes:
    time = np.linspace(0.0, 1.0, 8)
    return packed(**{"time_s": time, "tube.top.fx_n": np.sin(time), "ground.dx_um": time})


def results_of_ansys() -> bytes:
    """Return the results that come with the library that reads them."""
    from ansys.mapdl.reader import examples

    return Path(examples.rstfile).read_bytes()


def png() -> bytes:
    from PIL import Image

    out = io.BytesIO()
    Image.fromarray(np.arange(64, dtype=np.uint8).reshape(8, 8)).save(out, "PNG")
    return out.getvalue()


SAG = "# mm\n" + "\n".join(",".join(f"{row * column:.3f}" for column in range(5)) for row in range(4)) + "\n"
GRID = "4 4 10.0 10.0 0 0 0\n" + "".join(f"{k * 0.01:.4f} 0 0 0\n" for k in range(16))
HISTORY = "time_s,M1.dx_um,M1.rx_urad\n" + "".join(f"{k / 10},{k},{-k}\n" for k in range(8))
TEMPERATURES = "temperature_c,M1.dz_um,M1.z4_nm\n" + "".join(f"{k},{k}.5,{-k}\n" for k in range(9))
LOADS = "time_s,tube.top.fx_n,ground.rx_urad\n" + "".join(f"{k / 10},{k % 3},{-k}\n" for k in range(9))
SPECTRUM = "frequency_hz,psd\n" + "".join(f"{k},{1 / k}\n" for k in range(1, 9))
RECORD = "time_s,command_mm,sensor_mm,image_mm\n" + "".join(
    f"{k / 1000},0,{0.1 * k},{'' if k % 2 else 0.2 * k}\n" for k in range(40)
)
FORCES = "time_s,force_n\n" + "".join(f"{k / 100},{k % 3}\n" for k in range(30))
CLUSTER = "interface: ib0\njobs: 2\nprocesses: 4\nmemory: 4 GiB\nwalltime: '01:00:00'\nmodules: [gcc/13]\n"
OP4 = [f"truss_{form}.op4" for form in (
    "big_endian", "bigmat_binary", "bigmat_text", "dense_binary", "dense_text", "nonbigmat_binary",
    "nonbigmat_text")]  # fmt: skip
