"""Small motion about a steady rotation of a flexible body: where gyroscopic forces come from. SI units.

In axes that turn steadily with the spin W, the frame of the body is displaced by xi and turned by a small
theta, and a material point is at p = xi + E(theta) (x + Phi q). The quadratic terms of its kinetic energy
|p' + W x p|^2 / 2, integrated over the mass, make the inertia, the Coriolis and the centrifugal forces.
"""

import numpy as np

from wavequake.errors import UserError
from wavequake.mechanics.model import Array, ReducedModel
from wavequake.mechanics.multibody.flexible_body import (
    CROSS,
    FlexibleBody,
    mass_matrix,
    position_fields,
    velocity_fields,
)
from wavequake.mechanics.multibody.linear_system import LinearSystem, linear_system

_BALANCE = 1e-6


def steady_deformation(body: FlexibleBody, spin: Array, centrifugal_stiffness: Array | None = None) -> Array:
    """Return the coordinates (r,) under the centrifugal forces of a steady spin (3,) in rad/s.

    ``centrifugal_stiffness`` (r, r) is the geometric stiffness by the stress of a unit spin, as in `drive`.

    Raises
    ------
    UserError
        If the spin is so fast that no deformation balances it.
    """
    onto = _onto(spin)
    count = body.order
    blocks = body.integrals[4:, 4:].reshape(count, 3, count, 3)
    # Softening by the centrifugal forces, in the form p . W x (W x p): negative.
    softening = np.einsum("jalc,ca->jl", blocks, onto)
    load = np.einsum("jac,ca->j", body.integrals[4:, 1:4].reshape(count, 3, 3), onto)
    stiffness = _stiffness(body, spin, centrifugal_stiffness) + softening
    if count and np.linalg.eigvalsh(0.5 * (stiffness + stiffness.T))[0] <= 0:
        raise UserError(
            f"at a spin of {np.linalg.norm(spin):g} rad/s centrifugal forces exceed the stiffness of the "
            "flexible body; spin it more slowly, or give a centrifugal_stiffness"
        )
    deformation: Array = -np.linalg.solve(stiffness, load)
    return deformation


