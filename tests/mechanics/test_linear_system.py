from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg
from hypothesis import given
from hypothesis import strategies as st
from truss import model, truss

from wavequake.errors import UserError
from wavequake.mechanics.multibody.joined import Bearing, Joint, Link, Place, assemble, assemble_system
from wavequake.mechanics.multibody.linear_system import first_order, linear_system, poles, symmetric_and_skew
from wavequake.mechanics.vibration.modal import modal_model
from wavequake.mechanics.vibration.state_space import state_space
from wavequake.reduction.reduce import reduce

TURN = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])


def mass_point(mass=2.0, damping=0.0, stiffness=0.0):
    return model(
        mass * np.eye(3), damping * np.eye(3), stiffness * np.eye(3), np.eye(3),
        name="disk", nodes=np.zeros((1, 3)), interfaces=np.array([0]), surface=np.eye(3),
        surface_nodes=np.array([0]), surface_weights=np.ones(1),
    )  # fmt: skip


def jeffcott(spin, internal=6.0, external=9.0, stiffness=800.0, mass=2.0):
    """Laval (Jeffcott) rotor in resting axes: internal damping acts on the velocity relative to the shaft."""
    shaft = Bearing(
        Place(0, 0), None,
        stiffness * np.eye(3) + internal * spin * TURN,
        (internal + external) * np.eye(3),
    )  # fmt: skip
    return assemble_system([mass_point(mass)], [shaft])


def test_the_jeffcott_rotor_whirls_at_the_roots_of_its_complex_equation():
    """With z = x + i y: m z'' + (d_i + d_e) z' + (k - i d_i W) z = 0."""
    spin = 31.0
    wanted = np.roots([2.0, 15.0, 800.0 - 6j * spin])
    wanted = np.concatenate([wanted, wanted.conj(), np.roots([2.0, 15.0, 800.0])])
    found = poles(jeffcott(spin))
    assert np.abs(found[:, None] - wanted).min(axis=0) == pytest.approx(np.zeros(6), abs=1e-9)


def test_internal_damping_destabilizes_above_the_critical_speed_times_its_share():
    """Stable up to W = sqrt(k / m) (1 + d_e / d_i): there the growing whirl is at the critical speed."""
    critical = np.sqrt(800.0 / 2.0)
    limit = critical * (1 + 9.0 / 6.0)
    assert poles(jeffcott(0.999 * limit)).real.max() < -1e-4
    assert poles(jeffcott(1.001 * limit)).real.max() > 1e-4
    edge = poles(jeffcott(limit))
    edge = edge[np.argmax(edge.real)]
    assert edge.real == pytest.approx(0.0, abs=1e-9)
    assert abs(edge.imag) == pytest.approx(critical, rel=1e-12)


def test_without_external_damping_the_critical_speed_is_the_limit():
    critical = np.sqrt(800.0 / 2.0)
    assert poles(jeffcott(0.999 * critical, external=0.0)).real.max() < 0
    assert poles(jeffcott(1.001 * critical, external=0.0)).real.max() > 1e-3


def test_a_rotor_on_a_flexible_pedestal_has_the_roots_of_the_coupled_pair():
    """Two bodies: disk on a shaft with internal damping, pedestal on a damped ground, z = x + i y."""
    spin, m, p = 60.0, 2.0, 5.0
    shaft = Bearing(Place(0, 0), Place(1, 0), 800.0 * np.eye(3) + 6.0 * spin * TURN, 6.0 * np.eye(3))
    ground = Link(Place(1, 0), None, (3000.0,) * 3, (40.0,) * 3)
    found = poles(assemble_system([mass_point(m), mass_point(p)], [shaft, ground]))
    inner = np.array([6.0, 800.0 - 6j * spin])
    disk, pedestal = np.polyadd([m, 0, 0], inner), np.polyadd([p, 40.0, 3000.0], inner)
    wanted = np.roots(np.polysub(np.polymul(disk, pedestal), np.polymul(inner, inner)))
    assert np.abs(found[:, None] - wanted).min(axis=0) == pytest.approx(np.zeros(4), abs=1e-8)


def test_joints_carry_skew_forces_over():
    """Two rotors joined in all directions are one of the sum of their masses and forces."""
    spin = 70.0
    halves = assemble_system(
        [linear_system(mass_point(1.0), circulatory=spin * 2.0 * TURN), mass_point(1.0)],
        [
            Bearing(Place(1, 0), None, 800.0 * np.eye(3) + spin * 4.0 * TURN, 15.0 * np.eye(3)),
        ],
        [Joint(Place(0, 0), Place(1, 0))],
    )
    assert halves.order == 3
    apart = np.abs(poles(halves)[:, None] - poles(jeffcott(spin)))  # equal imaginary parts: any order
    for axis in (0, 1):
        np.testing.assert_allclose(apart.min(axis=axis), 0.0, rtol=0, atol=1e-9)


