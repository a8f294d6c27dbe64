"""Loops of a telescope in study files: the thesis' limits, traces, sensors, bits, plug-ins and bad input."""

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import wavequake as wq
from wavequake.campaign.plugins import load_text
from wavequake.campaign.stopwatch import Stopwatch
from wavequake.chain.loops.block import Centroids
from wavequake.chain.loops.displaced import seen_through
from wavequake.chain.loops.light import Light
from wavequake.chain.loops.sensors.edges import EdgeSensors
from wavequake.chain.loops.sensors.slopes import SlopeSensor
from wavequake.chain.loops.sensors.wavefront import WavefrontSensor
from wavequake.cli import app
from wavequake.control.sampled.readings import means
from wavequake.errors import UserError
from wavequake.mechanics.disturbances.motion import RAD_PER_MAS
from wavequake.mechanics.disturbances.sources.edge_sensors import shared_edges
from wavequake.optics.polynomials.zernike import annular_zernike, annular_zernike_gradient
from wavequake.optics.segments.catalog import telescope
from wavequake.workflows.loops import telescope_loop
from wavequake.workflows.loops.telescope_bench import bench_of, designed, sampled_loops
from wavequake.workflows.loops.telescope_light import optics_of
from wavequake.workflows.loops.telescope_margins import loops
from wavequake.workflows.segments.bench import layout_of

SMALL = {
    "optics.rays": 300,
    "wavefront.zernike_terms": 15,
    "actuator.figure.terms": 15,
    "disturbance.history.instants": 50,
    "imaging.pixels": 16,
    "look.traced": 4,
    "campaign.cases": 2,
    "controller.rigid.vary": {"bandwidth_hz": [60], "latency_frames": [0.5]},
    "controller.elastic.vary": {"bandwidth_hz": [60], "latency_frames": [0.5]},
    "controller.elastic-faint.vary": {"bandwidth_hz": [60]},
    "controller.elastic-lqg.vary": {"latency_frames": [0.5]},
}
LIGHT = Light(28, 0.3, 15000.0, layout_of(telescope("tmt-18")))


def small(**changes):
    return wq.load_study("tmt-ao", SMALL | changes)


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


def table(bench, count):
    ids = np.arange(count)
    return {"case": ids, **telescope_loop.cases(bench.study, ids)}


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


# Sensors.


def test_a_misplaced_wavefront_sensor_reads_the_shifted_and_turned_wavefront():
    """Coefficients of W at displaced points, fitted by another way: an overlap integral over the annulus."""
    sensor = WavefrontSensor(name="w", shift=(0.02, -0.01), rotation_deg=3.0, magnification=1.01)
    rng = np.random.default_rng(4)
    seen = rng.standard_normal(len(LIGHT))
    rho = np.sqrt(np.linspace(0.3**2, 1, 401)[:-1] + 0.5 * (1 - 0.09) / 400)
    angle = np.arange(400) * 2 * np.pi / 400
    x, y = (np.outer(rho, part(angle)).ravel() for part in (np.cos, np.sin))
    turn = np.radians(3.0)
    at_x = 0.02 + 1.01 * (np.cos(turn) * x - np.sin(turn) * y)
    at_y = -0.01 + 1.01 * (np.sin(turn) * x + np.cos(turn) * y)
    noll = LIGHT.noll @ seen
    values = annular_zernike(at_x, at_y, 28, 0.3)[:, 1:] @ noll
    wanted = (annular_zernike(x, y, 28, 0.3)[:, 1:] * values[:, None]).mean(axis=0)
    np.testing.assert_allclose(
        sensor.matrix(LIGHT) @ seen, wanted, rtol=2e-4, atol=2e-4 * np.abs(wanted).max()
    )
    np.testing.assert_allclose(sensor.matrix(LIGHT, nominal=True) @ seen, noll)


def test_the_tilt_of_the_wavefront_falls_to_where_the_image_goes():
    """1 mas of line of sight along +x: a wavefront that falls by 1 mas times the distance along x."""
    slopes = np.zeros(len(LIGHT))
    slopes[0] = 1.0
    noll = LIGHT.noll @ slopes
    _, by_x, _ = annular_zernike_gradient(np.array([0.5]), np.array([0.2]), 28, 0.3)
    # nm per radius of 15 m.
    assert by_x[0, 1:] @ noll / 15e9 == pytest.approx(-RAD_PER_MAS)


