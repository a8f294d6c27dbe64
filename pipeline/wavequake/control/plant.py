"""Swing many benches beside each other after a hammer's blow, friction included (Störkle 2018, Eq. 5.2).

Modes are stepped exactly with forces held over each step, so that only Coulomb friction asks for short steps.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from wavequake.control.bench import Bench, bench_modes, force_column, image_row, measured_row
from wavequake.control.hammer import HAMMER, Hammer, step_means
from wavequake.control.linear import Array
from wavequake.errors import UserError

# Lens speed at which friction has all but its full size: a bearing's own motion below it is not modeled.
CREEP = 1e-3


@dataclass(frozen=True)
class FreeRuns:
    """Histories of c benches over k instants.

    Attributes
    ----------
    time : ndarray, shape (k,)
        s; the blow begins at 0, or as much before as is said.
    image, measured : ndarray, shape (c, k)
        Image motion that the lenses cause (a_F) and position of lens 4, m.
    lenses : ndarray, shape (c, l, k), optional
        Positions of all lenses that swing, m, where they were asked for.
    """

    time: Array
    image: Array
    measured: Array
    lenses: Array | None = None


def swing(
    benches: Sequence[Bench],
    blows: Array,
    *,
    friction: float = 0.0,
    duration: float = 6.0,
    step: float = 1e-3,
    hammer: Hammer = HAMMER,
    late: Array | None = None,
    keep_lenses: bool = False,
) -> FreeRuns:
    """Hit benches of equal size with a hammer.

    Parameters
    ----------
    benches : sequence of Bench
    blows : ndarray, shape (c,)
        Strength of each blow, as a multiple of the hammer's.
    friction : float
        Coulomb friction of each lens's bearing, N.
    duration, step : float
        s.
    hammer : Hammer
    late : ndarray, shape (c,), optional
        By how much each blow begins before the first instant, s; a control unit that asks for its trigger
        once per step sees it so late. 0 by default.
    keep_lenses : bool
        Whether to return the positions of all lenses, too.

    Raises
    ------
    UserError
        If the benches differ in size, a mode is overdamped, or the step is too long for the fastest mode.
    """
    if len({bench.size for bench in benches}) != 1:
        raise UserError("Benches that swing beside each other must have equally many degrees of freedom.")
    if friction < 0:
        raise UserError(f"The friction is {friction} N; it must not be negative.")
    every = [bench_modes(bench) for bench in benches]
    # The bench is the last axis: sums run over modes, one after the other, whatever the number of benches.
    poles = np.stack([modes.poles for modes in every], axis=-1)
    fastest = float(np.abs(poles).max())
    if not 0 < step <= 0.5 / fastest:
        raise UserError(
            f"A step of {step} s is too long for a mode of {fastest:.3g} rad/s; use {0.5 / fastest:.2g} s."
        )
    shapes = np.stack([modes.shapes for modes in every], axis=-1)
    lenses = shapes[: len(benches[0].lenses)]
    rows = np.stack(
        [
            np.stack([image_row(b) @ m.shapes, measured_row(b) @ m.shapes])
            for b, m in zip(benches, every, strict=True)
        ],
        axis=-1,
    )
    driven = np.stack([force_column(b) @ m.shapes for b, m in zip(benches, every, strict=True)], axis=-1)
    before = np.zeros(len(benches)) if late is None else late
    if not (np.isfinite(before).all() and (before >= 0).all()):
        raise UserError("A trigger cannot be seen before the blow begins: late must not be negative.")
    count, lead = round(duration / step) + 1, int(np.ceil(before.max() / step))
    force = np.zeros((lead + count, len(benches)))
    pushed = min(count, int(np.ceil(5 * hammer.p1 / step)))
    force[: lead + pushed] = step_means(hammer, step, pushed, before, lead)
    push = driven * blows
    grown = np.exp(poles * step)
    held = (grown - 1) / poles
    state = np.zeros_like(poles)
    outputs = np.empty((count, 2, len(benches)))
    positions = np.empty((count if keep_lenses else 0, *lenses[:, 0].shape))
    for k in range(-lead, count):
        # η = Im(z)/ω_d and η' = Im(λ z)/ω_d for z' = λ z + φᵀ f.
        if k >= 0:
            outputs[k] = (rows * (state.imag / poles.imag)).sum(axis=1)
        if k >= 0 and keep_lenses:
            positions[k] = (lenses * (state.imag / poles.imag)).sum(axis=1)
        speed = (lenses * ((poles * state).imag / poles.imag)).sum(axis=1)
        rubbing = friction * np.tanh(speed / CREEP)
        modal = push * force[lead + k] - (lenses * rubbing[:, None]).sum(axis=0)
        state = grown * state + held * modal
    kept = positions.transpose(2, 1, 0).copy() if keep_lenses else None
    return FreeRuns(np.arange(count) * np.float64(step), outputs[:, 0].T.copy(), outputs[:, 1].T.copy(), kept)
