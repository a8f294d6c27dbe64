"""Drawings as files: SVG, PNG, PDF, or a page that needs nothing else."""

from collections.abc import Iterable, Mapping
from html import escape
from pathlib import Path
from typing import Any

from matplotlib import rc_context

from wavequake.drawing.draw import draw
from wavequake.drawing.style import STYLE, Drawing, show_names, svg_text
from wavequake.errors import UserError
from wavequake.words import printable

_PAGE = """<!doctype html>
<html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>body {{ margin: 1rem; font: 16px sans-serif }} svg {{ max-width: 100%; height: auto }}</style>
<h1>{title}</h1>
{svg}
</html>
"""


def write_drawing(
    what: Any, file: Path, overrides: Mapping[str, Any] | Iterable[str] = (), solid: bool = False
) -> Path:
    """Draw something into a file, whose suffix says in what format, and return its absolute path.

    Raises
    ------
    UserError
        As `wavequake.drawing.draw.draw`, or if the file cannot be written.
    """
    target = file.resolve()
    figure = draw(what, overrides, solid=solid)
    try:
        if target.suffix.lower() == ".html":
            target.write_text(_page(figure, str(what)), encoding="utf-8")
        elif target.suffix.lower() == ".svg":
            target.write_text(svg_text(figure), encoding="utf-8")
        else:
            show_names(figure)
            with rc_context(STYLE):
                figure.savefig(
                    target, dpi=150, metadata={"CreationDate": None} if target.suffix == ".pdf" else None
                )
    except OSError as error:
        raise UserError(f"The drawing {target} cannot be written: {error.strerror or error}.") from None
    return target


def _page(figure: Drawing, title: str) -> str:
    text = svg_text(figure)
    return _PAGE.format(title=escape(printable(title)), svg=text[text.index("<svg") :])
