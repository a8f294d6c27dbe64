"""One flexible body in large motion: floating frame of reference with all inertia terms. SI units.

A material point is at r + A (x + Phi q): r and A carry the large motion, q the small linear deformation.
Finite elements interpolate positions as they interpolate displacements, so sums over nodes are the exact
integrals over the mass, and all inertia terms (centrifugal, Coriolis, gyroscopic, changing inertia) follow
from one matrix of them. This is the standard floating frame: centrifugal forces soften the linear elasticity
and do not stiffen it by the stress that they cause, unless `drive` is given a centrifugal stiffness.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from wavequake.errors import UserError
from wavequake.mechanics.model import Array, FiniteElementModel

# Cross product of unit vectors: (a x b)_i = _CROSS[i, j, k] a_j b_k.
_CROSS = np.zeros((3, 3, 3))
_CROSS[[0, 1, 2], [1, 2, 0], [2, 0, 1]] = 1.0
_CROSS[[0, 1, 2], [2, 0, 1], [1, 2, 0]] = -1.0


@dataclass(frozen=True)
class FlexibleBody:
    """Mass integrals and elasticity of one body in its own frame.

    Attributes
    ----------
    integrals : ndarray, shape (4 + 3 r, 4 + 3 r)
        Integrals over the mass of products of 1, x, y, z and the x, y, z parts of each shape.
    stiffness, damping : ndarray, shape (r, r)
        Of the shapes, N/m and N s/m per unit of the coordinates.
    """

    integrals: Array
    stiffness: Array
    damping: Array

    @property
    def order(self) -> int:
        """Number r of shapes."""
        return len(self.stiffness)


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


def flexible_body(
    points: Array, mass: Any, shapes: Array, stiffness: Array, damping: Array | None = None
) -> FlexibleBody:
    """Return the body that nodes, their mass and shapes of deformation make.

    Parameters
    ----------
    points : ndarray, shape (N, 3)
        m, in the frame of the body.
    mass : ndarray or sparse array, shape (N, N)
        Mass between nodes, kg, the same in every direction.
    shapes : ndarray, shape (N, 3, r)
        Displacements of the nodes; for `fly`, no combination of them may be a rigid motion. Modes (orthogonal
        in mass and stiffness) integrate fastest and most exactly.
    stiffness, damping : ndarray, shape (r, r)
        No damping if left out.

    Raises
    ------
    UserError
        If the shapes do not fit the points, or a number is not finite.
    """
    count, order = len(points), shapes.shape[-1]
    zero = np.zeros((order, order))
    body_stiffness = np.asarray(stiffness, dtype=np.float64)
    if points.shape != (count, 3) or shapes.shape != (count, 3, order) or body_stiffness.shape != zero.shape:
        raise UserError(
            f"points {points.shape}, shapes {shapes.shape} and stiffness {body_stiffness.shape} of a "
            "flexible body do not fit; they are (N, 3), (N, 3, r) and (r, r)"
        )
    fields = np.concatenate(
        [np.ones((count, 1)), points, shapes.transpose(0, 2, 1).reshape(count, -1)], axis=1
    )
    integrals = fields.T @ np.asarray(mass @ fields)
    if not (np.isfinite(integrals).all() and np.isfinite(body_stiffness).all()):
        raise UserError("a flexible body has values that are not finite")
    rates = zero if damping is None else damping
    return FlexibleBody(0.5 * (integrals + integrals.T), body_stiffness, rates)


def from_model(model: FiniteElementModel, shapes: Array) -> FlexibleBody:
    """Return the flexible body of a finite-element model and some displacement shapes.

    Parameters
    ----------
    model : FiniteElementModel
        Free in all directions at every node that has mass.
    shapes : ndarray, shape (n, r)
        Elastic modes, for example; columns over the degrees of freedom.
    """
    places = [np.flatnonzero(model.dof_direction == direction) for direction in range(3)]
    nodes = model.dof_node[places[0]]
    if any(not np.array_equal(model.dof_node[place], nodes) for place in places):
        raise UserError(f"the model {model.name} is held somewhere; a floating frame needs a free body")
    masses = [model.mass[place][:, place] for place in places]
    if any(abs(other - masses[0]).max() > 1e-9 * abs(masses[0]).max() for other in masses[1:]):
        raise UserError(f"the mass of the model {model.name} differs between x, y and z")
    moved = np.stack([shapes[place] for place in places], axis=1)
    return flexible_body(
        model.nodes[nodes],
        masses[0],
        moved,
        shapes.T @ (model.stiffness @ shapes),
        shapes.T @ (model.damping_matrix @ shapes),
    )


def fly(
    body: FlexibleBody,
    time: Array,
    velocity: Array,
    spin: Array,
    coordinates: Array | None = None,
    rates: Array | None = None,
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
    tolerance : float
        Relative, of the integrator (Dormand-Prince of order 8).

    Raises
    ------
    UserError
        If a rigid motion is among the shapes, the instants do not increase, the start is not finite, or the
        motion diverges.
    """
    zero, order = np.zeros(body.order), body.order
    q, dq = (zero if given is None else given for given in (coordinates, rates))
    _check_inertia(_inertia(body, _directions(q)))
    start = np.concatenate([np.zeros(3), [0.0, 0.0, 0.0, 1.0], velocity, spin, q, dq])

    def derivative(_: float, y: Array) -> Array:
        turn, v, w = y[3:7], y[7:10], y[10:13]
        q, dq = y[13 : 13 + order], y[13 + order :]
        directions = _directions(q)
        load = -_inertial_load(body, directions, w, np.cross(w, v), q, dq)
        load[6:] -= body.stiffness @ q + body.damping @ dq
        accelerated = scipy.linalg.solve(_inertia(body, directions), load, assume_a="pos")
        half = 0.5 * np.append(turn[3] * w + np.cross(turn[:3], w), -turn[:3] @ w)
        return np.concatenate([Rotation.from_quat(turn).apply(v), half, accelerated[:6], dq, accelerated[6:]])

    y = _integrate(derivative, start, time, tolerance, "DOP853")
    rotation = Rotation.from_quat(y[3:7].T)
    return Flight(
        time,
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
    tolerance: float = 1e-10,
) -> tuple[Array, Array]:
    """Integrate the deformation of a body whose frame is moved as told; undeformed and at rest at first.

    Parameters
    ----------
    time : ndarray, shape (t,)
        Increasing instants, s.
    base : callable
        Takes t; returns spin (3,), its rate (3,) and the acceleration of the origin (3,), in body axes.
    centrifugal_stiffness : ndarray, shape (r, r), optional
        Geometric stiffness by the stress of a unit spin: it counts times the squared spin. Without it spins
        above the body's lowest frequency diverge, as in any standard floating frame.

    Returns
    -------
    coordinates, rates : ndarray, shape (t, r)

    Raises
    ------
    UserError
        If the instants do not increase, or the deformation diverges.
    """
    order = body.order
    stress = np.zeros((order, order)) if centrifugal_stiffness is None else centrifugal_stiffness
    inertia = _inertia(body, _directions(np.zeros(order)))[6:, 6:]
    _check_inertia(inertia)
    inverse = np.linalg.inv(inertia)

    def derivative(t: float, y: Array) -> Array:
        q, dq = y[:order], y[order:]
        spin, spin_rate, acceleration = base(t)
        directions = _directions(q)
        load = -_inertial_load(body, directions, spin, acceleration, q, dq, spin_rate)[6:]
        load -= (body.stiffness + (spin @ spin) * stress) @ q + body.damping @ dq
        return np.concatenate([dq, inverse @ load])

    # Damped stiff shapes (the length of a beam) ask for an implicit method, which LSODA turns to by itself.
    y = _integrate(derivative, np.zeros(2 * order), time, tolerance, "LSODA")
    return y[:order].T, y[order:].T


