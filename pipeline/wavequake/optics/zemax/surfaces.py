"""One row of Zemax's lens data editor: its shape, aperture and coordinate break."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import zip_longest

import numpy as np

from wavequake.optics.polynomials.indices import convert_coefficients
from wavequake.optics.polynomials.transforms import powers_as_zernike
from wavequake.optics.segments.kinematics import cardan
from wavequake.optics.shapes.forms.odd_asphere import OddAsphere
from wavequake.optics.shapes.shape import shape_of_type, zemax_types
from wavequake.optics.shapes.shapes import (
    Conic,
    EvenAsphere,
    ExtendedPolynomial,
    GridSag,
    Opening,
    Shape,
    ZernikeSag,
)
from wavequake.optics.systems.kinematics import Break
from wavequake.optics.zemax.gradients import GRADIENTS, ROD
from wavequake.optics.zemax.grids import grid_sag
from wavequake.optics.zemax.media import CRYSTALS
from wavequake.optics.zemax.phases import MAX_EVEN_TERMS, PHASES, phase_base
from wavequake.optics.zemax.rows import (
    OPENINGS,
    Line,
    Row,
    as_count,
    as_integer,
    as_number,
    fail,
    numbered,
    powers_scaled,
    require_no_numbers,
)
from wavequake.optics.zemax.user_apertures import USER_DEFINED, user_polygon

MAX_TERMS = {  # up to degree 20; of aspheres, up to the power 480 and 240
    **{"XPOLYNOM": 230, "SZERNSAG": 231, "FZERNSAG": 37, "GRID_SAG": 231},
    **{"XASPHERE": 240, "XOSPHERE": 240},
}

_FRINGE_TERMS = 36
CORNERS = 72  # of the polygon that stands for an ellipse
RING_GROWTH = math.sqrt(2.0 * math.pi / CORNERS / math.sin(2.0 * math.pi / CORNERS))
"""By how much the corners of that polygon stand beyond a circle of its area."""
_SLIT = 1e-6  # rad, through which the inside of a dark ring is joined to what lies around it
_ASPHERE = range(1, 9)  # parameters of rho^2 to rho^16 beside Zernike polynomials

_Builder = Callable[[Row, float, float, float], Shape]


def shape(row: Row, scale: float) -> Shape:
    """Return the shape of a surface in mm; `scale` is mm per unit of the file."""
    curvature, conic = row.one("CURV"), row.one("CONI")
    c = as_number(curvature, 0) if curvature else 0.0
    radius = scale / c if c else math.inf
    kappa = as_number(conic, 0) if conic else 0.0
    builders: dict[str, _Builder] = {
        "EVENASPH": _even_asphere,
        "XPOLYNOM": _extended_polynomial,
        "SZERNSAG": _zernike,
        "FZERNSAG": _zernike,
        "GRID_SAG": _grid_sag,
        "XASPHERE": _extended_asphere,
        "XOSPHERE": _extended_asphere,
        "TILTSURF": _tilted,
        "IRREGULA": _irregular,
    }
    if row.type in builders:
        return builders[row.type](row, scale, radius, kappa)
    if (registered := shape_of_type(row.type)) is not None:
        return registered.from_zemax(row, scale, radius, kappa)
    if row.type in PHASES:
        return phase_base(row, scale, radius, kappa)
    if row.type in (*GRADIENTS, ROD):  # their parameters are those of the medium
        return Conic(radius, kappa)
    if row.type in CRYSTALS:  # parameters are the mode and the axis of the crystal
        return Conic(radius, kappa)
    if row.type != "STANDARD":
        fail(
            row.one("TYPE") or row.line,
            f"{row.label} is of the type {row.type}, which is not supported; STANDARD, COORDBRK, "
            f"{', '.join((*builders, *GRADIENTS, ROD, *CRYSTALS, *PHASES, *zemax_types()))} are",
        )
    require_no_numbers(row, "PARM", row.table("PARM"))
    return Conic(radius, kappa)


def _even_asphere(row: Row, scale: float, radius: float, conic: float) -> EvenAsphere:
    given = numbered(row, "PARM", 1, MAX_EVEN_TERMS)
    return EvenAsphere(radius, conic, powers_scaled(given, scale, 2, 2))


def _extended_polynomial(row: Row, scale: float, radius: float, conic: float) -> ExtendedPolynomial:
    require_no_numbers(row, "PARM", row.table("PARM"))
    coefficients, norm = _extra_data(row, scale)
    return ExtendedPolynomial(radius, conic, coefficients, norm)


def _extended_asphere(row: Row, scale: float, radius: float, conic: float) -> EvenAsphere | OddAsphere:
    # Powers of the distance over the normalization radius: even ones, or all of them.
    require_no_numbers(row, "PARM", row.table("PARM"))
    terms, norm = _extra_data(row, scale)
    even = row.type == "XASPHERE"
    step = 2 if even else 1
    powers = tuple(term / norm ** (step * k) for k, term in enumerate(terms, start=1))
    return EvenAsphere(radius, conic, powers) if even else OddAsphere(radius, conic, powers)


def _tilted(row: Row, scale: float, radius: float, conic: float) -> Conic:
    return Conic()  # `own_breaks` turns it


def tilted_image(row: Row) -> ExtendedPolynomial:
    """Return a plane z = a x + b y (TILTSURF), on which light is measured along the axes before it."""
    return ExtendedPolynomial(math.inf, 0.0, _slopes(row))


def _slopes(row: Row) -> tuple[float, float]:
    given = numbered(row, "PARM", 1, 2)
    return given.get(1, 0.0), given.get(2, 0.0)


def _irregular(row: Row, scale: float, radius: float, conic: float) -> Conic | ExtendedPolynomial:
    """Return a conic with spherical aberration, astigmatism along y and coma of the rim, PARM 5 to 7.

    They are heights at the semi-diameter; where it stands is said by `own_breaks`.
    """
    given = numbered(row, "PARM", 0, 7)  # 8 turns astigmatism and coma
    ball, along, coma = (given.get(k, 0.0) * scale for k in (5, 6, 7))
    if not any((ball, along, coma)):
        return Conic(radius, conic)
    size = row.one("DIAM")
    if size is None or not as_number(size, 0) > 0.0:
        fail(size or row.line, f"{row.label} has irregularities at its rim, but no semi-diameter (DIAM)")
    terms = [*(0.0, 0.0), *(0.0, 0.0, along), *(0.0, coma, 0.0, coma), *(ball, 0.0, 2.0 * ball, 0.0, ball)]
    return ExtendedPolynomial(radius, conic, tuple(terms), as_number(size, 0) * scale)


def _zernike(row: Row, scale: float, radius: float, conic: float) -> ZernikeSag:
    # Parameters 1-8 add an even asphere, 9 and 10 shift the polynomials; 0 only extrapolates.
    given = row.table("PARM")
    require_no_numbers(row, "PARM", {k: v for k, v in given.items() if k and k not in _ASPHERE})
    coefficients, norm = _extra_data(row, scale)
    if row.type == "FZERNSAG":
        coefficients = _from_fringe(row, coefficients)
    powers = [given.get(k, 0.0) * scale ** (1 - 2 * k) for k in _ASPHERE]
    if any(powers):
        coefficients = _added(coefficients, powers_as_zernike(powers, norm))
    return ZernikeSag(radius, conic, coefficients, norm)


def _grid_sag(row: Row, scale: float, radius: float, conic: float) -> GridSag:
    # Parameters 1-8 add an even asphere, 9 and 10 shift the Zernike terms of the extra data.
    powers = {k: value for k, value in numbered(row, "PARM", 0, 8).items() if k}
    zernike, norm = _extra_data(row, scale) if row.table("XDAT").get(1, 0.0) else ((), 1.0)
    on_conic, even = grid_sag(row, scale, radius, conic), powers_scaled(powers, scale, 2, 2)
    return replace(on_conic, even=even, zernike=zernike, pupil_radius=norm)


def _added(one: tuple[float, ...], other: tuple[float, ...]) -> tuple[float, ...]:
    return tuple(a + b for a, b in zip_longest(one, other, fillvalue=0.0))


def _from_fringe(row: Row, coefficients: tuple[float, ...]) -> tuple[float, ...]:
    """Return Noll coefficients for up to 37 Fringe ones, the last of which is term 49 of the full set."""
    fringe = np.array(coefficients[:_FRINGE_TERMS])
    if any(coefficients[_FRINGE_TERMS:]):
        fringe = np.concatenate([fringe, np.zeros(12), coefficients[_FRINGE_TERMS:]])
    return tuple(float(value) for value in convert_coefficients(fringe, "fringe", "noll"))


def _extra_data(row: Row, scale: float) -> tuple[tuple[float, ...], float]:
    """Return the coefficients and the normalization radius that a surface's extra data hold, in mm."""
    data = row.table("XDAT")
    count, norm = data.get(1, 0.0), data.get(2, 0.0)
    if not (norm > 0 and count == int(count) and count >= 0):
        fail(
            row.line,
            f"{row.label} needs a number of terms (XDAT 1) and a positive normalization radius (XDAT 2)",
        )
    if count > MAX_TERMS[row.type]:
        fail(
            row.line,
            f"{row.label} has {count:g} terms; a surface of the type {row.type} has at most "
            f"{MAX_TERMS[row.type]}",
        )
    return tuple(data.get(3 + k, 0.0) * scale for k in range(int(count))), norm * scale


