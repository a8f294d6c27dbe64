"""The viewer's films of loops, lines of sight, sweeps and structures against what their stores hold."""

import numpy as np
import pytest
from tests.workflows.small_disc import DISC

import wavequake as wq
from wavequake.control.frames.disturbance import sampled
from wavequake.viewer.film import displacements
from wavequake.viewer.view import film_of
from wavequake.workflows.loops.tip_tilt import shaped
from wavequake.workflows.study import bundled_studies

ADAPTIVE = {
    "campaign.cases": 2,
    "disturbance.history.instants": 12,
    "look.traced": 12,
    "optics.rays": 300,
    "wavefront.zernike_terms": 15,
    "actuator.figure.terms": 15,
    **DISC,
    "controller.body-perfect.modes": 10,
    "controller.body.modes": 10,
    "controller.body.vary": {"latency_frames": [0.5], "bandwidth_hz": [60.0]},
    "imaging.pixels": 16,
}


def film(folder, study, keys, cases=()):
    """Run a study and return its store, open, and its film."""
    wq.run(wq.load_study(study, keys), store=folder / "store", on="serial")
    return wq.open_store(folder / "store").load(), film_of(folder / "store", list(cases))


def test_loops_move_m2_and_the_light_as_the_store_says(tmp_path):
    stored, found = film(tmp_path, "tmt-ao", ADAPTIVE, [1])
    names = [take.of for take in found.takes]
    assert names[:4] == ["off", "rigid-perfect", "elastic-perfect", "body-perfect"]
    assert len(names) == 7  # and the best one of each actuator
    stage = found.stages[0]
    m2 = stage.names.index("M2")
    for take in found.takes:
        one = stored.sel(case=1, controller=take.of)
        np.testing.assert_allclose(take.series["line of sight, x and y"][1], one.traced_los, atol=1e-8)
        error = take.series["wavefront error of the fitted terms, rms"][1][:, 0]
        np.testing.assert_allclose(error, one.traced_wfe_rms, rtol=1e-9)
        np.testing.assert_allclose(take.images.mean(axis=0), one.exposure, rtol=0, atol=5e-5)
        np.testing.assert_allclose(take.time, one.time_s, rtol=1e-12)
        turns = 1e9 * np.abs(take.poses[:, m2]).max()
        bends = 0.0 if take.weights is None else 1e9 * np.abs(take.weights).max()
        if not take.of.startswith("body"):  # whose channels are no coefficients
            assert max(turns, bends) == pytest.approx(float(one.largest), rel=1e-12)
        assert take.maps[0].reach == found.takes[0].maps[0].reach
    assert (take.weights is None) == take.of.startswith(("off", "rigid"))


def test_a_line_of_sight_has_histories_alone(tmp_path):
    keys = {"simulated.duration_s": 0.4, "simulated.settling_s": 0.2, "campaign.cases": 8}
    stored, found = film(tmp_path, "tip-tilt-vibration", keys, [3, 6])
    study = wq.load_study("tip-tilt-vibration", keys)
    for take, rate in zip(found.takes, (500.0, 100.0), strict=True):
        left = take.series["what the controller leaves"][1]
        within = sampled(shaped(study), 1.0 / rate).within
        rms = np.sqrt(np.mean(left**2) + within)
        assert rms == pytest.approx(float(stored.simulated_mas[take.case]), rel=1e-9)
        assert take.time[-1] == pytest.approx(0.4)
    page = wq.view(tmp_path / "store", case=[0, 5]).read_text(encoding="utf-8")
    assert "case 5: lqg, 1000 Hz" in page
    assert wq.animate(tmp_path / "store", 1).stat().st_size > 1000


def test_a_sweep_shows_the_same_cases_of_its_points(tmp_path):
    keys = {"campaign.cases": 2, "optics.rays": 200, "sweep.optics.wavelength_nm": [550.0, 1100.0]}
    _, found = film(tmp_path, "tmt18-history", keys)
    first, second = found.takes
    assert [first.case, second.case] == [first.case, first.case + 2]
    assert first.label.startswith("optics.wavelength_nm = 550.0: history")
    assert f"(case {second.case} of the sweep)" in second.label
    np.testing.assert_array_equal(first.poses, second.poses)  # seed and number alone decide
    plain = film_of(tmp_path / "store", [second.case]).takes[0]
    np.testing.assert_array_equal(plain.planes, second.planes)


SLOW = """
[[disturbance]]
name = "slow"
model = "base-motion"
duration_s = 1.0
instants = 8
lines = [{ frequency_hz = 0.01, amplitude = { dx_um = 3.0, dy_um = 1.0, rz_urad = 2.0, ry_urad = 1.0 } }]
"""


def test_a_structure_rides_on_a_floor_that_moves_slowly(tmp_path):
    """Far below all resonances mirrors, tubes and legs move as one rigid body, by what the floor does."""
    text = bundled_studies()["telescope-structure"].read_text(encoding="utf-8")
    text = text.partition("# Which models of the mirrors")[0].replace("rings = 6", "rings = 3")
    file = tmp_path / "slow.toml"
    file.write_text(f"{text}{SLOW}[optics]\nrays = 100\n[campaign]\ncases = 1\n", encoding="utf-8")
    _, found = film(tmp_path, file, {})
    stage, take = found.stages[0], found.takes[0]
    assert {"M1", "M2", "image", "tube.top1", "tube.hub6", "primary.1", "camera.a"} <= set(stage.names)
    assert stage.faces.max() == len(stage.points) - 1
    assert len(stage.colors) == len(stage.faces)
    turning = ~np.char.startswith(np.array(stage.names)[stage.body], "primary.")
    turning &= ~np.char.startswith(np.array(stage.names)[stage.body], "secondary.")
    moved = displacements(stage, take)
    ones, zero = np.ones(len(stage.points)), np.zeros(len(stage.points))
    x, y, z = stage.points.T
    rigid = [(ones, zero, zero), (zero, ones, zero), (zero, zero, ones)]
    rigid += [(zero, -z, y), (z, zero, -x), (-y, x, zero)]
    columns = np.stack([np.stack(one, axis=1).ravel() for one in rigid], axis=1)
    for instant in moved:
        size, *_ = np.linalg.lstsq(columns, instant.ravel(), rcond=None)
        off = np.abs(instant.ravel() - columns @ size).reshape(-1, 3).max(axis=1) / np.abs(instant).max()
        assert off[turning].max() < 1e-4
        assert off.max() < 1e-2  # the ends of legs at mirrors, which have no rotation there, are thin
        assert (np.abs(size) <= 1e-6 * np.array([3.0, 1.0, 1e-3, 1e-3, 1.0, 2.0]) * 1.001).all()
    assert np.abs(moved).max() > 1e-7
