"""A flexible body under forces, torques and gravity in large motion against closed forms."""

import numpy as np
import pytest
import scipy.special
from scipy.integrate import cumulative_simpson
from test_nonlinear import WEIGHTS, tower
from truss import truss

from wavequake.errors import UserError
from wavequake.mechanics.multibody.flexible_body import flexible_body
from wavequake.mechanics.multibody.floating_frame import floating_frame
from wavequake.mechanics.multibody.loads import Gravity, NodeForce, NodeTorque
from wavequake.mechanics.multibody.nonlinear import drive, energy, fly, momentum, positions
from wavequake.mechanics.vibration.drive import Drive
from wavequake.mechanics.vibration.modal import modal_model
from wavequake.mechanics.vibration.response import displacements, respond

TIME = np.linspace(0, 0.4, 41)
STILL = np.zeros(3)
SPIN = np.array([2.0, 3.0, -1.0])
PUSH = np.array([3.0, -5.0, 8.0])


def at(node, points, shapes, force, follows=False):
    return NodeForce(points[node], shapes[node], force, follows)


def body_and_nodes(count=4, shift=(0.1, 0.2, 0.3)):
    return tower(shift, count=count)


def center(flight, points, shapes):
    return WEIGHTS @ positions(flight, points, shapes) / WEIGHTS.sum()


def test_a_constant_force_moves_the_center_of_mass_on_a_parabola():
    """However the body tumbles and vibrates."""
    body, points, shapes = body_and_nodes()
    start = np.array([0.1, 0.2, -0.3])
    flight = fly(body, TIME, start, SPIN, loads=[at(2, points, shapes, lambda t: PUSH)])
    middle = center(flight, points, shapes)
    speed = momentum(body, flight)[0][0] / WEIGHTS.sum()
    wanted = middle[0] + np.outer(TIME, speed) + np.outer(0.5 * TIME**2, PUSH) / WEIGHTS.sum()
    np.testing.assert_allclose(middle, wanted, rtol=0, atol=1e-9)
    assert np.abs(flight.coordinates).max() > 1e-3
    assert np.abs(flight.rotation.as_rotvec()).max() > 1.0


@pytest.mark.parametrize("follows", [False, True])
def test_momentum_gains_the_impulse_and_energy_the_work(follows):
    body, points, shapes = body_and_nodes()

    def force(t):
        return PUSH * np.sin(40.0 * t) + np.array([2.0, 0, 0])

    time = np.linspace(0, 0.4, 801)
    flight = fly(body, time, STILL, SPIN, loads=[at(3, points, shapes, force, follows)])
    given = np.array([force(t) for t in time])
    given = flight.rotation.apply(given) if follows else given
    where = positions(flight, points[3:4], shapes[3:4])[:, 0]
    speed = np.gradient(where, time, axis=0, edge_order=2)
    linear, angular = momentum(body, flight)
    impulse = cumulative_simpson(given, x=time, axis=0, initial=0)
    twist = cumulative_simpson(np.cross(where, given), x=time, axis=0, initial=0)
    work = cumulative_simpson(np.sum(given * speed, axis=1), x=time, initial=0)
    np.testing.assert_allclose(linear - linear[0], impulse, rtol=0, atol=1e-7)
    np.testing.assert_allclose(angular - angular[0], twist, rtol=0, atol=1e-7)
    total = energy(body, flight)
    np.testing.assert_allclose(total - total[0], work, rtol=0, atol=2e-4 * np.ptp(total))


def test_a_torque_feeds_angular_momentum_alone():
    """Rotations of the node by the shapes are those of a rigid plate of three nodes nearby."""
    body, points, shapes = body_and_nodes()
    arms = points[:3] - points[:3].mean(axis=0)
    cross = np.concatenate([-np.cross(np.eye(3), arm) for arm in arms])
    rotations = np.linalg.lstsq(cross, shapes[:3].reshape(9, -1) - np.tile(shapes[:3].mean(0), (3, 1)))[0]
    torque = np.array([0.3, 0.8, -0.5])
    flight = fly(body, TIME, STILL, SPIN, loads=[NodeTorque(rotations, lambda t: torque)])
    linear, angular = momentum(body, flight)
    np.testing.assert_allclose(linear, np.broadcast_to(linear[0], linear.shape), rtol=0, atol=1e-9)
    np.testing.assert_allclose(angular, angular[0] + np.outer(TIME, torque), rtol=0, atol=1e-9)


