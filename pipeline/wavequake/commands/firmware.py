"""`wavequake firmware`: build, test and flash the boards of the lens experiment."""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.table import Table

from wavequake.terminal import out

if TYPE_CHECKING:
    from wavequake.control.bench import Bench
    from wavequake.control.identification import Record
    from wavequake.control.linear import Array
    from wavequake.control.regulator import ModalRegulator
    from wavequake.control.sensor import SensorChain
    from wavequake.control.stage import Stage

_STEPS = 2000  # of a trial without a bench

app = typer.Typer(help="Build, test and flash the boards of the lens experiment.", no_args_is_help=True)

StudyArgument = Annotated[str, typer.Argument(help="Study of the workflow lens-experiment.")]
OverridesArgument = Annotated[
    list[str] | None, typer.Argument(metavar="[KEY=VALUE]...", help="e.g. controller.modal_step_ms=4")
]
FolderOption = Annotated[Path, typer.Option("--to", help="Folder of headers and images.")]
ArithmeticOption = Annotated[str, typer.Option(help="float, q31 or q16.")]
ControllerOption = Annotated[
    str,
    typer.Option(
        help="nominal; identified: from an uncontrolled run of a plant that the study draws; or an .npz file "
        "of any sampled linear controller: A, B, C, D, sample_time_s."
    ),
]
PlantOption = Annotated[int, typer.Option(min=0, help="Which plant is identified: its realization.")]
RecordOption = Annotated[
    Path | None,
    typer.Option(
        help="Identify the bench from this CSV of an uncontrolled run instead: time_s, sensor_mm, image_mm.",
    ),
]
DebugOption = Annotated[bool, typer.Option("--debug", help="Show tracebacks.")]


@dataclass(frozen=True)
class Designed:
    """A regulator, and what it is tried on: a drawn plant, or the nominal bench; without a stage, neither."""

    regulator: "ModalRegulator"
    bench: "Bench"
    stage: "Stage | None"
    chain: "SensorChain"
    friction: float
    strength: float = 1.0
    phases: "Array | None" = None
    late: float = 0.0


