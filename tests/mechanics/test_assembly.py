"""Assemblies of bodies against closed forms and dense solutions that share no code with them."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg

from wavequake.errors import UserError
from wavequake.mechanics.assembly.answers import Shaking, over_time, sag, steady
from wavequake.mechanics.assembly.beams import Tube, beam_frame
from wavequake.mechanics.assembly.bodies import placed, rigid_body
from wavequake.mechanics.assembly.links import End, Link
from wavequake.mechanics.assembly.plant import FLOOR, plant
from wavequake.mechanics.mirrors.material import Material
from wavequake.mechanics.model import ReducedModel

GROUND = End("ground")
INERTIA = np.diag([2.0, 3.0, 4.0])


def block(name="block", mass=8.0, center=(0.0, 0.0, 0.0), nodes=None, rows=True):
    points = {one: np.array(point) for one, point in (nodes or {}).items()}
    return rigid_body(
        name, mass, INERTIA, np.array(center), points, {("rigid", name): np.eye(6)} if rows else None
    )


def spring(name, first, second, stiffness, damping=(0.0, 0.0, 0.0)):
    return Link(name, "spring", first, second, stiffness, damping)


def test_a_block_on_four_springs_has_its_closed_form_modes():
    """Shifts: sum k / m; turns: sum of k times squared levers over the principal moments."""
    a, b, k = 0.5, 0.3, (1e5, 2e5, 3e5)
    corners = {f"{i}{j}": (i * a, j * b, 0.0) for i in (-1, 1) for j in (-1, 1)}
    links = [spring(one, End("block", one), GROUND, k) for one in corners]
    found = plant([block(nodes=corners)], links)
    expected = [4 * one / 8.0 for one in k]
    expected += [4 * k[2] * b**2 / 2.0, 4 * k[2] * a**2 / 3.0, 4 * (k[0] * b**2 + k[1] * a**2) / 4.0]
    np.testing.assert_allclose(found.omega**2, sorted(expected), rtol=1e-12)


def test_two_masses_in_a_row_have_their_closed_form_modes():
    across = {"1": (1.0, 0.0), "2": (-1.0, 0.0), "3": (0.0, 1.0), "4": (0.0, -1.0)}
    nodes = {one: (0.0, *point) for one, point in across.items()}
    bodies = [block("a", nodes=nodes), block("b", center=(1.0, 0.0, 0.0), nodes=nodes)]
    quarter = (5e3, 1e9, 1e9)
    links = [spring(f"g{one}", End("a", one), GROUND, quarter) for one in across]
    links += [spring(f"l{one}", End("a", one), End("b", one), quarter) for one in across]
    found = plant(bodies, links).omega
    golden = 2e4 / 8.0 * (3.0 + np.array([-1.0, 1.0]) * np.sqrt(5.0)) / 2.0
    for one in golden:
        assert np.abs(found**2 / one - 1.0).min() < 1e-9


def test_a_leg_pulls_along_its_line_only():
    """A mass on a tripod of legs: the stiffness is the sum of k n n^T, its turns held by soft springs."""
    feet = {f"{i}": np.array([np.cos(t), np.sin(t), -1.0]) for i, t in enumerate((0.1, 2.2, 4.3))}
    legs = [
        Link(f"leg {i}", "leg", End("block", "top"), End("ground", one), (1e6, 0.0, 0.0))
        for i, one in enumerate(feet)
    ]
    body = block(nodes={"top": (0.0, 0.0, 0.0), "x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0)})
    turns = [spring(one, End("block", one), GROUND, (1e-3, 1e-3, 1e-3)) for one in "xy"]
    found = plant([body], [*legs, *turns], feet)
    lines = [one / np.linalg.norm(one) for one in feet.values()]
    expected = np.linalg.eigvalsh(sum(1e6 * np.outer(one, one) for one in lines)) / 8.0
    np.testing.assert_allclose(found.omega[3:] ** 2, expected, rtol=1e-6)


def bar(count, first=0.0, length=1.0, mass_at_ends=(0.5, 0.5)):
    """A chain of `count` masses and springs in each of x, y, z, as dense matrices of a free model."""
    line = np.zeros((count, count))
    for i in range(count - 1):
        line[i : i + 2, i : i + 2] += np.array([[1.0, -1.0], [-1.0, 1.0]])
    masses = np.ones(count)
    masses[[0, -1]] = mass_at_ends
    return np.kron(np.diag(masses), np.eye(3)), np.kron(line, np.diag([3e5, 2e5, 1e5])), masses


def chain(name, count, ends=(0.5, 0.5), offset=0):
    """A body of a chain whose nodes are called by their numbers in the whole."""
    mass, stiffness, _ = bar(count, mass_at_ends=ends)
    points = np.array([[0.1 * (offset + i), 0.0, 0.0] for i in range(count)])
    model = ReducedModel(
        name, "chain", mass, stiffness, 1e-4 * stiffness, np.eye(3 * count), np.zeros((0, 3 * count)),
        points, np.arange(count), np.zeros(0, int), np.zeros(0), 0.0,
    )  # fmt: skip
    rows = {("rigid", f"{name}-end"): np.vstack([np.eye(3 * count)[-3:], np.zeros((3, 3 * count))])}
    body = placed(name, model, {str(offset + i): i for i in range(count)}, rows=rows)
    return replace(body, held=False)  # it has three rigid motions, without turns


def test_a_body_split_in_two_and_joined_rigidly_equals_the_whole():
    feet = [spring("foot", End("whole", "0"), GROUND, (1e5, 1e5, 1e5))]
    whole = plant([chain("whole", 9)], feet)
    # The mass at the cut is shared: half of it on either side.
    links = [
        spring("foot", End("left", "0"), GROUND, (1e5, 1e5, 1e5)),
        Link("weld", "rigid", End("left", "4"), End("right", "4")),
    ]
    halves = plant([chain("left", 5), chain("right", 5, offset=4)], links)
    np.testing.assert_allclose(halves.omega, whole.omega, rtol=1e-9)
    omega = np.array([30.0, 200.0, 700.0])
    at = np.zeros((3, whole.modal.inputs.shape[1]), dtype=complex)
    at[:, FLOOR] = np.array([1.0, 1j, 0.3, 0.0, 0.0, 0.0])
    other = np.zeros((3, halves.modal.inputs.shape[1]), dtype=complex)
    other[:, FLOOR] = at[:, FLOOR]
    full = steady(whole, Shaking(omega, at))
    split = steady(halves, Shaking(omega, other))[:, 6:]
    np.testing.assert_allclose(split, full, rtol=1e-9, atol=1e-9 * np.abs(full).max())


def test_welds_that_repeat_each_other_hold_as_one():
    corners = {f"{i}{j}": (i * 0.5, j * 0.3, 0.0) for i in (-1, 1) for j in (-1, 1)}
    bodies = [block("a", nodes=corners), block("b", center=(0.0, 0.0, 0.7))]
    feet = [spring(one, End("a", one), GROUND, (1e5, 2e5, 3e5)) for one in corners]
    welds = [Link(one, "rigid", End("a", one), End("b")) for one in corners]
    once, often = plant(bodies, [*feet, welds[0]]), plant(bodies, [*feet, *welds])
    np.testing.assert_allclose(often.omega, once.omega, rtol=1e-12)
    assert len(once.omega) == 6


def test_steady_vibration_is_the_dense_solution():
    """The chain on a spring and damper, its foot shaken: (K - w^2 M + i w D) u = (k + i w d) u_floor."""
    links = [spring("foot", End("whole", "0"), GROUND, (1e5, 2e5, 3e5), (40.0, 50.0, 60.0))]
    found = plant([chain("whole", 6)], links)
    mass, stiffness, _ = bar(6)
    select = np.zeros((18, 3))
    select[:3] = np.eye(3)
    springs, dampers = np.diag([1e5, 2e5, 3e5]), np.diag([40.0, 50.0, 60.0])
    stiff = stiffness + select @ springs @ select.T
    damp = 1e-4 * stiffness + select @ dampers @ select.T
    floor = np.array([1e-6, 2e-6j, -1e-6])
    for omega in (50.0, 321.0, 900.0):
        force = select @ ((springs + 1j * omega * dampers) @ floor)
        dense = np.linalg.solve(stiff - omega**2 * mass + 1j * omega * damp, force)
        pattern = np.zeros((1, found.modal.inputs.shape[1]), dtype=complex)
        pattern[0, :3] = floor
        answer = steady(found, Shaking(np.array([omega]), pattern))[0, :3]
        np.testing.assert_allclose(answer, dense[-3:], rtol=1e-9)


def test_a_force_from_rest_settles_to_the_steady_vibration():
    """The transient, by the exponential of the dense state matrix, dies out and leaves what is computed."""
    links = [spring("foot", End("whole", "0"), GROUND, (1e5, 1e5, 1e5), (400.0, 400.0, 400.0))]
    found = plant([chain("whole", 4)], links)
    mass, stiffness, _ = bar(4)
    select = np.zeros((12, 3))
    select[:3] = np.eye(3)
    stiff = stiffness + 1e5 * select @ select.T
    damp = 1e-4 * stiffness + 400.0 * select @ select.T
    inverse = np.linalg.inv(mass)
    omega = 150.0
    turn = np.array([[0.0, omega], [-omega, 0.0]])
    state = np.zeros((26, 26))
    state[:12, 12:24] = np.eye(12)
    state[12:24, :12], state[12:24, 12:24] = -inverse @ stiff, -inverse @ damp
    state[12:24, 24] = inverse[:, 9] * 1.0
    state[24:, 24:] = turn
    start = np.zeros(26)
    start[24] = 1.0
    time = 3.0 + np.array([0.0, 0.004, 0.011])
    dense = np.array([(scipy.linalg.expm(state * t) @ start)[9] for t in time])
    pattern = np.zeros((1, found.modal.inputs.shape[1]), dtype=complex)
    pattern[0, found.places["whole.3"][0].start] = 1.0
    answer = over_time(found, Shaking(np.array([omega]), pattern), time)[:, 0]
    np.testing.assert_allclose(answer, dense, rtol=1e-8)


def test_gravity_sags_a_hanging_bar_as_in_closed_form():
    """A chain on its foot under gravity along x: force in each spring is the weight beyond it."""
    links = [spring("foot", End("whole", "0"), GROUND, (1e5, 1e5, 1e5))]
    found = plant([chain("whole", 6)], links)
    masses = bar(6)[2]
    g = 9.81
    beyond = [masses[i:].sum() * g for i in range(6)]
    expected = beyond[0] / 1e5 + sum(beyond[1:]) / 3e5
    moved = sag(found, np.array([[g, 0.0, 0.0], [0.0, 0.0, -g]]))
    assert moved[0, 0] == pytest.approx(expected, rel=1e-10, abs=0.0)
    assert moved[1, 2] == pytest.approx(-(beyond[0] / 1e5 + sum(beyond[1:]) / 1e5), rel=1e-10, abs=0.0)


def test_gravity_turns_a_block_whose_center_is_above_its_springs():
    """Overhang: the moment m g h turns it about the springs' plane by m g h / (sum k y^2)."""
    corners = {f"{i}{j}": (i * 0.5, j * 0.5, 0.0) for i in (-1, 1) for j in (-1, 1)}
    body = block(center=(0.0, 0.0, 0.4), nodes=corners)
    links = [spring(one, End("block", one), GROUND, (1e6, 1e6, 1e6)) for one in corners]
    moved = sag(plant([body], links), np.array([[0.0, 10.0, 0.0]]))[0]
    turn = -8.0 * 10.0 * 0.4 / (4 * 1e6 * 0.25)
    assert moved[3] == pytest.approx(turn, rel=1e-10, abs=0.0)
    assert moved[1] == pytest.approx(8.0 * 10.0 / 4e6 - 0.4 * turn, rel=1e-10, abs=0.0)


