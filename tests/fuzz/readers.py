"""Every reader of users' files, each with small valid files."""

import base64
import io
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import full_file
import lens_readers as lenses
import numpy as np

DATA = Path(__file__).parents[1] / "data"


@dataclass(frozen=True)
class Reader:
    """What reads a file of the suffix, and makers of valid files."""

    suffix: str
    read: Callable[[Path], object]
    valid: tuple[Callable[[], bytes], ...]


def data(*names: str) -> tuple[Callable[[], bytes], ...]:
    return tuple((DATA / name).read_bytes for name in names)


def text(content: str) -> tuple[Callable[[], bytes], ...]:
    return (content.encode,)


def head(name: str, lines: int) -> Callable[[], bytes]:
    return lambda: b"".join((DATA / name).read_bytes().splitlines(keepends=True)[:lines])


def study(path: Path) -> object:
    from wavequake.workflows.study import load_study

    return load_study(path)


def bundled(name: str) -> Callable[[], bytes]:
    from wavequake.files import folder

    return (folder("workflows") / f"{name}.toml").read_bytes


def cluster(path: Path) -> object:
    from wavequake.cluster.template import Slurm, read_template

    return read_template(Slurm, path)


def mesh(path: Path) -> object:
    from wavequake.mechanics.importers.mesh import read_mesh

    return read_mesh(path)


def matrices(path: Path) -> object:
    from wavequake.mechanics.importers.model import READERS

    return READERS[path.suffix](path)


def model(path: Path) -> object:
    """Read stiffness, mass, degrees of freedom or mesh from `path`, by its first bytes, and join all."""
    from wavequake.mechanics.importers.model import import_model

    files = {key: DATA / f"brick.{end}" for key, end in (("mass", "mas"), ("dofs", "dof"), ("mesh", "inp"))}
    damaged = path.read_bytes()[:1]
    file = DATA / "brick.sti" if damaged == b"*" else path
    if damaged == b"*":
        files["mesh"] = path.rename(path.with_suffix(".inp"))
    return import_model(file, **files, units="m,kg,s,N", interfaces="MOUNT", surface="MIRROR")


def matrix_market(path: Path) -> object:
    from wavequake.mechanics.importers import abaqus, matrix_market

    if matrix_market.is_matrix_market(path):
        return matrix_market.read_matrix(path)
    return abaqus.read_matrix(path)


def dofs(path: Path) -> object:
    from wavequake.mechanics.importers.calculix import read_dofs

    return read_dofs(path)


def sag(path: Path) -> object:
    from wavequake.optics.shapes.sag_file import read_sag

    return read_sag(path)


def polygons(path: Path) -> object:
    from wavequake.optics.shapes.polygon_table import read_polygons

    return read_polygons(path)


@lru_cache
def telescope():
    from wavequake.optics.segments.layout import tmt18_segments

    return tmt18_segments()


def corners(path: Path) -> object:
    from wavequake.optics.shapes.corner_table import distorted

    return distorted(telescope(), path)


def corner_table() -> bytes:
    names = telescope().names
    rows = [f"{names[k]},{1 + k % 6},{1e-4 * k},-2e-4" for k in range(4)]
    return "\n".join(["segment,corner,dx_mm,dy_mm", *rows, ""]).encode()


def picture(path: Path) -> object:
    from wavequake.chain.images.picture import read_picture

    return read_picture(path)


def through_text(parse: Callable[[str, str], object]) -> Callable[[Path], object]:
    def read(path: Path) -> object:
        from wavequake.user_files import read_text

        return parse(read_text(path), path.name)

    return read


def history_table(content: str, name: str) -> object:
    from wavequake.mechanics.disturbances.history_table import read_table

    return read_table(content)


def spectrum(content: str, name: str) -> object:
    from wavequake.mechanics.disturbances.spectra import tabulated

    return tabulated(content, name)


def forces(content: str, name: str) -> object:
    from wavequake.mechanics.vibration.excitations import read_record

    return read_record(content, name)


def blow(content: str, name: str) -> object:
    from wavequake.control.recorded import read_recorded

    return read_recorded(content, name)