def test_misplaced_slopes_turn_with_the_sensor_and_are_those_of_what_it_sees():
    """A line of sight along x is cos and -sin of it along axes turned by 10 deg, times the magnification."""
    turned = SlopeSensor(name="s", across=6, rotation_deg=10.0, magnification=1.05).matrix(LIGHT)
    count = len(turned) // 2
    wanted = 1.05 * np.repeat([np.cos(np.radians(10.0)), -np.sin(np.radians(10.0))], count)
    np.testing.assert_allclose(turned[:, 0], wanted, atol=1e-12)
    placed = WavefrontSensor(name="w", shift=(0.1, 0.05), rotation_deg=20.0, magnification=0.9)
    x, y, h = np.array([0.3, -0.5]), np.array([0.4, 0.1]), 1e-6
    seen = seen_through(placed, x, y, 15, 0.3)
    for slopes, dx, dy in ((seen.by_x, h, 0.0), (seen.by_y, 0.0, h)):
        ahead, behind = (seen_through(placed, x + way * dx, y + way * dy, 15, 0.3).values for way in (1, -1))
        np.testing.assert_allclose(slopes, (ahead - behind) / (2 * h), atol=1e-7)


def test_edge_sensors_read_heights_and_angles_of_facing_segments():
    """By the planes of two moved segments at the places of the sensors, and across the edge by the arm."""
    sensor, layout = EdgeSensors(name="e", arm_m=0.05), LIGHT.layout
    rng = np.random.default_rng(6)
    count = len(layout)
    dz, rx, ry = rng.standard_normal((3, count))
    readings = sensor.matrix(LIGHT) @ np.concatenate([dz, rx, ry])
    first, second, ends = shared_edges(layout)
    assert len(readings) == 2 * len(first) == len(sensor.labels(LIGHT))

    def height(segment, at):
        across = layout.axes[segment][:2, 0] / np.linalg.norm(layout.axes[segment][:2, 0])
        x, y = (at - layout.centers_m[segment, :2]) @ np.array([across, [-across[1], across[0]]]).T
        return dz[segment] + rx[segment] * y - ry[segment] * x

    for edge in (0, 7, 20):
        a, b = first[edge], second[edge]
        along = ends[edge, 1] - ends[edge, 0]
        along = along / np.linalg.norm(along)
        outward = np.array([along[1], -along[0]])
        assert outward @ (layout.centers_m[b] - layout.centers_m[a])[:2] > 0
        at = ends[edge, 0] + 0.100722 * along
        step = height(a, at) - height(b, at)
        angle = sum(
            way * (height(segment, at + outward) - height(segment, at)) for segment, way in ((a, 1), (b, -1))
        )
        assert readings[edge] == pytest.approx(step + 0.05 * angle, abs=1e-9)


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


def test_slopes_are_where_the_images_of_subapertures_go():
    """Of a pure line of sight every subaperture shows it; of all else the mean gradient."""
    sensor = SlopeSensor(name="s", across=8)
    matrix = sensor.matrix(LIGHT)
    count = len(matrix) // 2
    wanted = np.repeat([1.0, 0.0], count)
    np.testing.assert_allclose(matrix[:, 0], wanted, atol=1e-12)
    np.testing.assert_allclose(matrix[:, 1], 1 - wanted, atol=1e-12)
    assert sensor.labels(LIGHT)[0] == "x[2,0]"
    # An inner subaperture, column 5, row 5: the line integral of the wavefront along its sides.
    row = sensor.labels(LIGHT).index("x[5,5]")
    low, high = 5 * 0.25 - 1, 6 * 0.25 - 1
    side = np.linspace(low, high, 2001)
    edge = [annular_zernike(np.full(2001, at), side, 28, 0.3)[:, 3:].mean(axis=0) for at in (low, high)]
    nm_per_radius = (edge[1] - edge[0]) / 0.25
    np.testing.assert_allclose(
        matrix[row, 2:],
        -nm_per_radius / 15e9 / RAD_PER_MAS,
        rtol=0.02,
        atol=0.02 * np.abs(matrix[row, 2:]).max(),
    )


