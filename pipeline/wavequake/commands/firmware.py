"""`wavequake firmware`: build, test and flash the boards of the lens experiment."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.table import Table

from wavequake.terminal import out

if TYPE_CHECKING:
    from wavequake.workflows.lens.boards import Designed

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


def _designed(
    study: str, overrides: list[str] | None, controller: str, plant: int, record: Path | None = None
) -> "Designed":
    from wavequake.workflows.lens.boards import designed
    from wavequake.workflows.study import load_study

    return designed(load_study(study, overrides or []), controller, plant, record)


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
    from wavequake.workflows.lens.boards import blow_of, tried

    designed = _designed(study, overrides, controller, plant)
    hit, sample_time = blow_of(designed), designed.regulator.sample_time
    found = list(tried(designed, hit, to))
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
        f"{1e3 * sample_time:g} ms. Ranges, and deviations after 1 s, in % of those uncontrolled. "
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
    from wavequake.workflows.lens.boards import flashing

    designed = _designed(study, overrides, controller, plant, record)
    image, digest, lines, tools = flashing(designed, board, arithmetic, to)
    out.print(f"{image} carries the gains {digest} of this design. To flash it:", markup=False)
    out.print(lines, markup=False, soft_wrap=True)
    out.print(f"({tools})", markup=False, soft_wrap=True)
