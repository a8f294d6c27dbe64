"""What surfaces do to light beside their shape: orders of diffraction, perfect lenses. Lengths in mm."""

from dataclasses import dataclass
from math import pi

import numpy as np

from wavequake.errors import UserError
from wavequake.kernels.trace.sequence import Phase, Polynomial
from wavequake.optics.shapes.forms.extended_polynomial import extended_powers
from wavequake.optics.shapes.shape import SMALLEST_RADIUS


@dataclass(frozen=True)
class Diffraction:
    """A grating or a binary optic: light of one order, to which each groove adds a wavelength.

    A place (x, y) of the surface adds ``order`` times the wavelength times the grooves up to there: those of
    ``lines`` per mm along y, and a phase over 2 pi.

    Attributes
    ----------
    order : float
        An integer for a real grating.
    lines : float
        Grooves per mm, along x and equally spaced along y on the vertex plane.
    radial : tuple of float
        Phase, rad: of u^2, u^4, ..., with u the distance from the axis over ``normalization_radius``.
    polynomial : tuple of float
        Phase, rad: of x, y, x^2, x y, y^2, ..., over the same radius.
    """

    order: float
    lines: float = 0.0
    radial: tuple[float, ...] = ()
    polynomial: tuple[float, ...] = ()
    normalization_radius: float = 1.0


@dataclass(frozen=True)
class PerfectLens:
    """A thin lens of power 1 / ``focal_length`` that images its object with equal paths."""

    focal_length: float


Effect = Diffraction | PerfectLens


def phase_of(effect: Diffraction, wavelength: float) -> Phase:
    """Return the path that an order adds to light of a wavelength (mm)."""
    waves = effect.order * wavelength / (2.0 * pi)
    norm = effect.normalization_radius
    even = tuple(waves * a / norm ** (2 * k) for k, a in enumerate(effect.radial, start=1))
    terms = waves * np.array(effect.polynomial)
    if effect.lines:
        terms = np.concatenate([terms, np.zeros(max(0, 2 - terms.size))])
        terms[1] += effect.order * wavelength * effect.lines * norm
    if not terms.size:
        return Phase(even)
    degree = sum(extended_powers(terms.size)[-1])
    coefficients = np.zeros((degree + 1) * (degree + 2) // 2)
    coefficients[1 : 1 + terms.size] = terms
    return Phase(even, Polynomial(degree, norm, coefficients))


def axis_effect(effect: Effect, wavelength: float) -> tuple[float, tuple[float, float]]:
    """Return the mean power at the vertex, 1/mm, and the slopes of the path that is added there."""
    if isinstance(effect, PerfectLens):
        return 1.0 / effect.focal_length, (0.0, 0.0)
    phase = phase_of(effect, wavelength)
    power = -2.0 * sum(phase.even[:1])
    if phase.polynomial is None:
        return power, (0.0, 0.0)
    terms, norm = [*phase.polynomial.coefficients, *[0.0] * 6], phase.polynomial.radius
    return power - (terms[3] + terms[5]) / norm**2, (terms[1] / norm, terms[2] / norm)


def effect_words(effect: Effect | None) -> str:
    """Return what `info` calls it."""
    if effect is None:
        return ""
    if isinstance(effect, PerfectLens):
        return f"perfect lens of f = {effect.focal_length:.8g} mm"
    kind = f"grating of {effect.lines:.8g} / mm" if effect.lines else "binary phase"
    return f"{kind}, order {effect.order:g}"


def require_effect(effect: Effect | None) -> None:
    """Raise UserError unless its numbers are finite and its lengths have a size."""
    if effect is None:
        return
    if isinstance(effect, PerfectLens):
        if not SMALLEST_RADIUS <= abs(effect.focal_length) < np.inf:
            raise UserError(
                f"its perfect lens has the focal length {effect.focal_length} mm; its size must be "
                f"{SMALLEST_RADIUS:g} mm at least"
            )
        return
    numbers = (effect.order, effect.lines, *effect.radial, *effect.polynomial)
    if not np.isfinite(numbers).all():
        raise UserError("its diffraction has an order, grooves or a phase that are not finite numbers")
    if not SMALLEST_RADIUS <= effect.normalization_radius < np.inf:
        raise UserError(
            f"the normalization radius of its phase is {effect.normalization_radius} mm; it must be "
            f"{SMALLEST_RADIUS:g} mm at least"
        )
