"""Firmware of a study of the lens bench: its regulator, images of boards, their trial, how to flash them."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from wavequake.campaign.schema import Study
from wavequake.control.bench import Bench
from wavequake.control.identification import Record
from wavequake.control.linear import Array
from wavequake.control.linear_regulator import linear_regulator, read_controller
from wavequake.control.recorded import read_recorded
from wavequake.control.regulator import ModalRegulator
from wavequake.control.sensor import SensorChain
from wavequake.control.stage import Stage
from wavequake.errors import UserError
from wavequake.firmware import trial
from wavequake.firmware.build import board_of, check_hash, flash_lines
from wavequake.firmware.gains import gains_of
from wavequake.firmware.loop import Blow, blow, wandering
from wavequake.user_files import read_bytes, read_text
from wavequake.workflows.lens import experiment as lens
from wavequake.workflows.lens.bench import bench_of
from wavequake.workflows.lens.study import LensStudy

_STEPS = 2000  # of a trial without a bench


@dataclass(frozen=True)
class Designed:
    """A regulator, and what it is tried on: a drawn plant, or the nominal bench; without a stage, neither."""

    regulator: ModalRegulator
    bench: Bench
    stage: Stage | None
    chain: SensorChain
    friction: float
    strength: float = 1.0
    phases: Array | None = None
    late: float = 0.0


def designed(
    loaded: Study, controller: str = "nominal", plant: int = 0, record: Path | None = None
) -> Designed:
    """Return the regulator of a study of the lens bench.

    Parameters
    ----------
    loaded : Study
    controller : str
        ``"nominal"``; ``"identified"``: from an uncontrolled run of the drawn plant number `plant`; or an
        .npz file of a sampled linear controller.
    plant : int
    record : Path, optional
        CSV of an uncontrolled run, from which the bench is identified in its place.

    Raises
    ------
    UserError
        If the study is of another kind, there is no such controller, or a file cannot be read.
    """
    if not isinstance(loaded, LensStudy):
        raise UserError(
            f"The study {loaded.study.name!r} is of the workflow {loaded.study.workflow}; firmware is made "
            "from one of lens-experiment."
        )
    file = Path(controller) if controller.endswith(".npz") else None
    if file is None and controller not in ("nominal", "identified"):
        raise UserError(
            f"There is no controller {controller!r}; there are nominal, identified, and .npz files of "
            "linear controllers."
        )
    if file is not None and record is not None:
        raise UserError(f"Give the controller {file.name} or a record to identify the bench from, not both.")
    springs = loaded.bench.springs[0]
    chain, friction = lens.chain_of(loaded), lens.errors_of(loaded).friction
    if controller == "identified" and not record:
        drawn, regulator = lens.tuned_plant(loaded, springs, plant)
        strength = drawn.blows[1]
        return Designed(
            regulator, drawn.bench, drawn.stage, chain, friction, strength, drawn.phases, drawn.late
        )
    if file is not None:
        return Designed(_linear(file), bench_of(loaded, springs), None, chain, friction)
    designs = lens.designs_of(loaded.identity_text(), springs)
    regulator = designs.regulator
    if record:
        regulator = lens.regulator_of_record(loaded, springs, _read(record))
    bench, late = bench_of(loaded, springs), lens.settings_of(loaded).trigger_late
    return Designed(regulator, bench, designs.stage, chain, friction, late=late)


def _read(path: Path) -> Record:
    try:
        text = read_text(path)
    except UserError as error:
        raise UserError(f"The record {error}") from None
    return read_recorded(text, path.name)


def _linear(path: Path) -> ModalRegulator:
    """Return the regulator that does what the controller of an .npz file does."""
    try:
        return linear_regulator(read_controller(read_bytes(path)))
    except UserError as error:
        raise UserError(f"{path.name}: {error}") from None


def blow_of(made: Designed) -> Blow:
    """Return what a trial hits the lens with; without a stage, what its sensor could read."""
    if made.stage is None:
        return wandering(_STEPS, 2**made.chain.adc_bits - 1)
    return blow(
        made.bench,
        made.chain,
        made.regulator.sample_time,
        duration=trial.DURATION,
        friction=made.friction,
        strength=made.strength,
        phases=made.phases,
        late=made.late,
    )


def tried(made: Designed, hit: Blow, folder: Path) -> Iterator[trial.Outcome]:
    """Yield what comes of every image that this machine can build and run, as `trial.trials`."""
    return trial.trials(hit, made.stage, made.regulator, made.chain, folder)


def flashing(made: Designed, board: str, arithmetic: str, folder: Path) -> tuple[Path, str, str, str]:
    """Return the image of a board, the digest of its gains, the lines that flash it, and what brings them.

    Raises
    ------
    UserError
        If the board is no hardware, or the image is missing or of another design.
    """
    chosen = board_of(board)
    if not chosen.flash:
        raise UserError(f"The board {board!r} is no hardware; boards that can be flashed: due, uno.")
    gains = gains_of(made.regulator, made.chain, arithmetic)
    image = folder / f"{board}-{arithmetic}{chosen.suffix}"
    check_hash(image, gains)
    return image, gains.digest, flash_lines(chosen, image), chosen.tools
