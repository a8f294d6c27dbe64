"""What controllers are designed for: sensors, actuator and timing, and the structure that carries them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from wavequake.control.sampled.channel import Dynamics, Timing, in_series
from wavequake.errors import UserError

Array = NDArray[np.float64]

# Motions that act less apart than this, as a share of one of them alone, are not told apart.
_APART = 1e-6
_ROUNDING = 1e-9
# Channels that a sentence names.
_NAMED = 4


@dataclass(frozen=True)
class Shaken:
    """Modes of a structure that white forces shake.

    Attributes
    ----------
    names : tuple of str
    hertz, zeta : ndarray, shape (M,)
        Frequencies and damping ratios.
    seen : ndarray, shape (K, M)
        Rms of all that is seen of each.
    """

    names: tuple[str, ...]
    hertz: Array
    zeta: Array
    seen: Array


def all_shaken(parts: Sequence[Shaken]) -> Shaken | None:
    """Return the modes of several structures as those of one; None: there are none."""
    if not parts:
        return None
    return Shaken(
        tuple(name for one in parts for name in one.names),
        np.concatenate([one.hertz for one in parts]),
        np.concatenate([one.zeta for one in parts]),
        np.hstack([one.seen for one in parts]),
    )


@dataclass(frozen=True)
class Watch:
    """A sensor of a controller.

    Attributes
    ----------
    sensor : str
    readings : tuple of str
        Names of the m readings.
    sees : ndarray, shape (m, p)
        Readings per position, as they are believed to be.
    noise : float
        Rms of a reading's mean over a period.
    shows : Dynamics
        How a reading follows what is read.
    shaken : ndarray, shape (m, K)
        Rms of what white forces do through each mode of the structure.
    answers : ndarray, shape (m, M)
        Readings per mode that answers the actuator.
    """

    sensor: str
    readings: tuple[str, ...]
    sees: Array
    noise: float
    shows: Dynamics
    shaken: Array
    answers: Array


@dataclass(frozen=True)
class Design:
    """What a controller is designed for.

    Attributes
    ----------
    controller, actuator : str
        Names, for messages.
    watched : tuple of Watch
        Its sensors; most controllers have one, and those that have not take readings one sensor after the
        other. `sensor`, `readings`, `sees`, `noise` and `shows` are those of the first.
    channels : tuple of str
        Names of the p channels.
    follows : Dynamics
        How the actuator follows a command.
    timing : Timing
        Of all sensors.
    shaken : Shaken or None
        The structure, where the study has one.
    answering : tuple of Dynamics
        Modes that answer the actuator.
    drives : ndarray, shape (M, p)
        How positions move along these.
    """

    controller: str
    actuator: str
    watched: tuple[Watch, ...]
    channels: tuple[str, ...]
    follows: Dynamics
    timing: Timing
    shaken: Shaken | None
    answering: tuple[Dynamics, ...]
    drives: Array

    @property
    def sensor(self) -> str:
        """Name of the first sensor."""
        return self.watched[0].sensor

    @property
    def readings(self) -> tuple[str, ...]:
        """Names of its readings."""
        return self.watched[0].readings

    @property
    def sees(self) -> Array:
        """Its readings per position, (m, p), as they are believed to be."""
        return self.watched[0].sees

    @property
    def noise(self) -> float:
        """Rms of the mean of one of its readings over a period."""
        return self.watched[0].noise

    @property
    def shows(self) -> Dynamics:
        """How one of its readings follows what is read."""
        return self.watched[0].shows

    @property
    def read(self) -> int:
        """Number of readings of all sensors."""
        return sum(len(one.readings) for one in self.watched)

    @property
    def dynamics(self) -> Dynamics:
        """From a channel's command to its reading."""
        return in_series(self.follows, self.shows)

    @property
    def sees_positions(self) -> bool:
        """Whether readings show where the actuator stands, as those of accelerometers do not."""
        return abs(self.dynamics.static_gain - 1.0) < _ROUNDING


def decoupling(asked: Design, modes: int | None = None, rates: bool = False) -> Array:
    """Return positions per reading (p, m): the pseudo-inverse of what the sensor sees, or of its best modes.

    With `rates`, the sensor need not see where things stand: accelerometers do not.

    Raises
    ------
    UserError
        If the sensor does not see a motion of the actuator; names its channel.
    """
    sizes = np.linalg.norm(asked.sees, axis=0)
    where = f"controller.{asked.controller}: the sensor {asked.sensor!r}"
    if not (rates or asked.sees_positions):
        raise UserError(f"{where} does not see where things stand; take lqg, lqr, state-space or a function.")
    if not sizes.any():
        channel = asked.channels[0]
        raise UserError(
            f"{where} does not see {channel!r} of the actuator {asked.actuator!r} at all, not at 0 Hz, where "
            "it stands, either; take a sensor that does, or leave the channel out."
        )
    sizes = np.where(sizes > 0.0, sizes, 1.0)  # what is not seen stays so in any unit
    left, values, right = np.linalg.svd(asked.sees / sizes, full_matrices=False)
    count = len(sizes)
    rank = int((values > _APART * values[0]).sum())
    if modes is None and rank < count:
        raise UserError(
            f"{where} tells {rank} of {count} motions of the actuator {asked.actuator!r} apart, so that "
            f"{_undetermined(asked, right[:rank])} not determined; set modes = {rank}, or take another "
            "sensor."
        )
    kept = rank if modes is None else modes
    if kept > rank:
        raise UserError(f"{where} tells {rank} motions of {asked.actuator!r} apart, not modes = {kept}.")
    return np.asarray((right[:kept].T / values[:kept]) @ left[:, :kept].T / sizes[:, None])


def _undetermined(asked: Design, seen: Array) -> str:
    """Name the channels that what is seen, orthonormal motions (rank, p), leaves open, and their frequencies.

    With these held all others are determined: they are the first pivots of what is not seen. Where channels
    stand no actuator has dynamics: that is at 0 Hz, beside the resonances or corners by which they follow.
    """
    left = len(asked.channels) - len(seen)
    hidden = np.eye(len(asked.channels)) - seen.T @ seen
    order = scipy.linalg.qr(hidden, mode="r", pivoting=True)[1][:left]
    named = [repr(asked.channels[place]) for place in sorted(order)]
    hertz = sorted({f"{abs(pole) / (2 * np.pi):.4g} Hz" for pole in np.linalg.eigvals(asked.follows.a)})
    more = f" and {left - _NAMED} more" if left > _NAMED else ""
    at = "at 0 Hz" + (f" (its own dynamics: {', '.join(hertz)})" if hertz else "")
    return f"{', '.join(named[:_NAMED])}{more} {'is' if left == 1 else 'are'}, {at},"