def opening(row: Row, scale: float) -> Opening | None:
    """Return the aperture of a surface in mm."""
    given = [line for keyword in OPENINGS for line in row.lines.get(keyword, [])]
    if not given:
        return None
    if len(given) > 1:
        fail(given[1], f"{row.label} has a second aperture; one is supported")
    line = given[0]
    shift = row.one("OBDC")
    center = (as_number(shift, 0) * scale, as_number(shift, 1) * scale) if shift else (0.0, 0.0)
    if line.keyword == "SPID":
        width, count = as_number(line, 0) * scale, as_count(line, 1)
        if not width > 0:
            fail(line, f"{row.label} has a spider whose arms are {width:g} mm wide, not a positive number")
        return Opening(arms=spider(width, count), center=center)
    if line.keyword in USER_DEFINED:
        corners = user_polygon(row, line, scale)
        passes = line.keyword == "USAP"
        return Opening(corners=corners, center=center) if passes else Opening(dark=corners, center=center)
    low, high = as_number(line, 0) * scale, as_number(line, 1) * scale
    if line.keyword in ("SQAP", "SQOB", "ELAP", "ELOB"):
        if not (low > 0.0 and high > 0.0):
            fail(line, f"{row.label} has an aperture of {low:g} by {high:g} mm; both must be positive")
        square = line.keyword.startswith("SQ")
        corners = rectangle(low, high) if square else ellipse(low, high)
        passes = line.keyword.endswith("AP")
        return Opening(corners=corners, center=center) if passes else Opening(dark=corners, center=center)
    if line.keyword == "OBSC" and not (low or high):
        return None
    if not 0 <= low < high:
        fail(
            line,
            f"{row.label} has an aperture from radius {low:g} to {high:g} mm; they must increase from >= 0",
        )
    if line.keyword == "OBSC":
        if not low:
            return Opening(inner=high, center=center)
        if reaches_beyond(row, line):
            return Opening(dark=ring(low, high), center=center)
        return Opening(outer=low, center=center)
    if row.type == "TILTSURF" and any(_slopes(row)):  # whose apertures are those of its projection
        if low:
            fail(line, f"{row.label} is a tilted plane with a ring as aperture, which is not supported")
        x, y = (np.array(ellipse(high, high)) + center).T
        there = np.stack([x, y, np.stack([x, y], axis=1) @ _slopes(row)], axis=1) @ _plane_axes(row)
        return Opening(corners=tuple(map(tuple, there[:, :2].tolist())))
    return Opening(outer=high, inner=low, center=center)


