"""The modal regulator: an observer of modes, and one row that inverts stage, hold and delay at their poles.

At a mode e^{λt}, a command γ z_k that is held over steps of T and arrives t_c late moves the stage by
γ H(λ) z with H = G(λ) (1 - e^{-λT})/(λT) e^{-λ t_c}. The row γ_j = -ρ_j / (s_5 H(λ_j)) therefore cancels
the image motion ρ_j z_j of each mode exactly (an output regulator, whose Sylvester equation is diagonal in
modes): no inverse filter, no prediction step, any sample time.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wavequake.control.bench import (
    COMPENSATOR,
    MEASURED,
    SENSITIVITIES,
    Bench,
    bench_modes,
    force_column,
    image_row,
)
from wavequake.control.gains import kalman_gain
from wavequake.control.hammer import HAMMER, Hammer, hammer_force
from wavequake.control.linear import Array
from wavequake.control.sampled.regulator import Stepped
from wavequake.control.stage import Stage, stage_response
from wavequake.errors import UserError

Complex = NDArray[np.complex128]

# A mode that shows in lens 4 by less than this share of the largest is taken as hidden.
HIDDEN = 1e-4


@dataclass(frozen=True)
class ModalModel:
    """Free motion after a blow at t = 0: y_L4 = Re Σ z_j, a = Re Σ ρ_j z_j, z_j = blow_j e^{λ_j t}.

    Attributes
    ----------
    poles : ndarray of complex, shape (m,)
        λ, 1/s, positive imaginary parts.
    image : ndarray of complex, shape (m,)
        ρ, image motion per motion of lens 4.
    blow : ndarray of complex, shape (m,)
        State after the blow, referred to t = 0, m.
    """

    poles: Complex
    image: Complex
    blow: Complex


@dataclass(frozen=True)
class ModalRegulator:
    """What the control unit runs: m complex modes.

    In each step z += start_k (for k steps from the trigger on), e = y - Re Σ z, z += gain e,
    u = Re Σ row z, and for the next step z *= step.

    Attributes
    ----------
    name : str
    sample_time, compute_delay : float
        s.
    step : ndarray of complex, shape (m,)
        e^{λT}.
    gain : ndarray of complex, shape (m,)
        Of the sampled Kalman filter.
    row : ndarray of complex, shape (m,)
        γ, command in m per modal coordinate in m.
    start : ndarray of complex, shape (k, m)
        Added in the first steps from the trigger on, m.
    """

    name: str
    sample_time: float
    compute_delay: float
    step: Complex
    gain: Complex
    row: Complex
    start: Complex

    @property
    def given(self) -> Stepped:
        """It as a loop runs it, on every case."""
        return side_by_side([self])

    def readings(self, measured: Array) -> Array:
        """Return what it reads, (k, 1, c), for positions (c, k) of lens 4 from the trigger on, m."""
        return measured.T[:, None]


def modal_model(bench: Bench, hammer: Hammer = HAMMER) -> ModalModel:
    """Return the modes of a bench as lens 4 sees them.

    Raises
    ------
    UserError
        If lens 4 hardly sees a mode; says which.
    """
    modes = bench_modes(bench)
    seen = modes.shapes[MEASURED]
    driven = force_column(bench) @ modes.shapes
    # η = Im(z)/ω_d for z' = λ z + φᵀ f; in y = Re(z') the coordinate is -i z φ_4/ω_d.
    blow = -1j * seen * driven / modes.poles.imag * blow_spectrum(hammer, modes.poles)
    share = np.abs(blow) / np.abs(blow).max()
    if (share < HIDDEN).any():
        number = int(np.argmin(share))
        raise UserError(
            f"The modal observer cannot be designed: lens 4 does not see mode {number + 1} "
            f"({modes.omega[number]:.4g} rad/s, {modes.omega[number] / 2 / np.pi:.3g} Hz); change the "
            "springs or measure another lens."
        )
    return ModalModel(modes.poles, (image_row(bench) @ modes.shapes / seen).astype(complex), blow)


def blow_spectrum(hammer: Hammer, poles: Complex, until: float = np.inf) -> Complex:
    """Return the integral of e^{-λt} F(t) over the blow, N s: a mode's state afterwards, referred to t = 0.

    At poles iω, this is the spectrum of the force.
    """
    last = min(until, 5 * hammer.p1)
    nodes, weights = np.polynomial.legendre.leggauss(48)
    time = (nodes + 1) * last / 2
    force = hammer_force(hammer, time) * weights * last / 2
    return np.asarray(np.exp(-np.outer(poles, time)) @ force)


def stage_gain(stage: Stage, poles: Complex, sample_time: float, compute_delay: float) -> Complex:
    """Return H(λ): the stage's motion per held and late command that swings as e^{λt}."""
    step = poles * sample_time
    return np.asarray(stage_response(stage, poles) * -np.expm1(-step) / step * np.exp(-poles * compute_delay))


