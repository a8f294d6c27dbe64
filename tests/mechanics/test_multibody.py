import numpy as np
import pytest
import scipy.linalg
from truss import TOWER, model, truss

from wavequake.errors import UserError
from wavequake.mechanics.multibody.joined import Joint, Link, Place, assemble
from wavequake.mechanics.vibration.drive import Drive, Impulse
from wavequake.mechanics.vibration.modal import modal_model
from wavequake.mechanics.vibration.response import displacements, respond

# Roots of cos x cosh x = 1: free-free Euler-Bernoulli beam.
FREE_FREE = np.array([4.730040745, 7.853204624, 10.99560784])


def beam(length, elements, bending=2.0, density=3.0, damping=1e-6):
    """A planar beam whose ends have the coordinates (axial, deflection, rotation) as x, y, z."""
    h, count = length / elements, elements + 1
    k_bend = (
        bending
        / h**3
        * np.array(
            [
                [12, 6 * h, -12, 6 * h],
                [6 * h, 4 * h**2, -6 * h, 2 * h**2],
                [-12, -6 * h, 12, -6 * h],
                [6 * h, 2 * h**2, -6 * h, 4 * h**2],
            ]
        )
    )
    m_bend = (
        density
        * h
        / 420
        * np.array(
            [
                [156, 22 * h, 54, -13 * h],
                [22 * h, 4 * h**2, 13 * h, -3 * h**2],
                [54, 13 * h, 156, -22 * h],
                [-13 * h, -3 * h**2, -22 * h, 4 * h**2],
            ]
        )
    )
    mass, stiffness = np.zeros((2, 3 * count, 3 * count))
    for e in range(elements):
        bend, axial = [3 * e + 1, 3 * e + 2, 3 * e + 4, 3 * e + 5], [3 * e, 3 * e + 3]
        stiffness[np.ix_(bend, bend)] += k_bend
        mass[np.ix_(bend, bend)] += m_bend
        stiffness[np.ix_(axial, axial)] += 1e3 / h * np.array([[1, -1], [-1, 1]])
        mass[np.ix_(axial, axial)] += density * h / 6 * np.array([[2, 1], [1, 2]])
    nodes = np.column_stack([np.linspace(0, length, count), np.zeros((count, 2))])
    ends = np.r_[0:3, 3 * elements : 3 * elements + 3]
    return model(
        mass,
        damping * stiffness,
        stiffness,
        np.eye(3 * count)[:, ends],
        name="beam",
        nodes=nodes,
        interfaces=np.array([0, elements]),
        surface=np.eye(3 * count),
        surface_nodes=np.arange(count),
        surface_weights=np.full(count, 1 / count),
    )


def frequencies(body):
    return np.sqrt(np.abs(scipy.linalg.eigh(body.stiffness, body.mass, eigvals_only=True)))


def test_two_joined_beams_are_one_long_beam():
    joined = assemble([beam(1.0, 8), beam(1.0, 8)], joints=[Joint(Place(0, 1), Place(1, 0))])
    long = beam(2.0, 16)
    assert joined.mass.shape == (51, 51)
    np.testing.assert_allclose(frequencies(joined)[3:], frequencies(long)[3:], rtol=1e-8)
    theory = (FREE_FREE / 2.0) ** 2 * np.sqrt(2.0 / 3.0)
    np.testing.assert_allclose(frequencies(joined)[3:6], theory, rtol=1e-3)


def test_stiff_links_tend_to_a_joint_with_the_inverse_of_their_stiffness():
    bodies = [beam(1.0, 6), beam(1.0, 6)]
    rigid = frequencies(assemble(bodies, joints=[Joint(Place(0, 1), Place(1, 0))]))[3]
    errors = []
    for stiffness in (1e5, 1e6):
        link = Link(Place(0, 1), Place(1, 0), (stiffness,) * 3)
        errors.append(rigid - frequencies(assemble(bodies, [link]))[3])
    assert errors[0] > 0
    assert errors[0] / errors[1] == pytest.approx(10.0, rel=0.01)


def test_hinge_leaves_one_more_free_motion():
    hinged = assemble([beam(1.0, 6), beam(1.0, 6)], joints=[Joint(Place(0, 1), Place(1, 0), (0, 1))])
    assert modal_model(hinged).free.sum() == 4