def test_a_floating_pair_keeps_its_center_of_mass():
    bodies = [block("a", nodes={"1": (0, 0.5, 0), "2": (0, -0.5, 0), "3": (0, 0, 0.5)}), block("b", 4.0)]
    links = [spring(one, End("a", one), End("b"), (1e5, 2e5, 3e5)) for one in "123"]
    found = plant(bodies, links)
    assert not found.grounded
    assert len(found.omega) == 6
    pattern = np.zeros((1, found.modal.inputs.shape[1]), dtype=complex)
    pattern[0, found.places["a"][0]] = [1.0, 2.0, 3.0]
    moved = steady(found, Shaking(np.array([100.0]), pattern))[0]
    np.testing.assert_allclose(8.0 * moved[:3] + 4.0 * moved[6:9], 0.0, atol=1e-18)


@pytest.mark.parametrize(
    ("links", "words"),
    [
        ([spring("s", End("block"), End("blok"), (1, 1, 1))], "no body; did you mean 'block'"),
        ([spring("s", End("block", "tp"), GROUND, (1, 1, 1))], "'tp' of 'block'; did you mean 'top'"),
        ([spring("s", End("block", "top"), End("block"), (1, 1, 1))], "joins 'block' with itself"),
        ([spring("s", End("block"), GROUND, (1, 1, 1))], "at no point; name a node"),
        ([spring("s", End("block", "top"), GROUND, (-1, 1, 1))], "from 0 to 1e\\+18"),
        ([spring("s", End("block", "top"), GROUND, (0, 0, 0))], "neither stiffness nor damping"),
        ([spring("s", End("block", "top"), GROUND, (1e3, 1e3, 1e3))], "3 motions without stiffness"),
        ([spring("s", End("block", "top"), End("other"), (1, 1, 1))], "motions without stiffness"),
        ([Link("l", "leg", End("block", "top"), GROUND, (1, 0, 0))], "ends somewhere on 'ground'"),
        ([Link("l", "leg", End("block", "top"), End("ground", "here"), (1, 0, 0))], "has no length"),
        ([spring("s", End("block", "top"), End("ground", "foot"), (1, 1, 1))], "which are 1000 mm apart"),
        ([], "are not joined; link them"),
        ([Link("w", "rigid", End("block", "top"), GROUND)], "'other' of structure has no support"),
    ],
)  # fmt: skip
def test_bad_links_are_said(links, words):
    bodies = [block(nodes={"top": (0.0, 0.0, 1.0)}), block("other", center=(0.0, 0.0, 5.0))]
    if "3 motions" in words:
        bodies = bodies[:1]
    ground = {"here": np.array([0.0, 0.0, 1.0]), "foot": np.zeros(3)}
    with pytest.raises(UserError, match=words):
        plant(bodies, links, ground)


