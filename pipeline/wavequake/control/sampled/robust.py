"""A filter of one channel that keeps sensitivity and effort below bounds at every frequency (H-infinity)."""

from importlib import import_module

import numpy as np

from wavequake.control.linear import Array, LinearModel
from wavequake.control.sampled.channel import Dynamics, Timing, sampled_channel
from wavequake.errors import UserError

# How much of a constant is left, which an exact integrator in the weight would not let the formulas have.
_LEFT = 1e-4
_LARGE = 1e6


def robust(
    bandwidth_hz: float, peak: float, effort: float, dynamics: Dynamics, timing: Timing
) -> LinearModel:
    """Return the filter with |S| below f / f_b up to f_b, below `peak` beyond, and |K S| below `effort`.

    The mixed-sensitivity problem with the weights 1/|S| and 1/|K S| (Skogestad and Postlethwaite 2005,
    section 2.8.2: W1 = (s / peak + w_b) / (s + w_b e)) in the plane of Tustin's transformation, which turns
    the circle into the imaginary axis and keeps norms; solved by Glover's and Doyle's formulas (slycot). What
    they find may be unstable by itself, as that of LQG may; the loop is stable, down to a least gain.

    Parameters
    ----------
    bandwidth_hz : float
        f_b.
    peak : float
        Above 1.
    effort : float
        Largest command per disturbance of 1.
    dynamics : Dynamics
    timing : Timing

    Raises
    ------
    UserError
        If slycot is not installed, or no controller keeps these bounds (says by how much).
    """
    try:
        slycot = import_module("slycot")
    except ImportError:
        raise UserError("an H-infinity design needs slycot; run: pip install slycot") from None
    plant = _tustin(sampled_channel(dynamics, timing))
    problem, n = _weighted(plant, bandwidth_hz * timing.period, peak, effort), len(plant.a) + 1
    sizes = n, 2, 3, 1, 1
    try:
        _, a, b, c, d = slycot.sb10ad(*sizes, 1.0, *problem, job=4)[:5]
    except slycot.exceptions.SlycotError:
        raise UserError(_refusal(slycot, sizes, problem)) from None
    found = _from_tustin(np.asarray(a), np.asarray(b), np.asarray(c), np.asarray(d))
    return LinearModel(found.a, found.b, -found.c, -found.d, timing.period)


def _refusal(slycot: object, sizes: tuple[int, ...], problem: tuple[Array, ...]) -> str:
    words = "no controller keeps |S| and |K S| below what is asked"
    try:
        least = slycot.sb10ad(*sizes, _LARGE, *problem, job=1)[0]  # type: ignore[attr-defined]
    except slycot.exceptions.SlycotError:  # type: ignore[attr-defined]
        return f"{words}; lower bandwidth_hz, or raise peak or effort."
    return (
        f"{words}: the best exceeds it {float(least):.3g} times; lower bandwidth_hz, or raise peak or effort."
    )


def _weighted(plant: LinearModel, turns: float, peak: float, effort: float) -> tuple[Array, ...]:
    """Return A, B, C, D from disturbance and command to W1 S, W2 K S and what the controller reads."""
    warped = 2 * np.tan(np.pi * turns)
    pole, gain = warped * _LEFT, 1.0 / peak
    # W1 = gain + (warped - gain pole) / (s + pole).
    slope = warped - gain * pole
    n = len(plant.a)
    a = np.block([[plant.a, np.zeros((n, 1))], [slope * -plant.c, np.array([[-pole]])]])
    b = np.block([[np.zeros((n, 1)), plant.b], [np.array([[slope]]), -slope * plant.d]])
    c = np.block([[-gain * plant.c, np.eye(1)], [np.zeros((1, n + 1))], [-plant.c, np.zeros((1, 1))]])
    d = np.block(
        [[np.array([[gain]]), -gain * plant.d], [np.array([[0.0, 1.0 / effort]])], [np.eye(1), -plant.d]]
    )
    return a, b, c, d


def _tustin(model: LinearModel) -> LinearModel:
    """Return a sampled model in the plane s = 2 (z - 1) / (z + 1), time in samples."""
    unit = np.eye(len(model.a))
    turned = np.linalg.inv(model.a + unit)
    return LinearModel(
        2 * turned @ (model.a - unit),
        2 * turned @ model.b,
        2 * model.c @ turned,
        model.d - model.c @ turned @ model.b,
    )


def _from_tustin(a: Array, b: Array, c: Array, d: Array) -> LinearModel:
    """Turn it back."""
    turned = np.linalg.inv(2 * np.eye(len(a)) - a)
    return LinearModel(turned @ (2 * np.eye(len(a)) + a), 2 * turned @ b, 2 * c @ turned, d + c @ turned @ b)
