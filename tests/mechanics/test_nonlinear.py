import numpy as np
import pytest
import scipy.linalg
from scipy.integrate import solve_ivp
from truss import TOWER, truss

from wavequake.errors import UserError
from wavequake.mechanics.mirrors.models import CircularMirror, circular_mirror
from wavequake.mechanics.multibody.flexible_body import flexible_body, from_model
from wavequake.mechanics.multibody.floating_frame import floating_frame
from wavequake.mechanics.multibody.nonlinear import drive, energy, fly, momentum, positions
from wavequake.mechanics.vibration.drive import Drive, Impulse
from wavequake.mechanics.vibration.eigen import eigenmodes
from wavequake.mechanics.vibration.modal import modal_model
from wavequake.mechanics.vibration.response import displacements, respond

WEIGHTS = 1.0 + 0.2 * np.arange(6)
# The spin-up manoeuvre that Simo and Vu-Quoc (1987) made a benchmark: 10 m, EA 28 MN, EI 14 kN m^2, 1.2 kg/m,
# brought to 6 rad/s within 15 s.
LENGTH, AXIAL, BENDING, LINE_MASS = 10.0, 2.8e7, 1.4e4, 1.2


def tower(shift=(0.0, 0.0, 0.0), stiffness=2e3, damping=0.0, count=12):
    """Six masses on soft bars and their lowest elastic modes, seen from any origin."""
    model = truss(stiffness=stiffness, damping=damping)
    modal = modal_model(model)
    kept = slice(6, 6 + count)
    shapes = modal.modes[:, kept]
    points = TOWER - WEIGHTS @ TOWER / WEIGHTS.sum() - np.array(shift)
    rates = np.diag(np.diag(modal.damping)[kept])
    field = shapes.reshape(6, 3, -1)
    body = flexible_body(points, np.diag(WEIGHTS), field, np.diag(modal.squared[kept]), rates)
    return body, points, field


def beam(terms):
    """Cantilever along x: points, mass, polynomial shapes along x and y, stiffness, stress of a unit spin."""
    nodes, weights = np.polynomial.legendre.leggauss(24)
    s, w = 0.5 * (nodes + 1), 0.5 * weights
    axial, bend = np.arange(1, terms + 1), np.arange(2, terms + 2)
    shapes = np.zeros((24, 3, 2 * terms))
    shapes[:, 0, :terms] = s[:, None] ** axial
    shapes[:, 1, terms:] = s[:, None] ** bend
    strain = axial * s[:, None] ** (axial - 1) / LENGTH
    slope = bend * s[:, None] ** (bend - 1) / LENGTH
    bent = bend * (bend - 1) * s[:, None] ** (bend - 2) / LENGTH**2
    stiffness = scipy.linalg.block_diag(
        AXIAL * LENGTH * strain.T @ (w[:, None] * strain), BENDING * LENGTH * bent.T @ (w[:, None] * bent)
    )
    tension = 0.5 * LINE_MASS * LENGTH**2 * (1 - s**2)
    stress = np.zeros_like(stiffness)
    stress[terms:, terms:] = LENGTH * slope.T @ ((w * tension)[:, None] * slope)
    points = np.column_stack([LENGTH * s, np.zeros((24, 2))])
    return points, np.diag(LINE_MASS * LENGTH * w), shapes, stiffness, stress


def spin_up(t, final=6.0, over=15.0):
    """Spin and its rate about z; constant after `over`."""
    if t >= over:
        return final, 0.0
    phase = 2 * np.pi * t / over
    return final / over * (t - over / (2 * np.pi) * np.sin(phase)), final / over * (1 - np.cos(phase))


def base(t):
    spin, rate = spin_up(t)
    return np.array([0, 0, spin]), np.array([0, 0, rate]), np.zeros(3)


