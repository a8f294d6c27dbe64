"""Bodies that carry segments and mirrors, against closed forms, a dense solution and the other spine."""

from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from small_bodies import floor, shaken
from small_carried import CELL, M2_ELASTIC, SPIDER, STUDY, TOP, numbers, text_of

from wavequake.kernels.device.devices import NUMPY
from wavequake.mechanics.disturbances.streams import own_streams
from wavequake.optics.rays.pupils import sunflower
from wavequake.optics.segments.catalog import telescope
from wavequake.optics.segments.parent import parent_system
from wavequake.optics.systems.kinematics import rest_states
from wavequake.optics.wavefronts.wavefront import measure_system, prepare_system
from wavequake.workflows.segments.bench import bench_of
from wavequake.workflows.segments.disturbance import KIND, draw
from wavequake.workflows.segments.draws import bodies_sight
from wavequake.workflows.systems.bench import system_bench
from wavequake.workflows.systems.disturbance import KIND as SYSTEM


def test_m2_on_springs_swings_as_the_closed_form_says(tmp_path):
    """Force along x at 37 Hz on 3000 kg over four springs; the floor's shift along y at 30 Hz, damped."""
    force = 'model = "body-force"\nat = ["top"]\ndirection = [1.0, 0.0, 0.0]\n'
    force += "lines = [{ frequency_hz = 37.0, force_n = 2.0 }]"
    damped = "[structure]\ndamping_ratio = 0.03\n"
    swing = {}
    for name, how in (("dx", shaken(force)), ("dy", floor("dy_um = 0.5", 30.0))):
        bench = bench_of(text_of(tmp_path, STUDY, TOP, SPIDER, damped, how))
        drawn = draw(bench, 0)
        moved = drawn.motion.rigid["M2"]
        axis = {"dx": 0, "dy": 1}[name]
        np.testing.assert_allclose(np.delete(moved, axis, axis=1), 0.0, atol=1e-9 * np.abs(moved).max())
        omega = 2 * np.pi * (37.0 if name == "dx" else 30.0)
        columns = np.exp(1j * omega * drawn.time)
        fit = np.linalg.lstsq(np.column_stack([columns.real, -columns.imag]), moved[:, axis])[0]
        swing[name] = np.hypot(*fit)
    assert bench.bodies.plants["full"].grounded

    def answer(stiffness, omega):
        return stiffness - 3000.0 * omega**2 + 2j * 0.03 * np.sqrt(stiffness * 3000.0) * omega

    wanted = 2.0 / abs(answer(4 * 2e7, 2 * np.pi * 37.0))
    assert swing["dx"] == pytest.approx(wanted, rel=1e-9)
    stiff, omega = 4 * 3e7, 2 * np.pi * 30.0
    # Damping is relative to the floor, which pushes through it, too.
    pushed = stiff + 2j * 0.03 * np.sqrt(stiff * 3000.0) * omega
    assert swing["dy"] == pytest.approx(0.5e-6 * abs(pushed / answer(stiff, omega)), rel=1e-9)


def test_a_rigid_cell_tilts_segments_as_the_whole_mirror_tilts(tmp_path):
    """A slow floor: segments move as points of one body, and light as by M1 of one piece that moves so."""
    rays = 'sampling = "sunflower"\nrays = 600'
    how = floor("rx_urad = 3.0, rz_urad = 1.0, dy_um = 2.0", 0.5)
    bench = bench_of(text_of(tmp_path, STUDY.replace("rays_per_segment = 6", rays), CELL, how))
    motion, system = draw(bench, 0).motion, bench.system
    assert not motion.rigid
    centers, axes = system.segments.centers, system.segments.axes * np.array([1.0, 1.0, -1.0])[:, None]
    shifts = 1e3 * np.einsum("kij,tkj->tki", axes, motion.segment_motion[..., :3])
    turns = np.einsum("kij,tkj->tki", -axes, motion.segment_motion[..., 3:])
    turn = turns[:, 0]
    assert np.abs(turn[:, 0]).max() > 1e-7
    np.testing.assert_allclose(turns, np.repeat(turn[:, None], 18, axis=1), atol=1e-9 * np.abs(turn).max())
    shift = shifts[:, 0] - np.cross(turn, centers[0])  # of the vertex
    whole = shift[:, None] + np.cross(turn[:, None], centers)
    np.testing.assert_allclose(shifts, whole, atol=1e-9 * np.abs(shifts).max())
    parent = parent_system(system)
    pupil = sunflower(parent.pupil.obscuration, 1.0, 600)
    one = prepare_system(parent, pupil.x, pupil.y, pupil.weight, 11)
    states = rest_states(parent, len(turn))
    states.surface_motion[:, 1, :3], states.surface_motion[:, 1, 3:] = shift, turn
    moved, rest = measure_system(one, states, NUMPY), measure_system(one, rest_states(parent), NUMPY)
    found = numbers(bench.text)
    to_mas = np.rad2deg(1.0 / abs(bench.first_order.focal_length)) * 3.6e6
    sight = moved.los * to_mas
    assert np.abs(sight[:, 1]).max() > 50.0
    np.testing.assert_allclose(found["los"][0], sight, atol=1e-5 * np.abs(sight).max())
    bent = (moved.zernike - rest.zernike)[:, 3:] * 550.0
    change = found["zernike"][0, :, 3:] - bench.static.zernike[0, 3:] * 550.0
    assert np.abs(bent).max() > 10.0
    # The spheres differ: the chief ray of segments meets M1 at rest.
    np.testing.assert_allclose(change, bent, atol=2e-3 * np.abs(bent).max())


