"""One row of Zemax's lens data editor: its shape, aperture and coordinate break."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import zip_longest

import numpy as np

from wavequake.optics.polynomials.indices import convert_coefficients
from wavequake.optics.polynomials.transforms import powers_as_zernike
from wavequake.optics.segments.kinematics import cardan
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
from wavequake.optics.zemax.gradients import GRADIENTS
from wavequake.optics.zemax.grids import grid_sag
from wavequake.optics.zemax.phases import MAX_EVEN_TERMS, PHASES, phase_base
from wavequake.optics.zemax.rows import (
    OPENINGS,
    Row,
    as_count,
    as_integer,
    as_number,
    fail,
    numbered,
    powers_scaled,
    require_no_numbers,
)

MAX_TERMS = {"XPOLYNOM": 230, "SZERNSAG": 231, "FZERNSAG": 37, "GRID_SAG": 231}  # up to degree 20

_FRINGE_TERMS = 36
CORNERS = 72  # of the polygon that stands for an ellipse
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
    }
    if row.type in builders:
        return builders[row.type](row, scale, radius, kappa)
    if (registered := shape_of_type(row.type)) is not None:
        return registered.from_zemax(row, scale, radius, kappa)
    if row.type in PHASES:
        return phase_base(row, scale, radius, kappa)
    if row.type in GRADIENTS:  # their parameters are those of the medium
        return Conic(radius, kappa)
    if row.type != "STANDARD":
        fail(
            row.one("TYPE") or row.line,
            f"{row.label} is of the type {row.type}, which is not supported; STANDARD, COORDBRK, "
            f"{', '.join((*builders, *GRADIENTS, *PHASES, *zemax_types()))} are",
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
    low, high = as_number(line, 0) * scale, as_number(line, 1) * scale
    if line.keyword == "SQAP":
        return Opening(corners=((-low, -high), (low, -high), (low, high), (-low, high)), center=center)
    if line.keyword == "ELAP":
        if not (low > 0.0 and high > 0.0):
            fail(
                line,
                f"{row.label} has an elliptic aperture of {low:g} and {high:g} mm; both must be positive",
            )
        return Opening(corners=ellipse(low, high), center=center)
    if not 0 <= low < high:
        fail(
            line,
            f"{row.label} has an aperture from radius {low:g} to {high:g} mm; they must increase from >= 0",
        )
    if line.keyword == "OBSC":
        # A ring that is dark from `low` on: what passes outside of it, if anything, is stopped, too.
        return Opening(outer=low, center=center) if low else Opening(inner=high, center=center)
    return Opening(outer=high, inner=low, center=center)


def ellipse(low: float, high: float) -> tuple[tuple[float, float], ...]:
    """Return the corners of a polygon of the area of an ellipse of these half-axes, to 6e-4 of them."""
    angle = 2.0 * math.pi * np.arange(CORNERS) / CORNERS
    grown = math.sqrt(2.0 * math.pi / CORNERS / math.sin(2.0 * math.pi / CORNERS))
    x, y = grown * low * np.cos(angle), grown * high * np.sin(angle)
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
    given: dict[int, tuple[int, int, list[float]]] = {}
    for line in row.lines.get("SCBD", []):
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
