"""The study of edge-sensor loops on a structure, with 18 segments: limits, residuals, bad input."""

import dataclasses
import tomllib
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import quad

import wavequake as wq
from wavequake.campaign.stopwatch import Stopwatch
from wavequake.control.sampled.flexible_left import flexible_margins
from wavequake.errors import UserError
from wavequake.mechanics.disturbances.spectra import resonance
from wavequake.report.loops.segment_control import answer, bandwidths_of, row_of, rows_of
from wavequake.report.loops.spectra import of_density
from wavequake.workflows.loops import segment_control, segment_control_bench
from wavequake.workflows.loops.loop_margins import loop_named, loops_of
from wavequake.workflows.loops.segment_control_bench import bench_of, loop_of
from wavequake.workflows.loops.segment_control_study import SegmentControlStudy

TEXT = (Path(__file__).parents[2] / "workflows" / "tmt-m1-control.toml").read_text()
ASTIGMATISM = {"name": "a", "hz": 6.3, "zeta": 0.01, "share": 0.05, "rms_nm": 6.0, "zernike": {6: 1.0}}


def study(mode=(ASTIGMATISM,), cases=1, mirror=(), **control):
    found = tomllib.loads(TEXT) | {"mode": mode, "campaign": {"cases": cases}}
    found["mirror"] |= {"telescope": "tmt-18", **dict(mirror)}
    found["control"] |= {"bandwidths_hz": [0.001, 1.0], **control}
    return SegmentControlStudy.model_validate(found, strict=False)


@pytest.fixture(scope="module")
def bench():
    return bench_of(study())


def test_a_slow_loop_leaves_what_there_was(bench):
    slow, fast = bench.loops
    # Loop gain at the structure's line, of a share of 0.05 and a damping ratio of 0.01: |S| = 1 / |1 + L|.
    gain = 0.001 / 6.3 * (1 + 0.05 / (2 * 0.01))
    assert 1 < slow.peak < 1 / (1 - gain)
    # A line from f0 / 300 to 300 f0 lacks 2.1e-5 of its rms.
    assert slow.structure == pytest.approx(bench.open_structure, rel=slow.peak - 1 + 2.2e-5)
    assert fast.wind < slow.wind < bench.open_wind


def left_by_closed_form(hertz, gain):
    """One frame and one of latency: mean over a frame of an integrator's residual."""
    angle = 2 * np.pi * hertz / 50
    s = 2 * np.sin(angle / 2)
    size = s**2 / (s**2 + gain**2 - 2 * gain * s * np.sin(1.5 * angle))
    return 1 - np.sinc(hertz / 50) ** 2 * (1 - size)


def test_what_is_left_is_that_of_the_closed_forms():
    # No servo, no structure's share, all modes alike.
    found = bench_of(study(slow=[], mode=[ASTIGMATISM | {"share": 0.0}], mirror={"servo_hz": None}))
    loop, g = found.loops[1], 2 * np.sin(np.pi / 50)
    assert g * (1 + g) / ((1 - g) * (2 + g)) == pytest.approx(0.0760508, abs=5e-8)
    expected = np.linalg.norm(found.modes.multipliers) * np.sqrt(g * (1 + g) / ((1 - g) * (2 + g)))
    # Its spectrum 2 T starts at 5e-6 Hz: 2.6e-6 of the variance are left out.
    assert loop.noise == pytest.approx(expected, rel=1.4e-6)
    line = resonance(6.3, 2 * 0.01 * 6.3, 6.0)
    edges = [(low, high) for low, high in pairwise((line.low_hz, *line.breaks_hz, 25.0, 50.0, line.high_hz))]
    of_line = sum(
        quad(lambda f: line.density(f) * left_by_closed_form(f, g), low, high, limit=500, epsrel=1e-10)[0]
        for low, high in edges
    )
    assert loop.structure == pytest.approx(np.sqrt(of_line), rel=1e-9)
    spectrum, bands = segment_control_bench._wind(found.study, found.layout, found.modes)
    of_wind = sum(
        np.sum(one.factor**2) * quad(
            lambda x: np.exp(x) * spectrum.density(np.exp(x)) * left_by_closed_form(np.exp(x), g),
            np.log(low), np.log(high), limit=2000, epsrel=1e-9,
        )[0]
        for one in bands
        for low, high in [one.edges_hz[[0, -1]]]
    )  # fmt: skip
    assert loop.wind == pytest.approx(np.sqrt(of_wind), rel=1e-6)
    assert found.limit_hz == pytest.approx(np.arcsin(0.5) * 50 / np.pi, rel=1e-8)  # g_max = 1


def test_spectra_add_up_to_what_is_left(bench):
    """Of the structure and of noise; of the wind without a loop a part is slower than what is drawn."""
    one = bench.loops[1]
    left = of_density("left", bench.hertz, one.shaken_density).above[0]
    assert left == pytest.approx(np.hypot(one.wind, one.structure), rel=0.01)
    noise = of_density("noise", bench.hertz, one.noise_density, flat=True).above[0]
    assert noise == pytest.approx(one.noise, rel=0.01)
    shaken = of_density("open", bench.hertz, bench.open_density).above[0]
    assert 0.9 < shaken / np.hypot(bench.open_wind, bench.open_structure) < 1.0


