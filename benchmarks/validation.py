"""Figures of docs/validation.md, measured anew: how far numbers of each area are from what they should be.

A dozen rows of all areas, in a minute; the tests hold many more, to the tolerances printed here.

``python -m benchmarks.validation``
"""

import csv
import json
import tempfile
from collections.abc import Iterator
from math import sqrt
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.special import j1

from wavequake.control.bench import fitted_bench
from wavequake.control.experiment import Settings, design
from wavequake.control.loop import commands_of
from wavequake.control.sensor import SensorChain
from wavequake.control.stage import Stage
from wavequake.errors import UserError
from wavequake.firmware.build import build
from wavequake.firmware.devices import HostDevice
from wavequake.firmware.gains import gains_of
from wavequake.firmware.loop import blow, positions_of
from wavequake.imaging.engines.matrix_fourier import matrix_fourier, psf
from wavequake.imaging.pupils.pupil_function import annular_pupil
from wavequake.kernels.device.devices import NUMPY, choose_device
from wavequake.mechanics.mirrors.models import annular_mirror, circular_mirror
from wavequake.mechanics.model import ReducedModel
from wavequake.mechanics.vibration.drive import Drive, Harmonic
from wavequake.mechanics.vibration.eigen import eigenmodes
from wavequake.mechanics.vibration.modal import modal_model
from wavequake.mechanics.vibration.response import respond
from wavequake.optics.catalog.names import optical_system
from wavequake.optics.derivatives.sensitivity import rigid_sensitivity
from wavequake.optics.media.glasses import AIR
from wavequake.optics.media.gradients import selfoc
from wavequake.optics.polynomials.zernike import annular_zernike
from wavequake.optics.systems.kinematics import SurfaceRow, rest_states, sequential
from wavequake.optics.systems.system import OpticalSystem, Pupil
from wavequake.optics.wavefronts.wavefront import measure_system, prepare_system
from wavequake.workflows.segments import disturbance as segment_disturbance
from wavequake.workflows.study import load_study

DATA = Path(__file__).parents[1] / "tests" / "data"
# Quantity, source of truth, tolerance, measured, unit.
Row = tuple[str, str, float, float, str]


def optics() -> Iterator[Row]:
    """Yield the thesis' telescope, its M2, the polynomials, and a rod of varying index."""
    truth = json.loads((DATA / "tmt_optics.json").read_text())
    system, pupil = optical_system("tmt-thesis"), _quadrature(optical_system("tmt-thesis").pupil.obscuration)
    prepared = [prepare_system(system, *pupil, 45, field) for field in range(len(system.fields))]
    found = [measure_system(one, rest_states(system), NUMPY).zernike[0] for one in prepared]
    apart = [one - row["c_noll_annular"] for one, row in zip(found, truth["fields"], strict=False)]
    yield "Zernike terms of the TMT, two fields", "80-bit trace", 1e-6, float(np.abs(apart).max()), "waves"
    matrix = rigid_sensitivity(prepared[0], [], choose_device())
    m2 = float(np.abs(matrix.los[matrix.elements.index("M2"), 3]).max())
    yield "line of sight per tilt of M2", "Eq. 4.24: 85460 mm/rad", 1.0, abs(m2 - 85460.0), "mm/rad"
    yield "the same: steps h and 2 h", "each other", 1e-5, float(matrix.disagreement.max()), "1"
    reference, worst = json.loads((DATA / "zernike_annular.json").read_text()), 0.0
    for text, radial in reference["radial_coefficients"].items():
        rho, angle = np.linspace(float(text), 1.0, 25), np.linspace(0.0, 6.0, 25)
        basis = annular_zernike(rho * np.cos(angle), rho * np.sin(angle), 45, float(text))
        for (n, m), column in zip(reference["nm"], basis.T, strict=True):
            wave = 1.0 if m == 0 else sqrt(2) * (np.cos(m * angle) if m > 0 else np.sin(-m * angle))
            powers = enumerate(radial[f"{n},{abs(m)}"])
            worst = max(
                worst, np.abs(column - wave * sum(c * rho ** (abs(m) + 2 * k) for k, c in powers)).max()
            )
    yield "annular Zernike polynomials, j <= 45", "60-digit Gram-Schmidt", 1e-12, float(worst), "1"
    way = 1.0 / (1.6 * 0.05 * np.tan(1.0))
    rows = [
        SurfaceRow("front", thickness=20.0, action="refract", medium=selfoc(1.6, 0.05)),
        SurfaceRow("rear", thickness=way, action="refract", medium=AIR),
        SurfaceRow("image"),
    ]
    rod = OpticalSystem("rod", sequential(rows), 0, Pupil("entrance_diameter", 1e-3))
    spot = measure_system(prepare_system(rod, *pupil, 11), rest_states(rod), NUMPY).spot_rms[0]
    yield "spot at the focus of a SELFOC rod, pupil of 1 um", "closed form", 1e-9, float(spot), "mm"


def mechanics() -> Iterator[Row]:
    """Yield the mirrors' frequencies and a forced response."""
    with (DATA / "calculix_refined.csv").open() as file:
        table = list(csv.DictReader(file))
    for name, model in (("circular", circular_mirror()), ("annular", annular_mirror())):
        expected = np.array([float(row[f"{name} C3D20R"]) for row in table[6:36]])
        apart = np.abs(eigenmodes(model, 36)[0][6:] / expected - 1.0).max()
        yield f"30 frequencies, {name} mirror", "CalculiX, finer mesh", 8e-3, float(apart), "relative"
    yield "oscillator that is shaken, 500 instants", "closed form", 1e-12, _oscillator(), "of the largest"


