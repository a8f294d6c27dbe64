from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg
from test_nonlinear import BENDING, LENGTH, LINE_MASS, beam, tower

from wavequake.errors import UserError
from wavequake.mechanics.mirrors.models import CircularMirror, circular_mirror
from wavequake.mechanics.multibody.flexible_body import flexible_body, from_model
from wavequake.mechanics.multibody.floating_frame import floating_frame
from wavequake.mechanics.multibody.joined import Bearing, Link, Place, assemble_system
from wavequake.mechanics.multibody.linear_system import poles
from wavequake.mechanics.multibody.nonlinear import fly, positions
from wavequake.mechanics.multibody.steady_rotation import steady_deformation, steady_rotation
from wavequake.mechanics.vibration.eigen import eigenmodes

NONE = np.zeros((0, 0))
AXES = np.array([[0.5, 0, 0], [-0.5, 0, 0], [0, 0.5, 0], [0, -0.5, 0], [0, 0, 0.2], [0, 0, -0.2]])


def rigid(points, weights):
    return flexible_body(points, np.diag(weights), np.zeros((len(points), 3, 0)), NONE)


def nearest(found, wanted):
    return np.abs(np.asarray(found)[:, None] - np.asarray(wanted)).min(axis=0)


def test_a_free_body_wobbles_or_tumbles_as_euler_says():
    """About a principal axis: p^2 = (I3 - I1) (I2 - I3) / (I1 I2) W^2, unstable for the middle one."""
    points = np.concatenate([np.diag([1.0, 0.6, 0.3]), -np.diag([1.0, 0.6, 0.3])])
    body = rigid(points, np.full(6, 2.0))
    moments = 4.0 * (np.sum([1.0, 0.36, 0.09]) - np.array([1.0, 0.36, 0.09]))
    for axis in range(3):
        spin = 5.0 * np.eye(3)[axis]
        i3, i1, i2 = (moments[(axis + step) % 3] for step in range(3))
        nutation = np.sqrt(complex((i3 - i1) * (i2 - i3) / (i1 * i2))) * 5.0
        found = poles(steady_rotation(body, spin, points, np.zeros((6, 3, 0))))
        # Beside it the turned frame itself: seen in turning axes, a tilted body stays or circles at -W.
        assert nearest(found, [nutation, -nutation, 5j, -5j, 0]) == pytest.approx(np.zeros(5), abs=1e-6)
        assert (found.real.max() > 1.0) == (axis == np.argsort(moments)[1])


def test_a_spinning_disk_on_springs_whirls_forward_and_backward():
    """I_t theta'' - i I_p W theta' + k theta = 0 in resting axes; in turning axes less W."""
    spin, stiffness = 40.0, 900.0
    body = rigid(AXES, np.full(6, 1.5))
    polar, diametral = 1.5 * 4 * 0.25, 1.5 * (2 * 0.25 + 2 * 0.04)
    rotor = steady_rotation(body, np.array([0, 0, spin]), AXES, np.zeros((6, 3, 0)))
    links = [Link(Place(0, node), None, (0.0, 0.0, stiffness)) for node in range(4)]
    links += [Link(Place(0, node), None, (stiffness, stiffness, 0.0)) for node in (4, 5)]
    found = poles(assemble_system([rotor], links))
    assert found.real == pytest.approx(np.zeros(12), abs=1e-6)
    twist = 2 * stiffness * 0.25 + 2 * stiffness * 0.04
    tilts = np.roots([diametral, -polar * spin, -twist])
    sways = np.array([1, -1]) * np.sqrt(2 * stiffness / 9.0)
    wanted = np.abs(np.concatenate([tilts, sways]) - spin)
    assert nearest(np.abs(found.imag), wanted) == pytest.approx(np.zeros(4), abs=1e-9 * spin)


@pytest.mark.parametrize("spin", [5.0, 15.0, 25.0])
def test_a_shaft_of_unequal_stiffness_is_unstable_between_its_critical_speeds(spin):
    """(k_x - m W^2 + m p^2) (k_y - m W^2 + m p^2) + 4 m^2 W^2 p^2 = 0."""
    m, kx, ky = 9.0, 9.0 * 100.0, 9.0 * 400.0
    rotor = steady_rotation(rigid(AXES, np.full(6, 1.5)), np.array([0, 0, spin]), AXES, np.zeros((6, 3, 0)))
    links = [Link(Place(0, node), None, (kx / 6, ky / 6, 1e4)) for node in range(6)]
    found = poles(assemble_system([rotor], links))
    a, b = kx / m - spin**2, ky / m - spin**2
    squares = np.roots([1.0, a + b + 4 * spin**2, a * b])
    wanted = np.concatenate([np.sqrt(squares.astype(complex)), -np.sqrt(squares.astype(complex))])
    assert nearest(found, wanted) == pytest.approx(np.zeros(4), abs=1e-8)
    assert (wanted.real.max() > 0.1) == (10.0 < spin < 20.0)


