"""One flexible body in large motion: floating frame of reference with all inertia terms. SI units.

A material point is at r + A (x + Phi q): r and A carry the large motion, q the small linear deformation. This
is the standard floating frame: centrifugal forces soften the linear elasticity and do not stiffen it by the
stress that they cause, unless `drive` is given a centrifugal stiffness.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy  # its parts load when first used
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from wavequake.errors import UserError
from wavequake.mechanics.model import Array
from wavequake.mechanics.multibody.flexible_body import (
    CROSS,
    FlexibleBody,
    mass_matrix,
    position_fields,
    velocity_fields,
)
from wavequake.mechanics.multibody.loads import Load, check_loads, generalized


@dataclass(frozen=True)
class Flight:
    """Motion of a flexible body.

    Attributes
    ----------
    time : ndarray, shape (t,)
    position, velocity : ndarray, shape (t, 3)
        Of the frame's origin, in inertial axes.
    rotation : Rotation
        From body to inertial axes, t of them.
    spin : ndarray, shape (t, 3)
        rad/s in body axes.
    coordinates, rates : ndarray, shape (t, r)
        Of the shapes.
    """

    time: Array
    position: Array
    velocity: Array
    rotation: Rotation
    spin: Array
    coordinates: Array
    rates: Array


# Spin, its rate, and the acceleration of the origin, all in body axes, at one instant.
BaseMotion = Callable[[float], tuple[Array, Array, Array]]


def fly(
    body: FlexibleBody,
    time: Array,
    velocity: Array,
    spin: Array,
    coordinates: Array | None = None,
    rates: Array | None = None,
    loads: Sequence[Load] = (),
    tolerance: float = 1e-11,
) -> Flight:
    """Integrate a free body from given velocities; its frame begins at the origin, axes parallel.

    Parameters
    ----------
    time : ndarray, shape (t,)
        Increasing instants, s.
    velocity, spin : ndarray, shape (3,)
        m/s and rad/s.
    coordinates, rates : ndarray, shape (r,), optional
        Deformation at the start; none if left out.
    loads : sequence of NodeForce, NodeTorque or Gravity, optional
    tolerance : float
        Relative, of the integrator (Dormand-Prince of order 8).

    Raises
    ------
    UserError
        If a rigid motion is among the shapes, the instants do not increase, the start or a load is not finite
        or does not fit, or the motion diverges.
    """
    zero, order = np.zeros(body.order), body.order
    q, dq = (zero if given is None else given for given in (coordinates, rates))
    _check_fit(body, velocity, spin, q, dq)
    _check_inertia(mass_matrix(body, velocity_fields(q)))
    check_loads(body, loads)
    start = np.concatenate([np.zeros(3), [0.0, 0.0, 0.0, 1.0], velocity, spin, q, dq])

    def derivative(t: float, y: Array) -> Array:
        turn, v, w = y[3:7], y[7:10], y[10:13]
        q, dq = y[13 : 13 + order], y[13 + order :]
        attitude = Rotation.from_quat(turn).as_matrix()
        directions = velocity_fields(q)
        load = generalized(body, loads, t, attitude, q)
        load -= _inertial_load(body, directions, w, np.cross(w, v), q, dq)
        load[6:] -= body.stiffness @ q + body.damping @ dq
        accelerated = scipy.linalg.solve(mass_matrix(body, directions), load, assume_a="pos")
        return np.concatenate([attitude @ v, _turning(turn, w), accelerated[:6], dq, accelerated[6:]])

    y = _integrate(derivative, start, time, tolerance, "DOP853")
    rotation = Rotation.from_quat(y[3:7].T)
    return Flight(
        np.asarray(time, dtype=np.float64),
        y[:3].T,
        rotation.apply(y[7:10].T),
        rotation,
        y[10:13].T,
        y[13 : 13 + order].T,
        y[13 + order :].T,
    )


def drive(
    body: FlexibleBody,
    time: Array,
    base: BaseMotion,
    centrifugal_stiffness: Array | None = None,
    loads: Sequence[Load] = (),
    tolerance: float = 1e-10,
) -> tuple[Array, Array]:
    """Integrate the deformation of a body whose frame is moved as told; undeformed and at rest at first.

    The axes of the frame are the inertial ones at the first instant.

    Parameters
    ----------
    time : ndarray, shape (t,)
        Increasing instants, s.
    base : callable
        Takes t; returns spin (3,), its rate (3,) and the acceleration of the origin (3,), in body axes.
    centrifugal_stiffness : ndarray, shape (r, r), optional
        Geometric stiffness by the stress of a unit spin: it counts times the squared spin. Without it spins
        above the body's lowest frequency diverge, as in any standard floating frame.
    loads : sequence of NodeForce, NodeTorque or Gravity, optional

    Returns
    -------
    coordinates, rates : ndarray, shape (t, r)

    Raises
    ------
    UserError
        If the instants do not increase, a load is not finite or does not fit, or the deformation diverges.
    """
    order = body.order
    stress = np.zeros((order, order)) if centrifugal_stiffness is None else centrifugal_stiffness
    inertia = mass_matrix(body, velocity_fields(np.zeros(order)))[6:, 6:]
    _check_inertia(inertia)
    inverse = np.linalg.inv(inertia)
    check_loads(body, loads)

    def derivative(t: float, y: Array) -> Array:
        q, dq, turn = y[:order], y[order : 2 * order], y[2 * order :]
        spin, spin_rate, acceleration = base(t)
        directions = velocity_fields(q)
        load = -_inertial_load(body, directions, spin, acceleration, q, dq, spin_rate)[6:]
        load -= (body.stiffness + (spin @ spin) * stress) @ q + body.damping @ dq
        if loads:
            load += generalized(body, loads, t, Rotation.from_quat(turn).as_matrix(), q)[6:]
        return np.concatenate([dq, inverse @ load, _turning(turn, spin)])

    # Damped stiff shapes (the length of a beam) ask for an implicit method, which LSODA turns to by itself.
    y = _integrate(derivative, np.append(np.zeros(2 * order + 3), 1.0), time, tolerance, "LSODA")
    return y[:order].T, y[order : 2 * order].T


def energy(body: FlexibleBody, flight: Flight) -> Array:
    """Return kinetic plus strain energy, J, shape (t,)."""
    found = []
    local = flight.rotation.inv().apply(flight.velocity)
    for v, w, q, dq in zip(local, flight.spin, flight.coordinates, flight.rates, strict=True):
        speed = np.concatenate([v, w, dq])
        found.append(
            0.5 * speed @ mass_matrix(body, velocity_fields(q)) @ speed + 0.5 * q @ body.stiffness @ q
        )
    return np.array(found)


def momentum(body: FlexibleBody, flight: Flight) -> tuple[Array, Array]:
    """Return linear (N s) and angular momentum about the inertial origin (N m s), each (t, 3)."""
    found = []
    local = flight.rotation.inv().apply(flight.velocity)
    for v, w, q, dq in zip(local, flight.spin, flight.coordinates, flight.rates, strict=True):
        found.append(mass_matrix(body, velocity_fields(q))[:6] @ np.concatenate([v, w, dq]))
    linear, angular = (flight.rotation.apply(part) for part in np.split(np.array(found), 2, axis=1))
    return linear, angular + np.cross(flight.position, linear)


def positions(flight: Flight, points: Array, shapes: Array) -> Array:
    """Return where nodes (N, 3) with shapes (N, 3, r) are in inertial axes, m, (t, N, 3)."""
    local = points + np.einsum("kdj,tj->tkd", shapes, flight.coordinates)
    turned: Array = np.einsum("tij,tkj->tki", flight.rotation.as_matrix(), local)
    return flight.position[:, None] + turned


def _turning(turn: Array, spin: Array) -> Array:
    """Rate of the quaternion (x, y, z, w) of a frame with a spin in its own axes."""
    return 0.5 * np.append(turn[3] * spin + np.cross(turn[:3], spin), -turn[:3] @ spin)


def _check_fit(body: FlexibleBody, *start: Array) -> None:
    shapes = [np.shape(part) for part in start]
    if shapes != [(3,), (3,), (body.order,), (body.order,)]:
        raise UserError(
            f"the start of a flexible body of {body.order} shapes needs a velocity and a spin of 3 numbers "
            f"and as many coordinates and rates as shapes, not {', '.join(map(str, shapes))}"
        )


def _check_inertia(matrix: Array) -> None:
    size = 1 / np.sqrt(np.maximum(np.diag(matrix), np.finfo(float).tiny))
    if scipy.linalg.eigvalsh(matrix * np.outer(size, size)).min(initial=1.0) < 1e-12:
        raise UserError(
            "the shapes of the flexible body contain a rigid motion or repeat each other, or its mass lies "
            "in one line; take elastic modes of a free body"
        )


def _inertial_load(
    body: FlexibleBody,
    directions: Array,
    spin: Array,
    origin: Array,
    q: Array,
    dq: Array,
    spin_rate: Array | None = None,
) -> Array:
    """H of Eq. 2.11 (6 + r): the inertia of what accelerates without second derivatives of coordinates."""
    turn = spin @ CROSS.transpose(1, 2, 0).reshape(3, 9)
    place, across = position_fields(q), turn.reshape(3, 3)
    onto = across @ across
    if spin_rate is not None:
        onto = onto + (spin_rate @ CROSS.transpose(1, 2, 0).reshape(3, 9)).reshape(3, 3)
    fields = place @ onto
    fields[4:] += 2 * np.kron(dq[:, None], across)
    fields[0] += origin
    result: Array = np.sum((body.integrals @ fields).T[:, None] @ directions, axis=0)[0]
    return result


def _integrate(
    derivative: Callable[[float, Array], Array], start: Array, time: Array, tolerance: float, method: str
) -> NDArray[np.float64]:
    time = np.asarray(time, dtype=np.float64)
    if time.ndim != 1 or len(time) < 2 or not (np.diff(time) > 0).all() or not np.isfinite(time).all():
        raise UserError("the motion of a flexible body needs at least two increasing instants")
    if not np.isfinite(start).all():
        raise UserError("the start of a flexible body's motion has values that are not finite")
    limit = 1e9 * (1.0 + np.abs(start).max())

    def diverged(_: float, y: Array) -> float:
        return float(limit - np.abs(y).max())

    diverged.terminal = True  # type: ignore[attr-defined]
    found = solve_ivp(
        derivative,
        (time[0], time[-1]),
        start,
        method=method,
        t_eval=time,
        rtol=tolerance,
        atol=1e-3 * tolerance,
        events=diverged,
    )
    if found.status != 0:
        raise UserError(
            f"the motion of the flexible body diverges near {found.t[-1] if len(found.t) else time[0]:g} s; "
            "linear elasticity in a floating frame does so above a critical spin (give a "
            "centrifugal_stiffness)"
        )
    result: Array = found.y
    return result