@pytest.mark.parametrize(
    ("mass", "inertia", "words"),
    [
        (-1.0, INERTIA, "it must be positive"),
        (1.0, np.diag([1.0, -1.0, 1.0]), "positive principal moments"),
        (1.0, np.diag([1.0, 1.0, 3.0]), "belong to no mass"),
    ],
)
def test_bad_rigid_bodies_are_said(mass, inertia, words):
    with pytest.raises(UserError, match=words):
        rigid_body("block", mass, inertia, np.zeros(3), {})


def test_gravity_needs_a_floor():
    bodies = [block("a", nodes={"1": (0, 0.5, 0), "2": (0, -0.5, 0), "3": (0, 0, 0.5)}), block("b", 4.0)]
    links = [spring(one, End("a", one), End("b"), (1e5, 2e5, 3e5)) for one in "123"]
    with pytest.raises(UserError, match="stands on the ground"):
        sag(plant(bodies, links), np.array([[0.0, 0.0, 9.81]]))


STEEL = Material(210e9, 0.3, 7850.0)


def beam(pieces=8, length=2.0):
    points = {"foot": np.zeros(3), "tip": np.array([0.0, 0.6, 0.8]) * length}
    frame = beam_frame("beam", points, [("foot", "tip")], Tube(0.1, 0.01), STEEL, pieces)
    along = points["tip"] / length
    rows = {("rigid", "tip"): np.eye(6 * (pieces + 1))[6:12]}
    return placed("beam", frame, {"foot": 0, "tip": 1}, rows=rows), along