@pytest.mark.parametrize("shift", [(0.0, 0.0, 0.0), (0.4, -0.3, 0.2)])
def test_a_tumbling_body_keeps_energy_and_momentum(shift):
    """Spins of the order of the lowest frequencies, deformations of centimeters."""
    body, *_ = tower(shift, count=4)
    rates = np.array([0.3, 1.0, -0.8, 0.5])
    flight = fly(
        body, np.linspace(0, 0.6, 25), np.array([0.1, 0.2, -0.3]), np.array([2.0, 3.0, -1.0]), rates=rates
    )
    total = energy(body, flight)
    np.testing.assert_allclose(total, total[0], rtol=1e-8)
    for part in momentum(body, flight):
        np.testing.assert_allclose(
            part, np.broadcast_to(part[0], part.shape), rtol=0, atol=1e-8 * np.abs(part[0]).max()
        )
    assert np.ptp(body.stiffness[0, 0] * flight.coordinates[:, 0] ** 2) > 1e-4 * total[0]


def test_momentum_is_that_of_the_points():
    body, points, shapes = tower((0.1, 0.2, 0.3))
    flight = fly(
        body,
        np.array([0.0, 1e-5, 2e-5]),
        np.array([0.1, 0.2, -0.3]),
        np.array([2.0, 3.0, -1.0]),
        rates=0.1 * np.ones(12),
    )
    where = positions(flight, points, shapes)
    speed = (where[2] - where[0]) / 2e-5
    linear, angular = momentum(body, flight)
    np.testing.assert_allclose(linear[1], WEIGHTS @ speed, rtol=1e-6)
    np.testing.assert_allclose(angular[1], WEIGHTS @ np.cross(where[1], speed), rtol=1e-6)
    elastic = 0.5 * np.sum(flight.coordinates[1] ** 2 * np.diag(body.stiffness))
    kinetic = 0.5 * np.sum(WEIGHTS[:, None] * speed**2)
    assert energy(body, flight)[1] == pytest.approx(kinetic + elastic, rel=1e-6)


def test_the_motion_does_not_depend_on_where_the_frame_is():
    time, spin = np.linspace(0, 0.3, 6), np.array([2.0, 3.0, -1.0])
    found = []
    for shift in ((0.0, 0.0, 0.0), (0.4, -0.3, 0.2)):
        body, points, shapes = tower(shift, count=4)
        flight = fly(body, time, np.cross(spin, shift), spin, rates=np.array([0.3, 1.0, -0.8, 0.5]))
        found.append(positions(flight, points, shapes) + np.array(shift))
    np.testing.assert_allclose(found[0], found[1], rtol=0, atol=1e-8)


def test_a_rigid_symmetric_top_precesses():
    """Without torque the spin turns about the axis of symmetry at (1 - I3 / I1) times the axial spin."""
    ring = np.array([[np.cos(a), np.sin(a), 0.0] for a in 2 * np.pi * np.arange(5) / 5])
    body = flexible_body(ring, np.eye(5), np.zeros((5, 3, 0)), np.zeros((0, 0)))
    time = np.linspace(0, 2, 101)
    flight = fly(body, time, np.zeros(3), np.array([0.3, 0.0, 4.0]))
    rate = (5.0 - 2.5) / 2.5 * 4.0
    expected = np.column_stack([0.3 * np.cos(rate * time), 0.3 * np.sin(rate * time), np.full(101, 4.0)])
    np.testing.assert_allclose(flight.spin, expected, rtol=0, atol=1e-9)


def test_a_spinning_dumbbell_obeys_its_radial_equation():
    """r'' = h^2 / r^3 - 2 k (r - 1) / m for two masses m at +-r, h = r^2 omega."""
    points = np.array([[1.0, 0, 0], [-1, 0, 0], [0, 0, 1e-3], [0, 0, -1e-3], [0, 1e-3, 0], [0, -1e-3, 0]])
    light = 1e-9
    mass = np.diag([2.0, 2.0] + [light] * 4)
    shapes = np.zeros((6, 3, 1))
    shapes[:2, 0, 0] = [1.0, -1.0]
    body = flexible_body(points, mass, shapes, np.array([[2 * 300.0]]))
    time, spin = np.linspace(0, 1.2, 25), 6.0
    flight = fly(body, time, np.zeros(3), np.array([0, 0, spin]))

    def radial(_, y):
        return [y[1], spin**2 / y[0] ** 3 - 300.0 / 2.0 * (y[0] - 1)]

    r = solve_ivp(radial, (0, 1.2), [1.0, 0.0], t_eval=time, rtol=1e-11, atol=1e-12, method="LSODA").y[0]
    assert r.max() > 1.3
    np.testing.assert_allclose(1 + flight.coordinates[:, 0], r, rtol=0, atol=1e-7)
    np.testing.assert_allclose(flight.spin[:, 2], spin / r**2, rtol=0, atol=1e-6)