def test_a_torque_is_a_pair_of_forces():
    """Equal and opposite forces at two nodes whose difference is the rotation of a bar between them."""
    body, points, shapes = body_and_nodes()
    bar, pull = points[1] - points[0], np.array([0.0, 2.0, 0.0])
    pair = [at(1, points, shapes, lambda t: pull, True), at(0, points, shapes, lambda t: -pull, True)]
    flight = fly(body, TIME, STILL, SPIN, loads=pair)
    # The bar along x turns about z by (u_y1 - u_y0) / length; its stretch is not in the load.
    length = bar[0]
    turn = np.zeros_like(shapes[0])
    turn[2] = (shapes[1][1] - shapes[0][1]) / length
    linear = momentum(body, flight)[0]
    np.testing.assert_allclose(linear, np.broadcast_to(linear[0], linear.shape), rtol=0, atol=1e-9)
    other = fly(
        body, TIME, STILL, SPIN, loads=[NodeTorque(turn, lambda t: np.array([0, 0, 2.0 * length]), True)]
    )
    # Exact where bar and axes agree; the deformed arm differs in second order.
    np.testing.assert_allclose(bar, [length, 0, 0], rtol=0, atol=1e-12)
    assert np.abs(flight.spin - other.spin).max() < 0.02 * np.abs(other.spin - SPIN).max()


def test_a_body_in_free_fall_feels_nothing():
    body, points, shapes = body_and_nodes()
    gravity = np.array([1.0, -9.8, 0.5])
    rates = np.array([0.3, 1.0, -0.8, 0.5])
    weightless = fly(body, TIME, STILL, SPIN, rates=rates)
    falling = fly(body, TIME, STILL, SPIN, rates=rates, loads=[Gravity(gravity)])
    np.testing.assert_allclose(falling.coordinates, weightless.coordinates, rtol=0, atol=1e-9)
    np.testing.assert_allclose(falling.spin, weightless.spin, rtol=0, atol=1e-8)
    fallen = positions(falling, points, shapes) - positions(weightless, points, shapes)
    np.testing.assert_allclose(
        fallen, np.broadcast_to(np.outer(0.5 * TIME**2, gravity)[:, None], fallen.shape), rtol=0, atol=1e-8
    )


def test_small_forces_tend_to_the_linear_response_with_order_two():
    model = truss(stiffness=2e3, damping=0.0)
    modal, frame = modal_model(model), floating_frame(model)
    body, points, shapes = tower()
    time, errors = np.linspace(0, 0.1, 101), []
    push = np.zeros((101, 9))
    push[:, 2], push[:, 4] = 2.0 * time / time[-1], 0.7
    linear = displacements(
        respond(modal, [Drive(np.zeros(9, dtype=bool), samples=push)], time), model.surface
    )[0].reshape(101, 6, 3)
    assert frame.mass == pytest.approx(WEIGHTS.sum())
    for size in (1.0, 0.1):
        loads = [
            at(0, points, shapes, lambda t, size=size: size * np.array([0, 0, 2.0 * t / 0.1])),
            at(1, points, shapes, lambda t, size=size: size * np.array([0, 0.7, 0])),
        ]
        moved = positions(fly(body, time, STILL, STILL, loads=loads), points, shapes) - points
        errors.append(np.abs(moved - size * linear).max())
    assert errors[0] / errors[1] == pytest.approx(100.0, rel=0.05)
    assert errors[1] < 1e-2 * np.abs(0.1 * linear).max()


def pendulum(mass=2.0, stiffness=900.0, arm=0.5):
    """A mass on a spring across an arm that turns in the vertical plane: one shape, tangential."""
    points = np.array([[arm, 0, 0], [0.1, 0.1, 0], [-0.1, 0, 0.1]])
    shapes = np.zeros((3, 3, 1))
    shapes[0, 1, 0] = 1.0
    return flexible_body(points, np.diag([mass, 1.0, 1.0]), shapes, np.array([[stiffness]])), points, shapes


