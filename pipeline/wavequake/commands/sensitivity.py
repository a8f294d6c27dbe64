"""`wavequake sensitivity` and `wavequake devices`: what motions do to the light, and what computes it."""

from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape
from rich.table import Table

from wavequake.commands.options import StoreOption
from wavequake.terminal import out, print_in_blocks

OverridesArgument = Annotated[
    list[str] | None, typer.Argument(metavar="[KEY=VALUE]...", help="e.g. campaign.cases=40")
]


def sensitivity(
    study: Annotated[
        str,
        typer.Argument(help="Study by name or path, name of a bundled system or telescope, or FILE.zmx."),
    ],
    overrides: OverridesArgument = None,
    store: StoreOption = None,
    figure_terms: Annotated[
        int | None,
        typer.Option(min=0, max=2016, help="Zernike terms of each segment's figure (default: the study's)."),
    ] = None,
    mirror_terms: Annotated[
        int | None,
        typer.Option(min=0, max=2016, help="The same of M2 and further mirrors or surfaces (default: 11)."),
    ] = None,
) -> None:
    """Show and keep how line of sight and wavefront follow motions of every surface and segment."""
    from wavequake.campaign.store.store import SENSITIVITY
    from wavequake.report.answers import sensitivity as of_segments
    from wavequake.report.answers import system_sensitivity as of_system
    from wavequake.workflows.sensitivity import stored_sensitivity
    from wavequake.workflows.sensitivity_source import sensitivity_study

    loaded = sensitivity_study(study, overrides or [])
    path = store or Path(loaded.store.path or loaded.default_store())
    found, kept = stored_sensitivity(loaded, path, figure_terms, mirror_terms)
    words_of = of_system if loaded.study.workflow.startswith("system-") else of_segments
    for table in words_of.tables(found):
        print_in_blocks(table)
    for line in words_of.explanations(found):
        out.print(line, markup=False)
    out.print(words_of.answer(found), markup=False, style="bold", highlight=False)
    words = "Were there already, nothing was computed" if kept else "Written"
    out.print(f"{words}: {(path / SENSITIVITY).resolve()}", markup=False, soft_wrap=True)


def devices() -> None:
    """List the devices that kernels can run on, and compare each with the NumPy twin."""
    from wavequake.kernels.device.devices import self_tests

    table = Table(box=None)
    for column in ("device", "kind", "platform", "largest difference to NumPy (mm)"):
        table.add_column(column)
    for device, result in self_tests():
        table.add_row(*map(escape, (device.name, device.kind, device.platform, result)))
    out.print(table)
