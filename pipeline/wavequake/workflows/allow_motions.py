"""Independent motions that are allowed: which elements and axes move how during a case.

A motion is static, anew at every instant ("rms"), or has a spectrum. At evenly spaced instants all of these
are sums of the same orthogonal waves with independent Gaussian numbers: a constant, cosines and sines of
whole periods. They differ in the share of their mean square that each wave has, so that the mean square of
what they cause is a sum of quadratic forms, one for every wave.
"""

import fnmatch
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from wavequake.campaign.rare.quadratic import QuadraticForm, quadratic_form
from wavequake.errors import UserError
from wavequake.optics.segments.modal_forms import MotionForm
from wavequake.workflows.asked_sections import RMS, STATIC, AllowedSpectrumSection
from wavequake.workflows.movable import Movable

Array = NDArray[np.float64]
Value = TypeVar("Value")

_EVEN = 1e-6  # share of a step by which instants may be off
_BEYOND = 0.01  # share of the power of a spectrum that may lie beyond what the instants resolve
_NOTHING = 1e-14  # share of the largest curvature that counts as none


@dataclass(frozen=True)
class AllowedMotions:
    """Independent motions of K columns over n instants.

    Attributes
    ----------
    sizes : ndarray, shape (K,)
        Rms over cases and instants.
    waves : ndarray, shape (n, n)
        Row by instant; columns are orthogonal and have the mean square 1.
    powers : ndarray, shape (n, K)
        Share of a column's mean square that each wave has.
    """

    sizes: Array
    waves: Array
    powers: Array

    def grown(self, factor: float) -> "AllowedMotions":
        """Return the motions times a factor."""
        return replace(self, sizes=factor * self.sizes)

    def drawn(self, random: np.random.Generator) -> Array:
        """Draw the motion (n, K) of a case."""
        acting = self.sizes > 0.0
        motion = np.zeros(self.powers.shape)
        scale = np.sqrt(self.powers[:, acting]) * self.sizes[acting]
        motion[:, acting] = self.waves @ (scale * random.standard_normal(scale.shape))
        return motion

    def form(self, form: MotionForm) -> QuadraticForm:
        """Return the mean over the instants of a form of the motions, without its directions.

        A wave that is not constant has no mean, so that what is linear in the motion sees the first one only.
        """
        scale = np.sqrt(self.powers) * self.sizes
        first = scale[0] > 0.0
        found = quadratic_form(
            form.constant,
            scale[0, first] * form.linear[first],
            np.outer(scale[0, first], scale[0, first]) * form.square[np.ix_(first, first)],
        )
        curvatures, known = [found.curvatures], dict[bytes, Any]()
        for row in scale[1:]:
            size, acting = float(row.max(initial=0.0)), row > 0.0
            if size == 0.0:
                continue
            shape = np.round(row[acting] / size, 14)  # alike but for rounding: a cosine and its sine
            key = shape.tobytes() + acting.tobytes()
            if key not in known:
                known[key] = np.linalg.eigvalsh(np.outer(shape, shape) * form.square[np.ix_(acting, acting)])
            curvatures.append(size**2 * known[key])
        bent = np.concatenate(curvatures)
        slopes = np.concatenate([found.slopes, np.zeros(len(bent) - len(found.slopes))])
        kept = (np.abs(bent) > _NOTHING * np.abs(bent).max(initial=0.0)) | (slopes != 0.0)
        return QuadraticForm(form.constant, slopes[kept], bent[kept], np.zeros((0, int(kept.sum()))))


def allowed_motions(
    movable: Movable, sizes: Array, kinds: Sequence[str], spectra: Mapping[str, AllowedSpectrumSection]
) -> AllowedMotions:
    """Return motions of the rms `sizes` (K,), of the `kinds` (k,) of the first columns; all others rest.

    Raises
    ------
    UserError
        If the instants are too few or too uneven for a kind, or do not resolve a spectrum.
    """
    acting = [kind for kind, size in zip(kinds, sizes, strict=False) if size > 0.0]
    used = sorted(set(acting) - {STATIC})
    if not used:
        return AllowedMotions(sizes, np.ones((1, 1)), np.ones((1, len(sizes))))
    time = movable.time
    if len(time) < 2 or np.ptp(np.diff(time)) > _EVEN * np.diff(time).mean():
        words = "one instant" if len(time) < 2 else "instants of uneven spacing"
        raise UserError(
            f"allow.kind: {used[0]!r} is a motion during a case, but a case of {movable.name!r} has {words}; "
            "give the disturbance instants and duration_s."
        )
    step = float(np.diff(time).mean())
    waves, frequencies = _waves(len(time), step)
    shares = {STATIC: np.eye(len(time))[0], RMS: np.full(len(time), 1.0 / len(time))}
    shares |= {name: _shares(name, spectra[name], frequencies, step) for name in used if name != RMS}
    powers = np.zeros((len(time), len(sizes)))
    powers[0] = 1.0
    for column, kind in enumerate(kinds):
        powers[:, column] = shares[kind]
    return AllowedMotions(sizes, waves, powers)


