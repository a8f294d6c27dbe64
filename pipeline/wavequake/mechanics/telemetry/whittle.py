"""Vibration lines by maximum likelihood from the Fourier coefficients of several signals (Whittle 1953).

Near a line the signals y are a few oscillators q_j that white noise drives, each seen with a direction a_j of
its own, and a background: S(f) = sum_j a_j a_j^T L(f; f_j, D_j) + N(f). Coefficients of different frequencies
are independent, so that the likelihood is that of complex Gaussian vectors, and its Fisher information gives
the covariance of all that is found (Brillinger 1981, section 9.5).
"""

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_DONE = 1e-4  # of the logarithm of the likelihood: 0.01 standard deviations
_ENOUGH = 0.01  # of that where only a limit of confidence is looked for, which is 1.92 below
_SMALL = 1e-3  # half width of differences in logarithms


def oscillator(frequency: Array, natural_hz: float, damping: float, step: float) -> Array:
    """Return the one-sided PSD (F,) of a sampled oscillator of unit variance under white noise, 1/Hz.

    From its autocorrelation exp(-D w t) (cos(w' t) + D / sqrt(1 - D^2) sin(w' t)), w' = w sqrt(1 - D^2),
    summed over all lags: what is beyond half the sampling frequency is folded back, as in the data.

    Parameters
    ----------
    frequency : ndarray, shape (F,)
        Hz.
    natural_hz, damping : float
        Undamped natural frequency and damping ratio below 1.
    step : float
        s.
    """
    omega, root = 2.0 * np.pi * natural_hz, np.sqrt(1.0 - damping**2)
    pole = np.exp(step * omega * (-damping + 1j * root))
    turn = np.exp(-2j * np.pi * step * frequency)
    weight = 1.0 - 1j * damping / root
    lags = weight / (1.0 - pole * turn) + np.conj(weight) / (1.0 - np.conj(pole) * turn)
    return np.asarray(2.0 * step * (lags.real - 1.0))


@dataclass(frozen=True)
class Window:
    """What is fitted: averages of coefficients in a range of frequencies, for signals of unit noise.

    Attributes
    ----------
    frequency : ndarray, shape (B,)
        Hz.
    power : ndarray, shape (B, c, c)
        Real part of the mean of outer products of coefficients.
    weight : ndarray, shape (B,)
        How many coefficients a mean has.
    step : float
        s, of the record.
    known : ndarray, shape (B, c, c)
        Density of what is known already: lines elsewhere, whose flanks reach into the window.
    """

    frequency: Array
    power: Array
    weight: Array
    step: float
    known: Array

    @property
    def place(self) -> Array:
        """Logarithm of the frequency about the window's middle, scaled to -1 ... 1."""
        logarithm = np.log(self.frequency)
        middle = 0.5 * (logarithm[0] + logarithm[-1])
        return np.asarray((logarithm - middle) / max(logarithm[-1] - middle, 1e-12))


@dataclass(frozen=True)
class Fit:
    """Lines and background of a window.

    Attributes
    ----------
    logs : ndarray, shape (J, 2)
        Logarithms of frequency in Hz and damping ratio.
    shapes : ndarray, shape (J, c)
        Rms of each line in each signal, with signs.
    noise : ndarray, shape (2, c)
        Logarithm of the background's density in the middle and its slope over `Window.place`.
    loss : float
        Negative logarithm of the likelihood, up to a constant.
    covariance : ndarray, shape (P, P)
        Of logs, shapes and noise, raveled one after the other.
    """

    logs: Array
    shapes: Array
    noise: Array
    loss: float = np.inf
    covariance: Array = field(default_factory=lambda: np.zeros((0, 0)))

    @property
    def count(self) -> int:
        """Number of lines J."""
        return len(self.logs)