def reaches_beyond(row: Row, dark: Line) -> bool:
    """Tell whether a surface is wider than a dark ring (OBSC) on it: light may then pass outside."""
    size = row.one("DIAM")
    return size is not None and as_number(size, 0) > as_number(dark, 1)


def rectangle(low: float, high: float) -> tuple[tuple[float, float], ...]:
    """Return the corners of a rectangle of these half widths."""
    return ((-low, -high), (low, -high), (low, high), (-low, high))


def ring(low: float, high: float) -> tuple[tuple[float, float], ...]:
    """Return the corners of a polygon of the area of a ring between two radii, which a narrow slit opens."""
    angle = 1.0 + np.linspace(_SLIT, 2.0 * math.pi - _SLIT, CORNERS + 1)  # no usual ray lies in the slit
    there = np.stack([np.cos(angle), np.sin(angle)], axis=1) * RING_GROWTH
    return tuple(map(tuple, np.concatenate([high * there, low * there[::-1]]).tolist()))


def ellipse(low: float, high: float) -> tuple[tuple[float, float], ...]:
    """Return the corners of a polygon of the area of an ellipse of these half-axes, to 6e-4 of them."""
    angle = 2.0 * math.pi * np.arange(CORNERS) / CORNERS
    x, y = RING_GROWTH * low * np.cos(angle), RING_GROWTH * high * np.sin(angle)
    return tuple(zip(x.tolist(), y.tolist(), strict=True))


def spider(width: float, count: int) -> tuple[tuple[float, float], ...]:
    """Return equally spaced arms of one width, the first along x."""
    return tuple((2.0 * math.pi * arm / count, width) for arm in range(count))