def test_a_cantilever_has_its_closed_form_modes_and_sag():
    body, along = beam(16)
    found = plant([body], [Link("weld", "rigid", End("beam", "foot"), GROUND)])
    section, length = Tube(0.1, 0.01), 2.0
    line = STEEL.density * section.area
    bending = STEEL.young * section.bending
    roots = np.array([1.8751040687, 4.6940911330, 7.8547574382])
    expected = roots**2 * np.sqrt(bending / line / length**4)
    np.testing.assert_allclose(found.omega[[0, 2, 5]], expected, rtol=5e-5)
    np.testing.assert_allclose(found.omega[[0, 2, 5]], found.omega[[1, 3, 6]], rtol=1e-7)
    twisting = np.pi / 2.0 / length * np.sqrt(STEEL.lame[1] / STEEL.density)
    assert found.omega[4] == pytest.approx(twisting, rel=2e-3)
    across = np.array([1.0, 0.0, 0.0])
    moved = sag(found, np.stack([9.81 * across, 9.81 * along]))
    deep = line * 9.81 * length**4 / (8 * bending)
    # Modes of a pair are at right angles to the rounding of the stiffest mode.
    rounding = np.finfo(float).eps * (found.omega.max() / found.omega.min()) ** 2
    np.testing.assert_allclose(moved[0, :3], deep * across, rtol=1e-9, atol=rounding * deep)
    stretch = STEEL.density * 9.81 * length**2 / (2 * STEEL.young)
    np.testing.assert_allclose(moved[1, :3], stretch * along, rtol=1e-8, atol=rounding * deep)
    turn = line * 9.81 * length**3 / (6 * bending)
    np.testing.assert_allclose(moved[0, 3:], turn * np.cross(along, across), rtol=1e-9, atol=rounding * turn)


