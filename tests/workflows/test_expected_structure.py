"""Controllers that know what a telescope's structure does: integrals over spectra, several sensors."""

from dataclasses import replace

import numpy as np
import pytest
from small_loops import table, written

from wavequake.campaign.stopwatch import Stopwatch
from wavequake.chain.loops.designed import asked_of
from wavequake.control.frames.disturbance import sampled
from wavequake.control.python_control import to_control
from wavequake.control.sampled.stability import controller_model, plant_model, sampled_margins, worst_pole
from wavequake.errors import UserError
from wavequake.optics.segments.telescope import M2
from wavequake.workflows.loops import telescope_loop
from wavequake.workflows.loops.telescope_bench import bench_of
from wavequake.workflows.run import notices

ONE_MODE = """
[[mode]]
name = "tower"
hz = 9.0
zeta = 0.1
m2 = { ry = 1.0 }
rms_nm = 50.0
[[sensor]]
name = "eye"
model = "line-of-sight"
rate_hz = 100.0
noise = 0.05
[[controller]]
name = "sum"
model = "integrator"
sensor = "eye"
actuator = "stage"
gain = 0.3
latency_frames = 1
[[controller]]
name = "knows"
model = "lqg"
sensor = "eye"
actuator = "stage"
structure = true
latency_frames = 1
[[controller]]
name = "told"
model = "lqg"
sensor = "eye"
actuator = "stage"
lines = [{ hz = 9.0, fwhm_hz = 1.8, rms = 1.0 }]
latency_frames = 1
[[actuator]]
name = "stage"
model = "m2-rigid"
"""
SHAKEN = {"disturbance.history.duration_s": 4.0, "disturbance.history.instants": 4000, "campaign.cases": 16}
SHAKEN |= {"disturbance.history.high_hz": 4.0, "disturbance.history.low_hz": 1.0, "look.traced": 0}
SHAKEN |= {"disturbance.history.peak_nm": 1e-6}


def test_modes_that_a_controller_is_to_expect_but_hardly_sees_are_said(tmp_path):
    """M2 along the axis moves no line of sight; what is not shaken is not asked for."""
    more = """
[[mode]]
name = "breathing"
hz = 6.0
zeta = 0.1
m2 = { dz = 1.0 }
rms_nm = 50.0
[[mode]]
name = "quiet"
hz = 7.0
zeta = 0.1
m2 = { dz = 1.0 }
"""
    study = written(tmp_path, ONE_MODE + more, SHAKEN)
    assert list(notices(study)) == [
        "controller.knows.structure: the sensor 'eye' sees the mode 'breathing' (6 Hz) not at all; it is not "
        "expected."
    ]
    assert not list(notices(written(tmp_path, ONE_MODE, SHAKEN)))


def test_what_loops_leave_of_a_shaken_structure_is_the_integral_over_its_spectrum(tmp_path):
    """Time average of the residual: S_d (1 - sinc^2 (1 - |S|^2)) + N of the noise, in closed form."""
    study = written(tmp_path, ONE_MODE, SHAKEN)
    bench = bench_of(study)
    kept = [one for one in bench.controllers if one.name in ("off", "sum", "knows", "told")]
    ids = np.arange(16)
    (block,) = telescope_loop.compute(
        replace(bench, controllers=tuple(kept)), table(bench, 16), "numpy", Stopwatch()
    )
    squares = (block.result["los"] ** 2).sum(axis=-1).mean(axis=-1)
    mean = squares.mean(axis=0)
    off = squares.std(axis=0, ddof=1) / np.sqrt(len(ids))
    found = {one.name: (mean[k], off[k]) for k, one in enumerate(kept)}

    hertz = np.linspace(1e-3, 400.0, 400_000)
    shape = 1.0 / ((1 - (hertz / 9.0) ** 2) ** 2 + (2 * 0.1 * hertz / 9.0) ** 2)
    open_square = (50.0 * np.linalg.norm(bench.optics.moved[M2][:2, 4])) ** 2
    density = open_square * shape / np.trapezoid(shape, hertz)
    w = 2 * np.pi * hertz / 100.0
    s, g, n = 2 * np.sin(w / 2), 0.3, 2
    rejected = s**2 / (s**2 + g**2 - 2 * g * s * np.sin((n - 0.5) * w))
    left = np.trapezoid(density * (1 - np.sinc(hertz / 100.0) ** 2 * (1 - rejected)), hertz)
    noise = 2 * 0.05**2 * g * (1 + g) / ((1 - g) * (2 + g))
    for name, wanted in (("off", open_square), ("sum", left + noise)):
        assert abs(found[name][0] - wanted) < 3 * found[name][1]
    assert found["knows"][0] < 0.75 * found["sum"][0]
    # The size that the structure gives is that of the mode in the sensor's unit; x and y share it.
    knows = study.part("controller", "knows")
    known, _ = knows.expected(asked_of(study, bench.optics, knows))
    size = np.sqrt(sampled(known, 0.01).variance)
    assert size == pytest.approx(np.sqrt(open_square / 2), rel=1e-6)


