"""Telescopes by name: the Thirty Meter Telescope, its simplified models, others, and a user's own."""

import difflib
import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from math import inf, isfinite, pi, sqrt
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from wavequake.errors import UserError
from wavequake.optics.checks import number, require_kind
from wavequake.optics.media.glasses import AIR, Medium, constant, glass
from wavequake.optics.segments.arrangements import tmt_segments
from wavequake.optics.segments.layout import (
    JWST_CONIC,
    JWST_RADIUS,
    TABLE_4_2_CONIC,
    TMT18_SIDE,
    TMT_CONIC,
    TMT_RADIUS,
    Segments,
    jwst_segments,
    monolithic,
    polygons_from_csv,
    tmt18_segments,
)
from wavequake.optics.segments.observatories import elt, gmt, gtc, het, keck
from wavequake.optics.segments.telescope import (
    Row,
    around_its_glass,
    segmented_telescope,
    sequential_surfaces,
)
from wavequake.optics.systems.system import OpticalSystem

_TMT_PUPIL = (1512.2, 15000.0)
_STOP_Z = -1874.9721  # plane of the full mirror's rim, as Table 4.2 prints it
_M3_TO_IMAGE = sqrt(2.0) * 14142.136  # 20 m; Table 4.2 prints the shifts in M3's frame


def telescope(name: str, **options: Any) -> OpticalSystem:
    """Build a telescope by name.

    Parameters
    ----------
    name : str
        ``tmt``, ``tmt-18``, ``tmt-thesis``, ``jwst``, ``elt``, ``keck``, ``gtc``, ``het``, ``gmt`` or
        ``custom``.
    **options
        Those of the function of the same name in this module; the others have none.

    Raises
    ------
    UserError
        If the name or an option is unknown (names the nearest valid one), or an option is out of range.

    Examples
    --------
    >>> telescope("tmt-18", gap=5.0)
    <OpticalSystem tmt-18: 18 segments, 5 surfaces, 1 field, 1 wavelength>
    """
    builder = _BUILDERS.get(name) if isinstance(name, str) else None
    if builder is None:
        raise UserError(f"There is no telescope {name!r}; {_nearest(str(name), list(_BUILDERS))}.")
    signature = inspect.signature(builder)
    for option in options:
        if option not in signature.parameters:
            valid = _nearest(option, list(signature.parameters))
            raise UserError(f"The telescope {name} has no option {option!r}; {valid}.")
    for option, parameter in signature.parameters.items():
        if parameter.default is parameter.empty and option not in options:
            raise UserError(f"The telescope {name} needs the option {option!r}.")
        if parameter.annotation is float and option in options:
            number(options[option], f"the option {option} of the telescope {name}")
    return builder(**options)


def tmt(gap: float = 2.5) -> OpticalSystem:
    """Return the Thirty Meter Telescope: 492 segments with gaps in mm, official prescription, f = 450 m."""
    return _tmt("tmt", tmt_segments(gap), TMT_CONIC, -6227.67857, _TMT_PUPIL)


def tmt18(side: float = TMT18_SIDE, gap: float = 0.0) -> OpticalSystem:
    """Return the simplified TMT of 18 hexagons (Störkle 2018, section 4.6) and Table 4.2.

    Parameters
    ----------
    side : float
        Side length of a hexagon, mm. The pupil is the annulus that the segments fill but for their gaps: from
        the side to sqrt(13) times the side.
    gap : float
        Between neighboring edges, mm.
    """
    return _tmt("tmt-18", tmt18_segments(side, gap), TABLE_4_2_CONIC, -6227.68, (side, sqrt(13.0) * side))


def tmt_thesis() -> OpticalSystem:
    """Return the TMT with a monolithic primary mirror (Störkle 2018, Table 4.2)."""
    return _tmt("tmt-thesis", monolithic(_TMT_PUPIL[1]), TABLE_4_2_CONIC, -6227.68, _TMT_PUPIL)


def _tmt(
    name: str, segments: Segments, conic: float, m2_radius: float, pupil: tuple[float, float]
) -> OpticalSystem:
    """Assemble a TMT; M2's conic is negative, where Table 4.2 has lost the sign."""
    rows = [
        Row("M2", m2_radius, -1.31822813, 27093.75, semi_diameter=1512.2),
        Row("M3", inf, 0.0, 23593.75, tilt=pi / 4.0, semi_diameter=1753.95),
        Row("image", inf, 0.0, _M3_TO_IMAGE),
    ]
    return segmented_telescope(name, segments, TMT_RADIUS, conic, sequential_surfaces(rows), _STOP_Z, *pupil)


