"""Media whose refractive index varies in space: SELFOC rods, Luneburg lenses, axial gradients.

n² is a polynomial in r² and z about the vertex and in the frame of the surface that begins the medium, and
moves with that surface; `wavequake.kernels.trace.gradient_numpy` follows rays through it. In steps of the
default length path and position are exact to some 1e-11 of the way; the error grows as the fourth power of
the step.
"""

import cmath
from dataclasses import dataclass
from math import inf, isfinite

import numpy as np

from wavequake.errors import UserError
from wavequake.kernels.trace.sequence import Gradient
from wavequake.optics.checks import alike, number
from wavequake.optics.media.glasses import Medium, constant, refractive_index

SELFOC = "selfoc"
"""Formula of rods whose maker gives index and gradient by the wavelength."""
_SHORTEST = 1e-2  # step, relative to the default
_STEPS_PER_SCALE = 100.0  # default steps on the length over which the index changes
_STEPS_OF_RODS = 400.0  # which are many such lengths long, over which errors add up
_MOST_GROWTH = 36.0  # by its exponential the last digit of where a ray starts becomes all of where it ends


@dataclass(frozen=True)
class GradientIndex:
    """A medium with n² = n0² + sum radial[k] r^(2 k + 2) + sum axial[k] z^(k + 1), in powers of 1/mm.

    ``base`` gives n0, the index at the vertex, at each wavelength. ``step`` (mm) is how far a ray goes at a
    time; None chooses it by `default_step`. A base of the formula "selfoc" gives the powers, too.
    """

    name: str
    base: Medium
    radial: tuple[float, ...] = ()
    axial: tuple[float, ...] = ()
    step: float | None = None


def selfoc(
    index: float, constant_per_mm: float, higher: tuple[float, ...] = (), step: float | None = None
) -> GradientIndex:
    """Return a rod with n² = n0² (1 - g² r² + h4 g⁴ r⁴ + h6 g⁶ r⁶ + ...) about the z axis.

    Parameters
    ----------
    index, constant_per_mm : float
        n0 on the axis and g.
    higher : tuple of float
        h4, h6, ...
    step : float, optional
        mm.

    Raises
    ------
    UserError
        If something is no number.
    """
    index, constant_per_mm = (number(one, "a number of the rod") for one in (index, constant_per_mm))
    shares = (-1.0, *alike("the higher terms of the rod", higher)[0].tolist())
    radial = tuple(
        share * _power(index, 2) * _power(constant_per_mm, 2 * k) for k, share in enumerate(shares, start=1)
    )
    return GradientIndex("SELFOC", constant(index), radial, (), step)