def test_internal_damping_has_the_same_limit_in_turning_axes():
    """Resting dampers d_e carry d_e W x in turning axes; stable up to sqrt(k / m) (1 + d_e / d_i)."""
    limit = np.sqrt(900.0 / 9.0) * (1 + 3.0 / 2.0)
    for factor, stable in ((0.999, True), (1.001, False)):
        spin = np.array([0, 0, factor * limit])
        rotor = steady_rotation(rigid(AXES, np.full(6, 1.5)), spin, np.zeros((1, 3)), np.zeros((1, 3, 0)))
        shaft = Bearing(
            Place(0, 0), None, 900.0 * np.eye(3) + 3.0 * np.cross(np.eye(3), spin), 5.0 * np.eye(3)
        )
        found = poles(assemble_system([rotor], [shaft]))
        swaying = found[np.abs(np.abs(found.imag) - abs(10.0 - spin[2])) < 0.1]
        assert len(swaying) == 2
        assert (swaying.real < 0).all() == stable


# Flapping frequencies of a cantilever at eta = W sqrt(rho A L^4 / EI): Wright, Smith, Thresher and Wang 1982,
# J. Appl. Mech. 49, as tabulated by Bir 2009, AIAA 2009-1035, Table 3a.
WRIGHT = {
    0: (3.516, 22.035, 61.697),
    1: (3.682, 22.181, 61.842),
    3: (4.797, 23.320, 62.985),
    6: (7.360, 26.809, 66.684),
    12: (13.170, 37.603, 79.615),
}


@pytest.mark.parametrize("eta", WRIGHT)
def test_a_rotating_beam_has_the_published_frequencies(eta):
    """Flapping as published; in the plane of rotation its square is less by W^2."""
    points, mass, shapes, stiffness, stress = beam(8)
    bend, k, g = shapes[..., 8:], stiffness[8:, 8:], stress[8:, 8:]
    unit = np.sqrt(BENDING / (LINE_MASS * LENGTH**4))
    lag = bend @ scipy.linalg.eigh(k, np.einsum("ndi,nm,mdj->ij", bend, mass, bend))[1]
    turn = scipy.linalg.eigh(k, np.einsum("ndi,nm,mdj->ij", bend, mass, bend))[1]
    k, g = turn.T @ k @ turn, turn.T @ g @ turn
    flap = lag[:, [0, 2, 1]]
    both = flexible_body(points, mass, np.concatenate([flap, lag], 2), scipy.linalg.block_diag(k, k))
    spin = np.array([0, 0, eta * unit])
    rotor = steady_rotation(
        both, spin, points[:0], np.zeros((0, 3, 16)), clamped=True,
        centrifugal_stiffness=scipy.linalg.block_diag(g, g),
    )  # fmt: skip
    found = np.unique(np.round(np.abs(poles(rotor).imag) / unit, 6))
    wanted = np.array(WRIGHT[eta])
    assert nearest(found, wanted) == pytest.approx(np.zeros(3), abs=6e-4)
    assert nearest(found, np.sqrt(wanted**2 - eta**2)) == pytest.approx(np.zeros(3), abs=1.2e-3)


def test_small_disturbances_of_a_spinning_body_follow_the_linear_system_with_order_two():
    """Against the nonlinear integration of the same body: what is left falls with the square."""
    body, points, shapes = tower(count=4)
    # A principal axis of the undeformed body is near one of the deformed body, but not equal: find that one.
    spin = balanced_axis(body, 4.0)
    system = steady_rotation(body, spin, points, shapes, name="tower")
    q0, size, errors = steady_deformation(body, spin), 1e-3, []
    random = np.random.default_rng(3)
    start = np.concatenate([0.3 * random.normal(size=6), random.normal(size=4)])
    time = np.linspace(0.0, 0.2, 5)
    a = np.block(
        [
            [np.zeros((10, 10)), np.eye(10)],
            [
                -np.linalg.solve(system.model.mass, system.model.stiffness + system.circulatory),
                -np.linalg.solve(system.model.mass, system.model.damping_matrix + system.gyroscopic),
            ],
        ]
    )
    moved = np.array([(scipy.linalg.expm(a * t) @ np.append(np.zeros(10), start))[:10] for t in time])
    linear = (moved @ system.model.surface.T).reshape(len(time), -1, 3)
    for size in (1e-2, 1e-3):
        flight = fly(
            body, time, size * start[:3], spin + size * start[3:6], q0, size * start[6:], tolerance=1e-12
        )
        where = positions(flight, points, shapes)
        angle = np.linalg.norm(spin) * time
        back = [scipy.linalg.expm(-t * np.cross(np.eye(3), spin)) for t in time]
        turned = np.einsum("tij,tkj->tki", back, where)
        errors.append(np.abs(turned - (points + shapes @ q0) - size * linear).max())
    assert angle[-1] > 0.5
    assert errors[0] / errors[1] == pytest.approx(100.0, rel=0.1)


