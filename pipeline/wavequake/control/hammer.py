"""The blow of the modal hammer (Störkle 2018, Eq. 5.9 to 5.14)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import gamma

from wavequake.control.linear import Array
from wavequake.errors import UserError

GRAVITY = 9.81


@dataclass(frozen=True)
class Hammer:
    """Force p3 (t/p1)^(p2-1) exp(-(t/p1)^p2) from t = 0 on.

    Attributes
    ----------
    p1, p2, p3 : float
        s, 1, N; the defaults are those of Eq. 5.9.
    """

    p1: float = 0.0032
    p2: float = 2.065
    p3: float = 48.55


# That of Eq. 5.9.
HAMMER = Hammer()


def hammer_force(hammer: Hammer, time: ArrayLike) -> Array:
    """Return the force at instants in s, N (Eq. 5.9); zero before the blow."""
    ratio = np.maximum(np.asarray(time, dtype=np.float64), 0.0) / hammer.p1
    return np.asarray(hammer.p3 * ratio ** (hammer.p2 - 1) * np.exp(-(ratio**hammer.p2)))


def impulse(hammer: Hammer, until: ArrayLike = np.inf) -> Array:
    """Return the momentum handed over until an instant, N s; p1 p3 / p2 in all (Eq. 5.10)."""
    ratio = np.maximum(np.asarray(until, dtype=np.float64), 0.0) / hammer.p1
    return np.asarray(-np.expm1(-(ratio**hammer.p2)) * hammer.p1 * hammer.p3 / hammer.p2)


def mean_delay(hammer: Hammer) -> float:
    """Return the instant of the force's center of area, s: where one sudden blow would stand for it."""
    return hammer.p1 * float(gamma(1 + 1 / hammer.p2))


def step_means(hammer: Hammer, step: float, count: int, late: ArrayLike = 0.0, lead: int = 0) -> Array:
    """Return the mean force over each of lead + count steps, N, so that no momentum is lost by sampling.

    The first `lead` steps lie before 0, and each blow begins `late` s, (...), before 0: (steps, ...).
    """
    if not step > 0:
        raise UserError(f"The step is {step} s; it must be positive.")
    ends = np.add.outer(step * np.arange(-lead, count + 1), np.asarray(late, dtype=np.float64))
    return np.asarray(np.diff(impulse(hammer, ends), axis=0) / step)


def equivalent_force(hammer: Hammer, duration: float = 0.004) -> float:
    """Return the constant force that hands over the same momentum within `duration` s (Eq. 5.14)."""
    return float(impulse(hammer)) / duration


def hammer_velocity(arm: float = 0.220, angle_deg: float = 20.0) -> float:
    """Return the speed of the hammer's tip before the shock, from its arm in m (Eq. 5.11, 5.12)."""
    return float(np.sqrt(2 * GRAVITY * arm * (1 - np.cos(np.deg2rad(angle_deg)))))
