"""A lens on a stage in a loop: against paraxial matrices, and traced light."""

import numpy as np
import pytest
from small_loops import table
from study_text import controller, part
from test_camera_lenses import CAMERA, through
from test_custom_telescope import SQUARES

from wavequake.campaign.stopwatch import Stopwatch
from wavequake.errors import UserError
from wavequake.mechanics.disturbances.motion import RAD_PER_MAS
from wavequake.workflows.loops import telescope_loop
from wavequake.workflows.loops.telescope_bench import bench_of
from wavequake.workflows.study import load_study

LOOP = "".join(
    [
        part("disturbance", name="history", model="segment-history", peak_nm=50.0, instants=200),
        part("sensor", name="camera", model="line-of-sight", noise=0.01),
        part("actuator", name="stage", model="optic", of="lens", dofs=["dx", "dy"], resonance_hz=400.0),
        part("actuator", name="window", model="optic", of="cryostat", dofs=["rx", "ry"]),
        part("actuator", name="plate", model="optic", of="image"),
        controller("off", "off"),
        controller("perfect", "perfect", "camera", "stage"),
        controller("lens", "integrator", "camera", "stage", bandwidth_hz=100.0, latency_frames=0),
        "[look]\ntraced = 4\n",
    ]
)


def studied(tmp_path, old="", new=""):
    """Return the camera with its lens on a stage; its image stands where light of 550 nm meets."""
    (tmp_path / "polygons.csv").write_text(SQUARES)
    text = CAMERA.replace("segment-disturbance", "telescope-loop").replace(
        "wavelengths_nm = [550.0, 560.0]", "wavelength_nm = 550.0"
    )
    text = text[: text.index("[[disturbance]]")] + LOOP
    (tmp_path / "camera.toml").write_text(text.replace(old, new))
    return load_study(tmp_path / "camera.toml")


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    return bench_of(studied(tmp_path_factory.mktemp("lens")))


def test_a_lens_and_a_plate_move_the_image_as_paraxial_matrices_say(bench):
    """A lens that shifts by d moves it by (1 - A) d, A from height at the lens to height at the image."""
    before, after = through(550.0)
    focal = 1.0 / abs((after @ before)[1, 0])
    sights = bench.optics.sights
    to_mas = 1e-6 / RAD_PER_MAS / focal
    lens = (1.0 - after[0, 0]) * to_mas
    wanted = abs(lens) * np.eye(2)
    np.testing.assert_allclose(np.abs(sights["stage"][:2]), wanted, rtol=2e-3, atol=1e-6 * abs(lens))
    np.testing.assert_allclose(np.abs(sights["plate"][:2]), to_mas * np.eye(2), rtol=1e-6, atol=1e-9 * to_mas)
    # A plane plate of thickness t and index n that turns by a shifts light by a t (1 - 1/n).
    silica = 1.4599
    plate = 20.0 * (1 - 1 / silica) * abs(after[0, 0]) * 1e-9 / RAD_PER_MAS / focal
    found = np.abs(sights["window"][:2])
    np.testing.assert_allclose([found[0, 1], found[1, 0]], plate, rtol=5e-3)


def test_a_loop_by_the_lens_holds_the_line_of_sight(bench):
    (block,) = telescope_loop.compute(bench, table(bench, 2), "numpy", Stopwatch())
    rms = np.sqrt((block.result["los"] ** 2).mean(axis=(0, 2, 3)))
    off, perfect, lens = rms
    assert perfect < 1e-9 * off
    assert lens < 0.4 * off
    assert block.result["light_error_los"].max() < 1e-4 * off
    assert not block.messages


def test_a_stage_under_nothing_is_said_in_a_sentence(tmp_path):
    words = "actuator.stage.of: there is no surface or body 'lense' to move; there is M2, .*cryostat, lens"
    with pytest.raises(UserError, match=words):
        bench_of(studied(tmp_path, 'of = "lens"', 'of = "lense"'))
