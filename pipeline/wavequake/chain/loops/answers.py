"""Modes that answer what actuators do: of a structure that carries mirrors, or of a mirror that bends."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wavequake.control.sampled.channel import Dynamics
from wavequake.optics.systems.system import States

Array = NDArray[np.float64]
Put = Callable[[States, Array], None]


@dataclass(frozen=True)
class OwnModes:
    """Modes of what an actuator moves; what they answer is nothing at rest.

    Attributes
    ----------
    names : tuple of str
    dynamics : tuple of Dynamics
        How each answers what moves along it, as `wavequake.control.sampled.channel.recoil`.
    drives : ndarray, shape (M, p)
        How the actuator's positions move along modes.
    put : callable
        Adds positions of the modes (batch, M) to the first instants of a telescope's states.
    """

    names: tuple[str, ...]
    dynamics: tuple[Dynamics, ...]
    drives: Array
    put: Put


@dataclass(frozen=True)
class Answer:
    """Modes in a telescope.

    Attributes
    ----------
    names, dynamics, put
        As of `OwnModes`; None in systems without segments.
    shown : ndarray, shape (K, M)
        What sensors see per mode.
    drives : mapping of str to ndarray, shape (M, p)
        How positions of actuators move along modes; others do not.
    """

    names: tuple[str, ...]
    dynamics: tuple[Dynamics, ...]
    put: Put | None
    shown: Array
    drives: Mapping[str, Array]


def answering(answers: Sequence[Answer], actuators: Sequence[str]) -> tuple[Answer, ...]:
    """Return what answers one of these actuators; all else stays at rest."""
    return tuple(one for one in answers if any(name in one.drives for name in actuators))


def dynamics_of(answers: Sequence[Answer]) -> tuple[Dynamics, ...]:
    """Return the dynamics of all modes, one answer after the other."""
    return tuple(one for each in answers for one in each.dynamics)


def names_of(answers: Sequence[Answer]) -> tuple[str, ...]:
    """Return the names of all modes."""
    return tuple(one for each in answers for one in each.names)


def shown_of(answers: Sequence[Answer], seen: int) -> Array:
    """Return what sensors see of all modes, (K, M), of so many things K that are seen."""
    return np.hstack([np.zeros((seen, 0)), *(one.shown for one in answers)])


def drives_of(answers: Sequence[Answer], actuator: str, channels: int) -> Array:
    """Return how positions of an actuator move along all modes, (M, p)."""
    nothing = [np.zeros((len(one.names), channels)) for one in answers]
    rows = [one.drives.get(actuator, zero) for one, zero in zip(answers, nothing, strict=True)]
    return np.vstack([np.zeros((0, channels)), *rows])


def put_all(answers: Sequence[Answer], states: States, positions: Array) -> None:
    """Add positions of all modes (batch, M) to the first instants of a telescope's states."""
    first = 0
    for one in answers:
        last = first + len(one.names)
        assert one.put is not None
        one.put(states, positions[:, first:last])
        first = last