def balanced_axis(body, rate):
    """Principal axis of the body as the spin about it deforms it, by fixed-point iteration."""
    axis = np.array([0.0, 0.0, 1.0])
    for _ in range(60):
        q = steady_deformation(body, rate * axis)
        place = np.vstack([np.zeros(3), np.eye(3), np.kron(q[:, None], np.eye(3))])
        spread = place.T @ body.integrals @ place
        vectors = np.linalg.eigh(spread)[1]
        axis = vectors[:, np.argmax(np.abs(vectors.T @ axis))]
        axis = axis * np.sign(axis[2])
    return rate * axis


def test_a_mirror_of_finite_elements_spins_as_its_moments_of_inertia_say():
    """Nutation at W (I3 / I1 - 1) for a slow spin; elastic frequencies are those at rest up to the spin."""
    mirror = circular_mirror(CircularMirror(core=2, rings=2))
    frame = floating_frame(mirror)
    frequencies, modes = eigenmodes(mirror, 12)
    moved = replace(mirror, nodes=mirror.nodes - frame.center)
    shapes = (mirror.inputs.T @ modes[:, 6:]).reshape(3, 3, 6)
    points = moved.nodes[mirror.interfaces]
    spin, moments = 2.0, np.diag(frame.inertia)
    system = steady_rotation(from_model(moved, modes[:, 6:]), np.array([0, 0, spin]), points, shapes)
    found = np.abs(poles(system).imag)
    assert nearest(found, [spin * (moments[2] / moments[0] - 1)]) == pytest.approx([0.0], abs=1e-4 * spin)
    elastic = 2 * np.pi * frequencies[6:]
    assert nearest(found, elastic).max() < spin
    # A plate bends along the axis of its spin, where no Coriolis force acts: the lowest pair hardly splits.
    split = np.sort(found[np.abs(found - elastic[0]) < spin])[::2]
    assert split.mean() == pytest.approx(elastic[0], rel=1e-5)
    assert 1e-3 * spin < split[1] - split[0] < 0.05 * spin


def test_the_steady_deformation_of_a_dumbbell_is_that_of_its_springs():
    """r = k / (k - m W^2) for two masses on springs of rest length 1."""
    points = np.array([[1.0, 0, 0], [-1, 0, 0], [0, 0.2, 0], [0, -0.2, 0]])
    shapes = np.zeros((4, 3, 1))
    shapes[:2, 0, 0] = [1.0, -1.0]
    body = flexible_body(points, np.diag([2.0, 2.0, 1.0, 1.0]), shapes, np.array([[2 * 300.0]]))
    q = steady_deformation(body, np.array([0, 0, 6.0]))
    assert 1 + q == pytest.approx([300.0 / (300.0 - 2.0 * 36.0)], rel=1e-12)
    with pytest.raises(UserError, match="spin it more slowly"):
        steady_deformation(body, np.array([0, 0, 13.0]))


@pytest.mark.parametrize(
    ("points", "spin", "changes", "match"),
    [
        (AXES + np.array([0.1, 0, 0]), [0, 0, 3.0], {}, "not balanced"),
        (AXES, [0, 2.0, 3.0], {}, "not balanced"),
        (AXES, [0, 3.0], {}, r"they are \(3,\)"),
        (AXES, [0, 0, np.nan], {}, "must be finite"),
        (AXES, [0, 0, 3.0], {"centrifugal_stiffness": np.eye(2)}, "centrifugal stiffness must be"),
    ],
)
def test_bad_rotations_are_refused(points, spin, changes, match):
    with pytest.raises(UserError, match=match):
        steady_rotation(rigid(points, np.ones(6)), spin, points, np.zeros((6, 3, 0)), **changes)
