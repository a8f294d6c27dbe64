"""Segments that move, against closed forms, a foreign tracer and matrix exponentials."""

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.linalg
from small_segments import STUDY, text_of

from wavequake.kernels.device.devices import choose_device
from wavequake.mechanics.mirrors.models import HexagonalSegment, mirror_mesh
from wavequake.optics.segments.catalog import telescope
from wavequake.workflows.kinds import study_of
from wavequake.workflows.mirrors.segment_body import build_segment, hexagon_of, motion_rows, variant_of
from wavequake.workflows.segments.bench import bench_of
from wavequake.workflows.segments.mor import launches, traced
from wavequake.workflows.segments.mor_bench import (
    chosen_segments,
    model_of,
    motions,
    segment_drive,
    traced_instants,
)
from wavequake.workflows.segments.mor_study import telescope_study
from wavequake.workflows.study import load_study

DATA = Path(__file__).parents[1] / "data"
pytestmark = pytest.mark.usefixtures("mirror_models")


RECORD = "\n".join(f"{t},{50e-9 * (1 - np.cos(np.pi * t / 2))}" for t in np.linspace(0, 2, 401))


@pytest.mark.parametrize("support", ["springs", "rigid"])
def test_supports_that_rise_slowly_lift_the_segment_as_one(tmp_path, support):
    (tmp_path / "rise.csv").write_text(RECORD)
    rise = '[[excitation]]\nname = "rise"\nkind = "file"\nfile = "rise.csv"\n'
    (tmp_path / "study.toml").write_text(STUDY.split("[[excitation]]")[0] + rise)
    study = load_study(
        tmp_path / "study.toml",
        [
            f"model.support={support}",
            "time.duration_s=2.0",
            "time.step_s=5e-3",
            "time.traced=4",
            "optics.sampling=sunflower",
            "optics.zernike_terms=45",
            "segments.signs=alike",
        ],
    )
    text = study.identity_text()
    model, lifted = model_of(text), 100e-9
    moved = motions(study, model, model.reference, [7])[0, -1, 0]
    np.testing.assert_allclose(moved[2], lifted * 1e3, rtol=1e-4)
    assert np.abs(np.delete(moved, 2)).max() < 1e-4 * moved[2]

    seen = traced(study, model.bench, "one", moved[None, None, None], choose_device("auto"))
    # Segment 8 of a tracer that shares no code with ours: waves per m along z of the optics, of which the
    # normal's part counts; the rest slides the segment along its surface.
    facts = json.loads((DATA / "tmt18_segments.json").read_text())
    per_z = np.linalg.norm(facts["piston_z"]["zernike"][7][3:])
    along = model.bench.system.segments.axes[7, 2, 2]
    np.testing.assert_allclose(seen["wfe_zernike"][0, 0], per_z / along * lifted * 550.0, rtol=1e-2)


def test_one_lifted_segment_is_a_plateau_of_the_wavefront():
    text = text_of("optics.rays_per_segment=72")
    study, model = study_of(text), model_of(text)
    moved = np.zeros((1, 1, 1, 6 + 11))
    moved[..., 2] = 50e-6  # mm
    seen = traced(study, model.bench, "one", moved, choose_device("auto"))
    # An indicator of 1/18 of the glass, less its projections on piston, x and y over 18 equal hexagons.
    centers, side = model.bench.system.segments.centers[:, :2], hexagon_of(model.bench.system)[0]
    spread = np.mean(centers**2) + 5 / 24 * side**2
    share = 1 / 18
    square = share - share**2 - np.sum((share * centers[7]) ** 2) / spread
    rise = 2 * 50.0 * model.bench.system.segments.axes[7, 2, 2]
    np.testing.assert_allclose(seen["wfe_rms"][0, 0], rise * np.sqrt(square), rtol=5e-3)


@pytest.mark.parametrize("name", ["A1", "B10"])
def test_one_lifted_segment_of_the_tmt_is_that_of_a_foreign_tracer(name):
    facts = json.loads((DATA / "tmt492_segments.json").read_text())["segments"]
    study = study_of(text_of("telescope.name=tmt", f"segments.name={name}"))
    bench = bench_of(telescope_study(study).identity_text())
    (place,) = chosen_segments(study, bench, "one")
    moved = np.zeros((1, 1, 1, 6 + 11))
    moved[..., :3] = 50e-6 * bench.system.segments.axes[place, 2]  # along the telescope's axis, mm
    seen = traced(study, bench, "one", moved, choose_device("auto"))
    # Theirs keeps the plane, of which one of 492 segments has little.
    center, share = bench.system.segments.centers[place, :2], 1 / 492
    plane = share * np.sum(center**2) / np.mean(bench.system.segments.centers[:, :2] ** 2)
    expected = 50.0 * facts[name]["piston_z"]["rms_opd_full_pupil_piston_removed"]
    np.testing.assert_allclose(seen["wfe_rms"][0, 0], expected * (1 - plane / 2), rtol=2e-3)