def imaging() -> Iterator[Row]:
    """Yield the diffraction pattern of a ring."""
    transform = matrix_fourier(annular_pupil(256, 0.4), 64, 0.25)
    image = psf(transform, np.zeros((1, len(annular_pupil(256, 0.4).cells))))[0]
    t = np.pi * np.hypot(transform.axis[:, None], transform.axis)
    with np.errstate(invalid="ignore", divide="ignore"):
        ring = np.where(t == 0.0, 1 - 0.16, 2 * (j1(t) - 0.4 * j1(0.4 * t)) / t) / (1 - 0.16)
    yield "image of an annular pupil", "Airy pattern", 1e-4, float(np.abs(image - ring**2).max()), "peak"


def campaigns() -> Iterator[Row]:
    """Yield whether a case's bits depend on its chunk."""
    keys = ["telescope.name=tmt-18", "optics.rays_per_segment=18", "imaging.pixels=32"]
    text = load_study("tmt-segments", keys).identity_text()
    together = segment_disturbance.KIND.compute(text, np.arange(3), "auto").arrays
    alone = [segment_disturbance.KIND.compute(text, np.array([case]), "auto").arrays for case in range(3)]
    different = sum(
        int(np.count_nonzero(_bytes(values[case]) != _bytes(alone[case][name][0])))
        for name, values in together.items()
        for case in range(3)
    )
    yield "cases alone and in a chunk: bytes apart", "each other", 0.0, float(different), "bytes"


def firmware() -> Iterator[Row]:
    """Yield how far the C core's commands are from the regulator's in double precision."""
    bench, chain = fitted_bench(), SensorChain()
    regulator = design(bench, Stage(), Settings()).regulator
    hit, step = blow(bench, chain, regulator.sample_time, duration=4.0), 2 * chain.reach / 4095
    measured = hit.adc * step - chain.reach
    truth = commands_of(regulator, measured[None])[0]
    for variant, beyond in (("float", 0.05e-6), ("q31", 0.05e-6), ("q16", 2e-6)):
        with tempfile.TemporaryDirectory() as folder:
            image = build("host", gains_of(regulator, chain, variant), Path(folder))
            codes = HostDevice(image).run(hit.adc, hit.trigger)
        apart = 1e6 * np.abs(positions_of(codes, chain.reach) - truth).max()
        yield f"commands in C, {variant}", "NumPy", 1e6 * (step / 2 + beyond), float(apart), "um"


def _quadrature(obscuration: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return Gauss-Legendre points in r^2 and even azimuths over the unit annulus, with weights."""
    node, weight = np.polynomial.legendre.leggauss(24)
    r = np.sqrt(obscuration**2 + (1.0 - obscuration**2) * (node + 1.0) / 2.0)
    angle = 2.0 * np.pi * (np.arange(96) + 0.5) / 96
    x, y = np.outer(r, np.cos(angle)).ravel(), np.outer(r, np.sin(angle)).ravel()
    return x, y, np.repeat(weight, 96)


def _oscillator() -> float:
    """Return how far the response of an oscillator to a sinusoid from rest is from its closed form."""
    natural, ratio, omega, time = 40.0, 0.02, 55.0, np.linspace(0.0, 1.3, 500)
    none = np.zeros(0, dtype=np.int64)
    model = ReducedModel(
        name="oscillator",
        method="none",
        mass=np.eye(1),
        damping_matrix=np.array([[2 * ratio * natural]]),
        stiffness=np.array([[natural**2]]),
        inputs=np.eye(1),
        surface=np.zeros((0, 1)),
        nodes=np.zeros((0, 3)),
        interfaces=none,
        surface_nodes=none,
        surface_weights=np.zeros(0),
        seconds=0.0,
    )
    shaken = Drive(np.zeros(1, dtype=bool), (Harmonic(omega, 0.0, np.zeros(1), np.ones(1)),))
    found = respond(modal_model(model), [shaken], time).coordinates[0, :, 0]
    steady = 1.0 / (natural**2 - omega**2 + 2j * ratio * natural * omega)
    roots = np.roots([1.0, 2 * ratio * natural, natural**2]).astype(complex)
    start = np.linalg.solve(np.array([[1, 1], roots]), [-steady.imag, -(1j * omega * steady).imag])
    truth = (steady * np.exp(1j * omega * time)).imag + (np.exp(np.outer(time, roots)) @ start).real
    return float(np.abs(found - truth).max() / np.abs(truth).max())


def _bytes(values: np.ndarray) -> np.ndarray:
    return np.frombuffer(np.ascontiguousarray(values).tobytes(), np.uint8)


def main() -> None:
    """Measure all rows and print them by area."""
    table = Table("area", "quantity", "against", "tolerance", "measured", "unit", title="Validation")
    for area in (optics, mechanics, imaging, campaigns, firmware):
        try:
            for quantity, source, tolerance, measured, unit in area():
                style = None if measured <= tolerance else "red"
                numbers = (f"{tolerance:.2g}", f"{measured:.2g}")
                table.add_row(area.__name__, quantity, source, *numbers, unit, style=style)
        except UserError as error:  # a compiler that is not there, for instance
            table.add_row(area.__name__, str(error), "", "", "skipped", "")
    console = Console()
    console.print(table, width=max(console.width, 110))


if __name__ == "__main__":
    main()