def test_springs_between_rigid_bodies_and_ground_give_the_textbook_pair():
    """Two masses of 2 kg on ground springs 300 N/m with a spring 500 N/m between: in and out of phase."""
    mass = model(2 * np.eye(3), np.zeros((3, 3)), np.zeros((3, 3)), np.eye(3), nodes=np.zeros((1, 3)))
    ground = [Link(Place(b, 0), None, (300.0, 300.0, 300.0)) for b in (0, 1)]
    between = Link(Place(0, 0), Place(1, 0), (500.0, 0.0, 0.0), (7.0, 0.0, 0.0))
    pair = assemble([mass, mass], [*ground, between])
    expected = np.sqrt([150.0] * 5 + [150.0 + 500.0])
    np.testing.assert_allclose(frequencies(pair), expected, rtol=1e-12)
    np.testing.assert_allclose(np.sort(np.linalg.eigvalsh(pair.damping_matrix))[-1], 14.0, rtol=1e-12)


def test_internal_springs_dampers_and_joints_keep_momentum():
    """Links act along the global axes between points at one place, so angular momentum is kept too."""
    bodies = [truss(interfaces=(0, 1, 2)), truss(points=TOWER[::-1].copy(), interfaces=(3, 4, 5))]
    links = [Link(Place(0, 1), Place(1, 1), (1e5, 2e5, 3e5), (50.0, 20.0, 10.0))]
    pair = assemble(bodies, links, [Joint(Place(0, 0), Place(1, 2))])
    assert modal_model(pair).free.sum() == 7  # held at two points, they may fold about the line between
    push = np.zeros(18)
    push[[1, 5]] = [1.0, 2.0]
    time = np.linspace(0, 0.02, 100)
    drive = Drive(np.zeros(18, dtype=bool), impulses=(Impulse(0.0, push),))
    motion = displacements(respond(modal_model(pair), [drive], time), pair.surface)[0].reshape(100, 12, 3)
    weights, points = np.tile(1.0 + 0.2 * np.arange(6), 2), pair.nodes
    linear = np.einsum("k,tkd->td", weights, motion)
    angular = np.einsum("k,tkd->td", weights, np.cross(points, motion))
    twist = np.cross(TOWER[0], [0, 1.0, 0]) + np.cross(TOWER[1], [0, 0, 2.0])
    np.testing.assert_allclose(linear, np.outer(time, [0, 1.0, 2.0]), rtol=0, atol=1e-9)
    np.testing.assert_allclose(angular, np.outer(time, twist), rtol=0, atol=1e-9)
    np.testing.assert_allclose(motion[:, 0], motion[:, 11], rtol=0, atol=1e-12)


def test_nodes_and_weights_are_numbered_through():
    pair = assemble([beam(1.0, 2), beam(1.0, 3)])
    assert pair.interfaces.tolist() == [0, 2, 3, 6]
    assert pair.surface_nodes.tolist() == list(range(7))
    assert pair.surface_weights.sum() == pytest.approx(1.0)
    assert pair.surface.shape == (21, 21)


@pytest.mark.parametrize(
    ("links", "joints", "match"),
    [
        ([Link(Place(2, 0), None, (1.0, 1.0, 1.0))], [], "no body 2"),
        ([Link(Place(0, 2), None, (1.0, 1.0, 1.0))], [], "no interface node 2"),
        ([Link(Place(0, 0), None, (1.0, -1.0, 1.0))], [], "at least 0"),
        ([Link(Place(0, 0), None, (1.0, np.nan, 1.0))], [], "finite"),
        ([], [Joint(Place(0, 0), None), Joint(Place(0, 0), None, (2,))], "dependent"),
        ([], [Joint(Place(0, 0), Place(0, 0))], "dependent"),
        ([], [Joint(Place(0, 0), None, ())], "directions"),
        ([], [Joint(Place(0, 0), None, (3,))], "directions"),
    ],
)
def test_bad_connections_are_refused(links, joints, match):
    with pytest.raises(UserError, match=match):
        assemble([beam(1.0, 2), beam(1.0, 2)], links, joints)


def test_no_bodies_or_too_many_coordinates_are_refused():
    with pytest.raises(UserError, match="at least one body"):
        assemble([])
    big = model(np.zeros((1600, 1)), np.zeros((1, 1)), np.zeros((1, 1)), np.zeros((1600, 3)))
    with pytest.raises(UserError, match="3200 coordinates together"):
        assemble([big, big])
