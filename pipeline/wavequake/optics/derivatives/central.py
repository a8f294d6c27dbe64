"""Central differences with a checked step: the one way in which derivatives of traces are taken.

Everything is computed with a step and with twice that. Where the two disagree, neither is a derivative: a ray
crossed an edge, rounding is too large, or the motion acts nonlinearly.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wavequake.errors import UserError
from wavequake.optics.wavefronts.record import Wavefront

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

DOFS = ("dx", "dy", "dz", "rx", "ry", "rz")
TOLERANCE = 1e-5
SIGNS = np.array([1.0, -1.0, 2.0, -2.0])
"""Steps of a checked difference, in their order."""

FAINT = 1e-4  # of a tilt or shift of the whole pupil: where all derivatives are smaller, this is their scale


@dataclass(frozen=True)
class Steps:
    """Half widths of the central differences: of translations in mm, rotations in rad, figures in mm."""

    translation: float = 1e-3
    rotation: float = 1e-6
    figure: float = 1e-5

    def require(self) -> None:
        """Raise UserError unless all are positive numbers."""
        for name, step in vars(self).items():
            if not (np.isfinite(step) and step > 0.0):
                raise UserError(f"the step of a {name} is {step}, it must be a positive number")


@dataclass(frozen=True)
class SensitivityMatrix:
    """Derivatives with respect to E elements (surfaces or segments) of D degrees of freedom each.

    Attributes
    ----------
    elements : tuple of str, length E
    dofs : tuple of str, length D
        dx ... rz, or Z1, Z2, ... for a figure's circular Noll Zernike terms.
    steps : ndarray, shape (D,)
        Half width of the central differences, mm or rad.
    zernike : ndarray, shape (E, D, J)
        Of the annular Noll coefficients, waves per mm or rad.
    los : ndarray, shape (E, D, 2)
        Of the line of sight (Störkle 2018, Eq. 3.39, annular tilt / sqrt(1 + eps^2)), mm per mm or rad in the
        axes of the image plane, which is the detector: if it moves, the image moves against it.
    centroid : ndarray, shape (E, D, 2)
        Of the rays' geometric centroid, mm per mm or rad.
    rms_raw : ndarray, shape (E, D)
        Rms over the rays of the derivative of the OPD, piston removed, waves per mm or rad.
    disagreement : ndarray, shape (E, D)
        Between the derivatives with this step and the double one, relative to the largest derivative of the
        same quantity with respect to any element and degree of freedom of the same unit (or to 1e-4 of what
        a shift or tilt of the whole pupil does, if that is more); inf if the motion loses rays.
    tolerance : float
        The largest disagreement of a valid column.
    """

    elements: tuple[str, ...]
    dofs: tuple[str, ...]
    steps: Array
    zernike: Array
    los: Array
    centroid: Array
    rms_raw: Array
    disagreement: Array
    tolerance: float

    def part(self, which: slice) -> "SensitivityMatrix":
        """Return the matrix of some of its elements."""
        arrays = {name: getattr(self, name)[which] for name in BY_ELEMENT}
        return replace(self, elements=self.elements[which], **arrays)

    @property
    def agrees(self) -> bool:
        """Whether two steps agree in all columns."""
        return bool(np.all(self.disagreement <= self.tolerance))

    @property
    def worst(self) -> tuple[str, str, float]:
        """Element, degree of freedom and size of the largest disagreement between two steps."""
        element, dof = np.unravel_index(np.argmax(self.disagreement), self.disagreement.shape)
        return self.elements[element], self.dofs[dof], float(self.disagreement[element, dof])


BY_ELEMENT = ("zernike", "los", "centroid", "rms_raw", "disagreement")
"""Arrays of a matrix whose first axis is that of its elements."""


class Differences(NamedTuple):
    """Between K pairs of instants, (K, ...); one is intact if it loses the rays lost at rest, no others."""

    zernike: Array
    los: Array
    centroid: Array
    rms_raw: Array
    intact: NDArray[np.bool_]

    def first(self, count: int) -> "Differences":
        """Return those of the first pairs."""
        zernike, los, centroid, rms_raw, intact = self
        return Differences(zernike[:count], los[:count], centroid[:count], rms_raw[:count], intact[:count])


def differences(found: Wavefront, rms_raw: Array, same: NDArray[np.bool_]) -> Differences:
    """Return those of pairs of instants; `same` (2 K,) says which instants lose the rays lost at rest."""
    zernike, los, centroid = (
        values[0::2] - values[1::2] for values in (found.zernike, found.los, found.centroid)
    )
    return Differences(zernike, los, centroid, rms_raw, same[0::2] & same[1::2])


def weighted_rms(weight: Array, values: Array) -> Array:
    """Return the rms (K,) of values (K, N) of rays of weights (N,) about their means; NaN do not count."""
    kept = np.isfinite(values)
    shares = np.where(kept, weight, 0.0)
    total = np.maximum(shares.sum(axis=1), np.finfo(float).tiny)
    values = np.where(kept, values, 0.0)
    values = values - (np.sum(shares * values, axis=1) / total)[:, None]
    return np.asarray(np.sqrt(np.sum(shares * values**2, axis=1) / total), dtype=np.float64)


# Moves elements (K,) in degrees of freedom (K,) by plus and minus sizes (K,), and returns the differences.
Pairs = Callable[[Indices, Indices, Array], Differences]


def sensitivity_matrix(
    pairs: Pairs,
    at_once: int,
    elements: Sequence[str],
    dofs: tuple[str, ...],
    sizes: Array,
    faint: tuple[ArrayLike, ArrayLike],
    tolerance: float = TOLERANCE,
) -> SensitivityMatrix:
    """Return the derivatives of wavefront and line of sight (the columns of C_a, Störkle 2018, Eq. 4.21).

    Parameters
    ----------
    pairs : callable
        Traces at most `at_once` pairs.
    elements, dofs : sequence of str, lengths E and D
    sizes : ndarray, shape (D,)
        Steps.
    faint : two array_like, shape (D,)
        Derivatives, of waves and of millimeters, below which all are called small.
    tolerance : float
    """
    fine, wide = (_derivatives(pairs, at_once, len(elements), factor * sizes) for factor in (1.0, 2.0))
    # Columns of one unit share a scale: a mirror's turn about its own axis, which changes nothing, is as
    # accurate as its tilts.
    turns = np.array([name in DOFS[3:] for name in dofs])
    worst = np.zeros(fine.intact.shape)
    for one, other, floor in zip(fine[:3], wide[:3], (faint[0], faint[1], faint[1]), strict=True):
        size = np.abs(one).max(axis=(0, 2))
        largest = np.where(turns, size[turns].max(initial=0.0), size[~turns].max(initial=0.0))
        worst = np.maximum(worst, np.abs(one - other).max(axis=2) / np.maximum(largest, floor))
    return SensitivityMatrix(
        elements=tuple(elements),
        dofs=dofs,
        steps=sizes,
        zernike=fine.zernike,
        los=fine.los,
        centroid=fine.centroid,
        rms_raw=fine.rms_raw,
        disagreement=np.where(fine.intact & wide.intact & np.isfinite(worst), worst, np.inf),
        tolerance=tolerance,
    )


def _derivatives(pairs: Pairs, at_once: int, elements: int, sizes: Array) -> Differences:
    """Return central differences of half widths `sizes` (D,), (E, D, ...)."""
    columns, dofs = elements * len(sizes), len(sizes)
    parts = []
    for first in range(0, columns, at_once):
        element, dof = np.divmod(np.arange(first, min(first + at_once, columns)), dofs)
        parts.append(pairs(element, dof, sizes[dof]))
    zernike, los, centroid, rms_raw, intact = (np.concatenate(part) for part in zip(*parts, strict=True))
    shape, widths = (elements, dofs), 2.0 * sizes
    return Differences(
        zernike.reshape(*shape, -1) / widths[:, None],
        los.reshape(*shape, 2) / widths[:, None],
        centroid.reshape(*shape, 2) / widths[:, None],
        rms_raw.reshape(shape) / widths,
        intact.reshape(shape),
    )


def central(values: Array, step: ArrayLike) -> Array:
    """Return (f(+h) - f(-h)) / (2 h) of values (2 or more, ...), of which the first two are these."""
    return np.asarray((values[0] - values[1]) / (2.0 * np.asarray(step)), dtype=np.float64)


def gradient(values: Array, step: float) -> Array:
    """Return derivatives (..., 2) by x and y of values (4, ...) at a step along +x, -x, +y and -y."""
    return np.stack([central(values[:2], step), central(values[2:], step)], axis=-1)


def checked_derivative(
    values: Array,
    step: ArrayLike,
    what: str,
    remedy: str,
    axis: int | tuple[int, ...] | None = None,
    units: NDArray[Any] | None = None,
    least: ArrayLike = 0.0,
) -> Array:
    """Return central differences of values, if those of twice the step are the same.

    Parameters
    ----------
    values : ndarray, shape (4, ...)
        At `SIGNS` times the step; what is NaN in one of them is left out of the comparison.
    step : array_like
        One, or those of the last axis.
    what, remedy : str
        What is differentiated, and what to do if that fails, for the message.
    axis : int or tuple of int, optional
        Of a derivative, over which the largest number is the scale of the error; by default over all.
    units : ndarray, shape (K,), optional
        Labels of the other axis: derivatives of one unit share the largest scale of them.
    least : array_like
        What the scale is at least, where all derivatives are smaller.

    Returns
    -------
    ndarray, shape (...)

    Raises
    ------
    UserError
        If the two differ by more than `TOLERANCE` of the scale.
    """
    once, twice = central(values, step), central(values[2:], 2.0 * np.asarray(step))
    apart, size = (_largest(one, axis) for one in (once - twice, once))
    if units is not None:
        size = np.array([size[units == one].max() for one in units])
    size = np.maximum(size, least)
    with np.errstate(invalid="ignore", divide="ignore"):
        worst = float(np.max(np.where(apart > 0.0, apart / size, 0.0)))
    if not worst < TOLERANCE:
        raise UserError(f"the derivatives of {what} differ by {worst:.2g} between two steps; {remedy}")
    return once


def _largest(values: Array, axis: int | tuple[int, ...] | None) -> Array:
    found = np.abs(values)
    return np.asarray(np.max(np.where(np.isnan(found), 0.0, found), axis=axis), dtype=np.float64)
