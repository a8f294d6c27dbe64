"""Which elements move at a line, and which mode of the structure it is."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from wavequake.mechanics.telemetry.line import Line
from wavequake.optics.derivatives.central import DOFS
from wavequake.workflows.identify.seen import Seen

Array = NDArray[np.float64]

DOUBT = 0.01  # probability below which a deviation is no chance
_SAME = 1e-6  # of the largest singular value
_NEAR = 0.15  # share by which a mode's frequency may be off
_LIKE = 0.8  # correlation of shapes of a mode and a line
_FOLDS = 4.0  # times half the sampling frequency: where modes stand that are looked for in folded lines
_OFF = 0.005  # share by which such a mode may be off, where the study does not say


@dataclass(frozen=True)
class Explanation:
    """What moves at a line.

    Attributes
    ----------
    alone : tuple of tuple of str
        Sets of elements, each of which alone explains what the signals see: one element each, or else two;
        nothing where no two elements do.
    motion : dict of (str, str) to float
        By element and axis: rms in m or rad, with signs, of the first set, or of all elements; the least that
        explains the signals, a micrometer counting as much as a microradian.
    share : float
        Of the signals' mean square, by their noise, that this motion explains.
    """

    alone: tuple[tuple[str, ...], ...]
    motion: dict[tuple[str, str], float]
    share: float


@dataclass(frozen=True)
class MeasuredMode:
    """A mode of the structure that is a line.

    Attributes
    ----------
    number : int
        Counted from 1.
    line : Line
    model_hz, model_damping : float
        Of the model.
    likeness : float
        Square of the cosine between the shapes, weighted by their errors; NaN of a single signal.
    prior : (float, float)
        Standard deviations of the logarithms of what the model says, infinite where it does not say.
    """

    number: int
    line: Line
    model_hz: float
    model_damping: float
    likeness: float
    prior: tuple[float, float] = (np.inf, np.inf)

    def updated(self) -> tuple[float, float, Array]:
        """Return frequency, Hz, and damping ratio as updated, and the covariance of their logarithms.

        What the model says and what was measured, weighted by their certainty (both logarithms Gaussian).
        """
        known = 1.0 / np.square(self.prior)
        measured = np.linalg.inv(self.line.covariance[:2, :2])
        covariance = np.linalg.inv(measured + np.diag(known))
        logs = np.log([self.line.frequency_hz, self.line.damping])
        model = np.log([self.model_hz, self.model_damping])
        frequency, damping = np.exp(covariance @ (measured @ logs + known * model))
        return float(frequency), float(damping), covariance


def explained(line: Line, seen: Seen) -> Explanation:
    """Return which elements move at a line."""
    motions, _ = seen.at(line.frequency_hz)
    used = np.abs(motions).max(axis=(1, 2)) > 0.0
    weight = _whitening(line)[:, used]
    target, columns = weight @ line.rms[used], np.einsum("ic,ced->ied", weight, motions[used])
    scale = max(float(target @ target), np.finfo(float).tiny)
    for size in (1, 2):
        fitting: list[tuple[float, tuple[int, ...]]] = []
        for chosen in combinations(range(len(seen.elements)), size):
            part = columns[:, chosen].reshape(len(target), -1)
            _, left, rank = _least(part, target)
            freedom = len(target) - rank
            if rank and freedom >= 0 and left <= (chi2.isf(DOUBT, freedom) if freedom else 1e-9 * scale):
                fitting.append((left, chosen))
        if fitting:
            # None of them is known any better than others: the first along the light is taken.
            sets = sorted(chosen for _, chosen in fitting)
            first, names = sets[0], tuple(tuple(seen.elements[k] for k in one) for one in sets)
            part = columns[:, first].reshape(len(target), -1)
            return _explanation(names, part, [seen.elements[k] for k in first], target, scale)
    return _explanation((), columns.reshape(len(target), -1), list(seen.elements), target, scale)


def _explanation(
    alone: tuple[tuple[str, ...], ...], columns: Array, elements: Sequence[str], target: Array, scale: float
) -> Explanation:
    moved, left, _ = _least(columns, target)
    names = [(element, dof) for element in elements for dof in DOFS]
    largest = np.abs(moved).max(initial=0.0)
    motion = {
        name: float(value) for name, value in zip(names, moved, strict=True) if abs(value) > 1e-6 * largest
    }
    return Explanation(alone, motion, 1.0 - left / scale)


def _least(columns: Array, target: Array) -> tuple[Array, float, int]:
    """Return the least motion of best fit, what it leaves of the target's square, and the rank."""
    left, values, right = np.linalg.svd(columns, full_matrices=False)
    kept = values > _SAME * values.max(initial=0.0)
    parts = left.T @ target
    moved = right[kept].T @ (parts[kept] / values[kept])
    rest = target - columns @ moved
    return moved, float(rest @ rest), int(kept.sum())


