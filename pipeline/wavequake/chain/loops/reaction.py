"""What stages do to the bodies that carry them: the mass that they move pushes back. SI units.

A stage moves its load by p against what carries it, so that all that stands moves by q with
``M q'' + D q' + K q = -T' m p''``, where M holds the load at rest, and T is the motion of the load with q.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag

from wavequake.control.linear import Array
from wavequake.control.sampled.channel import Dynamics
from wavequake.mechanics.assembly.plant import Plant
from wavequake.mechanics.vibration.modal import ModalModel

_COUPLED = 1e-12
_NANO = 1e-9


@dataclass(frozen=True)
class Recoil:
    """How a plant answers accelerations of what stands on it: M modes, each of one input and one output.

    Attributes
    ----------
    names : tuple of str
    dynamics : tuple of Dynamics
        Of two states each: what the mode answers to loads ``m p``, as by ``-s^2 / (s^2 + 2 zeta w s + w^2)``.
    outward : ndarray, shape (r + f, M)
        Coordinates of the plant's elastic modes, then of its free motions, per mode.
    inward : ndarray, shape (M, r + f)
        Loads of the modes per load of these coordinates.
    """

    names: tuple[str, ...]
    dynamics: tuple[Dynamics, ...]
    outward: Array
    inward: Array


@dataclass(frozen=True)
class Pushing:
    """Modes of bodies that stages push, in nm and root of kg.

    Attributes
    ----------
    names : tuple of str
    dynamics : tuple of Dynamics
    outputs : ndarray, shape (m, M)
        Of the plant, m and rad, per mode.
    drives : mapping of str to ndarray, shape (M, p)
        Of stages that push.
    """

    names: tuple[str, ...]
    dynamics: tuple[Dynamics, ...]
    outputs: Array
    drives: Mapping[str, Array]


def pushed_by(plant: Plant, loads: Mapping[str, Array]) -> Pushing:
    """Return how a plant answers stages, by loads (r + f, p) of its coordinates per position, times s^2."""
    found = recoil_of(plant)
    return Pushing(
        found.names,
        found.dynamics,
        _NANO * coordinates(plant) @ found.outward,
        {name: found.inward @ load / _NANO for name, load in loads.items()},
    )


def coordinates(plant: Plant) -> Array:
    """Return the rows of a plant's outputs per coordinate of its elastic modes, then of its free motions."""
    return np.hstack([plant.shapes, plant.free])


def recoil_of(plant: Plant) -> Recoil:
    """Return how a plant answers; free motions do so at once, so that the sum of all momenta stays 0."""
    r, f = len(plant.omega), plant.free.shape[1]
    rates = np.diag(plant.modal.damping)
    apart = np.abs(plant.modal.damping - np.diag(rates)).max(initial=0.0)
    names = [f"mode {k + 1} of the bodies" for k in range(r)]
    outward = inward = np.eye(r)
    if apart <= _COUPLED * np.abs(rates).max(initial=0.0):
        dynamics = [_own(w, d) for w, d in zip(plant.omega, rates, strict=True)]
    else:
        names, dynamics, outward, inward = _coupled(plant.modal, names)
    names += [f"free motion {k + 1} of the bodies" for k in range(f)]
    dynamics += [_AT_ONCE] * f
    return Recoil(
        tuple(names), tuple(dynamics), block_diag(outward, np.eye(f)), block_diag(inward, np.eye(f))
    )


# What follows at once, with two states that nothing moves.
_AT_ONCE = Dynamics(-np.eye(2), np.zeros(2), np.zeros(2), -1.0)


def _own(omega: float, rate: float) -> Dynamics:
    """Return -s^2 / (s^2 + rate s + omega^2), with the states q and q' / omega."""
    a = np.array([[0.0, omega], [-omega, -rate]])
    return Dynamics(a, np.array([0.0, omega]), np.array([1.0, rate / omega]), -1.0)


def _coupled(modal: ModalModel, named: Sequence[str]) -> tuple[list[str], list[Dynamics], Array, Array]:
    """Return the same where dampers couple modes: -I - sum of l^2 v w' / (s - l) over all poles l.

    Of l v = a + i b and l w = c + i d a pair makes 2 (b d' - a c') P + 2 (a d' + b c') Q, where P and Q are
    (s - Re l) and Im l over |s - l|^2.
    """
    r, omega = len(modal.squared), np.sqrt(modal.squared)
    # Positions are as large as velocities.
    swing = np.block([[np.zeros((r, r)), np.diag(omega)], [-np.diag(omega), -modal.damping]])
    values, vectors = np.linalg.eig(swing)
    inverse = np.linalg.inv(vectors)
    names, dynamics, outward, inward = list(named), [_AT_ONCE] * r, [*np.eye(r)], [*np.eye(r)]
    for value, vector, left in zip(values, vectors.T, inverse, strict=True):
        if value.imag < 0:
            continue
        v, w = value * vector[:r] / omega, value * left[r:]
        a = np.array([[value.real, value.imag], [-value.imag, value.real]])
        p, q = (Dynamics(a, np.array([0.0, 1.0]), np.array(seen)) for seen in ([0.0, 1.0], [1.0, 0.0]))
        if value.imag > 0:
            parts = [(p, v.real, -2 * w.real), (q, v.real, 2 * w.imag)]
            parts += [(p, v.imag, 2 * w.imag), (q, v.imag, 2 * w.real)]
        else:
            parts = [(p, v.real, -w.real)]
        for one, out, into in parts:
            names.append(f"{abs(value) / (2 * np.pi):.4g} Hz of the bodies")
            dynamics.append(one)
            outward.append(out)
            inward.append(into)
    return names, dynamics, np.array(outward).T, np.array(inward)


def load_mass(mass: float, inertia: Array, away: Array) -> Array:
    """Return forces and moments (6, 6) about a point per acceleration there of a rigid load.

    Parameters
    ----------
    mass : float
        kg.
    inertia : ndarray, shape (3, 3)
        About the center of mass, kg m^2, in the axes of the motion.
    away : ndarray, shape (3,)
        From the point to the center of mass, m, in these axes.
    """
    x, y, z = away
    arm = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    moved = np.block([[np.eye(3), -arm], [np.zeros((3, 3)), np.eye(3)]])
    own = np.zeros((6, 6))
    own[:3, :3], own[3:, 3:] = mass * np.eye(3), inertia
    return np.asarray(moved.T @ own @ moved)
