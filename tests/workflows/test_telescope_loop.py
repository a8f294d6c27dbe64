"""Loops of a telescope in study files: the thesis' limits, traces, bits, several loops at once, reports."""

import tracemalloc

import numpy as np
import pytest
from small_loops import first_case, small, table, written
from typer.testing import CliRunner

import wavequake as wq
from wavequake.campaign.stopwatch import Stopwatch
from wavequake.chain.loops.closing import grows
from wavequake.chain.loops.designed import designed
from wavequake.chain.loops.judged import sampled_loops
from wavequake.cli import app
from wavequake.control.sampled.readings import means
from wavequake.control.sampled.stability import Worst
from wavequake.errors import UserError
from wavequake.kernels.device.devices import choose_device
from wavequake.mechanics.disturbances.motion import RAD_PER_MAS
from wavequake.workflows.loops import loop_margins, telescope_loop
from wavequake.workflows.loops.telescope_bench import bench_of, loops
from wavequake.workflows.loops.telescope_light import drawn, optics_of, seen_of
from wavequake.workflows.loops.telescope_study import LookSection


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    path = tmp_path_factory.mktemp("loops") / "store"
    wq.run(small(), store=path)
    return path


@pytest.fixture(scope="module")
def dataset(store):
    return wq.open_store(store).load()


# The limits of the thesis, and rays.


def test_perfect_controllers_are_the_limits_of_the_thesis(dataset):
    """Rigid: the line of sight goes to zero, the wavefront stays; elastic: the rms is the static one."""
    one = dataset.sel(controller="rigid-perfect")
    assert np.abs(one["los"]).max() < 1e-9
    off = dataset.sel(controller="off")
    np.testing.assert_allclose(one["wfe_rms"], off["wfe_rms"], rtol=5e-3)  # M2 tilted is a bit of coma
    assert off["wfe_rms"].mean() > 1.5 * dataset["static_wfe_rms"]
    elastic = dataset.sel(controller="elastic-perfect")
    np.testing.assert_allclose(elastic["wfe_rms"], dataset["static_wfe_rms"], rtol=1e-9)
    assert np.abs(elastic["los"]).max() < 1e-9
    # Of rays, too, that have never heard of the sensitivities.
    np.testing.assert_allclose(elastic["traced_wfe_rms"], dataset["static_wfe_rms"], rtol=1e-4)
    assert np.abs(elastic["traced_los"]).max() < 1e-4
    assert elastic["peak"].min() > dataset.sel(controller="off")["peak"].max()


def test_a_run_that_is_interrupted_goes_on_with_the_same_bits(tmp_path, dataset, monkeypatch):
    """It ends in the second of two chunks; the second run computes that one alone."""
    study, begun, real = small(**{"store.chunk_cases": 1}), [], telescope_loop._batch

    def stopped(bench, index, rows, realizations, device, clock):
        begun.extend(realizations.tolist())
        if begun == [0, 1]:
            raise KeyboardInterrupt
        return real(bench, index, rows, realizations, device, clock)

    monkeypatch.setattr(telescope_loop, "_batch", stopped)
    with pytest.raises((KeyboardInterrupt, UserError)):
        wq.run(study, store=tmp_path / "store", on="serial")
    wq.run(study, store=tmp_path / "store", on="serial")
    assert begun == [0, 1, 1]
    found = wq.open_store(tmp_path / "store").load()
    for name in ("los", "wfe_rms", "exposure", "traced_los", "limited"):
        np.testing.assert_array_equal(found[name], dataset[name], err_msg=name)


def test_memory_does_not_grow_with_time(tmp_path):
    """Thirteen times as many frames of 16 cases: a small part of what their readings would take."""
    more = """
[[sensor]]
name = "fast"
model = "wavefront"
rate_hz = 2000.0
noise = 1.0
[[controller]]
name = "long"
model = "integrator"
sensor = "fast"
actuator = "figure"
gain = 0.2
"""
    slow = {"disturbance.history.low_hz": 0.5, "disturbance.history.high_hz": 2.0, "look.traced": 0}
    peaks, frames = [], []
    for duration in (0.5, 6.5):
        study = written(tmp_path, more, slow | {"disturbance.history.duration_s": duration})
        bench, rows = bench_of(study), range(telescope_loop.ROWS)
        one = next(each for each in bench.controllers if each.name == "long")
        draws = [drawn(study, bench.optics, 0, row) for row in rows]
        seen = [seen_of(study, bench.optics, draw) for draw in draws]
        tracemalloc.start()
        positions, *_ = telescope_loop.positions_of(bench, one, 0, draws, seen, choose_device("numpy"))
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        assert np.ptp(positions[3]) > 0
        frames.append(2000 * duration)
    whole = 8 * (frames[1] - frames[0]) * one.loops[0].readings * telescope_loop.ROWS
    assert whole > 2e7
    assert peaks[1] - peaks[0] < 0.03 * whole


def test_linear_light_is_that_of_traced_rays(dataset):
    assert dataset["light_error_wfe_rms"].max() < 1e-3
    assert dataset["light_error_los"].max() < 1e-4
    assert dataset["los"].std() > 0.05