def test_small_motion_tends_to_the_linear_response_with_order_two():
    """A blow: what the nonlinear terms add to the displacements grows with the square of the blow."""
    model = truss(stiffness=2e3, damping=0.0)
    modal, frame = modal_model(model), floating_frame(model)
    body, points, shapes = tower()
    time, push, errors = np.linspace(0, 0.1, 21), np.zeros(9), []
    push[[2, 4]] = [1.0, 0.7]
    linear = displacements(
        respond(modal, [Drive(np.zeros(9, dtype=bool), impulses=(Impulse(0.0, push),))], time), model.surface
    )[0].reshape(21, 6, 3)
    start = np.linalg.solve(model.mass, model.inputs @ push)
    rigid = frame.projector @ start
    rates = modal.modes[:, ~modal.free].T @ model.mass @ start
    for size in (1e-2, 1e-3):
        flight = fly(body, time, size * rigid[:3], size * rigid[3:], rates=size * rates)
        moved = positions(flight, points, shapes) - points
        errors.append(np.abs(moved - size * linear).max())
    assert errors[0] / errors[1] == pytest.approx(100.0, rel=0.05)
    assert errors[1] < 1e-2 * np.abs(1e-3 * linear).max()


def test_damping_takes_energy_and_leaves_momentum():
    body, *_ = tower(damping=1e-3, count=4)
    flight = fly(body, np.linspace(0, 0.3, 21), np.zeros(3), np.array([2.0, 3.0, -1.0]))
    assert (np.diff(energy(body, flight)) < 0).all()
    angular = momentum(body, flight)[1]
    np.testing.assert_allclose(angular, np.broadcast_to(angular[0], angular.shape), rtol=0, atol=1e-8)


def test_beam_lags_behind_a_slow_start_by_its_static_deflection():
    """Angular acceleration loads it by a triangle: tip deflection -11 rho A alpha L^5 / (120 EI)."""
    points, mass, shapes, stiffness, _ = beam(4)
    bending = shapes[..., 4:]
    m = np.einsum("ndi,nm,mdj->ij", bending, mass, bending)
    squared, turn = scipy.linalg.eigh(stiffness[4:, 4:], m)
    body = flexible_body(points, mass, bending @ turn, np.diag(squared), 0.5 * np.diag(squared))
    alpha = 0.01
    motion = (np.zeros(3), np.array([0, 0, alpha]), np.zeros(3))
    q, _ = drive(body, np.array([0.0, 12.0]), lambda t: motion, tolerance=1e-8)
    tip = np.sum(turn @ q[-1])
    assert tip == pytest.approx(-11 * LINE_MASS * alpha * LENGTH**5 / (120 * BENDING), rel=1e-6)


def test_spun_up_beam_extends_as_a_rod():
    """Tip extension under the centrifugal forces of a slender rod: rho A w^2 L^3 / (3 EA) = 5.14e-4 m."""
    points, mass, shapes, stiffness, stress = beam(2)
    rates = 2e-3 * stiffness
    body = flexible_body(points, mass, shapes, stiffness, rates)
    q, _ = drive(body, np.array([0.0, 15.0, 18.0]), base, centrifugal_stiffness=stress, tolerance=1e-7)
    wanted = LINE_MASS * 6.0**2 * LENGTH**3 / (3 * AXIAL)
    assert q[-1, :2].sum() == pytest.approx(wanted, rel=2e-3)