@dataclass(frozen=True)
class Held:
    """What of a line a fit leaves as it is.

    The logarithm of its damping ratio, or else its shape along a direction (c,).
    """

    line: int
    direction: Array | None = None

    def slope(self, fit: Fit) -> Array:
        """Return the slope (P,) of what is held."""
        slope = np.zeros(fit.logs.size + fit.shapes.size + fit.noise.size)
        if self.direction is None:
            slope[2 * self.line + 1] = 1.0
            return slope
        first = fit.logs.size + self.line * len(self.direction)
        slope[first : first + len(self.direction)] = self.direction
        return slope


@dataclass(frozen=True)
class _Modelled:
    """A fit's densities: of lines (B, J), their slopes (B, J, 2), of the background (B, c), and all."""

    lines: Array
    slopes: Array
    noise: Array
    total: Array

    @cached_property
    def determinant(self) -> tuple[Array, Array]:
        """Signs and logarithms (B,) of the determinants of all."""
        if self.total.shape[1] != 2:
            return np.linalg.slogdet(self.total)
        total = self.total  # by hand, in a tenth of the time of LAPACK
        determinant = total[:, 0, 0] * total[:, 1, 1] - total[:, 0, 1] * total[:, 1, 0]
        with np.errstate(divide="ignore"):
            return np.sign(determinant), np.log(np.abs(determinant))

    @cached_property
    def inverse(self) -> Array:
        """Inverse (B, c, c) of all, which loss and slopes share."""
        total = self.total
        if total.shape[1] != 2:
            return np.asarray(np.linalg.inv(total))
        adjugate = np.empty_like(total)
        adjugate[:, 0, 0], adjugate[:, 1, 1] = total[:, 1, 1], total[:, 0, 0]
        adjugate[:, 0, 1], adjugate[:, 1, 0] = -total[:, 0, 1], -total[:, 1, 0]
        sign, logarithm = self.determinant
        return np.asarray(adjugate * (sign * np.exp(-logarithm))[:, None, None])


def _modelled(window: Window, fit: Fit, slopes: bool = True) -> _Modelled:
    lines = (
        np.stack([_line(window, one) for one in fit.logs], axis=1)
        if fit.count
        else np.zeros((len(window.frequency), 0))
    )
    change = np.zeros((*lines.shape, 2))
    if slopes:
        for j, one in enumerate(fit.logs):
            for k, half in enumerate((_SMALL * np.exp(one[1]), _SMALL)):  # frequencies by parts of the width
                away = half * np.eye(2)[k]
                change[:, j, k] = (_line(window, one + away) - _line(window, one - away)) / (2.0 * half)
    noise = np.exp(fit.noise[0] + window.place[:, None] * fit.noise[1])
    total = (lines[:, None] * fit.shapes.T) @ fit.shapes
    total[:, np.arange(noise.shape[1]), np.arange(noise.shape[1])] += noise
    total += window.known
    return _Modelled(lines, change, noise, total)


def _line(window: Window, logs: Array) -> Array:
    natural, damping = np.exp(logs)
    return oscillator(window.frequency, float(natural), float(min(damping, 0.95)), window.step)


def _loss(window: Window, modelled: _Modelled) -> float:
    sign, logarithm = modelled.determinant
    if not (sign > 0.0).all():
        return np.inf
    trace = np.einsum("bij,bji->b", modelled.inverse, window.power)
    return float(window.weight @ (logarithm + trace))


