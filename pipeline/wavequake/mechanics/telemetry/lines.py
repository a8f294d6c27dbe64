"""Vibration lines in records: where spectra rise above their surroundings, and which lines explain it."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d
from scipy.stats import chi2

from wavequake.mechanics.telemetry.line import NORMAL, RESOLVED, Line
from wavequake.mechanics.telemetry.profile import profile_ends, shape_ends
from wavequake.mechanics.telemetry.sinusoids import sinusoid, take_sinusoids
from wavequake.mechanics.telemetry.spectra import Fourier, fourier
from wavequake.mechanics.telemetry.subspace import Subspace, across, subspace
from wavequake.mechanics.telemetry.whittle import (
    Fit,
    Held,
    Window,
    fit_lines,
    noise_factor,
    oscillator,
    recolored,
    whitened_power,
)

Array = NDArray[np.float64]

MOST_LINES = 60
_WIDE = 0.1  # of the frequency: what is wider is background
_RISE = 1.4
_DOUBT = 7.0  # logarithm of one over the probability of a false line, all places together
_MOST_ADDED = 4
_SPLIT = 3.0  # of the likelihood's logarithm: two lines in the place of one are no regular alternative
_RECOLORED = 6  # times at most: lines and what their flanks hide are found in turns
_COLORED = 0.05  # of the likelihood's logarithm: done
_ROUNDS = 2
_VAGUE = 1.5  # of a damping ratio's logarithm
_ROUNDING = 1e-11  # of a signal's rms
_BESIDE, _CHANCE = 4.5, 1e-4  # coefficients about a sinusoid, and how often noise alone is taken for more
_EACH = 4  # signals of which each has a profile of its own
_BROAD = 0.25  # damping ratio beyond which a rise is background


def _rises(ratio: Array, spectrum: Fourier) -> Iterator[tuple[float, int, int]]:
    """Yield by how much a line would explain a rise of the ratio (F, c) over 1, its place and its width."""
    count, channels = ratio.shape
    total = np.vstack([np.zeros(channels), np.cumsum(ratio, axis=0)])
    scale, found = 1, []
    while scale == 1 or scale < _WIDE * spectrum.frequency[-1] * spectrum.duration:
        first = (
            0 if scale == 1 else int(np.searchsorted(spectrum.frequency, scale / (_WIDE * spectrum.duration)))
        )
        step = max(1, scale // 4)
        first = max(first, scale // 2)  # beyond the ends there is nothing to average
        starts = np.arange(first, count - scale // 2, step) - scale // 2
        mean = (total[starts + scale] - total[starts]) / scale if scale > 1 else ratio
        gain, high = np.zeros_like(mean), mean >= _RISE
        gain[high] = scale / spectrum.loss * (mean[high] - 1.0 - np.log(mean[high]))
        best = gain.max(axis=1)
        least = np.log(count * channels) + _DOUBT
        found += [(float(best[k]), first + int(k) * step, scale) for k in np.flatnonzero(best > least)]
        scale *= 2
    taken = np.zeros(count, dtype=bool)
    for gain_, place, width in sorted(found, reverse=True):
        if not taken[place]:
            yield gain_, place, width
            reach = round(1.5 * width) + 3
            taken[max(0, place - reach) : place + reach + 1] = True


@dataclass(frozen=True)
class _Candidate:
    frequency: float
    width: float  # Hz
    gain: float = 0.0  # of the likelihood's logarithm


def find_lines(values: Array, step: float, most: int = MOST_LINES) -> tuple[tuple[Line, ...], Fourier]:
    """Return the lines of a record, by increasing frequency, and its coefficients without sinusoids.

    Sinusoids are found first and taken out. Other candidates are where densities rise over `background`;
    those of one neighborhood are fitted together, and lines are added while the likelihood rises by more than
    chance gives.

    Parameters
    ----------
    values : ndarray, shape (n, c)
    step : float
        s.
    most : int
        Candidates, at most.
    """
    sinusoids, rest, spectrum, floor = take_sinusoids(values, step)
    # Rounding errors of a record without noise are no lines.
    found = [line for line in sinusoids if (np.abs(line.rms) > _ROUNDING * values.std(axis=0)).any()]
    floor = np.maximum(floor, _ROUNDING**2 * 2.0 * step * values.var(axis=0))
    candidates: list[_Candidate] = []
    for gain, place, width in _rises(np.abs(spectrum.values) ** 2 / floor, spectrum):
        candidates.append(
            _Candidate(float(spectrum.frequency[place]), max(width, 2) / spectrum.duration, gain)
        )
        if len(candidates) >= most:
            break
    groups = _groups(candidates, spectrum)
    by_group: dict[int, list[Line]] = {}
    for _ in range(_ROUNDS if len(groups) > 1 else 1):  # flanks of the others are known in the second only
        for number in sorted(range(len(groups)), key=lambda k: -max(one.gain for one in groups[k])):
            others = [line for other, lines in by_group.items() if other != number for line in lines]
            by_group[number] = _lines_of(groups[number], spectrum, floor, others)
    narrow: list[Line] = []
    for line in (line for lines in by_group.values() for line in lines):
        (found if line.fwhm_hz * spectrum.duration >= RESOLVED else narrow).append(line)
    for line in narrow:
        place = min(int(np.searchsorted(spectrum.frequency, line.frequency_hz)), len(floor) - 1)
        one, series = sinusoid(rest, step, line.frequency_hz, floor[place])
        without = fourier(rest - series, step)
        if _is_left(without, line.frequency_hz, floor[place]):
            found.append(line)  # narrow by chance: a sinusoid is not all that there is
            continue
        rest, spectrum = rest - series, without
        found.append(one)
    return tuple(sorted(found, key=lambda line: line.frequency_hz)), spectrum


def _is_left(spectrum: Fourier, frequency: float, floor: Array) -> bool:
    """Return whether there is more about a frequency than noise of the density `floor` (c,)."""
    near = np.abs(spectrum.frequency - frequency) <= _BESIDE / spectrum.duration
    left = float(np.sum(np.abs(spectrum.values[near]) ** 2 / floor))
    return left > 0.5 * float(chi2.isf(_CHANCE, 2 * int(near.sum()) * len(floor)))


def _reach(one: _Candidate, spectrum: Fourier) -> float:
    """Return how far from a line its neighborhood goes, Hz."""
    return float(
        min(max(0.05 * one.frequency, 4.0 * one.width, 24.0 / spectrum.duration), 0.4 * one.frequency)
    )


def _groups(candidates: Sequence[_Candidate], spectrum: Fourier) -> list[list[_Candidate]]:
    groups: list[list[_Candidate]] = []
    end = -np.inf
    for one in sorted(candidates, key=lambda one: one.frequency):
        last = groups[-1][-1].frequency if groups else -np.inf
        if one.frequency < end or one.frequency - _reach(one, spectrum) < last:
            groups[-1].append(one)
        else:
            groups.append([one])
        end = max(end, one.frequency + _reach(one, spectrum))
    return groups


def _lines_of(
    group: Sequence[_Candidate], spectrum: Fourier, floor: Array, others: Sequence[Line]
) -> list[Line]:
    """Return the lines of one neighborhood, into which others may reach."""
    low = min(one.frequency - _reach(one, spectrum) for one in group)
    high = max(one.frequency + _reach(one, spectrum) for one in group)
    inside = (spectrum.frequency >= low) & (spectrum.frequency <= high)
    near = spectrum.frequency[inside], spectrum.values[inside]
    whitening = _coloring(near, group, floor[inside])
    channels = len(whitening)
    seen = subspace(
        np.asarray(np.linalg.solve(whitening, near[1].T).T, dtype=np.complex128),
        [np.abs(near[0] - one.frequency) <= max(0.5 * one.width, 1.0 / spectrum.duration) for one in group],
    )
    near, color = (near[0], seen.along), np.eye(seen.basis.shape[1])
    others = [replace(line, rms=seen.basis.T @ np.linalg.solve(whitening, line.rms)) for line in others]
    chosen = _Chosen(
        spectrum.duration,
        0.4 / (spectrum.duration * high),
        _SPLIT + 0.5 * spectrum.loss * float(chi2.isf(np.exp(-_DOUBT) / inside.sum(), 2 + channels)),
        spectrum.loss,
    )
    finest = min(one.width for one in group) / 2.0
    window = _window(near, color, finest, spectrum, others)
    fit = Fit(np.zeros((0, 2)), np.zeros((0, len(color))), np.zeros((2, len(color))))
    fit = fit_lines(window, fit, chosen.least, steps=8, loss=chosen.taper)
    for one in sorted(group, key=lambda one: -one.gain):
        fit = _with_line(window, fit, one, chosen)
    for _ in range(_MOST_ADDED):
        if not fit.count:
            break
        whole = np.inf
        for _ in range(_RECOLORED):
            factor = noise_factor(window, fit)
            color, fit = color @ factor, recolored(fit, factor)
            finest = float(np.exp(fit.logs.sum(axis=1)).min()) * 2.0
            window = _window(near, color, finest, spectrum, others)
            fit = fit_lines(window, fit, chosen.least, loss=chosen.taper)
            reached = fit.loss + 2.0 * window.weight.sum() * np.linalg.slogdet(color)[1]
            if abs(whole - reached) < _COLORED:
                break
            whole = reached
        before = fit.count
        for one in _overlooked(window, fit, spectrum.duration):
            fit = _with_line(window, fit, one, chosen)
            if fit.count > before:
                break
        if fit.count == before:
            break
    return list(_made(window, fit, seen, near[0], whitening, color, spectrum.loss)) if fit.count else []


@dataclass(frozen=True)
class _Chosen:
    """Length of the record, least damping ratio, least gain of a line, and what a taper loses."""

    duration: float
    least: float
    gain: float
    taper: float


def _coloring(near: tuple[Array, NDArray[np.complex128]], group: Sequence[_Candidate], floor: Array) -> Array:
    """Return the factor (c, c) that makes unit noise the background beside the lines."""
    frequency, values = near
    apart = np.min([np.abs(frequency - one.frequency) / one.width for one in group], axis=0)
    beside = apart > min(4.0, 0.5 * float(apart.max()))
    channels = values.shape[1]
    scale = np.sqrt(np.exp(np.log(floor).mean(axis=0)))
    if int(beside.sum()) < 6 * channels:
        return np.diag(scale)
    scaled = values[beside] / scale
    # A strong line's flanks are no noise: what is far above the rest is left out.
    size = np.sum(np.abs(scaled) ** 2, axis=1)
    scaled = scaled[size <= 4.0 * np.median(size)]
    covariance = (scaled.T @ scaled.conj()).real / len(scaled)
    covariance += 1e-9 * np.trace(covariance) / channels * np.eye(channels)
    return np.asarray(scale[:, None] * np.linalg.cholesky(covariance))


def _window(
    near: tuple[Array, NDArray[np.complex128]],
    color: Array,
    finest: float,
    spectrum: Fourier,
    others: Sequence[Line],
) -> Window:
    frequency, values = near
    white = np.linalg.solve(color, values.T).T
    size = max(1, int(finest * spectrum.duration / 12.0))
    starts = np.arange(0, len(frequency), size)
    weight = np.diff(np.append(starts, len(frequency))).astype(float)
    padded = np.zeros((len(starts) * size, white.shape[1]), dtype=white.dtype)
    padded[: len(white)] = white
    pieces = padded.reshape(len(starts), size, -1)
    power = (pieces.transpose(0, 2, 1) @ pieces.conj()).real / weight[:, None, None]
    middle = np.add.reduceat(frequency, starts) / weight
    known = np.zeros_like(power)
    for line in others:
        shape = np.linalg.solve(color, line.rms)
        known += np.multiply.outer(
            oscillator(middle, line.frequency_hz, line.damping, spectrum.step), np.outer(shape, shape)
        )
    return Window(middle, power, weight, spectrum.step, known)


def _with_line(window: Window, fit: Fit, one: _Candidate, chosen: _Chosen) -> Fit:
    """Return a fit with one line more where that is worth it."""
    spacing = float(np.diff(window.frequency).max())
    about = np.abs(window.frequency - one.frequency) <= max(0.5 * one.width, spacing)
    if not about.any():
        return fit
    weight = window.weight[about]
    rise = np.average(whitened_power(window, fit)[about], axis=0, weights=weight)
    if _gain(rise, weight.sum()) < _least_rise(window):
        return fit
    share = np.average(window.power[about], axis=0, weights=weight)
    level = np.exp(fit.noise[0])
    values, vectors = np.linalg.eigh(share / np.sqrt(np.outer(level, level)))
    strength = max(float(values[-1]) - 1.0, 0.5) * one.width * np.pi / 2.0
    shape = vectors[:, -1] * np.sqrt(level * strength)
    for wide in (1.0, 0.3):
        logs = np.log([one.frequency, max(wide * one.width / (2.0 * one.frequency), 1.01 * chosen.least)])
        start = Fit(np.vstack([fit.logs, logs]), np.vstack([fit.shapes, shape * np.sqrt(wide)]), fit.noise)
        tried = fit_lines(window, start, chosen.least, steps=8, loss=chosen.taper)
        if tried.loss > fit.loss - 0.3 * chosen.gain:
            continue
        tried = fit_lines(window, tried, chosen.least, loss=chosen.taper)
        if tried.loss < fit.loss - chosen.gain and _is_sound(window, tried, chosen.duration):
            return tried
    return fit


def _gain(power: Array, weight: Array | float) -> Array:
    """Return how much of the likelihood's logarithm a rise of whitened powers (..., c, c) is worth."""
    size = np.maximum(np.linalg.eigvalsh(power), 1.0)
    return np.asarray(weight * np.sum(size - 1.0 - np.log(size), axis=-1))