def test_a_force_and_a_moment_bend_a_cantilever_as_in_closed_form():
    body, along = beam(pieces=1)
    found = plant([body], [Link("weld", "rigid", End("beam", "foot"), GROUND)])
    bending, across = STEEL.young * Tube(0.1, 0.01).bending, np.array([1.0, 0.0, 0.0])
    force, moment = found.places["beam.tip"]
    patterns = np.zeros((2, found.modal.inputs.shape[1]), dtype=complex)
    patterns[0, force] = across
    patterns[1, moment] = np.cross(along, across)
    moved = steady(found, Shaking(np.full(2, 1e-4), patterns)).real
    np.testing.assert_allclose(moved[0, :3], 2.0**3 / (3 * bending) * across, rtol=1e-9, atol=1e-20)
    np.testing.assert_allclose(moved[1, :3], 2.0**2 / (2 * bending) * across, rtol=1e-9, atol=1e-20)
    np.testing.assert_allclose(moved[1, 3:], 2.0 / bending * np.cross(along, across), rtol=1e-9, atol=1e-20)


def test_a_beam_turns_under_its_floor_without_strain():
    """The floor turns slowly about the origin: the tip follows as a rigid body."""
    body, _ = beam()
    found = plant([body], [Link("weld", "rigid", End("beam", "foot"), GROUND)])
    pattern = np.zeros((1, found.modal.inputs.shape[1]), dtype=complex)
    pattern[0, 3:6] = [1e-6, 2e-6, 3e-6]
    moved = steady(found, Shaking(np.array([1e-3]), pattern))[0].real
    np.testing.assert_allclose(moved[3:], [1e-6, 2e-6, 3e-6], rtol=1e-8)
    np.testing.assert_allclose(moved[:3], np.cross([1e-6, 2e-6, 3e-6], [0.0, 1.2, 1.6]), rtol=1e-8)


@pytest.mark.parametrize(
    ("members", "words"),
    [
        ([("a", "c")], "leads to 'c', which is no node"),
        ([("a", "a")], "has no length"),
        ([("a", "b"), ("b", "a")], "given twice"),
        ([], "reaches its node 'a'"),
    ],
)
def test_bad_frames_are_said(members, words):
    with pytest.raises(UserError, match=words):
        beam_frame("frame", {"a": np.zeros(3), "b": np.ones(3)}, members, Tube(0.1, 0.01), STEEL)