def test_noise_of_centroids_is_that_of_drawn_photons():
    """Centres of 3000 drawn frames: Poisson photons of a Gaussian spot, and read noise of every pixel."""
    camera = Centroids(photons=400.0, read_noise=3.0, spot_mas=20.0, pixel_mas=20.0, pixels=8)
    rng = np.random.default_rng(9)
    places = (np.arange(8) - 3.5) * 20.0
    share = np.exp(-(places**2) / (2 * 20.0**2))
    share /= share.sum()
    frames = rng.poisson(400.0 * np.outer(share, share), (3000, 8, 8)) + rng.normal(0, 3.0, (3000, 8, 8))
    centres = (frames.sum(axis=1) @ places) / 400.0
    drawn_rms = centres.std()
    assert camera.centroid_rms() == pytest.approx(drawn_rms, rel=0.05)
    assert Centroids().centroid_rms() == 0.0


def test_a_density_of_noise_is_that_of_white_noise_averaged_over_the_frame():
    sensor = WavefrontSensor(name="w", rate_hz=500.0, integration=0.5, noise=3.0, noise_density=0.2)
    assert sensor.noise_rms() == pytest.approx(np.hypot(3.0, 0.2 * np.sqrt(500.0)))


def written(path, more, changes=None):
    """Return the small study with more text at the end of its file."""
    path = path / "study.toml"
    path.write_text((Path(__file__).parents[2] / "workflows" / "tmt-ao.toml").read_text() + more)
    return wq.load_study(path, SMALL | (changes or {}))


def first_case(study):
    bench = bench_of(study)
    (block,) = telescope_loop.compute(bench, table(bench, 1), "numpy", Stopwatch())
    los = np.sqrt((block.result["los"] ** 2).sum(axis=-1).mean(axis=-1))[0]
    wfe = np.sqrt((block.result["wfe_rms"] ** 2).mean(axis=-1))[0]
    names = [one.name for one in bench.controllers]
    return bench, block, dict(zip(names, los, strict=True)), dict(zip(names, wfe, strict=True))


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


# Bad input: a sentence that names the block, the mode, the frequency.

MORE = """
[[controller]]
name = "more"
model = "{model}"
sensor = "{sensor}"
actuator = "{actuator}"
{keys}
"""


