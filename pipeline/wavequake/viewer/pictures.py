"""Write a drawing, or a page on which it can be turned."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from wavequake.drawing.files import write_drawing as drawn
from wavequake.errors import UserError

FORMATS = (".svg", ".png", ".pdf", ".html")


def write_drawing(
    what: Any,
    file: str | Path,
    overrides: Mapping[str, Any] | Iterable[str] = (),
    *,
    solid: bool = False,
) -> Path:
    """Draw something into a file, whose suffix says in what format, and return its absolute path.

    Parameters
    ----------
    what, overrides
        As of `wavequake.draw`.
    file : str or Path
        FILE.svg, .png, .pdf or .html.
    solid : bool
        In three dimensions; as .html a page on which it can be turned.

    Raises
    ------
    UserError
        As `wavequake.draw`, or if the file is of another kind or cannot be written.

    Examples
    --------
    >>> write_drawing("tmt", "tmt.html", solid=True)  # doctest: +SKIP
    """
    target = Path(file)
    if target.suffix.lower() not in FORMATS:
        raise UserError(f"{target} is no picture; its name must end in {', '.join(FORMATS)}.")
    if solid and target.suffix.lower() == ".html":
        from wavequake.viewer.view import write_scene

        return write_scene(what, target, overrides)
    return drawn(what, target, overrides, solid)
