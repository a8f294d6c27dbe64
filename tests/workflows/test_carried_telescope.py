"""A telescope on an elastic structure in loops of a study file: traced rays, oscillators, bad input."""

import numpy as np
import pytest
from small_loops import first_case, written

import wavequake as wq
from wavequake.chain.loops.structure import CarryingMode, carrying
from wavequake.errors import UserError
from wavequake.optics.segments.catalog import telescope
from wavequake.workflows.loops.telescope_bench import bench_of, loops
from wavequake.workflows.loops.telescope_light import drawn, seen_of
from wavequake.workflows.segments.bench import layout_of

LAYOUT = layout_of(telescope("tmt-18"))
STRUCTURE = """
[[mode]]
name = "spider"
hz = 14.0
zeta = 0.01
m2 = { dx = 0.1, ry = 0.4 }
pushed = { ry = 0.05 }
nodes = { ring = 1.3 }
rms_nm = 200.0
[[mode]]
name = "astigmatism"
hz = 6.3
zeta = 0.01
share = 0.06
rms_nm = 20.0
zernike = { 6 = 1.0 }
[[sensor]]
name = "felt"
model = "accelerometer"
rate_hz = 1000.0
m2 = ["ry"]
noise = 1e-5
[[sensor]]
name = "ring"
model = "displacement"
nodes = ["ri*"]
[[actuator]]
name = "pistons"
model = "segments"
resonance_hz = 60.0
[[actuator]]
name = "turn"
model = "m2-rigid"
dofs = ["ry"]
resonance_hz = 500.0
[[sensor]]
name = "slopes"
model = "slopes"
rate_hz = 100.0
[[controller]]
name = "held"
model = "integrator"
sensor = "slopes"
actuator = "pistons"
modes = 12
latency_frames = 0.5
bandwidth_hz = 1.0
[[controller]]
name = "felt"
model = "lqr"
sensor = "felt"
actuator = "turn"
lines = [{ hz = 14.0, fwhm_hz = 0.28, rms = 8e-8 }]
latency_frames = 0
effort = 1e-2
"""
LONGER = {"disturbance.history.duration_s": 0.5, "disturbance.history.instants": 500}
LONGER |= {"disturbance.history.high_hz": 20.0, "disturbance.history.peak_nm": 1.0}


@pytest.fixture(scope="module")
def carried(tmp_path_factory):
    return first_case(written(tmp_path_factory.mktemp("carried"), STRUCTURE, LONGER))


def test_linear_light_of_a_structure_is_that_of_traced_rays(carried):
    bench, block, los, _ = carried
    assert not block.messages
    assert block.result["light_error_wfe_rms"].max() < 1e-3
    assert block.result["light_error_los"].max() < 1e-4
    assert los["off"] > 0.5
    # It moves by what the loop itself pushes, too.
    (felt,) = (one for one in bench.controllers if one.name == "felt")
    assert felt.loops[0].drives[0] == pytest.approx([0.05])


def test_an_accelerometer_on_m2_takes_a_vibration_away(carried):
    """Its rotation is felt and corrected, its shift is not: the line of sight falls to what that leaves."""
    bench, _, los, _ = carried
    sight = bench.optics.moved[2][:2]
    rest = np.linalg.norm(0.1 * sight[:, 0]) / np.linalg.norm(0.1 * sight[:, 0] + 0.4 * sight[:, 4])
    assert los["felt"] < 0.4 * los["off"]
    assert los["felt"] > 0.5 * rest * los["off"]


def test_modes_are_stationary_oscillators():
    """Variance, and correlation over a lag: exp(-zeta w t)(cos wd t + zeta w / wd sin wd t)."""
    mode = CarryingMode(name="m", hz=5.0, zeta=0.05, rms_nm=3.0, m2={"dx": 1.0})
    one = carrying([mode], LAYOUT)
    time = np.array([0.0, 0.013, 0.05, 0.17, 0.25])
    drawn_modes = np.array([one.shaken(time, [np.random.default_rng(k)])[:, 0] for k in range(4000)])
    w, zeta = 2 * np.pi * 5.0, 0.05
    wd = w * np.sqrt(1 - zeta**2)
    lag = np.abs(time[:, None] - time)
    wanted = np.exp(-zeta * w * lag) * (np.cos(wd * lag) + zeta * w / wd * np.sin(wd * lag))
    found = drawn_modes.T @ drawn_modes / len(drawn_modes) / 9.0
    assert np.abs(found - wanted).max() < 4 * np.sqrt(2 / 4000)


