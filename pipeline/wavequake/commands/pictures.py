"""Commands that show what a system, mirror, study or store looks like."""

from pathlib import Path
from typing import Annotated

import typer

from wavequake.terminal import frame_progress, out


def complete_study(beginning: str) -> list[str]:
    """Return the bundled studies whose names begin so, for the shell."""
    from wavequake.files import folder

    return sorted(path.stem for path in folder("workflows").glob(f"{beginning}*.toml"))


def complete_name(beginning: str) -> list[str]:
    """Return the same with bundled systems and telescopes."""
    from wavequake.bundled import TELESCOPES
    from wavequake.optics.catalog.names import system_names

    systems = [name for name in (*system_names(), *TELESCOPES) if name.startswith(beginning)]
    return sorted({*systems, *complete_study(beginning)})


WhatArgument = Annotated[
    str,
    typer.Argument(
        help="Optical system, telescope or study by name, a lens file, study or finite-element file.",
        autocompletion=complete_name,
    ),
]
OverridesArgument = Annotated[
    list[str] | None, typer.Argument(metavar="[KEY=VALUE]...", help="e.g. campaign.cases=40")
]


def info(
    system: WhatArgument,
    overrides: OverridesArgument = None,
    figure: Annotated[
        Path | None, typer.Option("--figure", help="Draw it, too, into this file (.svg, .png, .pdf, .html).")
    ] = None,
    glass: Annotated[
        Path | None, typer.Option(help="Catalogue of glasses for a lens file (.agf), before all others.")
    ] = None,
) -> None:
    """Print a system's first-order data, fields and surfaces, models of mirrors, or what a file holds."""
    from wavequake.drawing.draw import described_study
    from wavequake.workflows.systems.source import described

    words = described_study(system, overrides or []) or described(system, overrides or [], glass)
    out.print(words, markup=False, soft_wrap=True)
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


def view(
    store: Annotated[Path, typer.Argument(help="Folder of the store.")],
    case: Annotated[
        list[int] | None, typer.Option("--case", min=0, help="Id of a case; may be given several times.")
    ] = None,
    file: Annotated[
        Path | None, typer.Option("-o", "--output", help="FILE.html (default: STORE/view.html).")
    ] = None,
) -> None:
    """Write one offline page on which cases of a store move: bodies, wavefront, image, line of sight."""
    from wavequake.viewer.view import view as write_view

    written = write_view(store, case, file, tell=lambda line: out.print(line, markup=False))
    size = written.stat().st_size / 1e6
    out.print(f"Written: {written} ({size:.1f} MB)", markup=False, soft_wrap=True)


def animate(store: Path, case: int, of: str | None, kind: str, file: Path | None = None) -> None:
    """Write a moving picture of a case and say where."""
    from wavequake.viewer.animate import animate

    with frame_progress() as progress:
        film = animate(store, case, of, kind, progress=progress, file=file)
    out.print(f"Written: {film}", markup=False, soft_wrap=True)


def _draw(what: str, overrides: list[str] | None, file: Path, solid: bool) -> None:
    from wavequake.viewer.pictures import write_drawing

    written = write_drawing(what, file, overrides or [], solid=solid)
    out.print(f"Written: {written}", markup=False, soft_wrap=True)