TWO_SENSORS = """
[[mode]]
name = "tower"
hz = 9.0
zeta = 0.02
m2 = { ry = 1.0, dx = 0.5 }
pushed = { ry = 0.02 }
rms_nm = 50.0
[[mode]]
name = "spider"
hz = 21.0
zeta = 0.02
m2 = { rx = 1.0 }
pushed = { rx = 0.02 }
rms_nm = 30.0
[[sensor]]
name = "eye"
model = "line-of-sight"
rate_hz = 100.0
noise = 2.0
[[sensor]]
name = "felt"
model = "accelerometer"
rate_hz = 100.0
resonance_hz = 200.0
m2 = ["rx", "ry"]
noise = 1e-5
[[actuator]]
name = "stage"
model = "m2-rigid"
resonance_hz = 200.0
[[controller]]
name = "both"
model = "lqg-fusion"
sensor = "eye"
also_reads = ["felt"]
actuator = "stage"
structure = true
latency_frames = 0.5
[[controller]]
name = "one"
model = "lqg-fusion"
sensor = "eye"
actuator = "stage"
structure = true
latency_frames = 0.5
"""


@pytest.fixture(scope="module")
def two_sensors(tmp_path_factory):
    keys = SHAKEN | {"disturbance.history.duration_s": 2.0, "disturbance.history.instants": 2000}
    return bench_of(written(tmp_path_factory.mktemp("two"), TWO_SENSORS, keys | {"look.traced": 1}))


def test_an_accelerometer_beside_a_camera_leaves_less(two_sensors):
    """A faint star leaves the camera in doubt of what the accelerometer feels; traced light agrees."""
    names = "off", "both", "one"
    kept = tuple(one for one in two_sensors.controllers if one.name in names)
    bench = replace(two_sensors, controllers=kept)
    (block,) = telescope_loop.compute(bench, table(bench, 4), "numpy", Stopwatch())
    rms = np.sqrt((block.result["los"] ** 2).mean(axis=(0, 2, 3)))
    left = dict(zip([one.name for one in kept], rms, strict=True))
    assert left["one"] < 0.8 * left["off"]
    assert left["both"] < 0.8 * left["one"]
    assert block.result["light_error_los"].max() < 1e-4
    assert not block.messages


def test_loops_of_two_sensors_have_the_poles_and_margins_of_python_control(two_sensors):
    control = pytest.importorskip("control", reason="needs python-control: pip install control")
    loop = two_sensors.linear["both"]
    plant, own = to_control(plant_model(loop)), to_control(controller_model(loop))
    assert (plant.noutputs, plant.ninputs) == (4, 2)
    poles = np.abs(control.feedback(plant, own).poles())
    assert poles.max() == pytest.approx(abs(worst_pole(loop).value), rel=1e-9)
    found = sampled_margins(loop)
    # The peak of (I + K G)^-1 on a fine grid of its own.
    w = np.linspace(1.0, 0.999 * np.pi * 100.0, 40_000)
    gain = np.moveaxis((own * plant)(np.exp(1j * w / 100.0)), -1, 0)
    peak = np.linalg.norm(np.linalg.inv(np.eye(2) + gain), 2, axis=(1, 2)).max()
    assert found.peak == pytest.approx(peak, rel=1e-3)
    for factor, stable in ((1 - 1e-4, True), (1 + 1e-4, False)):
        grown = control.feedback(factor * found.gain_up * plant, own).poles()
        assert (np.abs(grown).max() < 1) == stable


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('also_reads = ["felt"]', 'also_reads = ["gone"]', "also reads 'gone'; there is .*felt"),
        ('also_reads = ["felt"]', 'also_reads = ["eye"]', "reads 'eye' twice"),
        ("resonance_hz = 200.0\nm2", "integration = 0.5\nm2", "'both' have different frames"),
        ('"lqg-fusion"\nsensor = "eye"\nalso', '"lqg"\nsensor = "eye"\nalso', "'both' takes one sensor"),
        ("noise = 1e-5", "noise = 0.0", "controller.both: A filter needs positive noise"),
        ("rms_nm", "# ", "controller.both.structure: no sensor sees a mode of the structure shaken"),
    ],
)
def test_sensors_that_do_not_fit_each_other_are_said_in_a_sentence(old, new, words, tmp_path):
    assert old in TWO_SENSORS
    with pytest.raises(UserError, match=words):
        bench_of(written(tmp_path, TWO_SENSORS.replace(old, new), SHAKEN))
