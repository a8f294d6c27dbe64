"""The modal regulator: an observer of modes, and a row that inverts actuator, hold and delay at poles."""

from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from wavequake.chain.loops.block import Controller, register
from wavequake.chain.loops.design import Design
from wavequake.control.gains import kalman_gain
from wavequake.control.linear import Array, LinearModel
from wavequake.control.sampled.channel import Dynamics
from wavequake.control.sampled.regulator import Regulator, whole
from wavequake.errors import UserError

Complex = NDArray[np.complex128]
# Of its motion, what a sensor without noise is taken to be off.
_CLEAN = 1e-6


@register
class Modal(Controller):
    """It feeds forward: what the first sensor sees of modes is held still, as further sensors tell of them.

    Those must not see the actuator. It is the regulator of the lens bench (`wavequake.control.regulator`),
    for modes that are shaken all the time.
    """

    fuses: ClassVar[bool] = True

    model: Literal["modal"] = "modal"

    @property
    def asks_modes(self) -> bool:
        """It does."""
        return True

    def design(self, asked: Design) -> Regulator:
        """Return observer and row.

        Raises
        ------
        UserError
            If there are no modes or no further sensor, or one sees the actuator, or none sees a mode; or the
            first one does not see the actuator.
        """
        where = f"controller.{self.name}"
        target, *observers = asked.watched
        if asked.shaken is None or not asked.shaken.names:
            raise UserError(f"{where}: no modes are shaken, of which it feeds forward.")
        if not observers:
            raise UserError(
                f"{where}: also_reads must name what tells of the modes; {target.sensor!r} is to stand still."
            )
        if not target.sees.any():
            raise UserError(
                f"{where}: {target.sensor!r} does not see the actuator {asked.actuator!r}, which cannot hold "
                "it still; name by sensor one that does."
            )
        for one in observers:
            if one.sees.any() or (one.answers @ asked.drives).any():
                raise UserError(
                    f"{where}: {one.sensor!r} sees the actuator {asked.actuator!r}, so that it would feed "
                    "back; take lqg-fusion."
                )
        omega, zeta = 2 * np.pi * asked.shaken.hertz, asked.shaken.zeta
        poles: Complex = -zeta * omega + 1j * omega * np.sqrt(1 - zeta**2)
        timing = asked.timing
        late = np.exp(-poles * timing.latency)
        moved = _response(asked.follows, poles) * _mean(poles, timing.period) * late
        row = -np.linalg.pinv(target.sees) @ target.shaken / moved
        # Frames that end now, and those before.
        ago = np.exp(-np.outer(np.arange(timing.frames) * timing.frame, poles)).mean(axis=0)
        seen = _mean(poles, timing.integration)
        c = np.vstack([one.shaken * _response(one.shows, poles) * seen * ago for one in observers])
        hidden = ~c.any(axis=0) & target.shaken.any(axis=0)
        if hidden.any():
            k = int(np.argmax(hidden))
            raise UserError(
                f"{where}: no sensor in also_reads sees the mode {asked.shaken.names[k]!r} "
                f"({asked.shaken.hertz[k]:.4g} Hz), which moves {target.sensor!r}."
            )
        noise = np.concatenate([np.full(len(one.readings), one.noise) for one in observers])
        noise = np.maximum(noise, _CLEAN * np.linalg.norm(c, axis=1).max())
        step = np.exp(poles * timing.period)
        a = _real(np.diag(step))
        gain = kalman_gain(a, _real(c)[::2], np.repeat(1 - np.abs(step) ** 2, 2), noise**2)
        rows = _real(row)[::2]
        left = np.eye(len(a)) - gain @ _real(c)[::2]
        into = np.hstack([np.zeros((len(a), len(target.readings))), gain])
        return whole(LinearModel(a @ left, a @ into, rows @ left, rows @ into, timing.period))


def _response(dynamics: Dynamics, poles: Complex) -> Complex:
    """Return the transfer function at poles (m,)."""
    n = len(dynamics)
    found = [dynamics.c @ np.linalg.solve(s * np.eye(n) - dynamics.a, dynamics.b) for s in poles]
    return np.asarray(found, dtype=np.complex128) + dynamics.d


def _mean(poles: Complex, duration: float) -> Complex:
    """Return the mean of e^{λt} over the time before 0."""
    return np.asarray(-np.expm1(-poles * duration) / (poles * duration))


def _real(matrix: Array | Complex) -> Array:
    """Return a complex matrix as a real one, two rows and columns for each of its own."""
    parts = np.array([[matrix.real, -matrix.imag], [matrix.imag, matrix.real]])
    return np.asarray(parts.transpose(2, 0, 3, 1).reshape(2 * len(matrix), -1))