def test_forces_of_the_system_add_to_those_of_its_bodies():
    both = assemble_system(
        [linear_system(mass_point(), gyroscopic=3.0 * TURN), mass_point()],
        [Link(Place(b, 0), None, (800.0,) * 3) for b in (0, 1)],
        gyroscopic=scipy.linalg.block_diag(2.0 * TURN, 5.0 * TURN),
    )
    np.testing.assert_array_equal(both.gyroscopic, scipy.linalg.block_diag(5.0 * TURN, 5.0 * TURN))


def test_gyroscopic_forces_stabilize_a_top():
    """A point on a repelling spring is held by G above 2 sqrt(-k m), however Thomson and Tait built it."""
    for rate, stable in ((1.99, False), (2.01, True)):
        top = linear_system(
            replace(mass_point(1.0), stiffness=np.diag([-9.0, -9.0, 1.0])), gyroscopic=3.0 * rate * TURN
        )
        assert bool(poles(top).real.max() < 1e-6) is stable


@given(st.integers(0, 10**6))
def test_gyroscopic_forces_do_no_work(seed):
    """The energy's rate along any motion of the state space is that of the damping alone."""
    random = np.random.default_rng(seed)
    body, skew = truss(damping=1e-4), random.normal(size=(18, 18)) * 1e3
    system = linear_system(body, gyroscopic=skew - skew.T)
    a = first_order(system, body.surface).a
    energy = scipy.linalg.block_diag(body.stiffness, body.mass)
    rate = energy @ a
    wanted = scipy.linalg.block_diag(np.zeros((18, 18)), -body.damping_matrix)
    np.testing.assert_allclose(0.5 * (rate + rate.T), wanted, rtol=0, atol=1e-8 * np.abs(rate).max())


def test_circulatory_forces_feed_the_energy_of_a_whirl():
    """Per turn of a circle of radius r they do the work 2 pi r^2 n."""
    a = first_order(linear_system(mass_point(), circulatory=7.0 * TURN), np.eye(3)).a
    angle = np.linspace(0, 2 * np.pi, 401)[:-1]
    circle = 0.1 * np.array([np.cos(angle), np.sin(angle), 0 * angle])
    along = 0.1 * np.array([-np.sin(angle), np.cos(angle), 0 * angle])
    force = 2.0 * (a[3:, :3] @ circle)
    work = np.sum(force * along) * 2 * np.pi / 400
    assert work == pytest.approx(2 * np.pi * 0.1**2 * 7.0, rel=1e-12)


@pytest.mark.parametrize("frequency", [3.0, 97.0, 1300.0])
def test_transfer_matrix_solves_the_full_equations(frequency):
    random, s = np.random.default_rng(1), 2j * np.pi * frequency
    body = truss(damping=1e-5)
    g, n = (size * (x - x.T) for x, size in zip(random.normal(size=(2, 18, 18)), (50.0, 3e4), strict=True))
    system = first_order(linear_system(body, g, n), body.surface)
    found = system.c @ np.linalg.solve(s * np.eye(36) - system.a, system.b) + system.d
    wanted = np.linalg.solve(
        s**2 * body.mass + s * (body.damping_matrix + g) + body.stiffness + n, body.inputs
    )
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-8 * np.abs(wanted).max())


def test_without_skew_forces_it_is_the_symmetric_model():
    body = truss(damping=1e-5)
    pair = [body, truss(damping=1e-5)]
    links = [Link(Place(0, 1), Place(1, 1), (1e5, 2e5, 3e5), (50.0, 20.0, 10.0))]
    plain, system = assemble(pair, links), assemble_system(pair, links)
    np.testing.assert_array_equal(plain.stiffness, system.model.stiffness)
    assert not system.gyroscopic.any()
    assert not system.circulatory.any()
    first, second = state_space(modal_model(plain), plain.surface), first_order(system, plain.surface)
    for s in (200j, 3000j):
        transfers = [c @ np.linalg.solve(s * np.eye(len(a)) - a, b) + d for a, b, c, d in (first, second)]
        np.testing.assert_allclose(*transfers, rtol=0, atol=1e-7 * np.abs(transfers[0]).max())


