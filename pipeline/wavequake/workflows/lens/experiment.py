"""The workflow "lens-experiment": the oscillating lens bench under all controllers, over many plants.

A case is one plant with one configuration of springs. All controllers face the same blow, so they are a
dimension inside the case (Störkle 2018, Chapter 5).
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from wavequake.campaign.contract import Fixed
from wavequake.campaign.measured import Block, CaseTable, study_kind
from wavequake.campaign.measures import Axis, Measure, stored
from wavequake.campaign.stopwatch import Stopwatch
from wavequake.control.bench import bench_modes
from wavequake.control.camera import Camera, CameraError
from wavequake.control.experiment import (
    CONTROLLERS,
    TILE,
    Designs,
    Errors,
    Plant,
    Runs,
    Settings,
    camera_of,
    design,
    draw_plant,
    identify_plant,
    instants_of,
    residuals,
    run_plants,
    tuned_regulator,
)
from wavequake.control.hammer import HAMMER, hammer_force
from wavequake.control.identification import Record, identify
from wavequake.control.loop import late_deviation, peak_to_peak
from wavequake.control.regulator import ModalRegulator
from wavequake.control.sensor import SensorChain
from wavequake.control.stage import low_frequency_delay
from wavequake.errors import UserError
from wavequake.firmware.gains import gains_of
from wavequake.firmware.kept import host_image
from wavequake.firmware.units import FirmwareUnit
from wavequake.mechanics.disturbances.motion import generator
from wavequake.prepared import one_thread, prepared
from wavequake.workflows.kinds import study_of
from wavequake.workflows.lens.bench import bench_of, stage_of
from wavequake.workflows.lens.loops import asked_of, beside, closed_loops
from wavequake.workflows.lens.study import LensStudy

Array = NDArray[np.float64]

MODES = 11
_VOLTAGE = "1.65 V + 0.1375 V/mm times the command"


def controllers_of(study: LensStudy) -> tuple[str, ...]:
    """Return the controllers of each case: the reference's, the firmware's, then those of the study."""
    firmware = (f"firmware-{one}" for one in study.firmware.arithmetic)
    return (*CONTROLLERS, *firmware, *(one.name for one in study.loop))


def exact_of(study: LensStudy) -> str:
    """Return the controller that the firmware runs in its own arithmetic."""
    return {"nominal": "modal", "identified": "identified"}[study.firmware.design]


def errors_of(study: LensStudy) -> Errors:
    """Return what plants have beyond the nominal model, in SI units."""
    section = study.errors
    return Errors(
        section.stiffness, section.friction_mn / 1e3, section.stage_gain, section.stage_poles, section.blow,
        section.trigger_ms / 1e3,
    )  # fmt: skip


def chain_of(study: LensStudy) -> SensorChain:
    """Return the sensor chain."""
    return SensorChain(strip_error=study.errors.strip_um * 1e-6, adc_noise=study.errors.adc_noise)


def settings_of(study: LensStudy) -> Settings:
    """Return the settings of the controllers, in SI units."""
    section = study.controller
    times = {
        f"{name}_{kind}": getattr(section, f"{name}_{kind}_ms") / 1e3
        for name in ("ff", "fi", "both", "modal")
        for kind in ("step", "delay")
    }
    return Settings(
        **times,
        nominal_noise=section.nominal_noise,
        identified_noise=section.identified_noise,
        trigger_late=study.errors.trigger_ms / 2e3,
    )


@prepared(maxsize=8)
def designs_of(study_text: str, springs: str) -> Designs:
    """Design the controllers of a configuration, once per process."""
    study = study_of(study_text)
    return design(bench_of(study, springs), stage_of(study), settings_of(study))


@prepared(maxsize=4)
def _camera_of(study_text: str) -> CameraError:
    study = study_of(study_text)
    return camera_of(Camera(unsteadiness=study.errors.camera_um * 1e-6), study.study.seed)


def plant_of(study: LensStudy, springs: str, realization: int) -> Plant:
    """Draw a plant; configurations of springs share the draw of a realization."""
    rng = generator(study.study.seed, "lens-experiment", realization)
    instants = instants_of(study.time.duration_s)
    waves = len(chain_of(study).strip_periods)
    return draw_plant(
        rng, bench_of(study, springs), stage_of(study), errors_of(study), waves, instants, instants
    )


def case_of(study: LensStudy, case: int) -> tuple[str, int]:
    """Return springs and realization of a case: configurations alternate."""
    springs = study.bench.springs
    return springs[case % len(springs)], case // len(springs)


@one_thread()
def run_cases(study_text: str, springs: str, realizations: list[int]) -> Runs:
    """Run at most `TILE` plants of one configuration."""
    study = study_of(study_text)
    return run_plants(
        designs_of(study_text, springs),
        [plant_of(study, springs, one) for one in realizations],
        chain_of(study),
        _camera_of(study_text),
        friction=errors_of(study).friction,
        duration=study.time.duration_s,
        output_step=study.time.step_ms / 1e3,
        units=_units_of(study),
        unit_design=study.firmware.design,
        beside=beside(study_text, springs, realizations),
    )


def _units_of(study: LensStudy) -> tuple[FirmwareUnit, ...]:
    keep = study.firmware.design == "nominal"
    return tuple(FirmwareUnit(chain_of(study), one, keep) for one in study.firmware.arithmetic)


@one_thread()
def tuned_plant(study: LensStudy, springs: str, realization: int) -> tuple[Plant, ModalRegulator]:
    """Draw a plant, identify it from an uncontrolled run, and design its regulator, as its case does."""
    text = study.identity_text()
    plant, designs = plant_of(study, springs, realization), designs_of(text, springs)
    found = identify_plant(
        designs,
        plant,
        chain_of(study),
        _camera_of(text),
        friction=errors_of(study).friction,
        duration=study.time.duration_s,
    )
    return plant, tuned_regulator(designs, found)


@one_thread()
def regulator_of_record(study: LensStudy, springs: str, record: Record) -> ModalRegulator:
    """Identify the bench from a recording of an uncontrolled run, and design its regulator.

    Raises
    ------
    UserError
        If the recording does not identify the modes of the nominal bench.
    """
    designs = designs_of(study.identity_text(), springs)
    return tuned_regulator(designs, identify(record, designs.model))


def compute(study: LensStudy, table: CaseTable, device: str, clock: Stopwatch) -> Iterator[Block]:
    """Run plants under all controllers, those of one configuration beside each other."""
    for springs in study.bench.springs:
        rows = np.flatnonzero(table["springs"] == springs)
        for first in range(0, len(rows), TILE):
            yield from _tile(study, springs, table, rows[first : first + TILE])


def _tile(study: LensStudy, springs: str, table: CaseTable, rows: NDArray[np.int64]) -> Iterator[Block]:
    """Run a tile; where a plant fails, run its plants one by one and quarantine that one."""
    realizations = table["realization"][rows].tolist()
    try:
        runs = run_cases(study.identity_text(), springs, realizations)
    except UserError as error:
        if len(rows) == 1:
            yield Block(None, rows, {0: str(error)})
        for row in rows if len(rows) > 1 else ():
            yield from _tile(study, springs, table, np.array([row]))
        return
    yield Block(_stored(study, springs, realizations, runs) | _firmware(study, runs), rows)


def _stored(study: LensStudy, springs: str, realizations: list[int], runs: Runs) -> dict[str, Array]:
    ranges, deviations = residuals(runs)
    found = runs.identified
    true = [np.abs(bench_modes(plant_of(study, springs, one).bench).poles) for one in realizations]
    return {
        "image": 1e3 * runs.image,
        "command": 1e3 * runs.command,
        "stage_position": 1e3 * runs.stage,
        "lens_position": 1e3 * runs.lens,
        "sensor": 1e3 * runs.measured,
        "peak_to_peak": ranges,
        "deviation": deviations,
        "peak_to_peak_mm": 1e3 * peak_to_peak(runs.image),
        "deviation_mm": 1e3 * late_deviation(runs.image, runs.time),
        "true_frequency": np.array(true),
        "identified_frequency": np.array([np.abs(one.model.poles) for one in found]),
        "identified_rms": np.array([[1e6 * one.measured_rms, 1e6 * one.image_rms] for one in found]),
    }


def _firmware(study: LensStudy, runs: Runs) -> dict[str, NDArray[np.generic]]:
    """Return the hashes that images carry, and how far their commands are off those in double precision."""
    chain, arithmetic = chain_of(study), study.firmware.arithmetic
    if not arithmetic:
        return {}
    exact = runs.command[:, [CONTROLLERS.index(exact_of(study))]]
    off = 1e6 * (runs.command[:, len(CONTROLLERS) :][:, : len(arithmetic)] - exact)
    digests = [[gains_of(one, chain, each).digest for each in arithmetic] for one in runs.regulators]
    return {
        "firmware_hash": np.array([[int(one, 16) for one in row] for row in digests], dtype=np.uint64),
        "firmware_difference": np.abs(off).max(axis=-1),
        "firmware_rms": np.sqrt(np.mean(off**2, axis=-1)),
    }


def axes(study: LensStudy) -> dict[str, Axis]:
    """Return the dimensions of the measures."""
    found = {
        "controller": Axis(controllers_of(study), "controller"),
        "time": Axis(_stored_times(study), "time after the hammer's first touch", "s"),
        "signal": Axis(["lens 4", "image"], "signal"),
        "mode": Axis(MODES),
    }
    boards = study.firmware.arithmetic
    return {**found, "firmware": Axis(boards, "firmware")} if boards else found


def fixed(study: LensStudy) -> dict[str, Fixed]:
    """Return what a store of a study holds beside its measures."""
    force = hammer_force(HAMMER, _stored_times(study))
    return {"hammer_force": (("time",), force, {"units": "N", "long_name": "hammer force"})}


def _stored_times(study: LensStudy) -> Array:
    return np.asarray(study.time.step_ms / 1e3 * np.arange(study.fewest_instants))


def measures(study: LensStudy) -> Iterator[Measure]:
    """Yield the measures of a case."""
    for name, dims, words, attrs in (
        ("image", ("controller",), "image displacement (Störkle 2018, Eq. 5.5)", {}),
        ("command", ("controller",), "command to the stage, held", {"voltage": _VOLTAGE}),
        ("stage_position", ("controller",), "position of the stage with lens 5", {}),
        ("lens_position", (), "position of lens 4", {}),
        ("sensor", (), "position of lens 4 as the control unit reads it", {}),
    ):
        yield stored(name, "mm", words, (*dims, "time"), dtype="float32", attrs=attrs)
    each = ("controller",)
    yield stored("peak_to_peak", "%", "range of the image displacement, uncontrolled = 100", each)
    yield stored("deviation", "%", "standard deviation of it after 1 s, uncontrolled = 100", each)
    yield stored("peak_to_peak_mm", "mm", "range of the image displacement", each)
    yield stored("deviation_mm", "mm", "standard deviation of the image displacement after 1 s", each)
    yield stored("true_frequency", "rad/s", "frequencies of the plant", ("mode",))
    yield stored("identified_frequency", "rad/s", "frequencies that were identified", ("mode",))
    yield stored("identified_rms", "um", "rms that the identification leaves", ("signal",))
    if study.firmware.arithmetic:
        words = "hash of the gains in the image, a number of 16 hexadecimal digits"
        yield stored("firmware_hash", "1", words, ("firmware",), dtype="uint64")
        for name, what in (("difference", "largest"), ("rms", "rms")):
            words = f"{what} difference from the commands in double precision"
            yield stored(f"firmware_{name}", "um", words, ("firmware",))


def cases(study: LensStudy, ids: NDArray[np.int64]) -> CaseTable:
    """Return springs, realization and seed of cases."""
    springs, realizations = zip(*(case_of(study, case) for case in ids.tolist()), strict=True)
    return {
        "springs": np.array(springs, dtype=object),
        "realization": np.array(realizations),
        "seed": np.full(len(ids), study.study.seed),
    }


def describe(study: LensStudy) -> dict[str, str]:
    """Return modes and delays of the nominal models, for the plan."""
    lines = {"stage": f"lags by {1e3 * low_frequency_delay(stage_of(study)):.1f} ms"}
    for springs in study.bench.springs:
        omega = bench_modes(bench_of(study, springs)).omega
        lines[f"springs {springs}"] = f"{len(omega)} modes of {omega[0]:.1f} to {omega[-1]:.1f} rad/s"
    return lines


def check(study: LensStudy) -> None:
    """Raise UserError if a nominal design is impossible, or there is no compiler for firmware.

    Modes may be hidden, ode3 or a loop unstable, gains out of an arithmetic's range.
    """
    study_text = study.identity_text()
    for springs in study.bench.springs:
        regulator = designs_of(study_text, springs).regulator
        closed_loops(study_text, springs)
        for arithmetic in study.firmware.arithmetic:
            with host_image(gains_of(regulator, chain_of(study), arithmetic)):
                pass


def notices(study: LensStudy) -> Iterator[str]:
    """Yield what controllers of the registry leave out in their designs."""
    for springs in study.bench.springs:
        for one in study.loop:
            if study.sensors(one):
                yield from one.notices(asked_of(study, springs, one))


KIND = study_kind(
    "lens-experiment",
    LensStudy,
    cases=cases,
    compute=compute,
    measures=measures,
    axes=axes,
    fixed=fixed,
    describe=describe,
    check=check,
    notices=notices,
)
