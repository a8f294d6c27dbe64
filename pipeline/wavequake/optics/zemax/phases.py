"""Gratings, binary optics and paraxial lenses in .zmx files.

DGRATING has grooves along x, PARM 1 per micrometer of y, and the order PARM 2. BINARY_1 and BINARY_2 have
the order PARM 0, an even asphere PARM 1 to 8, and as extra data the number of terms, their normalization
radius and the terms in rad, of x, y, x^2, ... or of the radius squared, to the fourth, ... FZERNPHA has
Fringe polynomials in waves instead. TOROGRAT is a toroid (PARM 1 its radius along x) with the grooves PARM 2
and the order PARM 3. HOLOGRM2 is a hologram of two points, PARM 1 to 6, made at PARM 7 micrometers, of the
order PARM 8. PARAXIAL has the focal length PARM 1 and a mode of its paths, PARM 2, which are always
those between object and image here.
"""

import math

import numpy as np

from wavequake.errors import UserError
from wavequake.optics.polynomials.indices import convert_coefficients
from wavequake.optics.polynomials.zernike import circular_zernike_xy, noll_to_nm
from wavequake.optics.shapes.forms.toroid import Toroid
from wavequake.optics.shapes.phases import Diffraction, Effect, PerfectLens
from wavequake.optics.shapes.shapes import Conic, EvenAsphere, Shape
from wavequake.optics.zemax.rows import (
    Row,
    as_number,
    fail,
    numbered,
    powers_scaled,
    require_no_numbers,
    written,
)

MAX_EVEN_TERMS = 8
MAX_TERMS = 240
GROOVES_PER_MM = 1e3  # for one per micrometer

PHASES = ("DGRATING", "TOROGRAT", "BINARY_1", "BINARY_2", "FZERNPHA", "HOLOGRM2", "PARAXIAL")
_HOLOGRAM_MARGIN, _FARTHEST, _HOLOGRAM_TERMS = 1.25, 0.8, 100
_FRINGE_TERMS = 36  # after them comes term 49 of the full set


def phase_base(row: Row, scale: float, radius: float, conic: float) -> Shape:
    """Return the shape of a surface that has a phase; `scale` is mm per unit of the file."""
    if row.type == "PARAXIAL":
        return Conic()
    if row.type in ("DGRATING", "FZERNPHA", "HOLOGRM2"):
        return Conic(radius, conic)
    if row.type == "TOROGRAT":
        return Toroid(radius, conic, numbered(row, "PARM", 1, 3).get(1, 0.0) * scale or math.inf)
    even = {k: value for k, value in numbered(row, "PARM", 0, MAX_EVEN_TERMS).items() if k}
    terms = powers_scaled(even, scale, 2, 2)
    return EvenAsphere(radius, conic, terms) if terms else Conic(radius, conic)


def phase(row: Row, scale: float) -> Effect | None:
    """Return what a surface does to light beside its shape."""
    if row.type == "PARAXIAL":
        focal = numbered(row, "PARM", 1, 2).get(1, 0.0)
        if not focal:
            fail(row.line, f"{row.label} is a paraxial lens without a focal length (PARM 1)")
        return PerfectLens(focal * scale)
    if row.type == "DGRATING":
        given = numbered(row, "PARM", 1, 2)
        return Diffraction(given.get(2, 0.0), given.get(1, 0.0) * GROOVES_PER_MM)
    if row.type == "TOROGRAT":
        given = numbered(row, "PARM", 1, 3)
        return Diffraction(given.get(3, 0.0), given.get(2, 0.0) * GROOVES_PER_MM)
    if row.type == "HOLOGRM2":
        return _hologram(row, scale)
    if row.type not in PHASES:
        return None
    data = row.table("XDAT")
    count, norm = data.get(1, 0.0), data.get(2, 0.0)
    if not (norm > 0.0 and count == int(count) and 0 <= count <= MAX_TERMS):
        fail(
            row.line,
            f"{row.label} needs a number of terms up to {MAX_TERMS} (XDAT 1) and a positive normalization "
            "radius (XDAT 2)",
        )
    terms = tuple(data.get(3 + k, 0.0) for k in range(int(count)))
    order, radius = row.table("PARM").get(0, 0.0), norm * scale
    if row.type == "FZERNPHA":
        return _fringe_phase(row, terms, radius)
    if row.type == "BINARY_1":
        return Diffraction(order, polynomial=terms, normalization_radius=radius)
    return Diffraction(order, radial=terms, normalization_radius=radius)