def test_python_control_takes_an_unstable_rotor():
    control = pytest.importorskip("control")
    rotor = jeffcott(80.0)
    system = control.ss(*first_order(rotor, rotor.model.surface))
    assert isinstance(system, control.StateSpace)
    np.testing.assert_allclose(np.sort(system.poles().imag), np.sort(poles(rotor).imag), rtol=0, atol=1e-8)
    time = np.linspace(0, 1, 2001)
    push = np.zeros((3, 2001))
    push[0] = 1.0
    moved = control.forced_response(system, time, push).outputs
    roots = np.roots([2.0, 15.0, 800.0 - 6j * 80.0])
    # Step of 1 N along x: partial fractions of 1 / (s m (s - a) (s - b)).
    a, b = roots
    z = (1 / (a * b) + np.exp(a * time) / (a * (a - b)) + np.exp(b * time) / (b * (b - a))) / 2.0
    np.testing.assert_allclose(moved[0] + 1j * moved[1], z, rtol=0, atol=1e-10)


def test_equation_2_5_splits_and_adds_up():
    matrix = np.random.default_rng(0).normal(size=(5, 5))
    symmetric, skew = symmetric_and_skew(matrix)
    np.testing.assert_array_equal(symmetric, symmetric.T)
    np.testing.assert_array_equal(skew, -skew.T)
    np.testing.assert_allclose(symmetric + skew, matrix, rtol=1e-15)


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        (
            {"gyroscopic": np.eye(3)},
            r"gyroscopic matrix of disk is not skew.*\(G \+ G\^T reaches 2\)",
        ),
        (
            {"circulatory": np.ones((3, 3))},
            "circulatory matrix of disk is not skew-symm.*to the stiffness",
        ),
        ({"gyroscopic": TURN[:2, :2]}, r"gyroscopic matrix of disk must be finite and of shape \(3, 3\)"),
        ({"gyroscopic": 1j * TURN}, "gyroscopic matrix of disk is complex"),
        ({"circulatory": np.nan * TURN}, "circulatory matrix of disk must be finite"),
    ],
)
def test_bad_skew_matrices_are_refused(changes, match):
    with pytest.raises(UserError, match=match):
        linear_system(mass_point(), **changes)
    with pytest.raises(UserError, match=match.replace("of disk", "of assembly")):
        assemble_system([mass_point()], **changes)


@pytest.mark.parametrize(
    ("body", "match"),
    [
        (replace(mass_point(), mass=np.diag([1.0, 1.0, 0.0])), "not positive definite"),
        (replace(mass_point(), damping_matrix=-np.eye(3)), "damping of the model disk is negative"),
        (replace(mass_point(), stiffness=TURN), "stiffness matrix of the model disk is not symmetric"),
        (replace(mass_point(), mass=np.nan * np.eye(3)), "mass matrix of the model disk has entries"),
    ],
)
def test_bad_models_are_refused(body, match):
    for function in (poles, lambda system: first_order(system, np.eye(3))):
        with pytest.raises(UserError, match=match):
            function(linear_system(body))


def test_forces_that_are_not_symmetric_are_not_dropped():
    """A symmetric assembly has no place for them."""
    bearing = Bearing(Place(0, 0), None, np.eye(3) + TURN, np.eye(3))
    for bodies, links in [([mass_point()], [bearing]), ([linear_system(mass_point())], [])]:
        with pytest.raises(UserError, match="join them by assemble_system"):
            assemble(bodies, links)


def test_a_system_is_no_symmetric_model():
    system = linear_system(truss())
    with pytest.raises(UserError, match="state space of `first_order`"):
        modal_model(system)
    with pytest.raises(UserError, match="not a LinearSystem"):
        reduce(system, "modal12")


def test_bad_bearings_rows_and_sizes_are_refused():
    place = Place(0, 0)
    for stiffness, damping, match in [
        (np.eye(2), np.eye(3), r"stiffness of shape \(3, 3\)"),
        (np.eye(3), np.nan * np.eye(3), r"damping of shape \(3, 3\) that is finite"),
        (np.eye(3), -np.eye(3), "damping that is negative"),
    ]:
        with pytest.raises(UserError, match=match):
            assemble_system([mass_point()], [Bearing(place, None, stiffness, damping)])
    with pytest.raises(UserError, match="do not fit the 3 coordinates"):
        first_order(linear_system(mass_point()), np.eye(4))
    with pytest.raises(UserError, match="at least one body"):
        assemble_system([])
    big = model(np.zeros((3001, 1)), np.zeros((1, 1)), np.zeros((1, 1)), np.zeros((3001, 3)))
    with pytest.raises(UserError, match="takes at most 3000"):
        linear_system(big)
