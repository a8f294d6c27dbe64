"""Stages push the bodies that carry them: closed forms of masses in a row, and what must stay as it is."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from tests.workflows.small_system import INTEGRATOR, LOOP, PERFECT, SYSTEM

import wavequake as wq
from wavequake.chain.loops.reaction import coordinates, load_mass, recoil_of
from wavequake.errors import UserError
from wavequake.mechanics.assembly.bodies import rigid_body
from wavequake.mechanics.assembly.links import End, Link
from wavequake.mechanics.assembly.plant import plant
from wavequake.workflows.loops.loop_margins import loops_of
from wavequake.workflows.loops.pushing import pushing_notices
from wavequake.workflows.loops.system_light import drawn_at, optics_of
from wavequake.workflows.loops.system_loop import bench_of, motion_left
from wavequake.workflows.study import load_study

ANGLES = 0.1 + 2 * np.pi / 3 * np.arange(3)
AROUND = {name: np.array([np.cos(w), np.sin(w), 0.0]) for name, w in zip("abc", ANGLES, strict=True)}
HEAVY, LIGHT = 30.0, 4.0
# Of the springs to the ground and between the masses: N/m and N s/m, of three each.
SPRINGS = (2e5, 5e4)


def row_of_masses(dampers, ground=True):
    """Two masses on each other, and on the ground; along z they are those of a row."""
    rows = {("rigid", name): np.eye(6) for name in ("heavy", "light")}
    bodies = [
        rigid_body(name, mass, mass * np.eye(3), np.zeros(3), AROUND, {("rigid", name): rows["rigid", name]})
        for name, mass in (("heavy", HEAVY), ("light", LIGHT))
    ]
    joins = [("ground", "heavy")] * ground + [("heavy", "light")]
    links = [
        Link(f"{one}-{other}-{node}", "spring", End(one, node), End(other, node), (k,) * 3, (d,) * 3)
        for (one, other), k, d in zip(joins, SPRINGS[-len(joins) :], dampers[-len(joins) :], strict=True)
        for node in AROUND
    ]
    return plant(bodies, links, AROUND)


def answer_of(found, s):
    recoil = recoil_of(found)
    each = [
        one.c @ np.linalg.solve(s * np.eye(2) - one.a, one.b.astype(complex)) + one.d
        for one in recoil.dynamics
    ]
    rows = coordinates(found)
    load = rows[found.outputs["rigid", "light"]].T @ load_mass(LIGHT, LIGHT * np.eye(3), np.zeros(3))
    return rows @ (recoil.outward * each) @ recoil.inward @ load


@pytest.mark.parametrize("dampers", [(0.0, 0.0), (2e2, 5e1), (900.0, 3.0), (1.0, 4e3)])
@pytest.mark.parametrize("hertz", [0.3, 11.0, 24.7, 300.0])
def test_two_masses_in_a_row_answer_as_they_must(dampers, hertz):
    """(s^2 M + s D + K) z = -s^2 (0, m) p, none, proportional, other and beyond critical dampers."""
    found, s = row_of_masses(dampers), 2j * np.pi * hertz + 0.1
    (low, high), (first, second) = (3.0 * np.array(one) for one in (dampers, SPRINGS))
    k, d = (np.array([[a + b, -b], [-b, b]]) for a, b in ((first, second), (low, high)))
    mass = np.diag([HEAVY, LIGHT])
    wanted = np.linalg.solve(s**2 * mass + s * d + k, [0.0, -(s**2) * LIGHT])
    answer = answer_of(found, s)
    z = [found.outputs["rigid", name].start + 2 for name in ("heavy", "light")]
    assert_allclose(answer[z, 2], wanted, rtol=1e-8)
    assert_allclose(np.delete(answer[:, 2], z), 0.0, atol=1e-9 * np.abs(wanted).max())


def test_what_floats_keeps_its_momentum_at_every_frequency():
    found = row_of_masses((900.0, 3.0), ground=False)
    for s in (0.01j, 30j, 200j + 5.0, 1e5j):
        answer = answer_of(found, s)[:, 2]
        heavy, light = (answer[found.outputs["rigid", name].start + 2] for name in ("heavy", "light"))
        assert_allclose(HEAVY * heavy + LIGHT * (light + 1.0), 0.0, atol=1e-9 * LIGHT)


BODIES = """
[[body]]
name = "primary"
surfaces = ["M1"]
[body.rigid]
mass_kg = 200.0
inertia_kg_m2 = [20.0, 22.0, 40.0]
nodes_mm = { a = [300.0, 0.0, 0.0], b = [-150.0, 260.0, 0.0], c = [-150.0, -260.0, 0.0] }
[[body]]
name = "secondary"
surfaces = ["M2"]
[body.rigid]
mass_kg = 12.0
inertia_kg_m2 = [0.1, 0.12, 0.2]
center_mm = [10.0, -20.0, 1900.0]
nodes_mm = { a = [300.0, 0.0, 1900.0], b = [-150.0, 260.0, 1900.0], c = [-150.0, -260.0, 1900.0] }
[[link]]
name = "spider"
kind = "springs"
joins = [["primary", "secondary.a"], ["primary", "secondary.b"], ["primary", "secondary.c"]]
stiffness_n_m = 3e5
damping_n_s_m = 1000.0
"""
TREMOR = """
[[disturbance]]
name = "tremor"
model = "vibration-lines"
duration_s = 0.25
instants = 40
lines = [{ frequency_hz = 20.0, fwhm_hz = 4.0, rms_mas = 300.0 }]
"""
FEET = """
[[link]]
name = "feet"
kind = "springs"
joins = [["primary.a", "ground"], ["primary.b", "ground"], ["primary.c", "ground"]]
stiffness_n_m = {stiffness}
[structure]
damping_ratio = {zeta}
"""


def written(folder, *parts):
    path = folder / "pushing.toml"
    head = '[study]\nname = "small"\nworkflow = "system-loop"\n'
    path.write_text(head + "\n".join([SYSTEM, BODIES, TREMOR, *parts]))
    return path


def test_a_loop_in_space_keeps_momentum_and_angular_momentum(tmp_path):
    """Nothing acts from outside: the sums over both mirrors are zero at all instants."""
    stage = LOOP.replace('of = "M2"', 'of = "secondary"')
    bench = bench_of(load_study(written(tmp_path, stage, INTEGRATOR.replace("0.3", "0.01"))))
    one = next(each for each in bench.controllers if each.name == "integrator")
    motion = motion_left(bench, one, 0).rigid
    bodies = {each.name: each for each in bench.study.body}
    momentum, angular, largest = 0.0, 0.0, 0.0
    for name, optical in ((each.name, each) for each in bench.optics.bench.bodies):
        rigid = bodies[name].rigid
        center = 1e-3 * np.array(rigid.center_mm or optical.point)
        moves, turns = motion[name][:, :3], motion[name][:, 3:]
        moves = moves + np.cross(turns, center - 1e-3 * optical.point)
        momentum = momentum + rigid.mass_kg * moves
        angular = angular + turns * rigid.inertia_kg_m2 + rigid.mass_kg * np.cross(center, moves)
        largest = max(largest, np.abs(rigid.mass_kg * moves).max())
    assert largest > 1e-7
    assert_allclose(momentum, 0.0, atol=1e-9 * largest)
    assert_allclose(angular, 0.0, atol=1e-8 * largest)


def test_a_loop_that_pushes_its_structure_out_of_bounds_names_the_mode(tmp_path):
    """Stiff, the loop has its margins; what it pushes on soft feet swings, if its mirror is heavy."""
    stage = LOOP.replace('of = "M2"', 'of = "secondary"')
    feet = FEET.format(stiffness=2e6, zeta=1e-3)
    path = written(tmp_path, stage, INTEGRATOR, feet)
    with pytest.raises(
        UserError, match=r"by the mode '.* of the bodies' \(.* Hz\); were all stiff, it would"
    ):
        wq.plan(path)
    light = load_study(path, {"actuator.stage.mass_kg": 1e-6})
    (alone,) = loops_of(load_study(written(tmp_path, LOOP, INTEGRATOR, feet)))
    (found,) = loops_of(light)
    assert found.gain_up == pytest.approx(alone.gain_up, rel=1e-5)


def test_nothing_moves_but_what_is_disturbed_without_a_controller(tmp_path):
    """`off` has the bits of the study without loops, bodies or not."""
    stage = LOOP.replace('of = "M2"', 'of = "secondary"')
    shaken = written(tmp_path, stage, PERFECT)
    wq.run(shaken, store=tmp_path / "loop", on="serial", cases=1)
    plain = tmp_path / "plain.toml"
    plain.write_text(written(tmp_path).read_text().replace("system-loop", "system-disturbance"))
    wq.run(plain, store=tmp_path / "plain", on="serial", cases=1)
    off = wq.open_store(tmp_path / "loop").load().sel(controller="off")
    found = wq.open_store(tmp_path / "plain").load()
    np.testing.assert_array_equal(off["los_mm"].to_numpy(), found["los_mm"].to_numpy())


@pytest.mark.parametrize(
    ("of", "bodies", "words"),
    [
        ("M2", False, "no .*body.* of the study has mass"),
        ("image", True, "no body with mass carries 'image'"),
    ],
)
def test_a_mass_that_nothing_carries_is_refused(of, bodies, words, tmp_path):
    path = written(tmp_path, LOOP.replace('of = "M2"', f'of = "{of}"\nmass_kg = 2.0'), PERFECT)
    if not bodies:
        path.write_text(path.read_text().replace(BODIES, ""))
    with pytest.raises(UserError, match=f"actuator.stage.mass_kg: {words}"):
        optics_of(load_study(path))


def test_a_stage_under_a_surface_pushes_with_the_mass_that_it_is_told(tmp_path):
    """The same point mass, moved with the body that is one surface, or with this surface: one loop."""
    soft = INTEGRATOR.replace("0.3", "0.01")
    found = []
    for of in ("secondary", "M2"):
        stage = LOOP.replace('of = "M2"', f'of = "{of}"\nmass_kg = 12.0')
        optics = optics_of(load_study(written(tmp_path, stage, soft)))
        found.append(optics.answers[0].drives["stage"])
    # The body turns about the vertex of its surface.
    assert_allclose(found[0], found[1], rtol=1e-9, atol=1e-12 * np.abs(found[0]).max())


def test_what_does_not_say_its_mass_does_not_push_and_is_named(tmp_path):
    found = load_study(written(tmp_path, LOOP, PERFECT))
    (said,) = pushing_notices(found)
    assert said.startswith("actuator.stage: the body 'secondary' carries 'M2', but how much of its mass")
    assert optics_of(found).answers == ()


NODES = """
[[sensor]]
name = "felt"
model = "displacement"
rate_hz = 1000.0
nodes = ["primary.d?", "secondary.d?", "secondary.a.d?"]
"""


def test_nodes_that_sensors_read_keep_momentum_in_space(tmp_path):
    """What the stage moves and what answers it, by the centers of mass of both mirrors at any frequency."""
    stage = LOOP.replace('of = "M2"', 'of = "secondary"').replace('["rx", "ry"]', '["dx", "ry", "dz"]')
    optics = optics_of(load_study(written(tmp_path, stage, PERFECT, NODES)))
    (answer,) = optics.answers
    names, first = optics.light.nodes, len(optics.light) - len(optics.light.nodes)
    rows = {name: first + k for k, name in enumerate(names)}
    channels = optics.sights["stage"].shape[1]
    for s in (20j, 2e3j + 1.0):
        each = [one.c @ np.linalg.solve(s * np.eye(2) - one.a, one.b + 0j) + one.d for one in answer.dynamics]
        found = (answer.shown * each) @ answer.drives["stage"] + optics.sights["stage"]
        for dof in ("dx", "dy", "dz"):
            total = 200.0 * found[rows[f"primary.{dof}"]] + 12.0 * found[rows[f"secondary.{dof}"]]
            assert_allclose(total, np.zeros(channels), atol=1e-7)
    assert np.abs(found[rows["secondary.dx"]]).max() > 0.1


def test_a_node_of_a_shaken_body_moves_as_a_rigid_body(tmp_path):
    """By its motion about the vertex and the arm from there."""
    pump = '[[disturbance]]\nname = "pump"\nmodel = "body-force"\nat = ["secondary.b"]\nduration_s = 0.25\n'
    pump += "direction = [1.0, 0.4, 0.2]\ninstants = 40\nlines = [{ frequency_hz = 20.0, force_n = 0.5 }]\n"
    feet = FEET.format(stiffness=2e6, zeta=1e-2)
    path = written(tmp_path, LOOP, PERFECT, NODES, pump, feet)
    optics = optics_of(load_study(path))
    motion = drawn_at(optics, optics.bench.study.disturbance[1], 0, np.linspace(0.0, 0.2, 9))
    seen = optics.see(motion)[:, len(optics.light) - len(optics.light.nodes) :]
    moved = motion.rigid["secondary"]
    optical = next(one for one in optics.bench.bodies if one.name == "secondary")
    arm = np.array([0.3, 0.0, 1.9]) - 1e-3 * optical.point
    turned = np.kron(np.eye(2), optical.rotation)
    moved = moved @ turned.T
    wanted = 1e9 * (moved[:, :3] + np.cross(moved[:, 3:], arm))
    places = [optics.light.nodes.index(f"secondary.a.{dof}") for dof in ("dx", "dy", "dz")]
    assert_allclose(seen[:, places], wanted, rtol=0, atol=1e-6 * np.abs(wanted).max())


def test_a_sensor_that_sees_nothing_of_what_is_expected_is_named(tmp_path):
    """Lines move as the stage does, which nodes do not see: with the frequency of what is expected."""
    both = PERFECT.replace("perfect", "both").replace('model = "both"', 'model = "lqg-fusion"')
    both += 'also_reads = ["felt"]\nlines = [{ hz = 20.0, rms = 9.0 }]\n'
    noisy = NODES + "noise = 1.0\n", LOOP.replace("rate_hz = 1000.0", "rate_hz = 1000.0\nnoise = 9.0")
    path = written(tmp_path, *noisy[::-1], both, FEET.format(stiffness=2e6, zeta=1e-2))
    with pytest.raises(UserError, match=r"both: the sensor 'felt' sees nothing of what it expects \(20 Hz\)"):
        wq.plan(path)
