"""The header of a .zmx file: what changes the light but is not supported, and what is not understood."""

from collections.abc import Mapping, Sequence

from wavequake.optics.media.environment import Environment
from wavequake.optics.systems.apodization import STRONGEST, Apodization
from wavequake.optics.zemax.rows import Line, Row, as_integer, as_number, fail

PUPILS = ("ENPD", "FNUM", "OBNA", "FLOA")
_USED = (
    *("MODE", "NAME", "UNIT", "FTYP", "XFLN", "YFLN", "XFLD", "YFLD", "WAVM", "WAVL", "PWAV", "MNUM"),
    *("ENVD", "GFAC"),
)
# Those with a Z before them are of older files.
_VIGNETTING = ("VDXN", "VDYN", "VCXN", "VCYN", "VANN", "ZVDX", "ZVDY", "ZVCX", "ZVCY", "ZVAN")
# Version, notes, preferences, catalogs, names of other files; how rays are aimed (here always at the real
# stop) and path lengths referred; margins of drawn semi-diameters; weights and tolerances; polarization,
# which coatings need to act; settings of rays that have no sequence.
_HARMLESS = (
    *("VERS", "NOTE", "PFIL", "LANG", "GCAT", "COFN", "GLRS", "PICB", "BLNK", "LUID", "DMFS"),
    *("RAIM", "PUSH", "ROPD", "HYPR", "SDMA", "OMMA", "GSTD", "POLS", "NSCD"),
    *("FWGN", "FWGT", "WWGN", "WWGT", "WAVN", "TOL", "MOFF", "AUTH", "DBDT", "FCOM"),
)
_KNOWN = frozenset((*_USED, *PUPILS, *_VIGNETTING, *_HARMLESS))
_COLDEST, _HOTTEST, _DENSEST = -200.0, 500.0, 100.0  # degrees Celsius and atmospheres
_NAMED = 8


def require_supported(header: Mapping[str, Sequence[Line]]) -> None:
    """Refuse what changes the light, but not as an `OpticalSystem` does.

    Parameters
    ----------
    header : mapping of str to sequence of Line
        The lines outside of surfaces by keyword.

    Raises
    ------
    UserError
        If there is such a line; the message names it.
    """
    for line in header.get("MODE", [])[:1]:
        if line.words[:1] != ["SEQ"]:
            fail(line, f"the mode {line.rest!r} is not supported, only SEQ is")


def environment_of(header: Mapping[str, Sequence[Line]]) -> Environment | None:
    """Return the temperature and pressure that indices follow; None: they are those of the catalogues.

    Raises
    ------
    UserError
        If there is no such place.
    """
    line = next(iter(header.get("ENVD", [])), None)
    if line is None or len(line.words) < 3 or not as_integer(line, 2):
        return None
    temperature, pressure = as_number(line, 0), as_number(line, 1)
    if not (_COLDEST <= temperature <= _HOTTEST and 0.0 <= pressure <= _DENSEST):
        fail(
            line,
            f"the environment has {temperature:g} degrees Celsius and {pressure:g} atmospheres; possible are "
            f"{_COLDEST:g} to {_HOTTEST:g} and 0 to {_DENSEST:g}",
        )
    return Environment(temperature, pressure)


def apodization_of(header: Mapping[str, Sequence[Line]]) -> Apodization | None:
    """Return how the light falls over the pupil by ``GFAC factor type``; None: it is uniform.

    Raises
    ------
    UserError
        If there is no such type or factor.
    """
    line = next(iter(header.get("GFAC", [])), None)
    kind = as_integer(line, 1) if line is not None and len(line.words) > 1 else 0
    if line is None or kind == 0:
        return None
    if kind == 2:
        return Apodization("cosine_cubed")
    if kind != 1:
        fail(line, f"the apodization of the pupil is of type {kind}; 0 (uniform), 1 (Gaussian), 2 are read")
    factor = as_number(line, 0)
    if not 0.0 <= factor <= STRONGEST:
        fail(line, f"the factor of the Gaussian apodization is {factor:g}; it must be 0 to {STRONGEST:g}")
    return Apodization("gaussian", factor) if factor else None


def left_aside(header: Mapping[str, Sequence[Line]], rows: Sequence[Row]) -> str:
    """Return sentences that name what is not understood, each keyword once; empty if all is.

    Parameters
    ----------
    header : mapping of str to sequence of Line
        The lines before the surfaces by keyword.
    rows : sequence of Row
        The surfaces.
    """
    lines = [found[0] for keyword, found in header.items() if keyword not in _KNOWN]
    properties: dict[str, Line] = {}
    for row in rows:
        for line in row.unknown():
            properties.setdefault(line.keyword, line)
    said = [_named("The lens file's header has lines", lines)]
    said.append(_named("Its surfaces have properties", list(properties.values())))
    return " ".join(filter(None, said))


def _named(what: str, lines: Sequence[Line]) -> str:
    if not lines:
        return ""
    names = [f"{line.keyword[:12]} (line {line.number})" for line in lines[:_NAMED]]
    more = f" and {len(lines) - _NAMED} more" if len(lines) > _NAMED else ""
    return (
        f"{what} that are not understood and were left aside: {', '.join(names)}{more}. If they change the "
        "light, this system is another."
    )
