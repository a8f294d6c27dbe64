"""What follows a surface of a .zmx file: mirrors, glasses, constant indices and gradients."""

from wavequake.errors import UserError
from wavequake.optics.media.glasses import AIR, Medium, constant, glass
from wavequake.optics.media.gradients import GradientIndex
from wavequake.optics.shapes.shapes import SurfaceAction
from wavequake.optics.zemax.gradients import GRADIENTS, gradient
from wavequake.optics.zemax.rows import Line, Row, as_number, fail

MODEL_GLASS = "___BLANK"


def medium_after(
    row: Row, before: Medium | GradientIndex, scale: float
) -> tuple[SurfaceAction, Medium | GradientIndex]:
    """Return what a surface does and the medium after it; no glass means air.

    Parameters
    ----------
    row : Row
    before : Medium or GradientIndex
    scale : float
        mm per unit of the file.
    """
    line = row.one("GLAS")
    if row.type in GRADIENTS:
        if line is not None:
            fail(
                line,
                f"{row.label} begins a gradient in a named material, whose dispersion is not known; leave "
                "the glass blank",
            )
        return "refract", gradient(row, scale)
    if line is not None and line.words[:1] == ["MIRROR"]:
        if isinstance(before, GradientIndex):
            fail(line, f"{row.label} is a mirror inside a medium whose index varies; this is not supported")
        return "reflect", before
    after = AIR if line is None else _glass(line, row)
    return ("pass" if after == before else "refract"), after


def _glass(line: Line, row: Row) -> Medium:
    name = line.words[0] if line.words else ""
    if name != MODEL_GLASS and not (len(line.words) > 1 and line.words[1] == "1"):
        try:
            return glass(name)
        except UserError as error:
            fail(line, f"{row.label}: {error}".rstrip("."))
    index, abbe = as_number(line, 3), as_number(line, 4)
    if abbe:
        fail(
            line,
            f"{row.label} has a model glass with index {index:g} and Abbe number {abbe:g}; name a glass "
            "of the catalogue, or set the Abbe number to 0 for a constant index",
        )
    return constant(index)