def test_the_first_case_has_no_errors_and_the_limit_of_the_poles(bench):
    first, second = (segment_control._case(bench, one, Stopwatch()) for one in (0, 1))
    # Tenths of the gain are halved seven times, and the middle is taken.
    gains = [np.sin(np.pi * one / 50) for one in (first["limit_hz"], bench.limit_hz)]
    assert gains[0] == pytest.approx(gains[1], rel=1.001 * 0.1 / 2**8)
    assert first["gain_low"] == pytest.approx(1, abs=1e-9) == first["gain_high"]
    # Actuators alone have errors of 5 %.
    assert second["gain_low"] < 0.95 < 1.05 < second["gain_high"]
    assert abs(second["limit_hz"] / first["limit_hz"] - 1) > 0.1 / 2**7


def test_margins_agree_with_the_limit_and_parts_go_to_other_tools(bench):
    fast = bench.loops[1]
    exact = flexible_margins(fast.found)  # by poles; the curve's are read off its frequencies
    assert fast.curve.gain_up == pytest.approx(exact.gain_up, rel=2e-3)
    assert fast.curve.phase == pytest.approx(exact.phase, rel=2e-3)
    found = {one.name: one for one in loops_of(study())}
    one = found["1 Hz"]
    assert one.stable
    assert 2 * np.sin(np.pi * bench.limit_hz / 50) == pytest.approx(
        one.gain_up * 2 * np.sin(np.pi / 50), rel=1e-6
    )
    made = loop_named(study(), "1 Hz")
    assert made.plant.sample_time == pytest.approx(0.02)
    assert made.plant.c.shape[0] == made.controller.b.shape[1]


def test_a_slower_focus_bears_more_of_the_structures_focus():
    focus = ASTIGMATISM | {"zernike": {4: 1.0}, "share": 0.2}
    even, slow = (
        bench_of(study(mode=[focus], slow=part)) for part in ([], [{"first": 1, "last": 1, "factor": 0.25}])
    )
    assert even.limit_hz < 0.7 * slow.limit_hz
    assert even.loops[1].by_mode[0] > 1.5 * slow.loops[1].by_mode[0]


@pytest.mark.usefixtures("lettered")
def test_a_run_says_how_fast_and_what_remains(tmp_path):
    wq.run(study(cases=2), store=tmp_path / "s", on="serial")
    dataset = wq.open_store(tmp_path / "s")
    words = answer(dataset)
    assert words.startswith("The loop may have 1.00 Hz: the fastest of the bandwidths with |S| up to 2.00")
    assert "It is unstable from" in words
    assert "With 1 draw of errors" in words
    slow, fast = bandwidths_of(dataset)
    assert row_of(fast)["unstable"] == ("", "")
    grows = dataclasses.replace(fast, growth=2.0)
    assert "unstable" not in rows_of([slow, fast])[0]  # no column of nothing
    assert [row["unstable"][0] for row in rows_of([slow, grows])] == ["", "2.00 1/s"]
    assert slow.total > fast.total
    page = wq.report(tmp_path / "s").read_text()
    for title in (
        "Loop gain over frequency with its margins",
        "Loop gain in the complex plane",
        "Sensitivity and complementary sensitivity",
        "Spectrum of the surface, and how its rms adds up",
        "What sensor noise does to the surface",
    ):
        assert title in page


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"mode": [ASTIGMATISM | {"zernike": {2: 1.0}}]}, "do not see tilts of the whole mirror"),
        ({"mode": [ASTIGMATISM, ASTIGMATISM]}, "two modes are called 'a'"),
        ({"bandwidths_hz": [1.0, 0.5]}, "must be positive and rise"),
        ({"bandwidths_hz": [20.0]}, "more than a sixth of rate_hz = 50"),
        ({"slow": [{"first": 1, "last": 3, "factor": 0.5}] * 2}, "names mode 1 twice"),
        ({"mirror": {"actuator_angles_deg": [0.0, 90.0, 360.0]}}, "three angles"),
        ({"mirror": {"actuator_angles_deg": [0.0, 90.0, 90.5]}}, "three angles, 1 deg or more apart"),
        ({"mirror": {"actuator_angles_deg": [0.2, 90.0, 359.5]}}, "three angles, 1 deg or more apart"),
    ],
)
def test_bad_input_is_one_sentence(changes, words):
    with pytest.raises(ValueError, match=words):
        study(**changes)


def test_what_the_mirror_shows_to_be_wrong_is_one_sentence():
    own = study(slow=[{"first": 60, "last": 70, "factor": 0.5}])
    with pytest.raises(UserError, match=r"control\.slow names mode 70; the sensors see 51 modes"):
        bench_of(own)
    heavy = [ASTIGMATISM | {"share": 0.7}, ASTIGMATISM | {"name": "b", "share": 0.7}]
    with pytest.raises(UserError, match=r"1\.4 of the static response"):
        bench_of(study(mode=heavy))


def test_an_unstable_bandwidth_is_said_and_leaves_nothing():
    found = bench_of(study(mode=[ASTIGMATISM | {"share": 0.9}], bandwidths_hz=[0.01, 3.0]))
    assert found.loops[1].growth > 0
    assert np.isnan(found.loops[1].total)
    assert found.limit_hz < 3.0
    assert loop_of(found.study, found.structure, 3.0).gains.max() == pytest.approx(2 * np.sin(3 * np.pi / 50))


def test_a_study_whose_loops_are_all_unstable_has_a_report_that_says_so(tmp_path):
    wq.run(study(bandwidths_hz=[8.0]), store=tmp_path / "s")
    page = wq.report(tmp_path / "s").read_text()
    assert "No bandwidth keeps |S| up to 2." in page
    assert "It is unstable from" in page
    assert "Over frequency" not in page