def powers_at(medium: GradientIndex, wavelength_mm: float) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return the radial and the axial powers of n² at a wavelength.

    Rods of the formula "selfoc" have n = n0 (1 - g² r² / 2) with g = k2 + k3 / w² + k4 / w⁴ per mm, w in µm.
    """
    if medium.base.formula != SELFOC:
        return medium.radial, medium.axial
    squared, wave = medium_index(medium, wavelength_mm) ** 2, (1e3 * wavelength_mm) ** 2
    _, _, *terms = medium.base.coefficients
    strength = sum(term / wave**power for power, term in enumerate(terms)) ** 2
    return (-squared * strength, squared * strength**2 / 4.0), ()


def axial(coefficients: tuple[float, ...], step: float | None = None) -> GradientIndex:
    """Return a medium with the index n = a0 + a1 z + a2 z² + ..., z in mm from the vertex.

    Raises
    ------
    UserError
        If there are no numbers.
    """
    (powers,) = alike("the coefficients of the index", coefficients)
    if not len(powers):
        raise UserError("an axial gradient needs at least the index at its vertex")
    squared = np.polynomial.Polynomial(powers) ** 2
    rest = tuple(squared.coef[1:].tolist())
    return GradientIndex("axial gradient", constant(float(powers[0])), (), rest, step)


def luneburg(radius: float, step: float | None = None) -> GradientIndex:
    """Return a Luneburg lens, n² = 2 - (r² + (z - R)²) / R², whose front vertex is at z = 0.

    Raises
    ------
    UserError
        If the radius is not positive.
    """
    if not number(radius, "the radius of a Luneburg lens") > 0.0:
        raise UserError(f"the radius of a Luneburg lens is {radius} mm; it must be positive")
    square = _power(radius, -2)
    return GradientIndex("Luneburg lens", constant(1.0), (-square,), (2.0 / radius, -square), step)


def _power(base: float, exponent: int) -> float:
    """Return a power, infinite where it is too large for a number; a medium of such is refused later."""
    try:
        return float(base**exponent)
    except (OverflowError, ZeroDivisionError):
        return inf


def medium_index(medium: Medium | GradientIndex, wavelength_mm: float) -> float:
    """Return the refractive index of a medium, at its vertex if it has a gradient."""
    return refractive_index(medium.base if isinstance(medium, GradientIndex) else medium, wavelength_mm)


def gradient_of(medium: Medium | GradientIndex, wavelength_mm: float) -> Gradient | None:
    """Return how n² changes in a medium as the trace takes it; None for a homogeneous one.

    Raises
    ------
    UserError
        If the step is so short that rounding, not the step, would limit the accuracy.
    """
    if not isinstance(medium, GradientIndex):
        return None
    default = default_step(medium, wavelength_mm)
    step = default if medium.step is None else medium.step
    if step < _SHORTEST * default:
        raise UserError(
            f"the step of {step:g} mm through {medium.name} takes more than {1 / _SHORTEST:g} times as many "
            f"steps as the default, {default:.3g} mm, which is exact to 1e-11 of the way; take a longer one"
        )
    return Gradient(*powers_at(medium, wavelength_mm), step)


def default_step(medium: GradientIndex, wavelength_mm: float) -> float:
    """Return a hundredth of the length over which the strongest term changes n² by itself, mm.

    Of rods of the formula "selfoc" a quarter of that.
    """
    squared = medium_index(medium, wavelength_mm) ** 2
    across, along = powers_at(medium, wavelength_mm)
    terms = [(abs(c), 2 * k) for k, c in enumerate(across, start=1)]
    terms += [(abs(c), k) for k, c in enumerate(along, start=1)]
    lengths = [float((squared / c) ** (1.0 / power)) for c, power in terms if c]
    return min(lengths) / (_STEPS_PER_SCALE if medium.base.formula != SELFOC else _STEPS_OF_RODS)


def require_gradient(medium: GradientIndex) -> None:
    """Raise UserError unless the numbers of a medium make a gradient."""
    numbers = (*medium.radial, *medium.axial)
    if not all(isfinite(number) for number in numbers):
        raise UserError(f"the gradient of {medium.name} holds numbers that are not finite")
    if not any(numbers) and medium.base.formula != SELFOC:
        raise UserError(f"the medium {medium.name} has no gradient: give a constant index instead")
    if medium.step is not None and not (isfinite(medium.step) and medium.step > 0.0):
        raise UserError(f"the step through {medium.name} is {medium.step} mm; it must be positive")


def paraxial_transfer(
    medium: GradientIndex, wavelength_mm: float, start: float, way: float, sense: float
) -> np.ndarray:
    """Return the matrix of (y, n u) for a way along the axis.

    With t, the integral of dz / n, the paraxial ray equation is d²y/dt² = radial[0] y.

    Parameters
    ----------
    medium : GradientIndex
    wavelength_mm : float
    start : float
        z in the medium where the way begins, mm.
    way : float
        mm, along the light.
    sense : float
        1 where light goes along the medium's z, -1 where against it.

    Raises
    ------
    UserError
        If the index is not real on the way, or throws light so far from the axis that rounding decides where.
    """
    nodes, weights = np.polynomial.legendre.leggauss(32)
    places = start + sense * way * 0.5 * (nodes + 1.0)
    t = 0.5 * way * float(np.sum(weights / axis_index(medium, wavelength_mm, places)))
    across, _ = powers_at(medium, wavelength_mm)
    frequency = cmath.sqrt(-across[0] if across else 0.0)
    growth = abs((frequency * t).imag)
    if not growth < _MOST_GROWTH:
        raise UserError(
            f"the index of {medium.name} rises so steeply off the axis (radial[0] = {across[0]:g} per "
            f"mm^2) that {way:g} mm of it throw light exp({growth:.3g}) times as far off it; in a "
            "medium that focuses it falls (radial[0] < 0)"
        )
    along = t if frequency == 0.0 else cmath.sin(frequency * t) / frequency
    cosine = cmath.cos(frequency * t)
    numbers = [cosine, along, -(frequency**2) * along, cosine]
    return np.array([complex(number).real for number in numbers]).reshape(2, 2)


def axis_index(medium: GradientIndex, wavelength_mm: float, z: np.ndarray) -> np.ndarray:
    """Return the refractive index on the axis at z (mm).

    Raises
    ------
    UserError
        If it is not real there.
    """
    squared = np.polynomial.Polynomial([medium_index(medium, wavelength_mm) ** 2, *medium.axial])(z)
    if not np.min(squared, initial=inf) > 0.0:
        raise UserError(f"the index of {medium.name} is not real at z = {z[np.argmin(squared)]:.6g} mm")
    return np.asarray(np.sqrt(squared))