def fit_lines(
    window: Window,
    start: Fit,
    least: float,
    most: float = 0.5,
    steps: int = 60,
    loss: float = 1.0,
    held: Held | None = None,
) -> Fit:
    """Return the fit of highest likelihood near a start, by Fisher's scoring.

    Parameters
    ----------
    window : Window
    start : Fit
    least, most : float
        Damping ratios between which it is looked for.
    steps : int
        At most.
    loss : float
        By which the taper increases variances.
    held : Held, optional
        What stays as it is in the start; then the covariance is left out.
    """
    bounds = np.log([least, most])
    now, modelled = start, _modelled(window, start)
    value, lift = _loss(window, modelled), 1e-3
    for _ in range(steps):
        slope, information = _scores(window, now, modelled)
        scale = np.sqrt(np.diag(information))
        scale[scale == 0.0] = 1.0
        matrix = information / np.outer(scale, scale)
        improved = False
        while lift < 1e8:
            lifted = matrix + lift * np.eye(len(matrix))
            move = -np.linalg.solve(lifted, slope / scale)
            if held:
                fixed = held.slope(now) / scale
                along = np.linalg.solve(lifted, fixed)
                move -= along * (fixed @ move) / (fixed @ along)
            trial = _moved(now, move / scale, bounds)
            ahead = _modelled(window, trial, slopes=False)
            better = _loss(window, ahead)
            if better <= value:
                improved = True
                break
            lift *= 8.0
        if not improved:
            break
        gain, value, now = value - better, better, trial
        modelled, lift = _modelled(window, now), max(lift / 8.0, 1e-9)
        if gain < (_ENOUGH if held else _DONE):
            break
    if held:
        return replace(now, loss=value)
    _, information = _scores(window, now, modelled)
    scale = np.sqrt(np.diag(information))
    scale[scale == 0.0] = 1.0
    inverse = np.linalg.pinv(information / np.outer(scale, scale), hermitian=True)
    return replace(now, loss=value, covariance=loss * inverse / np.outer(scale, scale))


def _moved(fit: Fit, move: Array, bounds: Array) -> Fit:
    lines, shapes = fit.logs.size, fit.shapes.size
    logs = fit.logs + np.clip(move[:lines].reshape(-1, 2), [-0.02, -1.0], [0.02, 1.0])
    logs[:, 1] = np.clip(logs[:, 1], *bounds)
    noise = fit.noise + np.clip(move[lines + shapes :].reshape(2, -1), -2.0, 2.0)
    return Fit(logs, fit.shapes + move[lines : lines + shapes].reshape(fit.shapes.shape), noise)


def _scores(window: Window, fit: Fit, modelled: _Modelled) -> tuple[Array, Array]:
    """Return the gradient (P,) of the loss and the Fisher information (P, P).

    With E = S^-1 - S^-1 P S^-1 the gradient along dS is w tr(dS E), the information w tr(S^-1 dS S^-1 dS').
    """
    weight, lines, slopes, noise = window.weight, modelled.lines, modelled.slopes, modelled.noise
    count, channels = fit.shapes.shape
    inverse = modelled.inverse
    excess = inverse - inverse @ window.power @ inverse
    seen = inverse @ fit.shapes.T
    between = fit.shapes @ seen
    bent = excess @ fit.shapes.T
    powers = np.stack([np.ones_like(weight), window.place])
    diagonal = np.einsum("bii->bi", excess)
    weighted, wslopes = lines * weight[:, None], slopes * weight[:, None, None]
    wnoise = noise[None] * powers[..., None]
    slope = np.concatenate(
        [
            np.einsum("bjk,bj->jk", wslopes, np.einsum("jc,bcj->bj", fit.shapes, bent)).ravel(),
            2.0 * np.einsum("bj,bcj->jc", weighted, bent).ravel(),
            np.einsum("pb,bi->pi", powers * weight, noise * diagonal).ravel(),
        ]
    )
    # Sums over frequencies as products of matrices: of many signals they are nearly all of the work.
    flat = inverse.reshape(len(weight), -1)
    by_line = np.einsum("bjs,blt,bjl->jslt", wslopes, slopes, between**2)
    line_shape = np.empty((count, 2, count, channels))
    by_shape = np.empty((count, channels, count, channels))
    shape_noise = np.empty((count, channels, 2, channels))
    for j in range(count):
        for k in range(count):
            of_both = lines[:, k] * between[:, j, k]
            line_shape[j, :, k] = 2.0 * (wslopes[:, j] * of_both[:, None]).T @ seen[..., j]
            both = ((weighted[:, j] * of_both) @ flat).reshape(channels, channels)
            cross = (seen[..., k] * (weighted[:, j] * lines[:, k])[:, None]).T @ seen[..., j]
            by_shape[j, :, k] = 2.0 * (both + cross)
        own = ((noise * seen[..., j])[..., None] * inverse).reshape(len(weight), -1)
        of_noise = ((powers * weighted[:, j]) @ own).reshape(2, channels, channels)
        shape_noise[j] = 2.0 * of_noise.transpose(2, 0, 1)
    line_noise = np.einsum("bjs,pbi,bij->jspi", wslopes, wnoise, seen**2)
    squares = (noise[:, :, None] * noise[:, None] * inverse**2).reshape(len(weight), -1)
    pairs = (powers[:, None] * powers * weight).reshape(4, -1) @ squares
    by_noise = pairs.reshape(2, 2, channels, channels).transpose(0, 2, 1, 3)
    a, b, c = 2 * count, count * channels, 2 * channels
    top = np.hstack([by_line.reshape(a, a), line_shape.reshape(a, b), line_noise.reshape(a, c)])
    middle = np.hstack([line_shape.reshape(a, b).T, by_shape.reshape(b, b), shape_noise.reshape(b, c)])
    last = np.hstack([line_noise.reshape(a, c).T, shape_noise.reshape(b, c).T, by_noise.reshape(c, c)])
    information = np.vstack([top, middle, last])
    return slope, 0.5 * (information + information.T)