EVERYTHING = CELL.replace('["M1"]', '["M1", "M2", "M3", "image"]')


def test_a_telescope_that_moves_as_one_only_points_elsewhere(tmp_path):
    """Every part on one rigid body: turns of the floor are the line of sight, and no wavefront changes."""
    for amplitude, wanted in (
        ("rx_urad = 2.0", 2e-6),
        ("ry_urad = 2.0", 2e-6),
        ("dx_um = 5.0, dz_um = 9.0", 0),
    ):
        found = numbers(text_of(tmp_path, STUDY, EVERYTHING, floor(amplitude)))
        bench = bench_of(text_of(tmp_path, STUDY, EVERYTHING, floor(amplitude)))
        motion = draw(bench, 0).motion
        turn = np.abs(motion.rigid["M2"][:, 3:5]).max()
        assert turn == pytest.approx(wanted, rel=0.5, abs=1e-13)
        size = np.rad2deg(turn) * 3.6e6
        assert np.hypot(*found["los"][0].T).max() == pytest.approx(size, rel=1e-4, abs=1e-4)
        change = found["zernike"][0, :, 3:] - bench.static.zernike[0, 3:] * bench.wavelength_nm
        assert np.abs(change).max() < 0.05


MONOLITH = STUDY.replace('"tmt-18"', '"tmt-thesis"').replace("zernike_terms = 11", "zernike_terms = 28")
SURFACES = MONOLITH.replace("segment-disturbance", "system-disturbance").replace("[telescope]", "[system]")
SURFACES = SURFACES.replace("[imaging]\nenabled = false\n", "")
SURFACES = SURFACES.replace("rays_per_segment = 6", "rays = 600")
MONOLITH = MONOLITH.replace("rays_per_segment = 6", 'sampling = "sunflower"\nrays = 600')


def test_an_elastic_m2_bends_as_in_a_system_of_surfaces(tmp_path):
    """The same body, weight and floor on the other spine of optics, whose rays and chief ray are others."""
    sag = 'model = "gravity"\nelevation_deg = [62.0, 58.0]\naligned_deg = 60.0'
    how = shaken(sag, 3) + floor("dx_um = 0.4, ry_urad = 0.2", 25.0).replace('"one"', '"two"')
    how += shaken('model = "combine"\nof = ["one", "two"]', 3).replace('"one"\ndur', '"both"\ndur')
    own = text_of(tmp_path, MONOLITH, M2_ELASTIC, how, campaign__cases=3)
    other = text_of(tmp_path, SURFACES, M2_ELASTIC, how, campaign__cases=3)
    bench = bench_of(own)
    found, wanted = KIND.compute(own, np.array([2]), "numpy"), SYSTEM.compute(other, np.array([2]), "numpy")
    assert not any(found.messages + wanted.messages)
    moved = found.arrays["zernike"][0, :3] - bench.static.zernike[0] * bench.wavelength_nm
    other_rest = system_bench(other).static[0][0].zernike[0] * bench.wavelength_nm
    expected = wanted.arrays["zernike"][0, :3, 0, 0] - other_rest
    assert np.abs(expected).max() > 100.0
    np.testing.assert_allclose(moved, expected, atol=1e-4)
    to_mas = np.rad2deg(1.0 / bench.first_order.focal_length) * 3.6e6
    sight = wanted.arrays["los_mm"][0, :3, 0, 0] * abs(to_mas)
    np.testing.assert_allclose(found.arrays["los"][0, :3], sight, atol=1e-6 * np.abs(sight).max())


def npz(folder, **arrays):
    held = BytesIO()
    np.savez(held, **arrays)
    (Path(folder) / "own.npz").write_bytes(held.getvalue())


OWN = """
[[body]]
name = "tower"
[body.matrices]
file = "own.npz"
[body.matrices.carries]
"[1-4]" = ["{}a", "{}b", "{}c"]
"5" = ["5a", "5b", "5c"]
M2 = "ring"
"""


