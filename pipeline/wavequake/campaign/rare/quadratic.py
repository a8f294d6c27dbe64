"""Quadratic forms of Gaussian numbers: exact probabilities, and draws that make a rare value a common one.

The distribution function is an integral of the moment-generating function along a path through its saddle
point (Rice 1980): the same integral as Imhof's (1961), but what is left of it is the probability's own size,
so that 1e-30 is known to as many digits as 0.1.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import scipy  # its parts load when first used
from numpy.typing import NDArray

from wavequake.errors import UserError

Array = NDArray[np.float64]

_NOTHING = 1e-14  # share of the largest curvature or slope that counts as none
_PATH, _STEPS = 9.0, 1200  # half length of the path in sinh(x) widths of the saddle, and its points
_LEAST = 1e-280  # probabilities below it are none


@dataclass(frozen=True)
class QuadraticForm:
    """f(u) = constant + sum of slope y + curvature y^2, with y = directions^T u, of standard normal u (d,).

    Attributes
    ----------
    constant : float
    slopes, curvatures : ndarray, shape (r,)
    directions : ndarray, shape (d, r)
        Orthonormal columns.
    """

    constant: float
    slopes: Array
    curvatures: Array
    directions: Array

    @property
    def mean(self) -> float:
        """Mean of the values."""
        return float(self.constant + self.curvatures.sum())

    def values(self, points: Array) -> Array:
        """Return the values (n,) at points (n, d)."""
        return self.along(points @ self.directions)

    def along(self, y: Array) -> Array:
        """Return the values (n,) at coordinates along the directions, (n, r)."""
        return np.asarray(self.constant + y @ self.slopes + y**2 @ self.curvatures)


def quadratic_form(constant: float, linear: Array, square: Array) -> QuadraticForm:
    """Return constant + linear . u + u . square u in the coordinates in which it is a sum.

    Parameters
    ----------
    constant : float
    linear : ndarray, shape (d,)
    square : ndarray, shape (d, d)
        Symmetric.
    """
    curvatures, directions = np.linalg.eigh(square)
    bent = np.abs(curvatures) > _NOTHING * np.abs(curvatures).max(initial=0.0)
    curvatures, directions = curvatures[bent], directions[:, bent]
    slopes = directions.T @ linear
    rest = linear - directions @ slopes
    size = float(np.linalg.norm(rest))
    if size > 1e-12 * max(float(np.linalg.norm(linear)), float(np.abs(curvatures).max(initial=0.0))):
        curvatures, slopes = np.append(curvatures, 0.0), np.append(slopes, size)
        directions = np.column_stack([directions, rest / size])
    return QuadraticForm(constant, slopes, curvatures, directions)


def cumulant(form: QuadraticForm, s: NDArray[np.complex128] | Array | float) -> NDArray[np.complex128]:
    """Return log E exp(s f) where it exists, of the shape of `s`."""
    at = np.asarray(s, dtype=np.complex128)[..., None]
    narrow = 1.0 - 2.0 * at * form.curvatures
    terms = -0.5 * np.log(narrow) + 0.5 * (at * form.slopes) ** 2 / narrow
    return np.asarray(at[..., 0] * form.constant + terms.sum(axis=-1))


def exceedance(form: QuadraticForm, limit: float) -> float:
    """Return the probability that the form exceeds a limit, to some twelve digits; 0 below 1e-280."""
    start = _root(form, limit, pole=True)
    if start is None:
        return 0.0
    height = float(cumulant(form, start).real) - start * limit - np.log(start)
    if height < np.log(_LEAST):
        return 0.0
    width = 1.0 / np.sqrt(_slope_of_mean(form, start) + start**-2)
    # From the saddle upwards, leaning to where exp(s (constant - limit)) fades, never across the real axis.
    lean = 0.5 if limit > form.constant else 0.0
    step = _PATH / _STEPS
    x = (np.arange(_STEPS) + 0.5) * step
    y, dy = np.sinh(x), np.cosh(x)
    bend = np.sqrt(1.0 + y**2)
    path = start + width * (lean * (bend - 1.0) + 1j * y)
    direction = width * (lean * y / bend + 1j) * dy
    with np.errstate(over="ignore", under="ignore", invalid="ignore"):
        inside = np.exp(cumulant(form, path) - path * limit - np.log(path) - height) * direction
    inside = np.where(np.isfinite(inside), inside, 0.0)
    return float(min(np.exp(height) * inside.imag.sum() * step / np.pi, 1.0))


def limit_of(form: QuadraticForm, probability: float) -> float:
    """Return the limit that the form exceeds with a probability between 0 and 1."""
    scale = np.sqrt(_slope_of_mean(form, 0.0))
    low, high = form.mean - scale, form.mean + scale
    while exceedance(form, low) < probability:
        low -= 2.0 * (high - low)
    while exceedance(form, high) > probability:
        high += 2.0 * (high - low)

    def lacks(limit: float) -> float:
        return float(np.log(max(exceedance(form, limit), _LEAST)) - np.log(probability))

    found: float = scipy.optimize.brentq(lacks, low, high, xtol=1e-13 * scale, rtol=1e-13)
    return found


def largest_factor(form: QuadraticForm, limit: float, probability: float) -> float:
    """Return by what all numbers may grow until a limit is exceeded with a probability.

    Raises
    ------
    UserError
        If the limit is exceeded without any, or none reaches it.
    """
    if form.constant >= limit:
        raise UserError(f"The limit is exceeded at rest: {form.constant:.6g} against {limit:.6g}.")
    if not form.curvatures.any() and not form.slopes.any():
        raise UserError("Nothing changes what is limited, so that anything is allowed.")

    def lacks(logarithm: float) -> float:
        factor = float(np.exp(logarithm))
        grown = replace(form, slopes=factor * form.slopes, curvatures=factor**2 * form.curvatures)
        return float(np.log(max(exceedance(grown, limit), _LEAST)) - np.log(probability))

    size = form.mean - form.constant + float(np.linalg.norm(form.slopes)) * np.sqrt(limit - form.constant)
    low = high = 0.5 * float(np.log((limit - form.constant) / max(size, 1e-300)))
    while lacks(low) > 0.0:
        low -= 1.0
    while lacks(high) < 0.0:
        high += 1.0
    found: float = scipy.optimize.brentq(lacks, low, high, xtol=1e-12)
    return float(np.exp(found))


@dataclass(frozen=True)
class Tilt:
    """The Gaussian distribution whose density is that of u times exp(rate f(u) - norm).

    Its mean value of f is the limit, and the weight of a draw depends on f alone (Siegmund 1976).

    Attributes
    ----------
    form : QuadraticForm
    rate, norm : float
    means, widths : ndarray, shape (r,)
        Of the coordinates along the form's directions; all others are standard normal.
    """

    form: QuadraticForm
    rate: float
    norm: float
    means: Array
    widths: Array

    def drawn(self, unit: Array) -> Array:
        """Return points (..., d) of standard normal numbers of that shape."""
        y = unit @ self.form.directions
        return np.asarray(unit + (self.means + (self.widths - 1.0) * y) @ self.form.directions.T)

    def along(self, unit: Array) -> Array:
        """Return the coordinates (..., r) of :meth:`drawn` along the form's directions."""
        return np.asarray(self.means + self.widths * (unit @ self.form.directions))

    def weights(self, values: Array) -> Array:
        """Return the weights of draws with some values of the form."""
        return np.asarray(np.exp(self.norm - self.rate * values))


