"""`wavequake new`: begin a study of one's own."""

from pathlib import Path
from typing import Annotated

import typer

from wavequake.terminal import out


def new(
    source: Annotated[
        str, typer.Argument(help="Bundled study, system or telescope by name, LENS.zmx, or MODEL.sti.")
    ],
    file: Annotated[
        Path | None, typer.Option("-o", "--output", help="FILE.toml (default: NAME.toml here).")
    ] = None,
) -> None:
    """Write a commented study file of what a name, lens file or finite-element model holds."""
    from wavequake.workflows.new_study import new_study

    path = new_study(source, file)
    out.print(f"Written: {path}", markup=False, soft_wrap=True)
    out.print(f"Next: wavequake draw {path.name}, wavequake plan {path.name}", markup=False, soft_wrap=True)