def _waves(count: int, step: float) -> tuple[Array, Array]:
    """Return waves (n, n), a column each, and their frequencies (n,) in Hz."""
    periods = (np.arange(count) + 1) // 2
    phase = 2.0 * np.pi * np.outer(np.arange(count), periods) / count
    waves = np.sqrt(2.0) * np.where(np.arange(count) % 2, np.cos(phase), np.sin(phase))
    waves[:, 0] = 1.0
    if count % 2 == 0:
        waves[:, -1] /= np.sqrt(2.0)  # up and down in turn
    return waves, periods / (count * step)


def power_of(section: AllowedSpectrumSection) -> float:
    """Return the integral of a spectrum over its frequencies."""
    return float(np.trapezoid(section.psd, section.frequency_hz))


def _shares(name: str, section: AllowedSpectrumSection, frequencies: Array, step: float) -> Array:
    """Return the share of a spectrum's power that each wave has: what is nearest to its frequency.

    What is slower than half a period per case is constant.
    """
    knots, total = np.array(section.frequency_hz), power_of(section)
    spacing, nyquist = frequencies[1], 0.5 / step
    tops = np.minimum(np.unique(frequencies) + 0.5 * spacing, nyquist * (1.0 + 1e-12))
    grid = np.unique(np.concatenate([knots, tops[(tops > knots[0]) & (tops < knots[-1])]]))
    psd = np.interp(grid, knots, section.psd)
    below = np.concatenate([[0.0], np.cumsum(0.5 * (psd[1:] + psd[:-1]) * np.diff(grid))])
    found = np.diff(np.interp(tops, grid, below), prepend=0.0) / total
    missing = 1.0 - found.sum()
    if missing > _BEYOND:
        raise UserError(
            f"allow.spectrum.{name}: {missing:.0%} of its power lies beyond {nyquist:g} Hz, which the "
            f"instants of the disturbance do not resolve ({step:g} s apart): give it more instants, a "
            "shorter duration_s, or cut the spectrum."
        )
    places = np.rint(frequencies / spacing).astype(np.int64)
    return np.asarray((found / found.sum() / np.bincount(places))[places])


def of_columns(table: Mapping[str, Value], movable: Movable, default: Value, where: str) -> list[Value]:
    """Return what a table of elements, axes, or both says of each of the first columns.

    What names an axis rules over what does not, and names over patterns with ``*`` or ``?``.

    Raises
    ------
    UserError
        If a key names nothing that moves, or two keys of one rank say different things of a column.
    """
    names = [movable.column_name(column) for column in range(len(movable.place))]
    asked = {key: _split(key, movable.axes) for key in table}
    found: list[Value] = []
    reached = set[str]()
    for element, axis in names:
        ranked: dict[tuple[bool, bool], list[str]] = {}
        for key, (pattern, of) in asked.items():
            if of not in (None, axis) or not (pattern == element or fnmatch.fnmatchcase(element, pattern)):
                continue
            ranked.setdefault((of is not None, pattern == element), []).append(key)
            reached.add(key)
        best = ranked[max(ranked)] if ranked else []
        if any(table[key] != table[best[0]] for key in best):
            raise UserError(
                f"{where}: {' and '.join(map(repr, best))} both name {element} {axis} and say different "
                "things of it; name it alone, or leave one out."
            )
        found.append(table[best[0]] if best else default)
    if lost := next((key for key in table if key not in reached), None):
        raise UserError(
            f"{where}: the disturbance {movable.name!r} does not move {lost!r}; it moves "
            f"{_some(movable.elements)} along {', '.join(movable.axes)}: write an element, an axis, or an "
            "element and an axis."
        )
    return found


def _some(names: Sequence[str]) -> str:
    return ", ".join(names) if len(names) <= 12 else f"{', '.join(names[:6])} ... {names[-1]}"


def _split(key: str, axes: Sequence[str]) -> tuple[str, str | None]:
    """Return the element's pattern and the axis of a key."""
    if key in axes:
        return "*", key
    for axis in axes:
        if key.endswith(f" {axis}"):
            return key.removesuffix(f" {axis}"), axis
    return key, None