def test_the_rigid_mirror_has_the_sensitivity_of_the_thesis():
    """Eq. 4.24: 85460 mm per rad at the image of the larger circular pupil; axes of the bench's own."""
    optics = optics_of(small())
    bench = optics.control.bench
    per_rad = optics.sights["tilt"][:2] * 1e9 * RAD_PER_MAS
    assert np.abs(per_rad[0, 1] * bench.first_order.focal_length) == pytest.approx(85460, rel=0.03)
    np.testing.assert_allclose(per_rad @ bench.m2_tilt, np.eye(2), atol=1e-6)


def test_loops_that_are_fast_and_quiet_come_to_the_perfect_one():
    """Without noise, at 20 kHz, an integrator is within 3 % of what off leaves; slower ones are in order."""
    left = []
    for rate in (500.0, 2000.0, 20000.0):
        changes = {
            "sensor.sight.noise": 0.0,
            "sensor.sight.rate_hz": rate,
            "actuator.tilt.resonance_hz": None,
        }
        changes |= {"controller.rigid.vary": {"gain": [0.4], "latency_frames": [0]}, "look.traced": 0}
        los = first_case(small(**changes))[2]
        left.append(los["rigid/0.4/0"] / los["off"])
    assert left[0] > left[1] > left[2]
    assert left[2] < 0.03


def test_means_of_straight_lines_are_exact_between_any_instants():
    """A quadratic integral of the lines against a fine trapezoid, and of a straight line the middle."""
    time = np.array([0.0, 0.3, 0.4, 1.0])
    seen = np.array([[0.0, 1.0], [2.0, 1.6], [-1.0, 1.8], [0.5, 3.0]])
    begins, ends = np.array([0.0, 0.1, 0.35, 0.9]), np.array([0.2, 0.37, 0.95, 1.0])
    found = means(time, seen, begins, ends)
    for row, (begin, end) in enumerate(zip(begins, ends, strict=True)):
        fine = np.unique(np.concatenate([np.linspace(begin, end, 2001), time[(time > begin) & (time < end)]]))
        values = np.interp(fine, time, seen[:, 0])
        assert found[row, 0] == pytest.approx(np.trapezoid(values, fine) / (end - begin), rel=1e-9, abs=1e-12)
    np.testing.assert_allclose(found[:, 1], 1.0 + begins + ends)


# Bits, resumption and reports.


def test_a_case_has_its_bits_alone_in_a_chunk_and_on_workers(dataset, tmp_path):
    study = small(**{"campaign.cases": 5, "store.chunk_cases": 2})
    workers = wq.run(study, store=tmp_path / "two", on="local", workers=2).load()
    bench = bench_of(study)
    last = {key: values[4:] for key, values in table(bench, 5).items()}
    (alone,) = telescope_loop.compute(bench, last, "auto", Stopwatch())
    for name in ("wfe_rms", "los", "largest", "traced_los", "exposure"):
        assert np.array_equal(alone.result[name][0], workers[name].to_numpy()[4])
        assert np.array_equal(dataset[name].to_numpy(), workers[name].to_numpy()[:2])


def test_a_share_of_cases_is_traced_and_missing_of_the_others(dataset):
    bench = bench_of(small(**{"look.share": 0.5}))
    (found,) = telescope_loop.compute(bench, table(bench, 2), "auto", Stopwatch())
    for name, values in found.result.items():
        of_traces = "traced" in name or name in ("exposure", "peak", "ee50", "ee80") or "light" in name
        assert np.array_equal(values[0], dataset[name].to_numpy()[0]), name
        if of_traces:
            assert np.isnan(values[1]).all(), name
        else:
            assert np.array_equal(values[1], dataset[name].to_numpy()[1]), name
    assert not found.messages


@pytest.mark.parametrize("share", [1.0, 0.7, 1 / 3, 0.1, 0.016])
def test_of_any_number_of_cases_that_share_is_traced(share):
    traced = np.cumsum([LookSection(share=share).traces(k) for k in range(2000)])
    assert traced[0] == 1
    assert np.abs(traced - share * np.arange(1, 2001)).max() < 1.0


def test_poles_are_those_of_python_control_and_all_loops_are_stable():
    control = pytest.importorskip("control", reason="needs python-control: pip install control")
    study = small()
    assert all(make().margins().stable for make in loops(study).values())
    plant, own = wq.loop(study, "rigid/60/0.5")
    radius = np.abs(control.feedback(plant, own).poles()).max()
    assert np.log(radius) * 1000 == pytest.approx(loops(study)["rigid/60/0.5"]().margins().growth, rel=1e-6)


def test_the_report_says_what_is_left(store):
    done = CliRunner().invoke(app, ["report", str(store)])
    assert done.exit_code == 0, done.output
    page = (store / "report.html").read_text()
    for title in ("Loop gain over frequency", "Loop gain in the complex plane", "complementary sensitivity"):
        assert title in page
    for words in (
        "Sensitivity and complementary",
        "leaves the least wavefront error",
        "over their latency",
        "Exposures of case",
        "perfect",
    ):
        assert words in page
    for name in ("off", "rigid/60/0.5", "elastic-lqg/0.5"):
        assert name in done.output


