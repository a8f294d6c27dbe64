"""The controllers of the reference text: Kalman filter with feed-forward and future integration.

Störkle 2018, Sections 5.3 and 5.4. All are linear and become one sampled model each, from measured lens and
hammer force to the command of the stage.
"""

from dataclasses import dataclass

import numpy as np

from wavequake.control.bench import COMPENSATOR, SENSITIVITIES, Bench, bench_model
from wavequake.control.gains import kalman_bucy_gain
from wavequake.control.hammer import HAMMER, Hammer, step_means
from wavequake.control.linear import (
    Array,
    LinearModel,
    bogacki_shampine,
    in_series,
    linear_model,
    spectral_radius,
    zero_order_hold,
)
from wavequake.control.modes import check_observable
from wavequake.control.sampled.regulator import Regulator, whole
from wavequake.control.stage import Stage, all_pass_inverse
from wavequake.errors import UserError

# Densities of process and measurement noise, Eq. 5.23 and the text after it.
PROCESS_NOISE, SENSOR_NOISE = 5e-8, 1e-9


@dataclass(frozen=True)
class SampledController:
    """One step of a linear controller: u_k = C x_k + D v_k, x_{k+1} = A x_k + B v_k, v = (y_L4, u_F).

    Attributes
    ----------
    name : str
    sample_time : float
        s.
    compute_delay : float
        From sampling to the command's arrival at the stage, s.
    a, b, c, d : ndarray, shapes (n, n), (n, 2), (n,), (2,)
        Of measured lens position in m and hammer force in N; the command in m.
    """

    name: str
    sample_time: float
    compute_delay: float
    a: Array
    b: Array
    c: Array
    d: Array

    @property
    def given(self) -> Regulator:
        """It as a loop runs it."""
        return whole(LinearModel(self.a, self.b, self.c[None], self.d[None], self.sample_time))

    def readings(self, measured: Array, hammer: Hammer = HAMMER) -> Array:
        """Return what it reads, (k, 2, c), for positions (c, k) of lens 4 at its instants, m.

        The trigger at the first of them tells it of the blow, whose course is known beforehand (Eq. 5.9): it
        takes the mean force of each step, which a held input must be for no momentum to come too early.
        """
        force = step_means(hammer, self.sample_time, measured.shape[1])
        return np.stack([measured.T, np.broadcast_to(force[:, None], measured.T.shape)], axis=1)


@dataclass(frozen=True)
class KalmanFilter:
    """The continuous filter x^' = A x^ + B (u_F, y_L4), estimated image = row x^ (Eq. 5.17, 5.18).

    Attributes
    ----------
    a, b : ndarray, shapes (n, n), (n, 2)
        Inputs (y_L4, u_F).
    image : ndarray, shape (n,)
    gain : ndarray, shape (n,)
    """

    a: Array
    b: Array
    image: Array
    gain: Array


def kalman_filter(
    bench: Bench, q: float = PROCESS_NOISE, r: float = SENSOR_NOISE, with_force: bool = True
) -> KalmanFilter:
    """Design the filter on a bench (Eq. 2.22, 2.23 with G = 1); without the force its input counts nothing.

    Raises
    ------
    UserError
        If lens 4 does not see a mode; says which.
    """
    whole = bench_model(bench)
    measured = linear_model(whole.a, whole.b, whole.c[1:])
    check_observable(measured, "The Kalman filter of the bench")
    gain = kalman_bucy_gain(measured, q, r)
    force = whole.b if with_force else np.zeros_like(whole.b)
    return KalmanFilter(whole.a - gain @ measured.c, np.hstack([gain, force]), whole.c[0], gain[:, 0])


def _target(estimator: KalmanFilter, steps: int, step: float) -> LinearModel:
    """Return filter and target of the stage, Eq. 5.6, `steps` of `step` s ahead (Eq. 5.19, 5.20)."""
    ahead = zero_order_hold(linear_model(estimator.a, estimator.b, estimator.image), step)
    power, total = np.eye(len(ahead.a)), np.zeros_like(ahead.b)
    for _ in range(steps):
        power, total = ahead.a @ power, ahead.a @ total + ahead.b
    row = -estimator.image / SENSITIVITIES[COMPENSATOR]
    return linear_model(estimator.a, estimator.b, row @ power, row @ total)


def feed_forward(
    bench: Bench, stage: Stage, sample_time: float = 0.002, compute_delay: float = 0.001, ahead: int = 0
) -> SampledController:
    """Design filter and all-pass inverse (Eq. 5.21), solved jointly by ode3; `ahead` steps of 5.20 between.

    ``ahead=2`` is the FF+FI controller, which the reference could only simulate.

    Raises
    ------
    UserError
        If the solver is unstable at the sample time; says its spectral radius.
    """
    inverse = all_pass_inverse(stage)
    joint = in_series(_target(kalman_filter(bench), ahead, sample_time), inverse)
    return _sampled("FF+FI" if ahead else "FF", joint, sample_time, compute_delay)


def future_integration(
    bench: Bench, sample_time: float = 0.008, compute_delay: float = 0.003, ahead: int = 2
) -> SampledController:
    """Design filter without hammer force and prediction by `ahead` steps (Eq. 5.20), solved by ode3.

    Raises
    ------
    UserError
        If the solver is unstable at the sample time; says its spectral radius.
    """
    return _sampled(
        "FI", _target(kalman_filter(bench, with_force=False), ahead, sample_time), sample_time, compute_delay
    )


def estimator_only(
    bench: Bench, sample_time: float = 0.002, compute_delay: float = 0.001
) -> SampledController:
    """Design the filter alone, commanding the target of Eq. 5.6 as it is estimated."""
    return _sampled("KF", _target(kalman_filter(bench), 0, sample_time), sample_time, compute_delay)


def _sampled(name: str, model: LinearModel, step: float, delay: float) -> SampledController:
    sampled = bogacki_shampine(model, step)
    radius = spectral_radius(sampled)
    if not radius < 1.0:
        raise UserError(
            f"The controller {name} is unstable at a sample time of {1e3 * step:g} ms: the solver ode3 has "
            f"the spectral radius {radius:.3g}, which must be below 1; {_longest(model)}"
        )
    return SampledController(name, step, delay, sampled.a, sampled.b, sampled.c[0], sampled.d[0])


def _longest(model: LinearModel) -> str:
    """Say up to which sample time ode3 is stable."""
    times = 1e-3 * 2.0 ** np.arange(4, -5.1, -0.125)
    stable = [time for time in times if spectral_radius(bogacki_shampine(model, float(time))) < 1]
    return f"{1e3 * stable[0]:.2g} ms would do." if stable else "its filter itself does not decay."