def test_a_shape_of_the_mirror_has_unit_rms_and_gives_way_along_itself():
    """Its share of its own motion is what it gives way, whatever the shape; what is across does nothing."""
    mode = CarryingMode(name="m", hz=5.0, zeta=0.05, share=0.1, zernike={4: 2.0, 7: 1.0})
    other = CarryingMode(name="n", hz=9.0, zeta=0.05, share=0.2, zernike={6: 1.0})
    one = carrying([mode, other], LAYOUT)
    answered = one.answers @ one.moves
    np.testing.assert_allclose(np.diag(answered), [0.1, 0.2], rtol=1e-12)
    # Even and odd in y, or of another angle: by symmetry of the 18 segments they have nothing in common.
    np.testing.assert_allclose(answered - np.diag([0.1, 0.2]), 0.0, atol=1e-12)
    # Piston of all segments is no part of focus beyond that of its own mean.
    heights = one.moves[:18, 1]
    assert heights.std() > 0.5


@pytest.mark.parametrize("unit", [1e-320, 1e300])
def test_the_unit_of_a_shape_does_not_matter(unit):
    shapes = [{4: 1.0, 6: 0.25}, {4: unit, 6: 0.25 * unit}]
    modes = [CarryingMode(name="m", hz=5.0, zeta=0.05, share=0.1, zernike=shape) for shape in shapes]
    wanted, found = (carrying([mode], LAYOUT) for mode in modes)
    np.testing.assert_allclose(found.moves, wanted.moves, rtol=1e-3, atol=1e-12)
    np.testing.assert_allclose(found.answers, wanted.answers, rtol=1e-3, atol=1e-12)


def test_sensors_read_m2_and_points_of_the_structure(tmp_path):
    study = written(tmp_path, STRUCTURE, LONGER)
    optics = bench_of(study).optics
    case = drawn(study, optics, 0, 0)
    seen = seen_of(study, optics, case)
    light = optics.light
    ring, felt = (study.part("sensor", name) for name in ("ring", "felt"))
    assert ring.labels(light) == ("ring",)
    assert felt.labels(light) == ("ry[M2]",)
    m2 = case.motion.rigid["M2"]
    np.testing.assert_allclose(felt.readings(light) @ seen.T / 1e-9, [m2[:, 4] * 1e9], rtol=1e-9, atol=1e-9)
    # The ring moves by 1.3 of the mode, M2 along x by 0.1.
    np.testing.assert_allclose(ring.readings(light) @ seen.T, [13e9 * m2[:, 0]], rtol=1e-9, atol=1e-9)


def test_margins_know_the_structure(tmp_path):
    """A share of 0.9 makes a loop unstable that on a stiff structure is stable; the mode is named."""
    makers = loops(written(tmp_path, STRUCTURE, LONGER))
    found = makers["held"]().margins()
    stiff = loops(written(tmp_path, STRUCTURE.replace("share = 0.06", "share = 0.0"), LONGER))[
        "held"
    ]().margins()
    assert found.stable
    assert found.gain_up < 0.8 * stiff.gain_up
    text = STRUCTURE.replace("share = 0.06", "share = 0.9")
    words = r"controller\.held is unstable: .* by the mode 'astigmatism' \(6\.3 Hz\); were all stiff, it"
    with pytest.raises(UserError, match=words):
        bench_of(written(tmp_path, text, LONGER))


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("share = 0.06", "share = 1.6", "mode.astigmatism.share: input should be less than or equal to 1"),
        (
            "rms_nm = 200.0",
            "rms_nm = 1e300",
            "mode.spider.rms_nm: input should be less than or equal to 1e+12 (it is 1e+300)",
        ),
        (
            "zernike = { 6 = 1.0 }",
            "m2 = { dz = 1.0 }",
            "the mode 'astigmatism' has a share of M1, which it does not move",
        ),
        (
            "pushed = { ry = 0.05 }",
            "pushed = { ry = 9.0 }",
            "together give way by 3.6 of what is moved; lower",
        ),
        ('name = "spider"', 'name = "astigmatism"', "two modes are called 'astigmatism'"),
        ("m2 = { dx = 0.1, ry = 0.4 }", "m2 = { dw = 1.0 }", "mode.spider.m2.dw"),
        (
            'nodes = ["ri*"]',
            'nodes = ["top"]',
            "sensor.ring.nodes: there is no node 'top'; there are ring to",
        ),
        ('nodes = ["ri*"]', "segments = []", "sensor.ring reads nothing; name segments, m2 or nodes"),
        (
            'actuator = "turn"',
            'actuator = "pistons"',
            "'felt' does not see 'dz[1]' of the actuator 'pistons'",
        ),
    ],
)
def test_structures_that_cannot_be_are_said_in_a_sentence(old, new, words, tmp_path):
    assert STRUCTURE.count(old) == 1
    with pytest.raises(UserError) as caught:
        wq.plan(written(tmp_path, STRUCTURE.replace(old, new), LONGER))
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)
