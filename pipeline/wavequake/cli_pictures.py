"""Commands that show what a system, mirror, study or store looks like."""

from pathlib import Path
from typing import Annotated

import typer

from wavequake.errors import UserError
from wavequake.terminal import out

FORMATS = (".svg", ".png", ".pdf", ".html")

WhatArgument = Annotated[
    str, typer.Argument(help="Optical system, telescope or study by name, FILE.zmx, or a study by path.")
]
OverridesArgument = Annotated[
    list[str] | None, typer.Argument(metavar="[KEY=VALUE]...", help="e.g. campaign.cases=40")
]


def info(
    system: Annotated[
        str, typer.Argument(help="Optical system or telescope by name, FILE.zmx, or a study by name or path.")
    ],
    overrides: OverridesArgument = None,
    figure: Annotated[
        Path | None, typer.Option("--figure", help="Draw it, too, into this file (.svg, .png, .pdf, .html).")
    ] = None,
) -> None:
    """Print first-order data, fields, wavelengths and surfaces of an optical system."""
    from wavequake.workflows.systems.system_source import load_system

    out.print(load_system(system, overrides or []).info(), markup=False, soft_wrap=True)
    if figure is not None:
        _draw(system, overrides, figure, solid=False)


def draw(
    what: WhatArgument,
    overrides: OverridesArgument = None,
    solid: Annotated[bool, typer.Option("--3d", help="In space; as .html it can be turned.")] = False,
    file: Annotated[
        Path | None, typer.Option("-o", "--output", help="FILE.svg, .png, .pdf or .html (default: NAME.svg).")
    ] = None,
) -> None:
    """Draw a system with its rays to scale, a segmented mirror with its names, or a finite-element mirror."""
    _draw(what, overrides, file or Path(f"{Path(what).stem}.svg"), solid)


def _draw(what: str, overrides: list[str] | None, file: Path, solid: bool) -> None:
    if file.suffix.lower() not in FORMATS:
        raise UserError(f"{file} is no picture; its name must end in {', '.join(FORMATS)}.")
    from wavequake.drawing.files import write_drawing

    out.print(f"Written: {write_drawing(what, file, overrides or [], solid)}", markup=False, soft_wrap=True)