def test_a_summary_without_traces_has_a_report(tmp_path):
    study = small(**{"look.traced": 0, "store.reduce": "summary"})
    found = wq.run(study, store=tmp_path / "store").load()
    assert "exposure" not in found
    assert CliRunner().invoke(app, ["report", str(tmp_path / "store")]).exit_code == 0


# Several loops.


def test_a_wrong_arm_changes_focus_alone(tmp_path):
    """Edge sensors see focus by their arm only: 4 cm for 5 make its gain 0.8, others stay in 0.2 %."""
    more = """
[[sensor]]
name = "edges"
model = "edges"
rate_hz = 1000.0
true_arm_m = 0.04
[[actuator]]
name = "all"
model = "segments"
dofs = ["dz", "rx", "ry"]
[[controller]]
name = "m1"
model = "integrator"
sensor = "edges"
actuator = "all"
bandwidth_hz = 60.0
"""
    with pytest.raises(UserError, match=r"tells 51 of 54 motions of the actuator 'all' apart.*modes = 51"):
        wq.plan(written(tmp_path, more))
    study = written(tmp_path, more + "modes = 51\n")
    optics = optics_of(study)
    loop = sampled_loops(study, optics, {"m1": designed(study, optics, study.part("controller", "m1"))})["m1"]
    gains = np.sort(np.abs(np.linalg.eigvals(loop.regulator.decoupling @ loop.sees)))
    np.testing.assert_allclose(gains[:3], 0.0, atol=1e-9)
    assert gains[3] == pytest.approx(0.8, abs=1e-6)
    np.testing.assert_allclose(gains[4:], 1.0, atol=2e-3)
    _, block, _, wfe = first_case(study)
    assert wfe["m1"] < 0.8 * wfe["off"]
    assert block.result["light_error_wfe_rms"].max() < 1e-3


def test_slopes_and_segments_close_a_loop_beside_a_faster_one(tmp_path):
    """Two loops at once: segments by 500 commands per second of slopes, M2's tilt by the line of sight."""
    more = """
[[sensor]]
name = "slopes"
model = "slopes"
rate_hz = 1000.0
across = 10
[[actuator]]
name = "pistons"
model = "segments"
[[controller]]
name = "slow"
model = "integrator"
sensor = "slopes"
actuator = "pistons"
rate_hz = 500.0
latency_frames = 0.25
bandwidth_hz = 60.0
modes = 8
[[controller]]
name = "both"
model = "integrator"
sensor = "sight"
actuator = "tilt"
latency_frames = 0.5
bandwidth_hz = 60.0
beside = ["slow"]
"""
    bench, block, los, wfe = first_case(written(tmp_path, more))
    assert los["both"] < 0.7 * los["off"]
    assert wfe["both"] < 0.9 * wfe["off"]
    assert wfe["both"] == pytest.approx(wfe["slow"], rel=1e-2)
    assert block.result["light_error_los"].max() < 1e-4
    assert block.result["light_error_wfe_rms"].max() < 1e-3
    assert bench.controllers[-1].sight.shape[1] == 2 + 18


def test_matrices_are_the_controller_that_they_spell(tmp_path):
    """u_k = u_(k-1) - 0.3 M^-1 y_k as A, B, C, D leaves what the integrator leaves."""
    sight = optics_of(small()).sights["tilt"][:2]
    gain = (-0.3 * np.linalg.inv(sight)).tolist()
    more = f"""
[[controller]]
name = "own"
model = "state-space"
sensor = "sight"
actuator = "tilt"
a = [[1, 0], [0, 1]]
b = {gain}
c = [[1, 0], [0, 1]]
d = {gain}
[[controller]]
name = "same"
model = "integrator"
sensor = "sight"
actuator = "tilt"
gain = 0.3
"""
    study = written(tmp_path, more)
    _, _, los, _ = first_case(study)
    assert los["own"] == pytest.approx(los["same"], rel=1e-9)
    found = {name: make().margins() for name, make in loops(study).items() if name in ("own", "same")}
    for key in ("growth", "gain_up", "phase_deg"):
        assert getattr(found["own"], key) == pytest.approx(getattr(found["same"], key), rel=1e-6)


@pytest.mark.parametrize(("off", "unstable"), [(0.0, False), (1e-12, False), (-1e-12, False), (1e-6, True)])
def test_what_neither_grows_nor_decays_is_stable_to_rounding(off, unstable, monkeypatch):
    """Margins and the check before a run judge alike: an integrator of what nothing sees has a pole of 1."""
    worst = Worst(1.0 + off, off * 1000.0, 0.0, np.ones(1))
    monkeypatch.setattr(loop_margins, "worst_pole", lambda loop: worst)
    assert grows(worst) == unstable
    found = next(iter(loops(small()).values()))().margins()
    assert found.stable != unstable