def _least_rise(window: Window) -> float:
    """Return what chance explains of a rise anywhere in a window, of any width, hardly ever."""
    return float(np.log(4.0 * len(window.frequency) * window.power.shape[1])) + 1.0


def _is_sound(window: Window, fit: Fit, duration: float) -> bool:
    """Return whether all lines lie in the window, are lines and not background, and can be told apart."""
    frequency, damping = np.exp(fit.logs.T)
    inside = (frequency > window.frequency[0]) & (frequency < window.frequency[-1])
    error = np.sqrt(np.diag(fit.covariance)[1 : 2 * fit.count : 2])
    told = (error < _VAGUE) | (2.0 * damping * frequency * duration < RESOLVED)
    return bool((inside & (damping < _BROAD) & told).all())


def _overlooked(window: Window, fit: Fit, duration: float) -> Iterator[_Candidate]:
    """Yield where a fit leaves a rise, then halves of its lines."""
    white = whitened_power(window, fit) * window.weight[:, None, None]
    best: tuple[float, int, int] = (0.0, 0, 1)
    spacing = float(np.median(np.diff(window.frequency)))
    for scale in (1, 3, 9, 27):
        if scale > len(white) // 4:
            break
        weight = uniform_filter1d(window.weight, scale)
        gain = _gain(uniform_filter1d(white, scale, axis=0) / weight[:, None, None], scale * weight)
        if gain.max() > best[0]:
            best = float(gain.max()), int(gain.argmax()), scale
    if best[0] < _least_rise(window):
        return
    yield _Candidate(float(window.frequency[best[1]]), max(best[2] * spacing, 2.0 / duration))
    for natural, damping in np.exp(fit.logs):
        width = 2.0 * damping * natural
        if width * duration > 2.0 * RESOLVED:
            yield _Candidate(float(natural + 0.5 * width), float(0.5 * width))
            yield _Candidate(float(natural - 0.5 * width), float(0.5 * width))