def coordinate_break(row: Row, scale: float, thickness: float) -> Break:
    """Return a coordinate break; tilts are right-handed about x, y and z, in this order.

    With the order flag the turns are about z, y and x, before the shift, which undoes a break of opposite
    numbers.
    """
    given = row.table("PARM")
    return _break([given.get(k, 0.0) for k in range(1, 6)], bool(given.get(6, 0.0)), scale, thickness)


def _break(numbers: Sequence[float], tilt_first: bool, scale: float, thickness: float = 0.0) -> Break:
    shift = (numbers[0] * scale, numbers[1] * scale, 0.0)
    angles = np.deg2rad(numbers[2:5])
    if not tilt_first:
        return Break(shift, (float(angles[0]), float(angles[1]), float(angles[2])), False, thickness)
    return Break(shift, cardan_angles(cardan(-angles).T), True, thickness)


def own_breaks(row: Row, scale: float) -> tuple[Break | None, Break | None]:
    """Return the coordinate breaks before and after a surface that is tilted or decentered itself (SCBD).

    A line holds which of both it is (1, 2), its order, whose numbers it takes (0 its own, 1 those before this
    surface, 2 their reverse), and these numbers: x, y and the angles, as of a coordinate break.
    """
    if row.type in ("IRREGULA", "TILTSURF"):
        if "SCBD" in row.lines:
            fail(row.lines["SCBD"][0], f"{row.label}, a {row.type}, is tilted itself, which is not supported")
        return _irregular_breaks(row, scale) if row.type == "IRREGULA" else _tilted_breaks(row)
    given: dict[int, tuple[int, int, list[float]]] = {}
    for line in row.lines.get("SCBD", []):
        if row.type == "COORDBRK" and line.words[:1] == ["3"]:
            continue  # whose numbers a coordinate return found; they stand in the file
        which, order, taken = (as_integer(line, place) for place in range(3))
        numbers = [as_number(line, place) for place in range(3, 8)]
        if which not in (1, 2) or which in given or order not in (0, 1):
            fail(
                line,
                f"{row.label} needs one tilt before it (1) and one after it (2) at most, of order 0 or 1",
            )
        given[which] = (order, taken, numbers)
        first = given.get(1, (0, 0, [0.0] * 5))
        expected = {
            0: (order, numbers),
            1: (first[0], first[2]),
            2: (1 - first[0], [-value for value in first[2]]),
        }
        if taken not in (expected if which == 2 else (0,)) or (order, numbers) != expected[taken]:
            fail(line, f"{row.label} takes its tilt from another surface, which is not supported")
    before, after = (
        _break(numbers, order == 1, scale) if any(numbers) else None
        for order, _, numbers in (given.get(which, (0, 0, [0.0] * 5)) for which in (1, 2))
    )
    return before, after


def _irregular_breaks(row: Row, scale: float) -> tuple[Break | None, Break | None]:
    """Return the shift and tilt of an irregular surface (PARM 1 to 4), and what undoes them behind it."""
    given = row.table("PARM")
    numbers = [*(given.get(k, 0.0) for k in range(1, 5)), 0.0]
    if not any(numbers):
        return None, None
    return _break(numbers, False, scale), _break([-value for value in numbers], True, scale)


def _tilted_breaks(row: Row) -> tuple[Break | None, Break | None]:
    """Return the turns onto a plane z = a x + b y and back; other axes stay."""
    turn = _plane_axes(row)
    if (turn == np.eye(3)).all():
        return None, None
    there, back = (Break((0.0, 0.0, 0.0), cardan_angles(one), False, 0.0) for one in (turn, turn.T))
    return there, back


def _plane_axes(row: Row) -> np.ndarray:
    """Return the axes (columns) of a plane z = a x + b y: its normal, and x and y turned the shortest way."""
    a, b = _slopes(row)
    cosine = 1.0 / math.sqrt(1.0 + a * a + b * b)
    share = cosine / (1.0 + cosine)
    return cosine * np.array(
        [
            [1.0 / cosine - share * a * a, -share * a * b, -a],
            [-share * a * b, 1.0 / cosine - share * b * b, -b],
            [a, b, 1.0],
        ]
    )


def cardan_angles(rotation: np.ndarray) -> tuple[float, float, float]:
    """Return the angles about x, y and z (rad) of R = Rx Ry Rz; where two coincide the last is zero."""
    slant = math.hypot(rotation[0, 0], rotation[0, 1])
    beta = math.atan2(rotation[0, 2], slant)
    if slant < 1e-9:
        return math.atan2(rotation[2, 1], rotation[1, 1]), beta, 0.0
    return (
        math.atan2(-rotation[1, 2], rotation[2, 2]),
        beta,
        math.atan2(-rotation[0, 1], rotation[0, 0]),
    )