def jwst() -> OpticalSystem:
    """Return the James Webb Space Telescope's segments before a two-mirror equivalent of its optics.

    Published are the radii of curvature of the primary (15.8797 m) and secondary mirror (1778.913 mm) and the
    focal length, 131.4 m; the third mirror and the spacings are not confirmed. So this is a Cassegrain
    telescope: M2 stands where the two radii give f = 131.4 m (7.104 m before M1, the real one at 7.169 m),
    and the conics (-1 and -1.274 instead of -0.9967 and -1.6598) make the axis exactly stigmatic. Scales and
    segment effects on axis are those of the telescope; its field aberrations and sensitivities to M2 are not.

    The pupil is the annulus about the glass.
    """
    focal_length, m2_radius = 131400.0, -1778.913
    f1, f2 = -JWST_RADIUS / 2.0, m2_radius / 2.0
    distance = f1 + f2 - f1 * f2 / focal_length
    magnification = focal_length / f1
    m2_conic = -(((magnification + 1.0) / (magnification - 1.0)) ** 2)
    rows = [
        Row("M2", m2_radius, m2_conic, distance),
        Row("image", inf, 0.0, magnification * (f1 - distance)),
    ]
    note = (
        "Published are the radii of M1 and M2 and the focal length; assumed is a Cassegrain equivalent "
        "without M3: the place of M2 and both conics follow from f = 131.4 m and a stigmatic axis."
    )
    made = around_its_glass("jwst", jwst_segments(), JWST_RADIUS, JWST_CONIC, rows)
    return replace(made, note=note)


def custom(
    polygons: str | Path | TextIO,
    primary_radius: float,
    surfaces: Sequence[Mapping[str, Any]],
    primary_conic: float = -1.0,
) -> OpticalSystem:
    """Return a user's telescope; its pupil is the annulus about the glass.

    Parameters
    ----------
    polygons : path or text stream
        CSV of the segments (see `wavequake.optics.segments.layout.polygons_from_csv`).
    primary_radius, primary_conic : float
        Of M1's parent surface; the radius is in mm and negative, because the mirror is concave.
    surfaces : sequence of mappings
        What follows M1, the image plane last: ``name``, ``radius_mm`` (None for a plane; negative if the
        center of curvature lies towards the sky's side of an unfolded telescope), ``conic`` (0 by default),
        ``even_asphere`` (of rho^2, rho^4, ... in mm^-1, mm^-3, ...),
        ``distance_mm`` along the light from the previous surface, ``tilt_deg`` of a fold mirror about its y
        axis (0 by default; a lens turns alone), ``semi_diameter_mm`` beyond which it vignettes light (None,
        without an edge, by default), ``glass``: what follows a surface that refracts, by name, an index, or
        "air" (None, a mirror, by default), ``body``: the name under which surfaces move together.
    """
    if not (isfinite(primary_radius) and primary_radius < 0.0):
        raise UserError(
            f"The radius of the primary mirror is {primary_radius:g} mm; it must be negative (concave)."
        )
    if not isfinite(primary_conic):
        raise UserError(f"The conic constant of the primary mirror is {primary_conic}; it must be a number.")
    if not surfaces:
        raise UserError("A custom telescope needs surfaces after the primary mirror, the image plane last.")
    rows = [_row(surface, index) for index, surface in enumerate(surfaces, start=1)]
    last = rows[-1]
    if isfinite(last.radius) or last.tilt or isfinite(last.semi_diameter) or any(last.even) or last.glass:
        raise UserError(
            f"The last surface, {last.name!r}, is the image plane; it must have no radius, no "
            "even_asphere, no tilt, no semi_diameter_mm and no glass."
        )
    _require_air_at_the_image(rows)
    _require_names([row.name for row in rows])
    _require_bodies(rows)
    segments = polygons_from_csv(polygons, primary_radius, primary_conic)
    reach = float(np.hypot(*np.moveaxis(segments.corners, -1, 0)).max())
    if reach > -primary_radius:
        raise UserError(
            f"The segments reach {reach:g} mm from the axis, farther than the radius of curvature of the "
            f"primary mirror, {-primary_radius:g} mm: polygons are in m, primary_radius_mm in mm."
        )
    return around_its_glass("custom", segments, primary_radius, primary_conic, rows)


def _require_air_at_the_image(rows: Sequence[Row]) -> None:
    """Raise UserError if the light that meets the image is still in glass."""
    glasses = [(row.glass, row.name) for row in rows if row.glass is not None]
    if glasses and glasses[-1][0] != AIR:
        medium, name = glasses[-1]
        raise UserError(
            f"The light meets the image in {medium.name}, behind {name!r}; the last surface that refracts "
            'must have glass = "air".'
        )