@pytest.mark.parametrize(
    ("block", "words"),
    [
        (
            {"sensor": "sigth"},
            "the controller 'more' names the sensor 'sigth'; there is sight, wavefront, faint",
        ),
        ({"actuator": ""}, "the controller 'more' names no actuator; there is tilt, figure"),
        ({"keys": "rate_hz = 300"}, "gives 300 commands per second, but its sensor 'sight' 1000 frames"),
        ({"keys": "rate_hz = 2000"}, "gives 2000 commands per second, but its sensor 'sight' 1000 frames"),
        (
            {"keys": "latency_frames = 99.5"},
            "'more' acts after 0.1005 s, when the cases of 'history' are over",
        ),
        ({"keys": "beside = ['off']"}, "'more' cannot run beside 'off'"),
        ({"keys": "beside = ['rigid/60/0.5']"}, "'more' and 'rigid/60/0.5' move one actuator, 'tilt'"),
        ({"actuator": "figure"}, "the sensor 'sight' tells 2 of 14 motions of the actuator 'figure' apart"),
        ({"actuator": "figure", "keys": "modes = 3"}, "tells 2 motions of 'figure' apart, not modes = 3"),
        ({"keys": "gain = 1.7"}, "controller.more is unstable: "),
        ({"keys": "gain = 0.5\nbandwidth_hz = 20"}, "controller.more: give gain or bandwidth_hz, not both"),
        ({"keys": "bandwidth_hz = 600"}, "bandwidth_hz is 600, not below half of its 1000 commands"),
        ({"keys": "mode_gains = {Z9 = 2}"}, "'tilt' has no channel 'Z9'; it has rx to ry"),
        ({"model": "lqg"}, "'more' expects no disturbance; give lines or drift_rms"),
        (
            {"model": "lqr", "keys": "lines = [{ hz = 0.3, rms = 1.0 }]"},
            "a line at 0.3 Hz cannot be 0.5 Hz wide; fwhm_hz must be between 3e-05 and 0.3",
        ),
        ({"model": "state-space", "keys": "each = true"}, "give a, b and c, or d alone"),
        ({"model": "integrater"}, "controller.more.model: there is no model 'integrater'"),
        (
            {"model": "state-space", "keys": "a=[[1]]\nb=[[1]]\nc=[[1]]"},
            "leads from 1 readings to 1 commands",
        ),
        (
            {"model": "state-space", "keys": "a=[[1,0],[0]]\nb=[[1]]\nc=[[1]]"},
            "rows of a matrix have different",
        ),
        (
            {"model": "state-space", "keys": "a=[[1,0]]\nb=[[1]]\nc=[[1]]"},
            "controller.more: A has shape (1, 2)",
        ),
    ],
)
def test_loops_that_cannot_be_are_said_in_a_sentence(block, words, tmp_path):
    keys = {"model": "integrator", "sensor": "sight", "actuator": "tilt", "keys": ""} | block
    with pytest.raises(UserError) as caught:
        wq.plan(written(tmp_path, MORE.format(**keys)))
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"actuator.tilt.stroke": 1.0}, "actuator.tilt is saturated from the start: 'history' asks r"),
        ({"actuator.tilt.stuck": {"rx": 0.0, "ry": 1.0}}, "all 2 channels of the actuator 'tilt' are stuck"),
        ({"sensor.sight.rate_hz": 1e9}, "sensor.sight.rate_hz: input should be less than or equal to 100000"),
        ({"actuator.tilt.stuck": {"rz": 0.0}}, "actuator.tilt.stuck: there is no channel 'rz'"),
        ({"actuator.tilt.bandwidth_hz": 50.0}, "actuator.tilt: give bandwidth_hz or resonance_hz, not both"),
        ({"actuator.figure.terms": 21}, "actuator.figure.terms is 21, more than wavefront.zernike_terms 15"),
        (
            {"sensor.wavefront.terms": 21},
            "sensor.wavefront.terms is 21, more than wavefront.zernike_terms 15",
        ),
        ({"sensor.wavefront.terms": 6}, "tells 5 of 14 motions of the actuator 'figure' apart, so that"),
        ({"sensor.faint.name": "sight"}, "two sensors are called 'sight'"),
        ({"sensor.wavefront.noise": 0.0}, "controller.elastic-lqg/0.5: The noise of the sensor is 0"),
        ({"look.traced": 51}, "look.traced is 51, but there are cases of 50 instants"),
        ({"wavefront.method": "slopes"}, "loops need wavefront.method = 'opd'"),
        ({"sensor.sight.rate_hz": 1e9}, "rate_hz: input should be less than or equal to 100000"),
        ({"sensor.wavefront.noise": 1e300}, "noise: input should be less than or equal to"),
        *(
            ({"controller.elastic-lqg.lines": [{"hz": 15, "fwhm_hz": 10, "rms": 2} | line]}, words)
            for line, words in (
                ({"rms": 1e300}, "rms: input should be less than or equal to"),
                ({"fwhm_hz": 1e-320}, "fwhm_hz: input should be greater than or equal to"),
            )
        ),
    ],
)
def test_blocks_that_do_not_fit_are_said_in_a_sentence(changes, words):
    with pytest.raises(UserError) as caught:
        wq.plan(small(**changes))
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_disturbance_that_linear_light_does_not_know_is_told_before_a_run(tmp_path):
    more = """
[[disturbance]]
name = "hum"
model = "surface-vibration"
of = ["M3"]
instants = 50
lines = [{ frequency_hz = 10.0, amplitude = { dx_um = 1.0 } }]
"""
    with pytest.raises(UserError, match="'hum' moves what the linear light of loops does not know"):
        wq.plan(written(tmp_path, more))


def test_noise_is_swept_as_any_key(tmp_path):
    changes = {"sweep.sensor.faint.noise": [0.0, 9.0], "look.traced": 0, "campaign.cases": 1}
    found = wq.run(small(**changes), store=tmp_path / "store").load()
    rms = (found["wfe_rms"] ** 2).mean("time") ** 0.5
    quiet, loud = (rms.sel(controller="elastic-faint/60").isel(case=case) for case in range(2))
    assert loud > 1.3 * quiet
    assert rms.sel(controller="elastic/60/0.5").std() == 0.0


