"""Loops that cannot be, and controllers of others: a sentence that names block, mode and frequency."""

import json
from pathlib import Path

import numpy as np
import pytest
from small_loops import SMALL, small, written
from typer.testing import CliRunner

import wavequake as wq
from wavequake.campaign.plugins import load_text
from wavequake.chain.loops.judged import strongest
from wavequake.cli import app
from wavequake.errors import UserError

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
        ({"actuator": "figure"}, "tells 2 of 14 motions of the actuator 'figure' apart"),
        (
            {"actuator": "figure"},
            "so that 'Z4', 'Z5', 'Z6', 'Z7' and 8 more are, at 0 Hz (its own dynamics: 1000 Hz), not",
        ),
        ({"actuator": "figure", "keys": "modes = 3"}, "tells 2 motions of 'figure' apart, not modes = 3"),
        ({"keys": "gain = 1.7"}, "controller.more is unstable: "),
        ({"keys": "gain = 0.5\nbandwidth_hz = 20"}, "controller.more: give gain or bandwidth_hz, not both"),
        ({"keys": "bandwidth_hz = 600"}, "bandwidth_hz is 600, not below half of its 1000 commands"),
        ({"keys": "mode_gains = {Z9 = 2}"}, "'tilt' has no channel 'Z9'; it has rx to ry"),
        ({"model": "lqg"}, "'more' expects no disturbance; give lines, drift_rms or structure"),
        (
            {"model": "lqr", "keys": "lines = [{ hz = 0.3, rms = 1.0 }]"},
            "a line at 0.3 Hz cannot be 0.5 Hz wide; fwhm_hz must be between 3e-05 and 0.3",
        ),
        (
            {"model": "lqg", "keys": "structure = true"},
            "controller.more.structure: there is neither",
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
        (
            {"actuator.tilt.resonance_hz": 1e-300},
            "resonance_hz: input should be greater than or equal to 0.001",
        ),
        ({"sensor.sight.bandwidth_hz": 1e300}, "bandwidth_hz: input should be less than or equal to 1000000"),
        ({"actuator.tilt.stroke": 1.0}, "actuator.tilt is saturated from the start: 'history' asks r"),
        ({"actuator.tilt.stroke": 1.0}, " half of the time (most at "),
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
        ({"actuator.tilt.dofs": ["rx", "rx"]}, "actuator.tilt.dofs: 'rx' is named twice"),
        ({"actuator.tilt.slew": 1e-3}, "actuator.tilt is saturated from the start: 'history' asks r"),
        ({"actuator.tilt.slew": 1e-3}, "per second half of the time (most at "),
        (
            {"sensor.sight.integration": 1e-300},
            "integration: input should be greater than or equal",
        ),
        ({"sensor.sight.noise_density": 1e300}, "noise_density: input should be less than or equal to"),
        ({"sensor.sight.quantum": 1e-300}, "sensor.sight.quantum: it is 1e-300; give 0, or 1e-15 or more"),
        ({"sensor.sight.photons": 1e-300}, "sensor.sight.photons: it is 1e-300; give 0, or 0.001 or more"),
        ({"sensor.sight.spot_mas": 1e300}, "spot_mas: input should be less than or equal to"),
        (
            {"sensor.wavefront.magnification": 1e300},
            "magnification: input should be less than or equal",
        ),
        ({"sensor.wavefront.shift": [0.0, 3.0]}, "shift: it is 0, 3 radii, so that the sensor stands beside"),
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


@pytest.mark.parametrize(
    ("stage", "dof"), [('"optic"\nof = "M3"', "dy"), ('"m2-rigid"', "rz"), ('"m2-rigid"', "dz")]
)
def test_what_a_sensor_does_not_see_is_no_matter_of_rays(stage, dof, tmp_path):
    """Neither M3 in its plane nor M2 about its axis move light, along it only the wavefront."""
    stage = f'[[actuator]]\nname = "flat"\nmodel = {stage}\ndofs = ["{dof}"]\n'
    loop = MORE.format(model="integrator", sensor="sight", actuator="flat", keys="bandwidth_hz = 4.0")
    with pytest.raises(UserError, match=f"'sight' does not see '{dof}' of the actuator 'flat' at all"):
        wq.plan(written(tmp_path, f"\n{stage}{loop}"))


def test_channels_that_a_sensor_does_not_see_are_named(tmp_path):
    stage = '[[actuator]]\nname = "both"\nmodel = "m2-rigid"\ndofs = ["rx", "dz"]\nresonance_hz = 90.0\n'
    loop = MORE.format(model="integrator", sensor="sight", actuator="both", keys="bandwidth_hz = 4.0")
    words = r"tells 1 of 2 motions of the actuator 'both' apart, so that 'dz' is, at 0 Hz"
    with pytest.raises(UserError, match=words):
        wq.plan(written(tmp_path, f"\n{stage}{loop}"))


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
    assert "1 of 29 loops are unstable" in done.output


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


def test_what_saturates_is_named_with_its_frequency():
    time = np.sort(np.concatenate([np.linspace(0, 1, 501), [0.0301, 0.5003]]))
    motion = 3 * np.sin(2 * np.pi * 12 * time) + 2 * np.sin(2 * np.pi * 40 * time)
    assert strongest(time, motion) == "most at 12 Hz"
    assert strongest(time, motion + 2.5) == "most at 12 Hz"  # 6.25 of what stands, 6.5 of what moves
    stands = "most at 0 Hz, where it stands"
    assert strongest(time, motion + 2.6) == stands
    assert strongest(time, 0 * motion + 1.0) == stands
    assert strongest(np.arange(8.0), np.resize([1.0, -1.0], 8) + 1.2) == stands  # as fast as instants tell