def linear_controller(path: Path) -> object:
    from wavequake.control.linear_regulator import linear_regulator, read_controller

    return linear_regulator(read_controller(path.read_bytes()))


def controller_npz() -> bytes:
    a = np.array([[0.9, 0.2], [-0.2, 0.9]])
    return packed(A=a, B=np.ones((2, 1)), C=np.ones((1, 2)), D=np.eye(1), sample_time_s=0.002)


def history_arrays(path: Path) -> object:
    from wavequake.mechanics.disturbances.history_arrays import read_arrays

    return read_arrays(base64.b64encode(path.read_bytes()).decode())


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


def telemetry(path: Path) -> object:
    from wavequake.mechanics.telemetry.record import read_record

    return read_record(path)


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


def body_of(make: str) -> Callable[[Path], object]:
    """Return what reads a body of numbers, as a study does: all of it in base64."""

    def read(path: Path) -> object:
        from wavequake.mechanics.assembly import arrays

        return getattr(arrays, make)("tube", base64.b64encode(path.read_bytes()).decode())

    return read


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


def nodal(path: Path) -> object:
    """Read displacements or modes at nodes, as a study does."""
    from wavequake.mechanics.nodal.results import read_results

    unit = None if path.suffix in (".csv", ".npz") else "mm"
    return read_results(path, unit, None, ("time", "case", "mode"))


def mode_table(path: Path) -> object:
    from wavequake.mechanics.nodal.modes import modes_of

    return modes_of(path, None)


def nodal_npz() -> bytes:
    shifts = np.arange(30.0).reshape(2, 5, 3)
    return packed(nodes_mm=np.eye(5, 3), displacements_um=shifts, time_s=[0.0, 1.0])


def nodal_rows(head: str, steps: tuple[str, ...]) -> str:
    rows = [f"{step},{node},{node}.5,0,{node % 3},0.1,-0.{node},0.3" for step in steps for node in range(9)]
    return "\n".join([head, *rows, ""])


def source_file(source: str) -> Callable[[Path], object]:
    """Return what gives a file to a disturbance, as a study does: its text, or all of it in base64."""

    def read(path: Path) -> object:
        from wavequake.mechanics.disturbances.sources import load_history, temperature_table
        from wavequake.user_files import read_text

        if source == "temperatures":
            return temperature_table._read(read_text(path))
        if path.suffix == ".csv":
            return load_history._read(read_text(path), None)
        return load_history._read(None, base64.b64encode(path.read_bytes()).decode())

    return read


def loads_npz() -> bytes:
    time = np.linspace(0.0, 1.0, 8)
    return packed(**{"time_s": time, "tube.top.fx_n": np.sin(time), "ground.dx_um": time})


def own_model(path: Path) -> object:
    from wavequake.workflows.mirrors.own_models import own_arrays

    return own_arrays(base64.b64encode(path.read_bytes()).decode(), "mine")


def results_of_ansys() -> bytes:
    """Return the results that come with the library that reads them."""
    from ansys.mapdl.reader import examples

    return Path(examples.rstfile).read_bytes()


def plugin(path: Path) -> object:
    """Read a plug-in; running it is what its user asked for."""
    from wavequake.campaign.plugins import read_plugin

    return read_plugin(path)


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