def modal_regulator(
    model: ModalModel,
    stage: Stage,
    sample_time: float = 0.002,
    compute_delay: float = 0.0002,
    *,
    name: str = "modal",
    process_noise: float = 0.003,
    sensor_noise: float = 6.6e-6,
    hammer: Hammer = HAMMER,
    late: float = 0.0,
) -> ModalRegulator:
    """Design observer and row for a modal model.

    Parameters
    ----------
    model : ModalModel
    stage : Stage
        As identified.
    sample_time, compute_delay : float
        s.
    name : str
    process_noise : float
        Standard deviation of what a mode gains per step, as a share of its amplitude after the blow.
    sensor_noise : float
        Standard deviation of the measurement, m.
    hammer : Hammer
        Its shape tells which share of the blow each of the first steps has seen.
    late : float
        By how much the blow is expected to begin before the step that sees the trigger, s.

    Raises
    ------
    UserError
        If a mode is unstable, or does not show in lens 4 (says which), or the stage has a zero at a pole.
    """
    growing = model.poles.real >= 0
    if growing.any():
        pole = model.poles[int(np.argmax(growing))]
        raise UserError(
            f"The modal regulator cannot be designed: mode {int(np.argmax(growing)) + 1} "
            f"({abs(pole):.4g} rad/s) does not decay, real part {pole.real:.3g} 1/s."
        )
    if not np.isfinite(model.image).all() or (model.blow == 0).any():
        number = int(np.argmin(np.isfinite(model.image) & (model.blow != 0)))
        raise UserError(
            f"The modal regulator cannot be designed: lens 4 does not see mode {number + 1} "
            f"({abs(model.poles[number]):.4g} rad/s)."
        )
    gain = stage_gain(stage, model.poles, sample_time, compute_delay)
    step = np.exp(model.poles * sample_time)
    count = len(step)
    a = np.zeros((2 * count, 2 * count))
    for j, factor in enumerate(step):
        a[2 * j : 2 * j + 2, 2 * j : 2 * j + 2] = [[factor.real, -factor.imag], [factor.imag, factor.real]]
    c = np.tile([[1.0, 0.0]], count)
    noise = np.repeat((process_noise * np.abs(model.blow)) ** 2, 2)
    columns = kalman_gain(a, c, noise, sensor_noise**2)[:, 0]
    row = -model.image / (SENSITIVITIES[COMPENSATOR] * gain)
    start = first_steps(model, sample_time, hammer, late)
    return ModalRegulator(
        name, sample_time, compute_delay, step, columns[::2] + 1j * columns[1::2], row, start
    )


def first_steps(model: ModalModel, sample_time: float, hammer: Hammer = HAMMER, late: float = 0.0) -> Complex:
    """Return what the blow adds to the modes in each step from the trigger on, (k, m).

    What it hands over within a step arrives at the next one, and what it did in the `late` s before the
    trigger was seen, at the first. Shares are those of the hammer's known shape;
    they sum up to the whole blow, referred to each step's instant.
    """
    count = max(1, int(np.ceil(4 * hammer.p1 / sample_time)))
    instants = late + sample_time * np.arange(count + 1)
    whole = blow_spectrum(hammer, model.poles)
    until = np.stack([blow_spectrum(hammer, model.poles, float(t)) if t else 0 * whole for t in instants])
    until[-1] = whole
    shares = np.diff(until, axis=0, prepend=0 * whole[None]) / whole
    start: Complex = shares * model.blow * np.exp(np.outer(instants, model.poles))
    return start


def side_by_side(regulators: Sequence[ModalRegulator]) -> Stepped:
    """Return regulators as loops run them, each on a case or one on all: of readings (1, c) in m.

    The first reading is that of the trigger. Regulators have equally many modes and steps of the blow. Sums
    run over modes alone, so that a case does not depend on its neighbors.
    """
    step, gain, row, begun = (
        np.stack([getattr(one, name) for one in regulators], axis=-2)
        for name in ("step", "gain", "row", "start")
    )
    count = step.shape[1]

    def function(states: Array, readings: Array) -> tuple[Array, Array]:
        # Modes (c, m) of real and imaginary parts, and how many steps ago the trigger was.
        real, imaginary = (np.ascontiguousarray(part.T) for part in (states[:count], states[count:-1]))
        z, k = real + 1j * imaginary, int(states[-1, 0])
        if k < len(begun):
            z = z + begun[k]
        z = z + gain * (readings[0] - z.real.sum(axis=1))[:, None]
        command = (row * z).real.sum(axis=1)
        z = z * step
        return np.vstack([z.real.T, z.imag.T, states[-1:] + 1.0]), command[None]

    return Stepped(2 * count + 1, function)