def _designed(
    study: str, overrides: list[str] | None, controller: str, plant: int, record: Path | None = None
) -> Designed:
    from wavequake.errors import UserError
    from wavequake.workflows.lens import experiment as lens
    from wavequake.workflows.lens.bench import bench_of
    from wavequake.workflows.lens.study import LensStudy
    from wavequake.workflows.study import load_study

    loaded = load_study(study, overrides or [])
    if not isinstance(loaded, LensStudy):
        raise UserError(
            f"The study {study!r} is of the workflow {loaded.study.workflow}; firmware is made from one of "
            "lens-experiment."
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


def _read(path: Path) -> "Record":
    from wavequake.control.recorded import read_recorded
    from wavequake.errors import UserError
    from wavequake.user_files import read_text

    try:
        text = read_text(path)
    except UserError as error:
        raise UserError(f"The record {error}") from None
    return read_recorded(text, path.name)


def _linear(path: Path) -> "ModalRegulator":
    """Return the regulator that does what the controller of an .npz file does."""
    from wavequake.control.linear_regulator import linear_regulator, read_controller
    from wavequake.errors import UserError
    from wavequake.user_files import read_bytes

    try:
        return linear_regulator(read_controller(read_bytes(path)))
    except UserError as error:
        raise UserError(f"{path.name}: {error}") from None


@app.command()
def build(
    study: StudyArgument = "lens-experiment",
    overrides: OverridesArgument = None,
    boards: Annotated[
        str,
        typer.Option(help="Comma-separated: due, uno, qemu, simavr, host; or none: the header alone."),
    ] = "due",
    arithmetic: ArithmeticOption = "q31",
    controller: ControllerOption = "nominal",
    plant: PlantOption = 0,
    record: RecordOption = None,
    to: FolderOption = Path("firmware-build"),
    debug: DebugOption = False,
) -> None:
    """Design the regulator of a study, write its gains as a C header, and build images."""
    from wavequake.firmware.build import build as build_image
    from wavequake.firmware.build import write_header
    from wavequake.firmware.gains import gains_of

    designed = _designed(study, overrides, controller, plant, record)
    gains = gains_of(designed.regulator, designed.chain, arithmetic)
    if boards == "none":
        place = (write_header(gains, to) / "wq_gains.h").resolve()
        out.print(f"Written: {place} (gains {gains.digest})", markup=False, soft_wrap=True)
        return
    for board in boards.split(","):
        image = build_image(board.strip(), gains, to)
        out.print(
            f"Written: {image.path.resolve()} ({image.compiler}, gains {gains.digest})",
            markup=False,
            soft_wrap=True,
        )


@app.command("test")
def try_images(
    study: StudyArgument = "lens-experiment",
    overrides: OverridesArgument = None,
    controller: ControllerOption = "nominal",
    plant: PlantOption = 0,
    to: FolderOption = Path("firmware-build"),
    debug: DebugOption = False,
) -> None:
    """Run the images in emulators on a simulated blow (exit code 4 if one differs from the host)."""
    from wavequake.firmware import trial
    from wavequake.firmware.loop import blow, wandering

    designed = _designed(study, overrides, controller, plant)
    regulator = designed.regulator
    if designed.stage is None:
        hit = wandering(_STEPS, 2**designed.chain.adc_bits - 1)
    else:
        hit = blow(
            designed.bench,
            designed.chain,
            regulator.sample_time,
            duration=trial.DURATION,
            friction=designed.friction,
            strength=designed.strength,
            phases=designed.phases,
            late=designed.late,
        )
    found = list(trial.trials(hit, designed.stage, regulator, designed.chain, to))
    table = Table(box=None)
    table.add_column("image", style="bold")
    for column in (
        "flash (B)",
        "instructions",
        "time (ms)",
        "range left (%)",
        "deviation left (%)",
    ):
        table.add_column(column, justify="right")
    table.add_column("commands")
    for one in found:
        if one.skipped:
            table.add_row(one.image, *5 * ["-"], "not run")
            continue
        table.add_row(
            one.image,
            *("-" if value is None else str(value) for value in (one.flash, one.instructions)),
            "-" if one.seconds is None else f"{1e3 * one.seconds:.3f}",
            *((f"{one.left.range:.2f}", f"{one.left.deviation:.2f}") if one.left else ("-", "-")),
            {None: "reference", True: "as the host's", False: "DIFFER from the host's"}[one.same],
        )
    out.print(table)
    out.print(
        "Instructions are the most in a step. Times are those of the longest step: on the Due at 84 MHz if "
        f"instructions take {trial.CYCLES_PER_INSTRUCTION:g} cycles, on the Uno's processor (in simavr) at "
        "16 MHz by cycles that were counted, of the decoder per edge. A step may take "
        f"{1e3 * regulator.sample_time:g} ms. Ranges, and deviations after 1 s, in % of those uncontrolled. "
        f"Commands are compared over {len(hit.adc)} steps, bit by bit.",
        markup=False,
    )
    for reason in dict.fromkeys(one.skipped for one in found if one.skipped):
        out.print(f"Not run: {reason}", markup=False, soft_wrap=True)
    if any(one.same is False for one in found):
        sys.exit(4)


@app.command()
def flash(
    board: Annotated[str, typer.Argument(help="due or uno.")],
    study: StudyArgument = "lens-experiment",
    overrides: OverridesArgument = None,
    arithmetic: ArithmeticOption = "q31",
    controller: ControllerOption = "nominal",
    plant: PlantOption = 0,
    record: RecordOption = None,
    to: FolderOption = Path("firmware-build"),
    debug: DebugOption = False,
) -> None:
    """Check that an image was built from the study's design, and say how to flash it; flashes nothing."""
    from wavequake.errors import UserError
    from wavequake.firmware.build import board_of, check_hash, flash_lines
    from wavequake.firmware.gains import gains_of

    chosen = board_of(board)
    if not chosen.flash:
        raise UserError(f"The board {board!r} is no hardware; boards that can be flashed: due, uno.")
    designed = _designed(study, overrides, controller, plant, record)
    gains = gains_of(designed.regulator, designed.chain, arithmetic)
    image = to / f"{board}-{arithmetic}{chosen.suffix}"
    check_hash(image, gains)
    out.print(f"{image} carries the gains {gains.digest} of this design. To flash it:", markup=False)
    out.print(flash_lines(chosen, image), markup=False, soft_wrap=True)
    out.print(f"({chosen.tools})", markup=False, soft_wrap=True)
