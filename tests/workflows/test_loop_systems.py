"""Loops of studies in python-control: its poles, margins and curves are those that the studies report."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

import wavequake as wq
from wavequake.campaign.stopwatch import Stopwatch
from wavequake.cli import app
from wavequake.errors import UserError
from wavequake.report.loops.frequency import Curve, arcs
from wavequake.workflows.loops import controller_bench, controller_mor, tip_tilt

SEGMENT = {
    "model.divisions": 3,
    "model.modes": 60,
    "controller.effort": [0.1],
    "reduction.variants": ["modal10", "guyan9"],
    "reduction.frequencies": 20,
}


@pytest.fixture(scope="module", autouse=True)
def cache(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(scope="module")
def control():
    return pytest.importorskip("control", reason="needs python-control: pip install control")


@pytest.mark.parametrize("delay", [1, 2, 3])
@pytest.mark.parametrize("name", ["integrator", "lqg"])
def test_poles_and_margins_of_frame_loops_are_those_of_python_control(control, name, delay):
    study = wq.load_study("tip-tilt-vibration", {"loop.delay_frames": delay})
    plant, controller = wq.loop(study, f"{name}, 500 Hz")
    assert plant.dt == controller.dt == 0.002
    found = tip_tilt.loops(study)[f"{name}, 500 Hz"]().margins()
    radius = np.abs(control.feedback(plant, controller).poles()).max()
    assert np.log(radius) * 500 == pytest.approx(found.growth, rel=1e-6)
    for factor, stable in ((1 - 1e-5, True), (1 + 1e-5, False)):
        poles = control.feedback(factor * found.gain_up * plant, controller).poles()
        assert (np.abs(poles).max() < 1) == stable
    if name == "integrator":  # of LQG's 31 states its polynomials lose the digits
        assert control.stability_margins(plant * controller)[1] == pytest.approx(found.phase_deg, rel=1e-6)


def test_curves_of_frame_loops_are_those_of_python_control(control):
    changes = {"loop.rates_hz": [500.0], "shaken.lines": "keck"}
    study = wq.load_study("tip-tilt-vibration", changes)
    bench = tip_tilt.bench_of(study)
    hertz = bench.hertz[bench.hertz < 250.0][::20]
    for one in bench.loops:
        plant, controller = wq.loop(study, f"{one.name}, 500 Hz")
        s, gain = (
            control.frequency_response(system, 2 * np.pi * hertz, squeeze=True).frdata.ravel()
            for system in (control.feedback(1, plant * controller), plant * controller)
        )
        shown = {key: values[bench.hertz < 250.0][::20] for key, values in one.curves.items()}
        size, phase = shown["loop_gain"], np.radians(shown["loop_phase"])
        np.testing.assert_allclose(size * np.exp(1j * phase), gain, rtol=1e-6)
        np.testing.assert_allclose(shown["rejection"], np.abs(s), rtol=1e-6)
        np.testing.assert_allclose(shown["passed_noise"], np.abs(1 - s), rtol=1e-6)
        # What a mean over the frame cannot see stays; of the rest |S|^2 is left.
        seen = np.sinc(hertz / 500.0) ** 2
        left = bench.open_psd[bench.hertz < 250.0][::20] * (1 - seen + seen * np.abs(s) ** 2)
        np.testing.assert_allclose(shown["left_psd"], left, rtol=1e-6)
        assert np.isnan(one.curves["rejection"][bench.hertz >= 250.0]).all()
        heard = 2 * study.loop.noise_mas**2 / 500.0 * np.abs(1 - s) ** 2
        np.testing.assert_allclose(shown["noise_psd"], heard, rtol=1e-6)


def test_loops_of_segments_have_the_poles_and_curves_of_python_control(control):
    study = wq.load_study("controller-mor", SEGMENT)
    bench = controller_bench.bench_of(study)
    omega = 2 * np.pi * bench.hertz[::60]
    for name, stable in (("modal10", True), ("guyan9", False)):
        plant, controller = wq.loop(study, f"{name}, effort 0.1")
        poles = control.feedback(plant, controller).poles()
        found = controller_mor.judged(bench, name, 0.1, Stopwatch())
        worst = poles[poles.real.argmax()]
        assert abs(found["growth"] - worst.real) < 1e-9 * abs(worst)
        assert found["unstable_poles"] == (poles.real >= 0).sum()
        assert found["stable"] == stable
        # By its matrices: its own responses are off by 3e-6 at a resonance where slycot computes them.
        both = plant * controller
        inner = 1j * omega[:, None, None] * np.eye(len(both.A)) - both.A
        response = both.C @ np.linalg.solve(inner, both.B.astype(complex)) + both.D
        size, phase = found["loop_gain"][::60], np.radians(found["loop_phase"][::60])
        unit = np.eye(3)
        np.testing.assert_allclose(
            np.prod(1 + size * np.exp(1j * phase), axis=1), np.linalg.det(unit + response), rtol=1e-6
        )
        if stable:  # what is left of forces and noise together is the wavefront
            both = found["left_psd"] + found["noise_psd"]
            left = np.trapezoid(both, bench.hertz) + both[0] * bench.hertz[0]
            assert np.sqrt(left) == pytest.approx(found["wavefront"], rel=1e-3)
        else:
            assert np.isnan(found["left_psd"]).all()
        s = np.linalg.inv(unit + response)
        for key, wanted in (("sensitivity", s), ("complementary", unit - s)):
            sizes = np.linalg.norm(wanted, 2, axis=(1, 2)) if stable else np.full(len(omega), np.nan)
            np.testing.assert_allclose(found[key][::60], sizes, rtol=1e-6)
    assert np.array_equal(wq.plant(study).A, wq.loop(study)[0].A)


def test_marks_lie_on_the_curve_where_it_is_critical():
    """L = 2 / (i x (1 + i x / 3)): size 1 at x^2 = 9/2 (sqrt(1 + 16/9) - 1), a phase margin and no other."""
    x = np.geomspace(0.1, 30, 20_001)
    gain = 2 / (1j * x * (1 + 1j * x / 3))
    where = np.sqrt(4.5 * (np.sqrt(1 + 16 / 9) - 1))
    phase = 90 - np.degrees(np.arctan(where / 3))
    ((point, found),) = Curve("one", x, gain[:, None], x, x, np.inf, phase).critical()
    assert found == pytest.approx(where, rel=1e-3)
    assert abs(point - 2 / (1j * where * (1 + 1j * where / 3))) < 1e-9


def test_a_nyquist_curve_is_drawn_as_arcs_and_has_gaps_where_it_is_not_known():
    """A delay has the gain 1 everywhere: chords between frequencies would come nearer to 0."""
    turned = np.exp(-1j * np.radians([0.0, 40.0, 90.0, 170.0, 175.0, 176.0]))
    drawn = arcs(turned)
    np.testing.assert_allclose(np.abs(drawn[np.isfinite(drawn)]), 1.0, rtol=1e-14)
    assert np.isin(turned.round(12), drawn.round(12)).all()
    gaps = np.isnan(drawn)
    assert gaps.any()
    before, after = np.flatnonzero(gaps)[[0, -1]] + [-1, 1]
    np.testing.assert_allclose(drawn[[before, after]], turned[2:4], rtol=1e-12)  # 80 degrees
    assert gaps.sum() == after - before - 1  # and nowhere else
    angles = -np.degrees(np.angle(drawn[~gaps]))
    assert (np.diff(angles) > 0).all()
    assert np.diff(angles)[np.diff(angles) < 60].max() < 4.0 + 1e-9
    spiral = np.array([1.0 + 0j, 3.0j * np.exp(-0.7j)])
    assert np.allclose(np.diff(np.abs(arcs(spiral))), 2.0 / (len(arcs(spiral)) - 1))
    assert len(arcs(np.array([1j, np.nan, 1.0]))) == 3


def test_an_unstable_loop_ends_margins_with_3_and_has_none():
    words = [f"{key}={json.dumps(value)}" for key, value in SEGMENT.items()]
    done = CliRunner().invoke(app, ["margins", "controller-mor", *words])
    assert done.exit_code == 3, done.output
    (line,) = (one for one in done.output.splitlines() if one.strip().startswith("guyan9, effort 0.1"))
    assert line.split()[3] == "unstable"
    assert "1 of 2 loops are unstable" in done.output
    stable = ["margins", "tip-tilt-vibration", "loop.rates_hz=[100.0]"]
    done = CliRunner().invoke(app, stable)
    assert done.exit_code == 0
    assert "S peak: how much it amplifies at worst" in " ".join(done.output.split())


@pytest.mark.parametrize(
    ("study", "name", "words"),
    [
        (
            "mirror-mor",
            None,
            "mirror-mor has no loops; controller-mor, tip-tilt-vibration, telescope-loop, system-loop, "
            "segment-control and lens-experiment have.",
        ),
        ("tip-tilt-vibration", "pid", "has no loop 'pid'; it has integrator, 100 Hz; lqg, 100 Hz;"),
    ],
)
def test_loops_that_there_are_not_are_told(study, name, words):
    with pytest.raises(UserError) as caught:
        wq.loop(study, name)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)