def steady_rotation(
    body: FlexibleBody,
    spin: Array,
    points: Array,
    shapes: Array,
    *,
    clamped: bool = False,
    centrifugal_stiffness: Array | None = None,
    name: str = "rotor",
) -> LinearSystem:
    """Linearize a body about a steady spin, in axes that turn with it.

    Links and joints that `assemble_system` adds turn with the body too: those to the ground have to be alike
    in all directions across the spin W, and a damper d at rest is a `Bearing` of damping d, stiffness d W x.

    Parameters
    ----------
    body : FlexibleBody
    spin : ndarray, shape (3,)
        rad/s, about an axis through the origin of the body's frame.
    points : ndarray, shape (k, 3)
        Undeformed interface nodes, m; their displacements are also the surface of the model.
    shapes : ndarray, shape (k, 3, r)
        Displacements of these nodes by the shapes.
    clamped : bool
        The frame is driven and cannot yield (a blade on a stiff hub): coordinates are the shapes alone.
    centrifugal_stiffness : ndarray, shape (r, r), optional
        Geometric stiffness by the stress of a unit spin; it counts times the squared spin.

    Returns
    -------
    LinearSystem
        Coordinates are displacements and rotations of the frame (six, unless clamped), then those of the
        shapes, relative to the steady state.

    Raises
    ------
    UserError
        If arrays do not fit or are not finite, the spin exceeds the stiffness, or a body that is not clamped
        is not balanced: the axis of the spin has to be a principal axis through its center of mass.
    """
    spin = np.asarray(spin, dtype=np.float64)
    points, shapes = np.asarray(points, dtype=np.float64), np.asarray(shapes, dtype=np.float64)
    _check(body, spin, points, shapes)
    q = steady_deformation(body, spin, centrifugal_stiffness)
    velocities, place, onto = velocity_fields(q), position_fields(q), _onto(spin)
    carried = np.einsum("ijk,j,kfz->ifz", CROSS, spin, velocities)
    gyroscopic = 2 * np.sum(velocities.transpose(0, 2, 1) @ (body.integrals @ carried), axis=0)
    stiffness = -np.sum(carried.transpose(0, 2, 1) @ (body.integrals @ carried), axis=0)
    stiffness[6:, 6:] += _stiffness(body, spin, centrifugal_stiffness)
    # Second-order displacements in the field of centripetal accelerations.
    pull = body.integrals @ (place @ onto)
    moment = place.T @ pull
    stiffness[3:6, 3:6] += 0.5 * (moment + moment.T) - np.trace(moment) * np.eye(3)
    across = np.einsum("iac,jac->ij", CROSS, pull[4:].reshape(-1, 3, 3))
    stiffness[3:6, 6:] += across
    stiffness[6:, 3:6] += across.T
    if not clamped:
        _check_balance(body, spin, pull[0], moment)
    kept = slice(6, None) if clamped else slice(None)
    deformed = points + shapes @ q
    nodes = np.concatenate(
        [
            np.broadcast_to(np.eye(3), (len(points), 3, 3)),
            -np.einsum("ijk,nj->nik", CROSS, deformed),
            shapes,
        ],
        axis=2,
    )
    rows = nodes.reshape(3 * len(points), 6 + body.order)[:, kept]
    damping = np.zeros_like(stiffness)
    damping[6:, 6:] = body.damping
    places = np.arange(len(points))
    model = ReducedModel(
        name=name,
        method="steady rotation",
        mass=mass_matrix(body, velocities)[kept, kept],
        stiffness=stiffness[kept, kept],
        damping_matrix=damping[kept, kept],
        inputs=rows.T.copy(),
        surface=rows,
        nodes=points,
        interfaces=places,
        surface_nodes=places,
        surface_weights=np.full(len(points), 1 / max(len(points), 1)),
        seconds=0.0,
    )
    return linear_system(model, gyroscopic[kept, kept])


def _onto(spin: Array) -> Array:
    """Matrix whose product with p is W x (W x p); symmetric."""
    result: Array = np.outer(spin, spin) - (spin @ spin) * np.eye(3)
    return result


def _stiffness(body: FlexibleBody, spin: Array, centrifugal_stiffness: Array | None) -> Array:
    if centrifugal_stiffness is None:
        return body.stiffness
    if (
        np.shape(centrifugal_stiffness) != body.stiffness.shape
        or not np.isfinite(centrifugal_stiffness).all()
    ):
        raise UserError(
            f"the centrifugal stiffness must be finite and of shape {body.stiffness.shape}, not "
            f"{np.shape(centrifugal_stiffness)}"
        )
    return body.stiffness + (spin @ spin) * centrifugal_stiffness


def _check(body: FlexibleBody, spin: Array, points: Array, shapes: Array) -> None:
    count = len(points)
    if spin.shape != (3,) or points.shape != (count, 3) or shapes.shape != (count, 3, body.order):
        raise UserError(
            f"spin {spin.shape}, points {points.shape} and shapes {shapes.shape} of a steady rotation do not "
            f"fit; they are (3,), (k, 3) and (k, 3, {body.order})"
        )
    if not (np.isfinite(spin).all() and np.isfinite(points).all() and np.isfinite(shapes).all()):
        raise UserError("spin, points and shapes of a steady rotation must be finite")


def _check_balance(body: FlexibleBody, spin: Array, force: Array, moment: Array) -> None:
    mass = float(body.integrals[0, 0])
    size = float(np.sqrt(np.trace(body.integrals[1:4, 1:4]) / mass))
    rate = float(spin @ spin)
    torque = np.einsum("iac,ac->i", CROSS, moment)
    if (
        np.abs(force).max() > _BALANCE * mass * size * rate
        or np.abs(torque).max() > _BALANCE * mass * size**2 * rate
    ):
        raise UserError(
            "the spinning body is not balanced: its spin has to be about a principal axis through the center "
            "of mass; place the frame there, or choose clamped=True for a body on a driven hub"
        )
