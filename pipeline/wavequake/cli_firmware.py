"""`wavequake firmware`: build, test and flash the boards of the lens experiment."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.table import Table

from wavequake.terminal import out

if TYPE_CHECKING:
    from wavequake.control.bench import Bench
    from wavequake.control.experiment import Designs
    from wavequake.control.sensor import SensorChain

app = typer.Typer(help="Build, test and flash the boards of the lens experiment.", no_args_is_help=True)

StudyArgument = Annotated[str, typer.Argument(help="Study of the workflow lens-experiment.")]
OverridesArgument = Annotated[
    list[str] | None, typer.Argument(metavar="[KEY=VALUE]...", help="e.g. controller.modal_step_ms=4")
]
FolderOption = Annotated[Path, typer.Option("--to", help="Folder of headers and images.")]
ArithmeticOption = Annotated[str, typer.Option(help="float, q31 or q16.")]
DebugOption = Annotated[bool, typer.Option("--debug", help="Show tracebacks.")]


def _designed(study: str, overrides: list[str] | None) -> "tuple[Bench, Designs, SensorChain, float]":
    from wavequake.control.experiment import design
    from wavequake.errors import UserError
    from wavequake.workflows import lens_experiment as lens
    from wavequake.workflows.lens_study import LensStudy
    from wavequake.workflows.study import load_study

    loaded = load_study(study, overrides or [])
    if not isinstance(loaded, LensStudy):
        raise UserError(
            f"The study {study!r} is of the workflow {loaded.study.workflow}; firmware is made from one of "
            "lens-experiment."
        )
    bench = lens.bench_of(loaded, loaded.bench.springs[0])
    designs = design(bench, lens.stage_of(loaded), lens.settings_of(loaded))
    return bench, designs, lens.chain_of(loaded), lens.errors_of(loaded).friction


@app.command()
def build(
    study: StudyArgument = "lens-experiment",
    overrides: OverridesArgument = None,
    boards: Annotated[
        str, typer.Option(help="Comma-separated: due, uno, qemu, host; or none, for the header alone.")
    ] = "due",
    arithmetic: ArithmeticOption = "q31",
    to: FolderOption = Path("firmware-build"),
    debug: DebugOption = False,
) -> None:
    """Design the regulator of a study, write its gains as a C header, and build images."""
    from wavequake.firmware.build import build as build_image
    from wavequake.firmware.build import write_header
    from wavequake.firmware.gains import gains_of

    _, designs, chain, _ = _designed(study, overrides)
    gains = gains_of(designs.regulator, chain, arithmetic)
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
    to: FolderOption = Path("firmware-build"),
    debug: DebugOption = False,
) -> None:
    """Run the images in emulators on a simulated blow (exit code 4 if one differs from the host)."""
    from wavequake.firmware.trial import CYCLES_PER_INSTRUCTION, trials

    bench, designs, chain, friction = _designed(study, overrides)
    found = list(trials(bench, designs.stage, designs.regulator, chain, to, friction))
    table = Table(box=None)
    table.add_column("image", style="bold")
    for column in (
        "flash (B)",
        "instructions",
        "time at 84 MHz (ms)",
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
        "Instructions are the most in a step. Times assume "
        f"{CYCLES_PER_INSTRUCTION:g} cycles per instruction; a step may take "
        f"{1e3 * designs.regulator.sample_time:g} ms. Ranges, and deviations after 1 s, in % of those "
        "without control.",
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
    to: FolderOption = Path("firmware-build"),
    debug: DebugOption = False,
) -> None:
    """Check that an image was built from the study's design, and say how to flash it; flashes nothing."""
    from wavequake.errors import UserError
    from wavequake.firmware.build import board_of, check_hash
    from wavequake.firmware.gains import gains_of

    chosen = board_of(board)
    if not chosen.flash:
        raise UserError(f"The board {board!r} is no hardware; boards that can be flashed: due, uno.")
    _, designs, chain, _ = _designed(study, overrides)
    gains = gains_of(designs.regulator, chain, arithmetic)
    image = to / f"{board}-{arithmetic}{chosen.suffix}"
    check_hash(image, gains)
    out.print(f"{image} carries the gains {gains.digest} of this design. To flash it:", markup=False)
    out.print(chosen.flash.format(image=image.with_suffix("")), markup=False, soft_wrap=True)