def energy(body: FlexibleBody, flight: Flight) -> Array:
    """Return kinetic plus strain energy, J, shape (t,)."""
    found = []
    local = flight.rotation.inv().apply(flight.velocity)
    for v, w, q, dq in zip(local, flight.spin, flight.coordinates, flight.rates, strict=True):
        speed = np.concatenate([v, w, dq])
        found.append(0.5 * speed @ _inertia(body, _directions(q)) @ speed + 0.5 * q @ body.stiffness @ q)
    return np.array(found)


def momentum(body: FlexibleBody, flight: Flight) -> tuple[Array, Array]:
    """Return linear (N s) and angular momentum about the inertial origin (N m s), each (t, 3)."""
    found = []
    local = flight.rotation.inv().apply(flight.velocity)
    for v, w, q, dq in zip(local, flight.spin, flight.coordinates, flight.rates, strict=True):
        found.append(_inertia(body, _directions(q))[:6] @ np.concatenate([v, w, dq]))
    linear, angular = (flight.rotation.apply(part) for part in np.split(np.array(found), 2, axis=1))
    return linear, angular + np.cross(flight.position, linear)


def positions(flight: Flight, points: Array, shapes: Array) -> Array:
    """Return where nodes (N, 3) with shapes (N, 3, r) are in inertial axes, m, (t, N, 3)."""
    local = points + np.einsum("kdj,tj->tkd", shapes, flight.coordinates)
    turned: Array = np.einsum("tij,tkj->tki", flight.rotation.as_matrix(), local)
    return flight.position[:, None] + turned


def _place(q: Array) -> Array:
    """Fields (4 + 3 r, 3) whose combination is the deformed position in body axes."""
    return np.vstack([np.zeros(3), np.eye(3), np.kron(q[:, None], np.eye(3))])


def _directions(q: Array) -> Array:
    """Velocity fields (3, 4 + 3 r, 6 + r): x, y, z parts of unit translations, spins and shape rates."""
    order = len(q)
    directions = np.zeros((3, 4 + 3 * order, 6 + order))
    here, shape = np.arange(3), np.arange(order)
    directions[here, 0, here] = 1.0
    directions[:, :, 3:6] = np.einsum("ijk,fk->ifj", _CROSS, _place(q))
    for axis in range(3):
        directions[axis, 4 + 3 * shape + axis, 6 + shape] = 1.0
    return directions


def _inertia(body: FlexibleBody, directions: Array) -> Array:
    """Mass matrix (6 + r, 6 + r) of Störkle 2018, Eq. 2.11."""
    result: Array = np.sum(directions.transpose(0, 2, 1) @ (body.integrals @ directions), axis=0)
    return result


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
    turn = spin @ _CROSS.transpose(1, 2, 0).reshape(3, 9)
    place, across = _place(q), turn.reshape(3, 3)
    onto = across @ across
    if spin_rate is not None:
        onto = onto + (spin_rate @ _CROSS.transpose(1, 2, 0).reshape(3, 9)).reshape(3, 3)
    fields = place @ onto
    fields[4:] += 2 * np.kron(dq[:, None], across)
    fields[0] += origin
    result: Array = np.sum((body.integrals @ fields).T[:, None] @ directions, axis=0)[0]
    return result


def _integrate(
    derivative: Callable[[float, Array], Array], start: Array, time: Array, tolerance: float, method: str
) -> NDArray[np.float64]:
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