def tilt_to(form: QuadraticForm, limit: float) -> Tilt:
    """Return the distribution that has its mean value at a limit.

    Raises
    ------
    UserError
        If the form never reaches the limit.
    """
    rate = _root(form, limit, pole=False)
    if rate is None:
        raise UserError(f"No case reaches {limit:.6g}.")
    variances = 1.0 / (1.0 - 2.0 * rate * form.curvatures)
    return Tilt(
        form,
        rate,
        float(cumulant(form, rate).real),
        rate * form.slopes * variances,
        np.sqrt(variances),
    )


def _mean_at(form: QuadraticForm, s: float) -> float:
    """Return the derivative of :func:`cumulant`: the mean of the form in the tilted distribution."""
    narrow = 1.0 - 2.0 * s * form.curvatures
    terms = form.curvatures / narrow + s * form.slopes**2 * (1.0 - s * form.curvatures) / narrow**2
    return float(form.constant + terms.sum())


def _slope_of_mean(form: QuadraticForm, s: float) -> float:
    narrow = 1.0 - 2.0 * s * form.curvatures
    return float(np.sum(2.0 * (form.curvatures / narrow) ** 2 + form.slopes**2 / narrow**3))


def _root(form: QuadraticForm, limit: float, pole: bool) -> float | None:
    """Return where the mean of the tilted form is the limit (and 1/s beyond it); None if nowhere.

    With the pole of the distribution function, s is positive.
    """
    scale = 1.0 / np.sqrt(_slope_of_mean(form, 0.0))
    top = float(form.curvatures.max(initial=0.0))
    bottom = float(form.curvatures.min(initial=0.0))

    def excess(s: float) -> float:
        return _mean_at(form, s) - limit - (1.0 / s if pole else 0.0)

    upper = _side(excess, 0.5 / top if top > 0.0 else np.inf, scale, 1.0)
    if upper is None:
        return None
    if pole:
        lower: float | None = 1e-3 * min(scale, upper)
        while excess(lower) > 0.0:  # type: ignore[arg-type]
            lower = lower * 1e-3  # type: ignore[operator]
    else:
        lower = _side(excess, 0.5 / bottom if bottom < 0.0 else -np.inf, scale, -1.0)
    if lower is None:
        return None
    found: float = scipy.optimize.brentq(excess, lower, upper, xtol=1e-14 * scale, rtol=1e-14)
    return found


def _side(excess: Callable[[float], float], end: float, scale: float, sign: float) -> float | None:
    """Return where on one side of 0, before its end, `excess` has that sign; None if nowhere."""
    for k in range(50):  # nearer to the end, 1 - 2 s curvature has no digits left
        place = sign * scale * 2.0**k if np.isinf(end) else end * (1.0 - 2.0 ** -(k + 1))
        if sign * excess(place) > 0.0:
            return place
    return None