def _hologram(row: Row, scale: float) -> Diffraction:
    """Return the phase of a hologram that makes of light from one point of the axis light to another.

    Light of the order m loses m times both ways to the points, over the wavelength at which it was made: a
    series in the square of the distance from the axis, which converges up to the nearer point's distance.
    """
    given = numbered(row, "PARM", 1, 8)
    ways = [abs(given.get(k, 0.0)) * scale for k in (3, 6)]
    curved, size = row.one("CURV"), row.one("DIAM")
    if any(given.get(k, 0.0) for k in (1, 2, 4, 5)) or (curved and as_number(curved, 0)):
        fail(
            row.line,
            f"{row.label} is a hologram that is curved or of points off its axis, which is not supported",
        )
    reach = _HOLOGRAM_MARGIN * as_number(size, 0) * scale if size else 0.0
    if not 0.0 < reach <= _FARTHEST * min(ways):
        fail(
            row.line,
            f"{row.label} is a hologram whose semi-diameter (DIAM) is not positive, or one of its points is "
            "not farther than one and a half of it",
        )
    made = given.get(7, 0.0)
    if not made > 0.0:
        fail(row.line, f"{row.label} is a hologram made at {made:g} um, not a positive wavelength")
    share = (reach / min(ways)) ** 2
    terms, power = np.zeros(_HOLOGRAM_TERMS), 1.0
    for k in range(_HOLOGRAM_TERMS):
        power *= (0.5 - k) / (k + 1)  # the binomial coefficient of 1 / 2 and k + 1
        terms[k] = sum(way * power * (reach / way) ** (2 * (k + 1)) for way in ways)
    kept = int(np.ceil(math.log(1e-17) / math.log(share))) if share else 1
    radians = -2.0 * math.pi / (made * 1e-3) * terms[:kept]
    return Diffraction(given.get(8, 0.0), radial=tuple(radians.tolist()), normalization_radius=reach)


def _fringe_phase(row: Row, waves: tuple[float, ...], radius: float) -> Diffraction:
    """Return Fringe polynomials in waves as a phase; parameter 0 is the order, 1 only extrapolates."""
    given = row.table("PARM")
    require_no_numbers(row, "PARM", {k: value for k, value in given.items() if k > 1})
    if len(waves) > _FRINGE_TERMS + 1:
        fail(row.line, f"{row.label} has {len(waves)} terms; Fringe polynomials are {_FRINGE_TERMS + 1}")
    coefficients = np.array(waves[:_FRINGE_TERMS])
    if any(waves[_FRINGE_TERMS:]):
        coefficients = np.concatenate([coefficients, np.zeros(12), waves[_FRINGE_TERMS:]])
    noll = convert_coefficients(coefficients, "fringe", "noll")
    degree = noll_to_nm(len(noll))[0] if len(noll) else 0
    powers = 2.0 * math.pi * circular_zernike_xy(degree, len(noll)) @ noll
    # A constant phase moves nothing: paths are compared between rays of one system.
    return Diffraction(given.get(0, 0.0), polynomial=tuple(powers[1:].tolist()), normalization_radius=radius)


def phase_lines(effect: Effect, shape: Shape, where: str) -> list[str]:
    """Return the type, the shape and the phase of a surface as lines.

    Raises
    ------
    UserError
        If no surface type has this shape and this phase.
    """
    if isinstance(effect, PerfectLens):
        return ["TYPE PARAXIAL", "CURV 0.0", f"PARM 1 {written(effect.focal_length)}", "PARM 2 1.0"]
    base = [f"CURV {written(1.0 / shape.radius)}", f"CONI {written(shape.conic)}"]
    binary = bool(effect.radial or effect.polynomial)
    if not binary and isinstance(shape, Conic):
        lines = effect.lines / GROOVES_PER_MM
        return ["TYPE DGRATING", *base, f"PARM 1 {written(lines)}", f"PARM 2 {written(effect.order)}"]
    even = shape.coefficients if isinstance(shape, EvenAsphere) else ()
    several = bool(effect.radial) + bool(effect.polynomial) + bool(effect.lines)
    if not isinstance(shape, Conic | EvenAsphere) or len(even) > MAX_EVEN_TERMS or several > 1 or not binary:
        raise UserError(
            f"The surface {where} diffracts by grooves, a radial phase and a polynomial together, or on a "
            "shape with which no surface type of lens files does."
        )
    terms = effect.radial or effect.polynomial
    values = [float(len(terms)), effect.normalization_radius, *terms]
    return [
        f"TYPE BINARY_{1 if effect.polynomial else 2}",
        *base,
        *(f"PARM {k} {written(value)}" for k, value in enumerate((effect.order, *even))),
        *(f"XDAT {k} {written(value)} 0 0" for k, value in enumerate(values, start=1)),
    ]