# Rotating cantilever, flapping: lambda at eta = Omega sqrt(rho A L^4 / EI): 3.682, 4.797, 7.360 by Wright,
# Smith, Thresher and Wang 1982 (in Bir 2009, AIAA 2009-1035, Table 3a); a further digit by a Ritz series.
@pytest.mark.parametrize(("eta", "flap"), [(1, 3.6816), (3, 4.7973), (6, 7.3604)])
def test_rotating_beam_swings_at_published_frequencies(eta, flap):
    """In the plane of rotation lambda^2 = flap^2 - eta^2, without centrifugal stiffness 3.5160^2 - eta^2."""
    points, mass, shapes, stiffness, stress = beam(6)
    shapes, k, g = shapes[..., 6:], stiffness[6:, 6:], stress[6:, 6:]
    m = np.einsum("ndi,nm,mdj->ij", shapes, mass, shapes)
    spin = eta * np.sqrt(BENDING / (LINE_MASS * LENGTH**4))
    for stiffened, squared in ((1.0, flap**2 - eta**2), (0.0, 3.5160**2 - eta**2)):
        if squared <= 0:
            continue
        lowest = scipy.linalg.eigh(k + stiffened * spin**2 * g, m)[1][:, :1]
        body = flexible_body(points, mass, shapes @ lowest, lowest.T @ k @ lowest)
        rate, push = np.sqrt(squared) * spin / eta, 0.1
        time = np.linspace(0, 4 * np.pi / rate, 61)
        motion = (np.array([0, 0, spin]), np.zeros(3), np.array([0, push, 0]))
        q, _ = drive(body, time, lambda t, motion=motion: motion, stiffened * lowest.T @ g @ lowest)
        share = float(np.sum(mass @ shapes[:, 1] @ lowest))
        expected = -push * share / rate**2 * (1 - np.cos(rate * time))
        np.testing.assert_allclose(q[:, 0], expected, rtol=0, atol=2e-3 * np.abs(expected).max())


def test_spin_above_the_first_frequency_diverges_without_centrifugal_stiffness():
    """3.80 rad/s is the beam's first frequency; at 6 rad/s the standard floating frame loses it."""
    points, mass, shapes, stiffness, stress = beam(2)
    body = flexible_body(points, mass, shapes[..., 2:], stiffness[2:, 2:])
    time = np.linspace(0, 25, 51)
    q, _ = drive(body, time, base, stress[2:, 2:], tolerance=1e-6)
    assert 0.3 < np.abs(q.sum(axis=1)).max() < 0.8
    with pytest.raises(UserError, match="diverges near"):
        drive(body, time, base, tolerance=1e-6)


def test_mirror_of_finite_elements_spins_as_a_rigid_disc_with_elastic_modes():
    mirror = circular_mirror(CircularMirror(core=2, rings=2))
    _, modes = eigenmodes(mirror, 10)
    body = from_model(mirror, modes[:, 6:])
    flight = fly(body, np.linspace(0, 0.01, 5), np.zeros(3), np.array([20.0, 0.0, 60.0]), tolerance=1e-10)
    total = energy(body, flight)
    np.testing.assert_allclose(total, total[0], rtol=1e-8)
    assert np.abs(flight.coordinates).max() > 0


def test_bad_bodies_are_refused():
    ok = np.zeros((6, 3, 1))
    ok[3, 2, 0] = 1.0
    mass, stiffness = np.diag(WEIGHTS), np.eye(1)
    time, still = np.array([0.0, 1.0]), np.zeros(3)
    with pytest.raises(UserError, match="rigid motion"):
        fly(flexible_body(TOWER, mass, np.ones((6, 3, 1)), stiffness), time, still, still)
    with pytest.raises(UserError, match="repeat each other"):
        drive(flexible_body(TOWER, mass, np.repeat(ok, 2, axis=2), np.eye(2)), time, base)
    line = flexible_body(TOWER * [1, 0, 0], mass, np.zeros((6, 3, 0)), np.zeros((0, 0)))
    with pytest.raises(UserError, match="one line"):
        fly(line, time, still, still)
    with pytest.raises(UserError, match="do not fit"):
        flexible_body(TOWER, mass, ok, np.eye(2))
    with pytest.raises(UserError, match="do not fit"):
        flexible_body(TOWER, np.eye(5), ok, stiffness)
    with pytest.raises(UserError, match="do not fit"):
        flexible_body(TOWER, mass, ok, stiffness, np.eye(2))
    with pytest.raises(UserError, match="not finite"):
        flexible_body(TOWER * np.nan, mass, ok, stiffness)
    body = flexible_body(TOWER, mass, ok, stiffness)
    with pytest.raises(UserError, match="increasing"):
        fly(body, np.zeros(2), still, still)
    with pytest.raises(UserError, match="start"):
        fly(body, time, still, still + np.nan)
