"""Heights in closed form and their slopes, in NumPy: the twins of ``kernels/forms.h``. Lengths in mm."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from wavequake.kernels.trace.sequence import Form
from wavequake.kernels.trace.surfaces import conic_sag, conic_slopes, even_sag_and_slopes

Array = NDArray[np.float64]
Heights = tuple[Array, Array, Array]


def form_heights(form: Form, x: Array, y: Array) -> Heights:
    """Return the height of a form and its slopes along x and y; NaN where it does not reach out so far."""
    return _FORMS[form.name](np.array(form.numbers), x, y)


def _radial(a: Array, x: Array, y: Array) -> Heights:
    """Return the sum of a[k] r^(k + 1); at the tip of a cone the slope counts as 0."""
    r = np.hypot(x, y)
    powers = np.polynomial.Polynomial([0.0, *a])
    factor = np.where(r > 0.0, powers.deriv()(r) / np.where(r > 0.0, r, 1.0), 0.0)
    return powers(r), factor * x, factor * y


def _biconic(a: Array, x: Array, y: Array) -> Heights:
    """Return q / (1 + sqrt(1 - s)) with q = a[0] x^2 + a[1] y^2, s = a[2] x^2 + a[3] y^2."""
    q = a[0] * x**2 + a[1] * y**2
    root = np.sqrt(1.0 - a[2] * x**2 - a[3] * y**2)
    slopes = (
        2.0 * a[i] * t / (1.0 + root) + q * a[i + 2] * t / (root * (1.0 + root) ** 2)
        for i, t in enumerate((x, y))
    )
    return q / (1.0 + root), *slopes


def _toroid(a: Array, x: Array, y: Array) -> Heights:
    """Return the curve of numbers a[1:] in the plane of y and z, turned about an axis at z = 1 / a[0]."""
    zero = np.zeros_like(y)
    conic = a[2] / a[1] ** 2 - 1.0 if a[1] else 0.0
    even, _, along = even_sag_and_slopes(zero, y, tuple(a[3:].tolist())) if len(a) > 3 else (zero, zero, zero)
    curve = conic_sag(zero, y, a[1], conic) + even
    steep = conic_slopes(zero, y, a[1], conic)[1] + along
    # The circle through the curve about the axis: of radius 1 / a[0] - curve, a line for a[0] = 0.
    bent = a[0] / (1.0 - a[0] * curve)
    root = np.sqrt(1.0 - np.square(bent * x))
    return curve + bent * x**2 / (1.0 + root), bent * x / root, steep / root


def _qbfs(a: Array, x: Array, y: Array) -> Heights:
    """Return w (1 - w) S(w) sqrt((1 - a[1] r^2) / (1 - a[2] r^2)), w = a[0] r^2, with S as in `_series`."""
    square = x**2 + y**2
    w, over, under = a[0] * square, 1.0 - a[1] * square, 1.0 - a[2] * square
    value, rise = _series(a[3:], w)
    lean = np.sqrt(over / under)
    height = w * (1.0 - w) * value * lean
    by_square = a[0] * lean * ((1.0 - 2.0 * w) * value + w * (1.0 - w) * rise)
    by_square = by_square + 0.5 * height * (a[2] / under - a[1] / over)
    return height, 2.0 * x * by_square, 2.0 * y * by_square


def _qcon(a: Array, x: Array, y: Array) -> Heights:
    """Return w^2 S(w), w = a[0] r^2, with S as in `_series`."""
    w = a[0] * (x**2 + y**2)
    value, rise = _series(a[1:], w)
    by_square = a[0] * (2.0 * w * value + w**2 * rise)
    return w**2 * value, 2.0 * x * by_square, 2.0 * y * by_square


def _series(a: Array, w: Array) -> tuple[Array, Array]:
    """Return the sum of Chebyshev polynomials of 2 w - 1 and its derivative by w."""
    series = np.polynomial.Chebyshev(a, domain=[0.0, 1.0])
    return series(w), series.deriv()(w)


_FORMS: dict[str, Callable[[Array, Array, Array], Heights]] = {
    "radial": _radial,
    "biconic": _biconic,
    "toroid": _toroid,
    "qbfs": _qbfs,
    "qcon": _qcon,
}