def _require_names(names: Sequence[str]) -> None:
    """Raise UserError unless surfaces after M1 have names of their own."""
    for index, name in enumerate(names):
        if not name.strip() or name in ("M1", "stop", *names[:index]):
            raise UserError(
                f"Surface {index + 1} after the primary mirror is called {name!r}; each needs a name of its "
                "own, other than M1 and stop."
            )


def _require_bodies(rows: Sequence[Row]) -> None:
    """Raise UserError if a body is called as a surface, or holds the image."""
    for row in rows:
        if row.body in ("M1", "stop", *(one.name for one in rows)):
            raise UserError(
                f"The body {row.body!r} of the surface {row.name!r} is called as a surface; give it a name "
                "of its own."
            )
    if rows[-1].body:
        raise UserError(
            f"The image plane, {rows[-1].name!r}, belongs to the body {rows[-1].body!r}; bodies are of "
            "mirrors and lenses."
        )


def _row(surface: Mapping[str, Any], index: int) -> Row:
    """Check one surface of a custom prescription."""
    require_kind(surface, Mapping, f"surface {index} after the primary mirror", " of keys to values.")
    keys = ["name", "radius_mm", "conic", "distance_mm", "tilt_deg", "semi_diameter_mm"]
    keys += ["even_asphere", "glass", "body"]
    name = str(surface.get("name", f"surface {index}"))
    for key in surface:
        if key not in keys:
            raise UserError(f"The surface {name!r} has the unknown key {key!r}; {_nearest(key, keys)}.")
    radius, edge = surface.get("radius_mm"), surface.get("semi_diameter_mm")
    values = {
        "radius_mm": inf if radius is None else radius,
        "conic": surface.get("conic", 0.0),
        "distance_mm": surface.get("distance_mm"),
        "tilt_deg": surface.get("tilt_deg", 0.0),
        "semi_diameter_mm": inf if edge is None else edge,
    }
    for key, value in values.items():
        if (
            not isinstance(value, int | float)
            or value != value
            or (key not in ("radius_mm", "semi_diameter_mm") and not isfinite(value))
        ):
            raise UserError(f"The surface {name!r} has {key} = {value!r}; it must be a number.")
    if values["radius_mm"] == 0.0 or not values["distance_mm"] > 0.0:
        raise UserError(f"The surface {name!r} needs a radius_mm other than 0 and a distance_mm above 0.")
    if not values["semi_diameter_mm"] > 0.0:
        raise UserError(f"The surface {name!r} needs a semi_diameter_mm above 0, or none.")
    even = tuple(surface.get("even_asphere", ()))
    if not all(isinstance(one, int | float) and isfinite(one) for one in even):
        raise UserError(f"The surface {name!r} has even_asphere = {list(even)!r}; it must be numbers.")
    return Row(
        name,
        even=tuple(float(one) for one in even),
        radius=float(values["radius_mm"]),
        conic=float(values["conic"]),
        distance=float(values["distance_mm"]),
        tilt=values["tilt_deg"] * pi / 180.0,
        semi_diameter=float(values["semi_diameter_mm"]),
        glass=_glass(name, surface.get("glass")),
        body=str(surface.get("body") or ""),
    )


def _glass(name: str, given: Any) -> Medium | None:
    """Return what follows a surface that refracts; None for a mirror."""
    if given is None or given == "mirror":
        return None
    if isinstance(given, str):
        try:
            return AIR if given.lower() == "air" else glass(given)
        except UserError as error:
            raise UserError(f"The surface {name!r}: {error}") from None
    if isinstance(given, bool) or not isinstance(given, int | float) or not (isfinite(given) and given > 0.0):
        raise UserError(
            f"The surface {name!r} has glass = {given!r}; it must be the name of a glass, a positive index, "
            '"air", or left out for a mirror.'
        )
    return constant(float(given))


def _nearest(name: str, valid: list[str]) -> str:
    near = difflib.get_close_matches(name, valid, n=1, cutoff=0.0)
    return f"the nearest valid one is {near[0]!r}" if near else "it has none"


_BUILDERS: dict[str, Callable[..., OpticalSystem]] = {
    "tmt": tmt,
    "tmt-18": tmt18,
    "tmt-thesis": tmt_thesis,
    "jwst": jwst,
    "elt": elt,
    "keck": keck,
    "gtc": gtc,
    "het": het,
    "gmt": gmt,
    "custom": custom,
}