def test_a_stiff_segment_on_springs_is_an_oscillator():
    text = text_of("model.spring_n_m=[5e6, 5e6, 5e6]", "time.duration_s=0.5", "time.traced=100")
    study, model = study_of(text), model_of(text)
    side = hexagon_of(model.bench.system)[0] / 1e3
    mass = 1.5 * np.sqrt(3.0) * side**2 * study.model.thickness_m * study.model.density_kg_m3
    own, driven = np.sqrt(3 * 5e6 / mass), 2 * np.pi * 20.0
    time = study.time.seconds[traced_instants(study)]
    ratio = driven / own
    # From rest, under a ground that moves as a sin(w t).
    expected = 5e-6 / (1 - ratio**2) * (np.sin(driven * time) - ratio * np.sin(own * time))
    moved = motions(study, model, model.reference, [7])[0, :, 0]
    sign = np.sign(moved[-1, 2] * expected[-1])
    np.testing.assert_allclose(sign * moved[:, 2], expected, rtol=0, atol=1e-2 * np.abs(expected).max())


def test_the_response_is_that_of_the_whole_model_by_matrix_exponentials():
    text = text_of("model.divisions=2", "model.mount_radius_m=1.72")
    study, model = study_of(text), model_of(text)
    side, turn = hexagon_of(model.bench.system)
    full = build_segment(study.model, side, model.bench.system.primary.shape.radius)
    mass, damping, stiffness = (
        np.asarray(matrix.todense()) for matrix in (full.mass, full.damping_matrix, full.stiffness)
    )
    order, time = len(mass), study.time.seconds
    step = time[1]
    drive = segment_drive(study, study.excitation[1], time, 7)
    inverse = np.linalg.inv(mass)
    # State, force and its slope; the force is joined by lines.
    system = np.zeros((2 * order + 2, 2 * order + 2))
    system[:order, order : 2 * order] = np.eye(order)
    system[order : 2 * order, :order] = -inverse @ stiffness
    system[order : 2 * order, order : 2 * order] = -inverse @ damping
    pattern = np.asarray(full.inputs.todense())[:, 2::3].sum(axis=1)
    system[order : 2 * order, 2 * order] = inverse @ pattern
    system[2 * order, 2 * order + 1] = 1.0
    power = scipy.linalg.expm(system * step)
    force, state, found = drive.samples[:, 2], np.zeros(2 * order + 2), []
    for number in range(len(time)):
        state[2 * order] = force[number]
        found.append(state[:order].copy())
        if number + 1 < len(time):
            state[2 * order + 1] = (force[number + 1] - force[number]) / step
            state = power @ state
    nodes = np.array(found)[traced_instants(study)] @ np.asarray(full.surface.todense()).T
    turned = nodes.reshape(len(nodes), -1, 3) @ np.array(
        [[np.cos(turn), np.sin(turn), 0], [-np.sin(turn), np.cos(turn), 0], [0, 0, 1]]
    )
    moved = motions(study, model, model.reference, [7])[1, :, 0]
    # Rebuild the heights of the nodes from rigid motion and figure, by least squares of their own.
    x, y, z = model.fit.nodes.T / 1e3
    weights = np.sqrt(full.surface_weights)
    columns = [
        np.concatenate(parts)
        for parts in (
            (weights, 0 * x, 0 * x),
            (0 * x, weights, 0 * x),
            (0 * x, 0 * x, weights),
            (0 * x, -z * weights, y * weights),
            (z * weights, 0 * x, -x * weights),
            (-y * weights, x * weights, 0 * x),
        )
    ]
    stacked = (turned * weights[None, :, None]).transpose(0, 2, 1).reshape(len(turned), -1)
    poses = np.linalg.lstsq(np.stack(columns, axis=1), stacked.T, rcond=None)[0].T
    scale = np.abs(moved[:, 2]).max()
    np.testing.assert_allclose(moved[:, :3], poses[:, :3] * 1e3, rtol=0, atol=1e-6 * scale)
    np.testing.assert_allclose(moved[:, 3:6], poses[:, 3:], rtol=0, atol=1e-9 * scale)
    # The error of a variant is its distance from this truth.
    small = motions(study, model, variant_of(model, "guyan9"), [7])[1, :, 0]
    assert np.abs(small[:, 2] - poses[:, 2] * 1e3).max() > 1e-4 * scale