def _made(
    window: Window, fit: Fit, seen: Subspace, frequency: Array, whitening: Array, color: Array, taper: float
) -> Iterator[Line]:
    """Yield lines in the units of the signals, with the intervals of their profiles."""
    turned, rest = whitening @ seen.basis @ color, whitening @ seen.rest
    beside, errors = across(seen, frequency, window.step, fit, color, taper)
    size, count = np.sqrt(np.sum(whitening**2, axis=1)), fit.shapes.shape[1]
    for j in range(fit.count):
        rms = turned @ fit.shapes[j] + rest @ beside[j]
        sign = 1.0 if rms[np.argmax(np.abs(rms / size))] >= 0.0 else -1.0
        own = np.concatenate([2 * j + np.arange(2), 2 * fit.count + count * j + np.arange(count)])
        turn = np.zeros((2 + len(rms), 2 + count))
        turn[:2, :2], turn[2:, 2:] = np.eye(2), sign * turned
        covariance = turn @ fit.covariance[np.ix_(own, own)] @ turn.T
        covariance[2:, 2:] += rest @ errors[j] @ rest.T
        deviation = float(np.sqrt(covariance[0, 0]))
        ends = np.vstack(
            [
                fit.logs[j, 0] + NORMAL * deviation * np.array([-1.0, 1.0]),
                fit.logs[j, 1] + profile_ends(window, fit, Held(j), taper),
                _rms_ends(window, fit, j, sign * turned, sign * rms, covariance[2:, 2:], taper),
            ]
        )
        natural, damping = np.exp(fit.logs[j])
        yield Line(float(natural), float(damping), sign * rms, covariance, True, ends)


def _rms_ends(
    window: Window, fit: Fit, j: int, turned: Array, rms: Array, covariance: Array, taper: float
) -> Array:
    """Return the ends (c, 2) of a line's rms, `turned` (c, k) times its shape and what is across: `rms`.

    Of few signals each has its own profile; of many, what they have in common.
    """
    channels, count = turned.shape
    if channels <= _EACH:
        each = [profile_ends(window, fit, Held(j, row), taper) for row in turned]
        return np.asarray(rms[:, None] + np.array(each))
    along = fit.shapes[j] / np.linalg.norm(fit.shapes[j])
    first = 2 * fit.count + count * j
    errors = fit.covariance[first : first + count, first : first + count]
    ends = profile_ends(window, fit, Held(j, along), taper)
    return shape_ends(rms, covariance, turned @ errors @ along, float(along @ errors @ along), ends)
