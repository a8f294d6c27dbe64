"""`wavequake new` and `migrate`: begin a study of one's own, or go on with an old one."""

from pathlib import Path
from typing import Annotated

import typer

from wavequake.commands.pictures import complete_name
from wavequake.terminal import out


def new(
    source: Annotated[
        str,
        typer.Argument(
            help="Bundled study, system or telescope by name, LENS.zmx, or MODEL.sti.",
            autocompletion=complete_name,
        ),
    ],
    file: Annotated[
        Path | None, typer.Option("-o", "--output", help="FILE.toml (default: NAME.toml here).")
    ] = None,
) -> None:
    """Write a commented study file of what a name, lens file or finite-element model holds."""
    from wavequake.workflows.new_study import new_study

    path, to_edit = new_study(source, file)
    out.print(f"Written: {path}", markup=False, soft_wrap=True)
    if to_edit:
        out.print(f"To be edited before it runs: {to_edit}", markup=False, soft_wrap=True)
    out.print(f"Next: wavequake draw {path.name}, wavequake plan {path.name}", markup=False, soft_wrap=True)


def migrate(study: Annotated[str, typer.Argument(help="Path of a study file of Wavequake 0.1.")]) -> None:
    """Say which keys of a study file of an earlier version have moved, and whose numbers have changed."""
    from wavequake.workflows.migrate import migrate as changes_of

    for line in changes_of(study):
        out.print(line, markup=False, soft_wrap=True)