def test_figure_and_rigid_motion_of_a_known_displacement():
    model = model_of(text_of())
    stage, side = model.stage, hexagon_of(model.bench.system)[0]
    assert np.isclose(np.rad2deg(model.turn), 30.0)
    x, y, z = stage.nodes[stage.surface_nodes].T * 1e3 / side
    rho2 = x**2 + y**2
    astigmatism = np.sqrt(6) * (x**2 - y**2)  # about the corner, 30 degrees off the local x axis
    defocus = np.sqrt(3) * (2 * rho2 - 1)
    shapes = np.zeros((4, len(x), 3))
    shapes[0, :, 2] = 3e-9 * astigmatism
    shapes[1, :, 2] = 2e-9 * defocus
    shapes[2, :, 0] = 1e-9  # along the corner
    shapes[3] = 1e-9 * np.cross([0.0, 0.0, 1.0], np.stack([x, y, z], axis=1) * side / 1e3)
    rows = motion_rows(model.fit, model.turn, SimpleNamespace(order=4, surface=shapes.reshape(4, -1).T))
    figure = rows[6:]
    # Of an astigmatism, a hexagon leaves no rigid motion.
    np.testing.assert_allclose(figure[[4, 5], 0], 3e-6 * np.array([np.sin(np.pi / 3), 0.5]), rtol=1e-3)
    np.testing.assert_allclose(figure[3, 1], 2e-6, rtol=1e-9)
    np.testing.assert_allclose(
        rows[:3, 2], 1e-6 * np.array([np.cos(np.pi / 6), 0.5, 0.0]), rtol=0, atol=1e-15
    )
    np.testing.assert_allclose(rows[:6, 3], [0, 0, 0, 0, 0, 1e-9], rtol=0, atol=1e-15)
    assert np.abs(figure[:, 2:]).max() < 1e-15


def test_small_motions_of_segments_add_up():
    text = text_of()
    study, model = study_of(text), model_of(text)
    every = chosen_segments(study, model.bench, "all")
    moved = motions(study, model, model.reference, every.tolist())[1, -2:]
    device = choose_device("auto")
    rest = next(launches(model.bench, every, 0 * moved, device))[2].opd
    whole = next(launches(model.bench, every, moved, device))[2].opd - rest
    parts = [
        next(launches(model.bench, every[k : k + 1], moved[:, k : k + 1], device))[2].opd - rest
        for k in every
    ]
    instants = (..., slice(0, 2))
    np.testing.assert_allclose(
        np.sum(parts, axis=0)[instants], whole[instants], rtol=0, atol=1e-4 * np.abs(whole[instants]).max()
    )


def test_one_segment_moves_as_it_does_among_all_and_is_paired_between_variants():
    text = text_of()
    study, model = study_of(text), model_of(text)
    everyone = motions(study, model, model.reference, list(range(18)))
    alone = motions(study, model, model.reference, [7])
    np.testing.assert_allclose(alone[:, :, 0], everyone[:, :, 7], rtol=0, atol=1e-12 * np.abs(alone).max())
    pistons = everyone[0, :, :, 2]
    signs = np.sign(pistons / pistons[:, :1])
    assert set(signs[-1]) == {-1.0, 1.0}
    np.testing.assert_allclose(np.abs(pistons), np.abs(pistons[:, :1]) * np.ones(18), rtol=1e-9)
    # Random vibrations differ from segment to segment.
    matrix = np.corrcoef(everyone[1, :, :, 2].T)
    assert np.abs(matrix[np.triu_indices(18, 1)]).max() < 0.99
    alike = load_study_of(text_of("segments.signs=alike"))
    np.testing.assert_array_equal(np.sign(motions(*alike, [0, 1, 2])[0, -1, :, 2]).std(), 0.0)


def load_study_of(text):
    model = model_of(text)
    return study_of(text), model, model.reference


def test_a_corner_of_the_model_is_a_corner_of_the_segment():
    for name, degrees in (("tmt", 0.0), ("tmt-18", 30.0), ("jwst", 0.0)):
        system = telescope(name)
        side, turn = hexagon_of(system)
        assert np.isclose(np.rad2deg(turn), degrees, atol=1.0), name
        mesh = mirror_mesh(HexagonalSegment(side=side / 1e3, mount_radius=0.3 * side / 1e3, divisions=4))
        front = mesh.nodes[mesh.front_nodes]
        farthest = front[np.argmax(front[:, 0])]
        np.testing.assert_allclose(farthest[:2], [side / 1e3, 0.0], rtol=0, atol=1e-9)