def test_an_unstable_loop_is_told_by_mode_and_frequency_and_has_no_margins(tmp_path):
    keys = {"model": "integrator", "sensor": "wavefront", "actuator": "figure", "keys": "gain = 0.2\n"}
    keys["keys"] += "latency_frames = 2.0\nmode_gains = {Z9 = 4.0}"
    study = written(tmp_path, MORE.format(**keys))
    with pytest.raises(
        UserError, match=r"controller.more is unstable: Z9 of 'figure' grows by .* 1/s at .* Hz"
    ):
        wq.plan(study)
    words = [f"{key}={json.dumps(value)}" for key, value in SMALL.items() if "vary" not in key]
    done = CliRunner().invoke(app, ["margins", str(tmp_path / "study.toml"), *words])
    assert done.exit_code == 3, done.output
    assert "1 of 25 loops are unstable" in done.output


def test_a_case_that_diverges_alone_says_so(tmp_path, monkeypatch):
    """A function of a plug-in has no poles that could be looked at before."""
    load_text("wild.py", WILD)
    more = MORE.format(model="wild", sensor="sight", actuator="tilt", keys="")
    found = wq.run(written(tmp_path, more), store=tmp_path / "store", cases=1)
    assert str(found["message"].to_numpy()[0]) == "it diverges under the controller 'more'"


WILD = """
from typing import Literal
from wavequake.chain.loops.block import Controller, register
from wavequake.control.sampled.regulator import Stepped


@register
class Wild(Controller):
    model: Literal["wild"] = "wild"

    def design(self, asked):
        return Stepped(len(asked.channels), grow)


def grow(states, readings):
    states = 10 * states + readings + 1e-9
    return states, states
"""


def snippet():
    """Return the controllers of docs/extending.md."""
    page = (Path(__file__).parents[2] / "docs" / "extending.md").read_text()
    return page.partition("## A controller")[2].partition("```python\n")[2].partition("```")[0]


def test_controllers_of_a_plug_in_run_from_the_command_line_and_have_a_report(tmp_path, wavequake):
    """The double integrator leaves less of slow motion than a single one of its gain; it has margins, too."""
    plugin = tmp_path / "mine.py"
    plugin.write_text(snippet())
    keys = {"sensor": "sight", "actuator": "tilt"}
    more = MORE.format(**keys, model="double-integrator", keys="gain = 0.2\nlatency_frames = 0.0")
    more += MORE.replace("more", "zone").format(**keys, model="dead-zone", keys="zone = 0.0")
    more += MORE.replace("more", "single").format(
        **keys, model="integrator", keys="gain = 0.2\nlatency_frames = 0"
    )
    more += MORE.replace("more", "plain").format(**keys, model="integrator", keys="gain = 0.3")
    study = tmp_path / "study.toml"
    study.write_text((Path(__file__).parents[2] / "workflows" / "tmt-ao.toml").read_text() + more)
    words = [f"{key}={json.dumps(value)}" for key, value in SMALL.items() if "vary" not in key]
    words += ["disturbance.history.low_hz=2.0", "disturbance.history.high_hz=5.0", "sensor.sight.noise=0"]
    store = tmp_path / "store"
    ran = wavequake("run", str(study), f"store.path={store}", *words, "--plugin", str(plugin))
    assert ran[0] == 0, ran
    found = wq.open_store(store).load()
    rms = (found["los"] ** 2).sum("axis").mean("time").mean("case") ** 0.5
    assert rms.sel(controller="more") < 0.9 * rms.sel(controller="single")
    np.testing.assert_allclose(rms.sel(controller="zone"), rms.sel(controller="plain"), rtol=1e-9)
    shown = wavequake("margins", str(study), *words, "--plugin", str(plugin))
    assert shown[0] == 0, shown
    assert "more" in shown[1]
    assert "zone" not in shown[1]
    assert wavequake("report", str(store), "--plugin", str(plugin))[0] == 0


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ("1 / 0", "controller.more cannot be designed: ZeroDivisionError: division by zero"),
        (
            "return Stepped(1, lambda x, y: (x, x))",
            "controller.more gives 1 commands of 2 readings; the",
        ),
        ("return Stepped(1, lambda x: x)", "controller.more cannot be designed: TypeError"),
        ("return 3", "controller.more cannot be designed: AttributeError"),
    ],
)
def test_controllers_of_others_that_fail_are_named(body, words, tmp_path):
    name = f"broken-{len(body)}"
    load_text(
        "broken.py", WILD.replace("wild", name).replace("return Stepped(len(asked.channels), grow)", body)
    )
    with pytest.raises(UserError) as caught:
        wq.plan(written(tmp_path, MORE.format(model=name, sensor="sight", actuator="tilt", keys="")))
    assert words in str(caught.value)
