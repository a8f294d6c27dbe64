"""Intervals of lines by profiles of the likelihood, which are as skew as the estimates.

A line that comes out too wide has too small an error, and the other way round: of a few independent numbers
(bandwidth times duration) intervals by standard deviations miss on one side. An end of an interval is where
the likelihood, highest over all else, is lower by what Wilks' theorem allows (Venzon and Moolgavkar 1988).
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from wavequake.mechanics.telemetry.line import NORMAL
from wavequake.mechanics.telemetry.whittle import Fit, Held, Window, fit_lines

Array = NDArray[np.float64]

_STEPS = 8
_TRIALS = 3
_NEAR = 0.02  # of a standard deviation
_LEAST, _MOST = 1e-9, 0.9  # damping ratios
_FAR = 3.0  # times as far as standard deviations say, at most


def profile_ends(window: Window, fit: Fit, held: Held, taper: float) -> Array:
    """Return how far what would be held goes down and up (2,), by 95 % confidence.

    Parameters
    ----------
    window : Window
    fit : Fit
        Of highest likelihood.
    held : Held
    taper : float
        By which the taper increases variances.
    """
    slope = held.slope(fit)
    path = fit.covariance @ slope
    deviation = float(np.sqrt(slope @ path))
    path = path / deviation**2
    ends = []
    for side in (-1.0, 1.0):
        away = side * NORMAL * deviation
        for _ in range(_TRIALS):
            start = _along(fit, path, away)
            if start is None:
                break
            found = fit_lines(window, start, _LEAST, _MOST, _STEPS, held=held)
            root = side * np.sqrt(2.0 * max(found.loss - fit.loss, 0.0) / taper)
            if not np.isfinite(root):
                break
            if abs(root - side * NORMAL) < _NEAR:
                break
            # The root of the likelihood's logarithm is away / deviation + bend away^2 nearly.
            bend = (root - away / deviation) / away**2
            inside = 1.0 / deviation**2 + 4.0 * bend * side * NORMAL
            if inside <= 0.0:
                away *= 1.5
            else:
                away = 2.0 * side * NORMAL / (1.0 / deviation + np.sqrt(inside))
            away = side * min(abs(away), _FAR * NORMAL * deviation)
        ends.append(away)
    return np.array(ends)


def _along(fit: Fit, path: Array, away: float) -> Fit | None:
    """Return a fit moved along its covariance until what is held is `away`; None beyond all lines."""
    lines, shapes = fit.logs.size, fit.shapes.size
    moved = path * away
    logs = fit.logs + moved[:lines].reshape(-1, 2)
    if not (logs[:, 1] < np.log(_MOST)).all():
        return None
    made = fit.shapes + moved[lines : lines + shapes].reshape(fit.shapes.shape)
    noise = np.clip(moved[lines + shapes :].reshape(2, -1), -1.0, 1.0)
    return replace(fit, logs=logs, shapes=made, noise=fit.noise + noise)


def shape_ends(rms: Array, covariance: Array, common: Array, variance: float, ends: Array) -> Array:
    """Return the ends (c, 2) of the intervals of a line's rms in each signal.

    Of many signals: what they have in common, the strength, has the interval of its profile; what is left of
    each one's error is even to both sides. Both are added as squares (Zou and Donner 2008).

    Parameters
    ----------
    rms, covariance : ndarray, shape (c,) and (c, c)
    common : ndarray, shape (c,)
        Covariance with the strength.
    variance : float
        Of the strength.
    ends : ndarray, shape (2,)
        How far that goes down and up.
    """
    shared = common / variance
    own = np.maximum(np.diag(covariance) - shared * common, 0.0) * NORMAL**2
    down, up = np.outer(ends, shared)
    low = -np.sqrt(np.minimum(down, up) ** 2 + own)
    high = np.sqrt(np.maximum(down, up) ** 2 + own)
    return np.stack([rms + low, rms + high], axis=1)
