"""Loads on one flexible body in large motion: forces and torques at nodes, and gravity. SI units."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from wavequake.errors import UserError
from wavequake.mechanics.model import Array
from wavequake.mechanics.multibody.flexible_body import FlexibleBody

# Takes t in s; returns x, y, z.
History = Callable[[float], Array]


@dataclass(frozen=True)
class NodeForce:
    """A force that acts at a node, wherever its deformation takes it.

    Attributes
    ----------
    point : ndarray, shape (3,)
        Place of the undeformed node in the frame of the body, m.
    shapes : ndarray, shape (3, r)
        Displacements of the node by the shapes of the body.
    force : callable
        Takes t; returns (3,), N.
    follows : bool
        The force turns with the frame of the body (a thruster); else its axes are inertial.
    """

    point: Array
    shapes: Array
    force: History
    follows: bool = False


@dataclass(frozen=True)
class NodeTorque:
    """A torque that acts at a node.

    ``rotations`` (3, r) are those of the node by the shapes of the body, rad; ``torque`` takes t and returns
    (3,), N m; ``follows`` as in `NodeForce`.
    """

    rotations: Array
    torque: History
    follows: bool = False


@dataclass(frozen=True)
class Gravity:
    """Weight of all mass; ``acceleration`` (3,) in m/s^2 and inertial axes."""

    acceleration: Array


Load = NodeForce | NodeTorque | Gravity


def check_loads(body: FlexibleBody, loads: Sequence[Load]) -> None:
    """Refuse loads whose arrays do not fit the body.

    Raises
    ------
    UserError
    """
    for place, load in enumerate(loads):
        if isinstance(load, Gravity):
            _check(place, "acceleration", load.acceleration, (3,))
        elif isinstance(load, NodeTorque):
            _check(place, "rotations", load.rotations, (3, body.order))
            _check_history(place, load.torque)
        else:
            _check_history(place, load.force)
            _check(place, "point", load.point, (3,))
            _check(place, "shapes", load.shapes, (3, body.order))


def _check(place: int, label: str, values: Array, shape: tuple[int, ...]) -> None:
    if np.shape(values) != shape or not np.isfinite(values).all():
        raise UserError(
            f"the {label} of load {place} on the flexible body must be finite and of shape {shape}, not "
            f"{np.shape(values)}"
        )


def _check_history(place: int, history: object) -> None:
    if not callable(history):
        raise UserError(f"the history of load {place} on the flexible body is no function of the time in s")


def generalized(body: FlexibleBody, loads: Sequence[Load], t: float, attitude: Array, q: Array) -> Array:
    """Return the forces on translation and rotation (in body axes) and on the shapes, shape (6 + r,).

    Parameters
    ----------
    attitude : ndarray, shape (3, 3)
        From body to inertial axes.
    q : ndarray, shape (r,)

    Raises
    ------
    UserError
        If a history returns something else than three finite numbers.
    """
    total = np.zeros(6 + body.order)
    for load in loads:
        if isinstance(load, Gravity):
            total += _weight(body, attitude.T @ load.acceleration, q)
            continue
        given = _evaluate(load, t)
        local = given if load.follows else attitude.T @ given
        if isinstance(load, NodeTorque):
            total[3:6] += local
            total[6:] += load.rotations.T @ local
        else:
            total[:3] += local
            total[3:6] += np.cross(load.point + load.shapes @ q, local)
            total[6:] += load.shapes.T @ local
    return total


def _evaluate(load: NodeForce | NodeTorque, t: float) -> Array:
    name, history = ("force", load.force) if isinstance(load, NodeForce) else ("torque", load.torque)
    given = np.asarray(history(t), dtype=np.float64)
    if given.shape != (3,) or not np.isfinite(given).all():
        raise UserError(f"a {name} on the flexible body is {given.tolist()} at {t:g} s; give x, y, z, finite")
    return given


def _weight(body: FlexibleBody, acceleration: Array, q: Array) -> Array:
    """First moments of the mass make the weight of the whole body, its torque and its load on the shapes."""
    moments = body.integrals[0]
    shapes = moments[4:].reshape(-1, 3)
    center = moments[1:4] + q @ shapes
    return np.concatenate([moments[0] * acceleration, np.cross(center, acceleration), shapes @ acceleration])
