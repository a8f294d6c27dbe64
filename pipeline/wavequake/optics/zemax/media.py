"""What follows a surface of a .zmx file: mirrors, glasses, constant indices and gradients."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from wavequake.errors import UserError
from wavequake.optics.media.environment import Environment
from wavequake.optics.media.glasses import (
    AIR,
    Catalogues,
    Medium,
    catalogue,
    catalogues,
    constant,
    glass,
    in_environment,
    refractive_index,
)
from wavequake.optics.media.gradients import GradientIndex
from wavequake.optics.media.model_glass import model_glass
from wavequake.optics.shapes.shapes import SurfaceAction
from wavequake.optics.zemax.gradients import GRADIENTS, ROD, gradient, rod
from wavequake.optics.zemax.rows import Line, Row, as_integer, as_number, fail

CRYSTALS = ("BIRE__IN", "BIRE_OUT")
"""Types of surfaces between which light is in a birefringent crystal."""
_ORDINARY = (0, 2)  # modes; with 2 and 3 polarization turns in a waveplate
MODEL_GLASS = "___BLANK"
_NUMBER = re.compile(r"\d{6}")

_MODEL, _PICKUP, _OFFSET = "1", "2", "4"  # a glass by numbers, of another surface, with another index
_D_LINE = 587.5618e-6
_SAME_INDEX, _SAME_ABBE = 1e-3, 0.5
_DEFAULT = (1.5, 40.0)  # what a file says of index and Abbe number where it does not know them


@dataclass(frozen=True)
class GlassShelf:
    """Where the glasses of a file are looked up, and what there is to say about them.

    Attributes
    ----------
    own : mapping of str to Medium
        The user's glasses by their name in upper case; they go before all others.
    named : tuple of str
        The catalogues that the file names (GCAT), in its order.
    environment : Environment or None
        Where glasses of catalogues are; None: where they were measured. Indices that the file gives stay.
    notes : list of str
        Sentences about glasses that were found elsewhere or whose index is another.
    """

    own: Mapping[str, Medium] = field(default_factory=dict)
    named: tuple[str, ...] = ()
    environment: Environment | None = None
    notes: list[str] = field(default_factory=list)

    def find(self, name: str) -> Medium:
        """Return a glass of the user's, of the catalogues that the file names, or else of any.

        Raises
        ------
        UserError
            If there is none of that name.
        """
        key = name.upper()
        if key in self.own:
            return self.own[key]
        if ":" in key:
            return glass(key)
        known: Catalogues = catalogues()
        for shelf in self.named:
            table = catalogue(shelf, known)
            if table is not None and key in table:
                return table[key]
        try:
            found = glass(name)
        except UserError as error:
            raise UserError(
                f"{str(error).removesuffix('.')}; give a catalogue that has it with --glass FILE.agf, or as "
                "system.glass_file of a study."
            ) from None
        if self.named and found.catalogue:
            self._note(
                f"The glass {name} is in none of the catalogues that the file names "
                f"({', '.join(self.named)}); that of {found.catalogue} was taken."
            )
        return found

    def compare(self, medium: Medium, line: Line, index: float, abbe: float) -> None:
        """Note that the file gives another index or Abbe number than the catalogue."""
        if (index, abbe) == _DEFAULT or not index or not _knows_d(medium):
            return
        own = refractive_index(medium, _D_LINE)
        if abs(own - index) > _SAME_INDEX:
            self._note(
                f"The index of {medium.name} is {own:.6g} by its catalogue (taken) and {index:.6g} by line "
                f"{line.number} of the file."
            )

    def _note(self, sentence: str) -> None:
        if sentence not in self.notes:
            self.notes.append(sentence)


def _knows_d(medium: Medium) -> bool:
    return medium.range_nm[0] <= 1e6 * _D_LINE <= medium.range_nm[1]


def picked_up(rows: Sequence[Row]) -> tuple[Row, ...]:
    """Return rows whose glass, if it is that of another surface, stands in them.

    A pickup names its glass itself where that has a name; a model glass, and air, it does not.
    """
    found: list[Row] = []
    for row in rows:
        line = row.one("GLAS")
        if line is not None and line.words[:2] == [MODEL_GLASS, _PICKUP]:
            number = as_integer(line, 2)
            if not 0 <= number < len(found):
                fail(line, f"{row.label} takes the glass of surface {number}, which does not stand before it")
            row = replace(row, lines={**row.lines, "GLAS": found[number].lines.get("GLAS", [])})
        found.append(row)
    return tuple(found)


def medium_after(
    row: Row, before: Medium | GradientIndex, scale: float, shelf: GlassShelf
) -> tuple[SurfaceAction, Medium | GradientIndex]:
    """Return what a surface does and the medium after it; no glass means air.

    Parameters
    ----------
    row : Row
    before : Medium or GradientIndex
    scale : float
        mm per unit of the file.
    shelf : GlassShelf
        Where its glass is looked up.
    """
    line = row.one("GLAS")
    if row.type == CRYSTALS[0]:
        _require_ordinary(row)
    if row.type == ROD:
        return "refract", _rod(line, row, scale, shelf)
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
    after = AIR if line is None or line.words[:1] in ([], ["AIR"]) else _glass(line, row, shelf)
    return ("pass" if after == before else "refract"), after


def _require_ordinary(row: Row) -> None:
    """Refuse a crystal of which the file traces the extraordinary ray, by its mode PARM 1."""
    mode = row.table("PARM").get(1, 0.0)
    if mode not in _ORDINARY:
        fail(
            row.line,
            f"{row.label} begins a crystal of which the extraordinary ray is traced (PARM 1 is {mode:g}); "
            f"only the ordinary one is supported, by the modes {' and '.join(map(str, _ORDINARY))}",
        )


def _rod(line: Line | None, row: Row, scale: float, shelf: GlassShelf) -> GradientIndex:
    name = line.words[0] if line and line.words else ""
    medium = shelf.own.get(name.upper())
    if medium is None:
        fail(
            line or row.line,
            f"{row.label} begins a rod of {name or 'no material'}, whose numbers are its maker's; give a "
            "file that has them, six lines for each material (name, B, C, K0, K1, K2), with --glass "
            "GRADIENT_9.DAT, or as system.glass_file of a study",
        )
    return rod(row, medium, scale)


def _glass(line: Line, row: Row, shelf: GlassShelf) -> Medium:
    words = line.words
    name, kind = words[0], words[1] if len(words) > 1 else ""
    index, abbe, deviation = (as_number(line, k) if len(words) > k else 0.0 for k in (3, 4, 5))
    if name == MODEL_GLASS or kind == _MODEL:
        as_number(line, 3)
        return _model(name, index, abbe, deviation, line, row, shelf)
    if kind == _OFFSET and any(as_number(line, k) for k in (6, 7) if len(words) > k):
        fail(line, f"{row.label} has a glass with an offset of its index, which is not supported")
    try:
        medium = _by_number(name) if _NUMBER.fullmatch(name) else shelf.find(name)
    except UserError as error:
        fail(line, f"{row.label}: {error}".rstrip("."))
    shelf.compare(medium, line, index, abbe)
    return _at(medium, line, row, shelf)


def _by_number(name: str) -> Medium:
    """Return the glass of a six-digit number: 517642 has the index 1.517 and the Abbe number 64.2."""
    return model_glass(1.0 + int(name[:3]) / 1000.0, int(name[3:]) / 10.0)


def _at(medium: Medium, line: Line, row: Row, shelf: GlassShelf) -> Medium:
    if shelf.environment is None:
        return medium
    try:
        return in_environment(medium, shelf.environment)
    except UserError as error:
        fail(line, f"{row.label}: {error}")


def _model(
    name: str, index: float, abbe: float, deviation: float, line: Line, row: Row, shelf: GlassShelf
) -> Medium:
    """Return a glass given by numbers: that of the catalogue whose name and numbers it has, if it has."""
    if name != MODEL_GLASS:
        try:
            medium = shelf.find(name)
        except UserError:
            pass
        else:
            if _knows_d(medium) and abs(refractive_index(medium, _D_LINE) - index) < _SAME_INDEX:
                return _at(medium, line, row, shelf)
    if not abbe:
        return constant(index)
    try:
        return model_glass(index, abbe, deviation)
    except UserError as error:
        fail(line, f"{row.label}: {error}".rstrip("."))
