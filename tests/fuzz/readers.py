"""Every reader of users' files, each with small valid files."""

import base64
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import full_file
import lens_readers as lenses
from valid_files import (
    CLUSTER,
    DATA,
    FORCES,
    GRID,
    HISTORY,
    LOADS,
    OP4,
    RECORD,
    SAG,
    SPECTRUM,
    TEMPERATURES,
    bundled,
    controller_npz,
    corner_table,
    data,
    dense_npz,
    gmsh,
    hdf5,
    head,
    history_npz,
    loads_npz,
    market,
    matrices_npz,
    modes_npz,
    nodal_npz,
    nodal_rows,
    npy,
    png,
    results_of_ansys,
    scipy_npz,
    sparse_npz,
    telemetry_csv,
    telemetry_fits,
    telemetry_npz,
    telescope,
    text,
    through_meshio,
    turning_npz,
)


@dataclass(frozen=True)
class Reader:
    """What reads a file of the suffix, and makers of valid files."""

    suffix: str
    read: Callable[[Path], object]
    valid: tuple[Callable[[], bytes], ...]


def study(path: Path) -> object:
    from wavequake.workflows.study import load_study

    return load_study(path)


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


def corners(path: Path) -> object:
    from wavequake.optics.shapes.corner_table import distorted

    return distorted(telescope(), path)


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


def history_arrays(path: Path) -> object:
    from wavequake.mechanics.disturbances.history_arrays import read_arrays

    return read_arrays(base64.b64encode(path.read_bytes()).decode())


def telemetry(path: Path) -> object:
    from wavequake.mechanics.telemetry.record import read_record

    return read_record(path)


def body_of(make: str) -> Callable[[Path], object]:
    """Return what reads a body of numbers, as a study does: all of it in base64."""

    def read(path: Path) -> object:
        from wavequake.mechanics.assembly import arrays

        return getattr(arrays, make)("tube", base64.b64encode(path.read_bytes()).decode())

    return read


def nodal(path: Path) -> object:
    """Read displacements or modes at nodes, as a study does."""
    from wavequake.mechanics.nodal.results import read_results

    unit = None if path.suffix in (".csv", ".npz") else "mm"
    return read_results(path, unit, None, ("time", "case", "mode"))


def mode_table(path: Path) -> object:
    from wavequake.mechanics.nodal.modes import modes_of

    return modes_of(path, None)


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


def own_model(path: Path) -> object:
    from wavequake.workflows.mirrors.own_models import own_arrays

    return own_arrays(base64.b64encode(path.read_bytes()).decode(), "mine")


def plugin(path: Path) -> object:
    """Read a plug-in; running it is what its user asked for."""
    from wavequake.campaign.plugins import read_plugin

    return read_plugin(path)


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