def whitened_power(window: Window, fit: Fit) -> Array:
    """Return the powers (B, c, c) of signals that are independent and of mean square 1 if a fit is right."""
    factor = np.linalg.cholesky(_modelled(window, fit, slopes=False).total)
    half = np.linalg.solve(factor, window.power)
    return np.asarray(np.linalg.solve(factor, half.transpose(0, 2, 1)))


def noise_factor(window: Window, fit: Fit, steps: int = 20) -> Array:
    """Return a factor (c, c) of the background's covariance, on average over the window, lines held fixed.

    The background of a fit is independent from signal to signal; this is what is left in common, by Fisher's
    scoring: expectation and maximization stand still where a line's flanks drown the background.
    """
    modelled = _modelled(window, fit, slopes=False)
    weight, noise = window.weight, np.diag(np.average(modelled.noise, axis=0, weights=window.weight))
    lines, count = modelled.total.copy(), len(noise)
    own = np.arange(count)
    lines[:, own, own] -= modelled.noise
    now = replace(modelled, total=lines + noise)
    value = _loss(window, now)
    for _ in range(steps):
        inverse = now.inverse
        slope = np.einsum("b,bij->ij", weight, inverse @ window.power @ inverse - inverse)
        flat = inverse.reshape(len(weight), count**2)
        pairs = ((flat * weight[:, None]).T @ flat).reshape((count,) * 4)  # of inverse elements ij, kl
        information = pairs.transpose(0, 2, 1, 3).reshape(count**2, count**2)
        information += 1e-12 * np.trace(information) * np.eye(count**2)
        move = np.linalg.solve(information, slope.ravel()).reshape(count, count)
        move, least, gain = 0.5 * (move + move.T), 0.05 * np.linalg.eigvalsh(noise)[0], 0.0
        for part in 0.5 ** np.arange(12):
            trial = noise + part * move
            if np.linalg.eigvalsh(trial)[0] < least:
                continue
            ahead = replace(modelled, total=lines + trial)
            gain = value - _loss(window, ahead)
            if gain > 0.0:
                value, noise, now = value - gain, trial, ahead
                break
        if gain < _DONE:
            break
    return np.asarray(np.linalg.cholesky(noise))


def recolored(fit: Fit, factor: Array) -> Fit:
    """Return a fit of signals that are solved by a factor (c, c), as a start."""
    shapes = np.asarray(np.linalg.solve(factor, fit.shapes.T).T, dtype=np.float64)
    return Fit(fit.logs, shapes, np.zeros_like(fit.noise))