def test_segments_on_three_nodes_follow_a_dense_solution(tmp_path):
    """Own matrices, of random stiffness: nodes by one dense solve, segments and M2 by geometry."""
    system, random = telescope("tmt-18"), np.random.default_rng(5)
    centers = dict(zip(system.segments.names, system.segments.centers, strict=True))
    around = np.array([[900.0, 100.0, 300.0], [-600.0, 700.0, 280.0], [-400.0, -800.0, 310.0]])
    names = [f"{name}{letter}" for name in "12345" for letter in "abc"]
    nodes = np.concatenate([centers[name] + around for name in "12345"])
    names, nodes = [*names, "ring"], np.vstack([nodes, [300.0, -200.0, -26000.0]])
    size, count = 30, len(nodes)
    inputs, turns = random.standard_normal((2, size, 3 * count)) * [[[1.0]], [[1e-3]]]
    stiffness = random.standard_normal((size, size))
    stiffness = 1e6 * (stiffness @ stiffness.T + 10.0 * np.eye(size))
    mass, damping = np.diag(random.uniform(50.0, 90.0, size)), 1e-4 * stiffness
    npz(
        tmp_path,
        mass=mass,
        stiffness=stiffness,
        damping=damping,
        nodes_mm=nodes,
        inputs=inputs,
        turns=turns,
        names=np.array(names),
    )
    line = "lines = [{ frequency_hz = 23.0, force_n = 5.0 }]"
    how = shaken(f'model = "body-force"\nat = ["tower.ring"]\ndirection = [0.0, 1.0, 0.0]\n{line}')
    bench = bench_of(text_of(tmp_path, STUDY, OWN, "[structure]\ndamping_ratio = 0.0\n", how))
    drawn = draw(bench, 0)
    omega = 2 * np.pi * 23.0
    dynamic = stiffness - omega**2 * mass + 1j * omega * damping
    swing = np.linalg.solve(dynamic, inputs[:, 3 * (count - 1) + 1] * 5.0)
    phase = np.exp(1j * omega * drawn.time)
    # The phase of the force is drawn; M2's largest motion tells it.
    m2 = turns[:, -3:].T @ swing
    seen = drawn.motion.rigid["M2"][:, 3:]
    start = np.linalg.lstsq(
        np.column_stack([(m2[0] * phase).real, -(m2[0] * phase).imag]), seen[:, 0], rcond=None
    )[0]
    swing = swing * (start[0] + 1j * start[1])
    assert abs(start[0] + 1j * start[1]) == pytest.approx(1.0, rel=1e-9)
    np.testing.assert_allclose(seen, np.outer(phase, turns[:, -3:].T @ swing).real, rtol=1e-9, atol=1e-18)
    away = (np.array([0.0, 0.0, -27093.75]) - nodes[-1]) * 1e-3
    moved = inputs[:, -3:].T @ swing + np.cross(turns[:, -3:].T @ swing, away)
    np.testing.assert_allclose(
        drawn.motion.rigid["M2"][:, :3], np.outer(phase, moved).real, rtol=1e-9, atol=1e-18
    )
    for place, name in enumerate("12345"):
        own = nodes[3 * place : 3 * place + 3] * 1e-3
        shift = (inputs[:, 9 * place : 9 * place + 9].T @ swing).reshape(3, 3)
        middle = own.mean(axis=0)
        # u = t + e x a, by its nine equations.
        rows = [np.hstack([np.eye(3), np.cross(np.eye(3), arm).T]) for arm in own - middle]
        fit = np.linalg.lstsq(np.vstack(rows), shift.ravel())[0]
        turn = fit[3:]
        there = fit[:3] + np.cross(turn, centers[name] * 1e-3 - middle)
        axes = np.diag([1.0, 1.0, -1.0]) @ bench.system.segments.axes[bench.layout.names.index(name)]
        index = bench.layout.names.index(name)
        wanted = np.concatenate([axes.T @ there, -axes.T @ turn])
        found = drawn.motion.segment_motion[:, index]
        np.testing.assert_allclose(found, np.outer(phase, wanted).real, rtol=1e-8, atol=1e-18)
    plant, population = bench.bodies.plants["full"], bench.study.disturbance[0]
    assert len(plant.shapes) == 36 > len(plant.omega)  # so that light is traced by modes, not by outputs
    sight = bodies_sight(bench, plant, "full", population, 0, own_streams, drawn.time)
    seen = np.deg2rad(numbers(bench.text)["los"][0] / 3.6e6)
    np.testing.assert_allclose(sight, seen, atol=1e-4 * np.abs(seen).max())
    still = [bench.layout.names.index(name) for name in bench.layout.names if name not in set("12345")]
    assert not drawn.motion.segment_motion[:, still].any()