READERS = {
    "study": Reader(".toml", study, (bundled("tmt-segments"), bundled("mirror-mor"))),
    "cluster": Reader(".yaml", cluster, text(CLUSTER)),
    "inp": Reader(".inp", mesh, data("brick.inp")),
    "bdf": Reader(".bdf", mesh, (through_meshio(".bdf"),)),
    "msh": Reader(".msh", mesh, (gmsh(binary=True), gmsh(binary=False))),
    "vtu": Reader(".vtu", mesh, (through_meshio(".vtu"), through_meshio(".vtu", binary=False))),
    "sti": Reader(".sti", matrices, data("brick.sti")),
    "model": Reader(".sti", model, data("brick.sti", "brick.inp")),
    "dof": Reader(".dof", dofs, data("brick.dof")),
    "mtx": Reader(".mtx", matrix_market, (market,)),
    "mtx-abaqus": Reader(".mtx", matrix_market, text("1,1, 1,1, 2.0\n1,2, 1,2, 2.0\n1,1, 1,2, -1.0\n")),
    "pch": Reader(".pch", matrices, data("truss.pch")),
    "op4": Reader(".op4", matrices, data(*OP4)),
    "npz": Reader(".npz", matrices, (dense_npz, sparse_npz, scipy_npz)),
    "h5": Reader(".h5", matrices, (hdf5,)),
    "controller": Reader(".npz", linear_controller, (controller_npz,)),
    "history-csv": Reader(".csv", through_text(history_table), text(HISTORY)),
    "history-npz": Reader(".npz", history_arrays, (history_npz,)),
    "body-matrices": Reader(".npz", body_of("from_matrices"), (matrices_npz, turning_npz)),
    "body-modes": Reader(".npz", body_of("from_modes"), (modes_npz,)),
    "nodal-csv": Reader(
        ".csv", nodal, text(nodal_rows("time_s,node,x_mm,y_mm,z_mm,dx_um,dy_um,dz_um", ("0", "0.5")))
    ),
    "nodal-npz": Reader(".npz", nodal, (nodal_npz,)),
    "nodal-txt": Reader(".txt", nodal, text("x y z dx dy dz\n" + "1.5 2 3 0.1 -0.2 1e-3\n2 1 3 0 0 1\n" * 9)),
    "op2": Reader(".op2", nodal, data("nodal/angle.op2", "nodal/rod_modes.op2")),
    "frd": Reader(".frd", nodal, data("nodal/brick.frd")),
    "mode-table": Reader(
        ".csv",
        mode_table,
        text(nodal_rows("mode,frequency_hz,node,x_mm,y_mm,z_mm,dx,dy,dz", ("1,20", "2,33.5"))),
    ),
    "plugin": Reader(".py", plugin, text("NAME = 'pendulum'\n")),
    "temperatures": Reader(".csv", source_file("temperatures"), text(TEMPERATURES)),
    "loads-csv": Reader(".csv", source_file("loads"), text(LOADS)),
    "loads-npz": Reader(".npz", source_file("loads"), (loads_npz,)),
    "own-model": Reader(".npz", own_model, (dense_npz,)),
    "spectrum": Reader(".csv", through_text(spectrum), text(SPECTRUM)),
    "forces": Reader(".csv", through_text(forces), text(FORCES)),
    "rec": Reader(".csv", through_text(blow), text(RECORD)),
    "sag-csv": Reader(".csv", sag, text(SAG)),
    "sag-npy": Reader(".npy", sag, (npy,)),
    "sag-dat": Reader(".dat", sag, text(GRID)),
    "polygons": Reader(".csv", polygons, (head("tmt_sector.csv", 12),)),
    "corners": Reader(".csv", corners, (corner_table,)),
    "zmx": Reader(".zmx", lenses.lens, lenses.lens_files()),
    "zar": Reader(".zar", lenses.lens, lenses.archives()),
    "zoom": Reader(".zmx", lenses.zoomed, text(lenses.written(*lenses.ZOOM))),
    "seq": Reader(".seq", lenses.lens, (lenses.SEQUENCE.encode, lenses.FOLDED.encode)),
    "agf": Reader(".agf", lenses.glasses, text(lenses.GLASSES)),
    "picture-png": Reader(".png", picture, (png,)),
    "picture-npy": Reader(".npy", picture, (npy,)),
    "picture-csv": Reader(".csv", picture, text(SAG)),
    "telemetry-csv": Reader(".csv", telemetry, (telemetry_csv,)),
    "telemetry-npz": Reader(".npz", telemetry, (telemetry_npz,)),
}
try:
    import astropy.io.fits  # noqa: F401 - now, not in each fork

    READERS["telemetry-fits"] = Reader(".fits", telemetry, (telemetry_fits,))
except ImportError:
    pass  # the library is optional
try:
    import ansys.mapdl.reader  # noqa: F401 - now, not in each fork

    READERS["full"] = Reader(".full", full_file.read, (full_file.small,))
    READERS["rst"] = Reader(".rst", nodal, (results_of_ansys,))
except ImportError:
    pass  # the library is optional