def test_gravity_on_a_driven_arm_is_a_resonator_under_a_sine():
    """The arm turns at W: q'' + (k / m - W^2) q = -g cos(W t) from rest."""
    body, *_ = pendulum()
    spin, g, time = 4.0, 9.81, np.linspace(0, 3, 151)
    motion = (np.array([0, 0, spin]), STILL, STILL)
    q, dq = drive(body, time, lambda t: motion, loads=[Gravity(np.array([0, -g, 0]))])
    square = 900.0 / 2.0 - spin**2
    size = -g / (square - spin**2)
    wanted = size * (np.cos(spin * time) - np.cos(np.sqrt(square) * time))
    np.testing.assert_allclose(q[:, 0], wanted, rtol=0, atol=1e-8)
    assert np.abs(dq).max() > 0.1


def test_a_lifted_frame_and_gravity_are_one():
    """Equivalence: gravity on a turning arm is an acceleration of its base the other way."""
    body, *_ = pendulum()
    spin, g, time = 4.0, 9.81, np.linspace(0, 1, 21)

    def lifted(t):
        up = g * np.array([np.sin(spin * t), np.cos(spin * t), 0])
        return np.array([0, 0, spin]), STILL, up

    fixed = (np.array([0, 0, spin]), STILL, STILL)
    first = drive(body, time, lifted)[0]
    second = drive(body, time, lambda t: fixed, loads=[Gravity(np.array([0, -g, 0]))])[0]
    np.testing.assert_allclose(first, second, rtol=0, atol=1e-8)


def test_a_hanging_bar_swings_as_a_pendulum_through_large_angles():
    """A constant force bears masses M above and m below: theta'' = -(g / l) (1 + m / M) sin theta."""
    length, g, top, below = 0.8, 9.81, 5.0, 1.0
    points = np.array([[0, 0, 0], [0, -length, 0], [0, 0, 1e-2], [0, 0, -1e-2]])
    shapes = np.zeros((4, 3, 0))
    body = flexible_body(points, np.diag([top - 2e-2, below, 1e-2, 1e-2]), shapes, np.zeros((0, 0)))
    rate = np.sqrt(g / length * (1 + below / top))
    modulus = 0.8
    spin = 2 * rate * modulus
    hold = NodeForce(points[0], shapes[0], lambda t: np.array([0, (top + below) * g, 0]))
    still = np.array([-spin * length * below / (top + below), 0, 0])
    time = np.linspace(0, 2, 41)
    weight = Gravity(np.array([0, -g, 0]))
    flight = fly(body, time, still, np.array([0, 0, spin]), loads=[weight, hold])
    wanted = 2 * np.arcsin(modulus * scipy.special.ellipj(rate * time, modulus**2)[0])
    np.testing.assert_allclose(flight.rotation.as_rotvec()[:, 2], wanted, rtol=0, atol=1e-8)
    assert np.abs(wanted).max() > 1.8


@pytest.mark.parametrize(
    ("load", "match"),
    [
        (NodeForce(STILL[:2], np.zeros((3, 4)), lambda t: PUSH), "point of load 0"),
        (NodeForce(STILL, np.zeros((3, 3)), lambda t: PUSH), r"shapes of load 0.*of shape \(3, 4\)"),
        (
            NodeForce(STILL, np.zeros((3, 4)), lambda t: PUSH[:2]),
            r"a force.*is \[3.0, -5.0\]",
        ),
        (NodeForce(STILL, np.zeros((3, 4)), lambda t: PUSH * np.nan), "give x, y, z, finite"),
        (NodeTorque(np.zeros((4, 3)), lambda t: PUSH), "rotations of load 0"),
        (NodeTorque(np.zeros((3, 4)), lambda t: PUSH / 0.0), "a torque on the flexible body"),
        (NodeTorque(np.zeros((3, 4)), PUSH), "history of load 0 on the flexible body is no function"),
        (Gravity(np.array([0, np.inf, 0])), "acceleration of load 0"),
    ],
)
@pytest.mark.filterwarnings("ignore:divide")
def test_bad_loads_are_refused(load, match):
    body, *_ = body_and_nodes()
    with pytest.raises(UserError, match=match):
        fly(body, TIME, STILL, SPIN, loads=[load])
    with pytest.raises(UserError, match=match):
        drive(body, TIME, lambda t: (SPIN, STILL, STILL), loads=[load])


def test_a_start_that_does_not_fit_is_refused():
    body, *_ = body_and_nodes()
    with pytest.raises(UserError, match=r"not \(3,\), \(3,\), \(3,\), \(4,\)"):
        fly(body, TIME, STILL, SPIN, coordinates=np.zeros(3))
    with pytest.raises(UserError, match="velocity and a spin of 3 numbers"):
        fly(body, TIME, STILL[:2], SPIN)