def _whitening(line: Line) -> Array:
    """Return W (c, c) with W C W^T = 1, C the covariance of a line's shape."""
    covariance = line.covariance[2:, 2:]
    scale = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    values = np.maximum(values, 1e-9 * values[-1])
    return np.asarray((vectors / np.sqrt(values)).T / scale)


@dataclass(frozen=True)
class FoldedMode:
    """A mode beyond half the sampling frequency that may be what a line is: number (from 1), Hz, the line."""

    number: int
    model_hz: float
    line: Line


def folded_modes(
    lines: Sequence[Line], seen: Seen, nyquist_hz: float, prior: float = np.inf
) -> tuple[FoldedMode, ...]:
    """Return modes that sampling would bring to where a line is, with a shape like its own.

    `prior` is the deviation of the logarithms of the model's frequencies; 0.5 % where it is infinite.
    """
    if seen.plant is None:
        return ()
    natural = seen.plant.omega / (2.0 * np.pi)
    off = prior if np.isfinite(prior) else _OFF
    found = []
    for line in lines:
        weight, (low, high) = _whitening(line), line.interval[0]
        target = weight @ line.rms
        for mode in np.flatnonzero((natural > nyquist_hz) & (natural < _FOLDS * nyquist_hz)).tolist():
            hz = float(natural[mode])
            folded = abs(hz - 2.0 * nyquist_hz * round(hz / (2.0 * nyquist_hz)))
            shape = weight @ seen.at(hz)[1][:, mode]
            size = float(np.linalg.norm(shape) * np.linalg.norm(target))
            near = low - off * hz <= folded <= high + off * hz
            if near and size > 0.0 and (len(target) == 1 or (shape @ target / size) ** 2 > _LIKE):
                found.append(FoldedMode(mode + 1, hz, line))
    return tuple(found)


def measured_modes(
    lines: Sequence[Line], seen: Seen, prior: tuple[float, float] = (np.inf, np.inf)
) -> tuple[MeasuredMode, ...]:
    """Return the modes of the structure that are lines, each line and mode once, the likest first.

    `prior` are the deviations of the logarithms of the model's frequencies and damping ratios. A mode's
    frequency may be off by 15 %; where there are several signals, the shapes must be alike.
    """
    if seen.plant is None:
        return ()
    omega = seen.plant.omega
    damping = 0.5 * np.diag(seen.plant.modal.damping) / omega
    found: list[tuple[float, int, int, float]] = []
    for number, line in enumerate(lines):
        _, modes = seen.at(line.frequency_hz)
        weight = _whitening(line)
        target = weight @ line.rms
        near = np.abs(np.log(omega / (2.0 * np.pi * line.frequency_hz))) < _NEAR
        for mode in np.flatnonzero(near).tolist():
            shape = weight @ modes[:, mode]
            size = float(np.linalg.norm(shape) * np.linalg.norm(target))
            if not line.resolved or size <= 0.0:
                continue
            like = float(shape @ target / size) ** 2 if len(target) > 1 else np.nan
            off = abs(np.log(omega[mode] / (2.0 * np.pi * line.frequency_hz))) / _NEAR
            if len(target) == 1 or like > _LIKE:
                found.append(((0.0 if np.isnan(like) else 1.0 - like) + 0.1 * off, number, mode, like))
    result: list[MeasuredMode] = []
    lines_done: set[int] = set()
    modes_done: set[int] = set()
    for _, number, mode, like in sorted(found, key=lambda one: one[0]):
        if number not in lines_done and mode not in modes_done:
            lines_done.add(number)
            modes_done.add(mode)
            hz = float(omega[mode] / (2.0 * np.pi))
            result.append(MeasuredMode(mode + 1, lines[number], hz, float(damping[mode]), like, prior))
    return tuple(sorted(result, key=lambda one: one.number))
