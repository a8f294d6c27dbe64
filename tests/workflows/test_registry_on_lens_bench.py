"""Sensors and controllers of the registry on the lens bench: what serves a telescope serves it, too."""

from typing import ClassVar, Literal

import numpy as np
import pytest
from numpy.testing import assert_allclose
from small_loops import first_case, written

from wavequake.campaign.contract import DONE
from wavequake.chain.loops.block import Controller, Sensor, register
from wavequake.chain.loops.design import decoupling
from wavequake.control.bench import COMPENSATOR, SENSITIVITIES, fitted_bench
from wavequake.control.experiment import Plant
from wavequake.control.linear import linear_model
from wavequake.control.loop import commands_of, stage_motion
from wavequake.control.plant import swing
from wavequake.control.regulator import modal_model, stage_gain
from wavequake.control.sampled.regulator import shared_filter
from wavequake.control.sensor import quantized_command
from wavequake.control.stage import Stage, stage_response
from wavequake.control.thesis import future_integration
from wavequake.errors import UserError
from wavequake.workflows.lens.experiment import KIND
from wavequake.workflows.lens.loops import beside, closed_loops
from wavequake.workflows.loops.loop_margins import loops_of
from wavequake.workflows.study import load_study

STILL = {"errors.stage_gain": 0.0, "errors.stage_poles": 0.0}


@register
class FromOutside(Controller):
    """Two integrators in a row."""

    model: Literal["from-outside"] = "from-outside"
    gain: float = 0.2

    def design(self, asked):
        a, b = [[1, 1], [0, 1]], [[-self.gain - self.gain**2 / 4], [-(self.gain**2) / 4]]
        return shared_filter(decoupling(asked), linear_model(a, b, a[:1], b[:1]))


@register
class Doubled(Sensor):
    """The line of sight, twice as large."""

    units: ClassVar[str] = "mas"
    model: Literal["doubled"] = "doubled"

    def labels(self, light):
        return ("x", "y")

    def matrix(self, light, nominal=False):
        return 2.0 * np.eye(2, light.optical)


BLOCKS = """
[[sensor]]
name = "outside"
model = "doubled"
rate_hz = {rate}

[[{block}]]
name = "mine"
model = "from-outside"
sensor = "outside"
actuator = "{actuator}"
gain = {gain}
latency_frames = 0.3
"""


def study_of(tmp_path, text, **changes):
    path = tmp_path / "bench.toml"
    path.write_text(
        '[study]\nname = "bench"\nworkflow = "lens-experiment"\n[time]\nduration_s = 2.0\n' + text
    )
    return load_study(path, changes)


def follow(study, runs, stage=None):
    """Return command and position of the stage under the study's loops on free runs of the fitted bench."""
    plant = Plant(fitted_bench(), stage or Stage(), *[np.zeros(0)] * 1, (1.0, 1.0), np.zeros(0), np.zeros(0))
    found = [one([plant], runs, 1e-3) for one in beside(study.identity_text(), "initial", [0])]
    return [(command[0], position[0]) for command, position in found]


@pytest.fixture(scope="module")
def free():
    bench = fitted_bench()
    return swing([bench], np.ones(1), duration=2.0, keep_lenses=True)


def test_one_sensor_and_controller_from_outside_serve_a_telescope_and_the_bench(tmp_path, free):
    telescope = written(tmp_path, BLOCKS.format(block="controller", rate=1000.0, actuator="tilt", gain=0.4))
    *_, los, _ = first_case(telescope)
    assert los["mine"] < 0.9 * los["off"]

    study = study_of(tmp_path, BLOCKS.format(block="loop", rate=100.0, actuator="stage", gain=0.05))
    command, position = follow(study, free)[0]
    expected = _stepped(free.image[0], period=0.01, late=0.003, gain=0.05)
    np.testing.assert_allclose(position, expected, atol=2e-3 * np.ptp(expected))
    assert min(np.ptp(position), np.ptp(command)) > 1e-4


def _stepped(image, period, late, gain):
    """Return the stage under the two integrators, by its transfer function's own difference equation.

    Steps of 0.02 ms: sums over frames are the sensor's means, and partial fractions of the stage's step.
    """
    fine = 2e-5
    stage = Stage()
    # Residues of G(s) / s: the response to a step, exact.
    poles = np.array(stage.poles)
    at = [
        stage.gain
        * np.prod([1 - p / z for z in stage.zeros])
        / np.prod([1 - p / q for q in stage.poles if q != p])
        * -1.0
        for p in poles
    ]
    per, delay = round(period / fine), round(late / fine)
    count = round((len(image) - 1) * 1e-3 / fine) + 1
    free = np.interp(fine * np.arange(count), 1e-3 * np.arange(len(image)), image)
    grown = np.exp(poles * fine)
    modal, position, moved = np.zeros(3, complex), np.zeros(count), np.zeros(count)
    acting, waiting, states = 0.0, [], np.zeros(2)
    a, b = np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([-gain - gain**2 / 4, -(gain**2) / 4])
    through = float(np.real(stage_response(stage, 1e9)))
    for k in range(count):
        position[k] = through * acting + np.real(modal.sum())
        if k % per == 0 and k:
            span = slice(k - per, k + 1)
            seen = free[span] + SENSITIVITIES[COMPENSATOR] * position[span]
            left = np.trapezoid(seen) / per / (SENSITIVITIES[COMPENSATOR] * stage.gain)
            wanted = states[0] + states[1] + b[0] * left
            states = a @ states + b * left
            waiting.append((k + delay, float(quantized_command(np.array(wanted)))))
        if waiting and waiting[0][0] == k:
            acting = waiting.pop(0)[1]
        moved[k] = through * acting + np.real(modal.sum())
        modal = grown * modal + acting * np.array(at) * (1 - grown) * -1.0
    return moved[:: round(1e-3 / fine)]


def test_the_reference_s_filter_is_a_controller_like_any_other(tmp_path, free):
    """FI reads lens 4 alone: by matrices in a study file, and by the bench's own path."""
    own = future_integration(fitted_bench())
    rows = [[list(map(float, row)) for row in one] for one in (own.a, own.b[:, :1] * 1e-3)]
    c, d = own.c.tolist(), float(own.d[0]) * 1e-3
    # Readings in nm, commands in um.
    text = f"""
[[sensor]]
name = "lens"
model = "displacement"
nodes = ["lens-4"]
rate_hz = 125.0
integration = 1e-3

[[loop]]
name = "FI by matrices"
model = "state-space"
sensor = "lens"
latency_frames = {0.003 / 0.008}
a = {rows[0]}
b = {rows[1]}
c = [{c}]
d = [[{d}]]
"""
    text = text.replace('"FI by matrices"', '"matrices"')
    command, position = follow(study_of(tmp_path, text), free)[0]
    given = commands_of(own, free.measured[:, ::8])
    expected = stage_motion(Stage(), given, 0.008, 0.003, 1e-3, len(free.time))[0]
    np.testing.assert_allclose(
        command[8:], np.repeat(quantized_command(given[0]), 8)[8 : len(command)], atol=2e-5
    )
    np.testing.assert_allclose(position, expected, atol=2e-5)
    assert np.ptp(expected) > 1e-3


CAMERA = """
[[sensor]]
name = "camera"
model = "line-of-sight"
rate_hz = 200.0
noise = 5.0
[[sensor]]
name = "lens"
model = "displacement"
nodes = ["lens-4"]
rate_hz = 200.0
"""
LOOP = """
[[loop]]
name = "{name}"
model = "{model}"
sensor = "camera"
latency_frames = {late}
{more}
"""


def test_perfect_leaves_nothing_and_off_moves_nothing(tmp_path, free):
    text = CAMERA + LOOP.format(name="perfect", model="perfect", late=1, more="")
    text += '[[loop]]\nname = "off"\nmodel = "off"\n'
    (_, moved), (_, still) = follow(study_of(tmp_path, text), free)
    image = free.image[0] + SENSITIVITIES[COMPENSATOR] * moved
    assert np.abs(image).max() < 1e-9 * np.abs(free.image).max()
    assert not still.any()


def test_the_bench_s_own_controllers_keep_their_bits_and_cases_do_not_depend_on_chunks(tmp_path):
    text = CAMERA + LOOP.format(name="known", model="lqr", late=0.2, more="structure = true\neffort = 1e-4")
    bare, looped = study_of(tmp_path, ""), study_of(tmp_path, text)
    plain = KIND.compute(bare.identity_text(), np.array([1]), "numpy")
    found = KIND.compute(looped.identity_text(), np.arange(2), "numpy")
    alone = KIND.compute(looped.identity_text(), np.array([1]), "numpy")
    assert (found.status == DONE).all()
    for name, values in alone.arrays.items():
        np.testing.assert_array_equal(values[0], found.arrays[name][1], err_msg=name)
        own = values[:, :6] if values.ndim > 1 and values.shape[1] == 7 else values
        np.testing.assert_array_equal(own, plain.arrays[name], err_msg=name)
    # It knows how the nominal bench swings: of a plant with 2 % other springs it leaves less than a half.
    assert (found.arrays["deviation"][:, 6] < 50).all()


def test_a_loop_bears_the_delay_that_its_margin_says(tmp_path):
    def bench(late):
        return study_of(
            tmp_path, CAMERA + LOOP.format(name="slow", model="integrator", late=late, more="gain = 0.1")
        )

    (found,) = loops_of(bench(0.5))
    frames = 200.0 * found.delay_ms / 1e3
    KIND.check(bench(0.5 + 0.99 * frames).identity_text())
    with pytest.raises(UserError, match=r"loop\.slow is unstable: 'stage' grows by .* at 2?\d\.?\d* Hz"):
        KIND.check(bench(0.5 + 1.01 * frames).identity_text())


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (
            LOOP.format(name="one", model="integrator", late=1, more=""),
            r"needs sensors, but there is no \[\[sens",
        ),
        (
            CAMERA + LOOP.format(name="FF", model="integrator", late=1, more=""),
            "two controllers are called 'FF'",
        ),
        (
            CAMERA + LOOP.format(name="a", model="integrator", late=1, more='actuator = "M2"'),
            "there is stage",
        ),
        (
            CAMERA + LOOP.format(name="a", model="integrator", late=1, more='beside = ["b"]'),
            "there is one stage",
        ),
        (CAMERA + LOOP.format(name="a", model="integrator", late=500, more=""), "less than or equal to 100"),
    ],
)
def test_loops_that_cannot_be_are_refused_when_a_study_is_read(tmp_path, text, words):
    with pytest.raises(UserError, match=words):
        study_of(tmp_path, text)


@pytest.mark.parametrize(("pole", "stable"), [(0.9, True), (1.1, False)])
def test_what_nothing_feeds_back_is_judged_by_itself(tmp_path, pole, stable):
    more = f"a = [[{pole}]]\nb = [[1.0]]\nc = [[1e-3]]"
    text = CAMERA + LOOP.format(name="ahead", model="state-space", late=1, more=more)
    study = study_of(tmp_path, text.replace('sensor = "camera"', 'sensor = "lens"'))
    if stable:
        KIND.check(study.identity_text())
        (found,) = loops_of(study)
        assert (found.stable, found.gain_up, found.peak) == (True, np.inf, 1.0)
    else:
        with pytest.raises(UserError, match=r"loop\.ahead is unstable: 'stage' grows by 19\.1 1/s at 0 Hz"):
            KIND.check(study.identity_text())


@pytest.mark.parametrize(
    ("sensor", "words"),
    [
        ('model = "displacement"\nnodes = ["lens-4"]', "does not see 'stage' of the actuator 'stage' at all"),
        (
            'model = "displacement"\nnodes = ["lens-7"]',
            "there is no node 'lens-7'; there are lens-1 to lens-6",
        ),
        ('model = "displacement"\nsegments = ["A1"]', "there is no segment 'A1'; there are no segments"),
        ('model = "displacement"\nm2 = ["rx"]', "reads what the lens bench does not have"),
        ('model = "edges"', "need a segmented mirror; this one has no edges"),
    ],
)
def test_sensors_that_see_nothing_are_named_before_a_run(tmp_path, sensor, words):
    text = f'[[sensor]]\nname = "camera"\nrate_hz = 200.0\n{sensor}\n'
    study = study_of(tmp_path, text + LOOP.format(name="a", model="integrator", late=1, more=""))
    with pytest.raises(UserError, match=words):
        KIND.check(study.identity_text())


FORWARD = """
[[sensor]]
name = "image"
model = "line-of-sight"
rate_hz = {rate}
[[sensor]]
name = "chain"
model = "displacement"
nodes = ["lens-{lens}"]
rate_hz = {rate}
noise = 100.0
[[loop]]
name = "forward"
model = "modal"
sensor = "image"
also_reads = ["{also}"]
latency_frames = {late}
"""


@pytest.mark.parametrize(("rate", "late", "share"), [(1000.0, 0.2, 1.0), (500.0, 1.7, 0.3)])
def test_the_modal_regulator_inverts_what_follows_at_every_pole(tmp_path, rate, late, share):
    """A mode e^{λt} of lens 4, told by means of frames, moves the stage so that the image stands still."""
    text = FORWARD.format(rate=rate, late=late, lens=4, also="chain")
    text = text.replace(f"rate_hz = {rate}", f"rate_hz = {rate}\nintegration = {share}")
    (one,) = closed_loops(study_of(tmp_path, text).identity_text(), "initial")
    model, bench = modal_model(fitted_bench()), one.given
    for pole, image in zip(model.poles, model.image, strict=True):
        z = np.exp(pole / rate)
        reading = np.exp(pole * share / rate * (np.arange(4000) + 0.5 - 4000) / 4000).mean()
        read = bench.decoupling[:, -1] * 1e9 * reading
        held = bench.c[0] @ np.linalg.solve(z * np.eye(len(bench.a[0])) - bench.a[0], bench.b[0] @ read)
        command = 1e-6 * (held + bench.d[0] @ read)
        moved = command[0] * stage_gain(Stage(), np.array([pole]), 1 / rate, late / rate)[0]
        assert abs(image + SENSITIVITIES[COMPENSATOR] * moved) < 1e-7 * abs(image)


def test_a_settled_modal_regulator_leaves_what_holding_its_commands_does(tmp_path):
    """Of the nominal bench, the hold's saw-tooth: the image's speed over a period, by the root of 12."""
    free = swing([fitted_bench()], np.ones(1), duration=6.0, keep_lenses=True)
    text = FORWARD.format(rate=500.0, late=1.7, lens=4, also="chain")
    _, position = follow(study_of(tmp_path, text, **{"time.duration_s": 6.0}), free)[0]
    settled = free.time > 4.0
    left = free.image[0] + SENSITIVITIES[COMPENSATOR] * position
    ripple = np.sqrt(np.mean(np.gradient(free.image[0], 1e-3)[settled] ** 2)) / 500 / np.sqrt(12)
    assert ripple < 0.03 * free.image[0][settled].std()
    assert left[settled].std() < ripple


def test_a_modal_regulator_that_could_hold_nothing_still_is_refused(tmp_path):
    text = FORWARD.format(rate=500.0, late=1, lens=4, also="chain").replace(
        'model = "line-of-sight"', 'model = "displacement"\nnodes = ["lens-3"]'
    )
    with pytest.raises(UserError, match="forward: 'image' does not see the actuator 'stage'"):
        KIND.check(study_of(tmp_path, text).identity_text())


@pytest.mark.parametrize(
    ("lens", "also", "words"),
    [
        (5, "chain", r"forward: 'chain' sees the actuator 'stage', so that it would feed back"),
        (4, "image", "reads 'image' twice"),
    ],
)
def test_a_modal_regulator_that_would_feed_back_is_refused(tmp_path, lens, also, words):
    with pytest.raises(UserError, match=words):
        KIND.check(
            study_of(tmp_path, FORWARD.format(rate=500.0, late=1, lens=lens, also=also)).identity_text()
        )


def test_stages_of_different_delays_move_as_each_alone():
    commands = np.cumsum(np.random.default_rng(4).standard_normal((3, 40)), axis=1) * 1e-6
    stages = [Stage(delay=delay, gain=gain) for delay, gain in ((4e-3, 1.0), (7.3e-3, 1.2), (4e-3, 0.9))]
    found = stage_motion(stages, commands, 2e-3, 1e-3, 1e-3, 100)
    for stage, own, row in zip(stages, commands, found, strict=True):
        assert_allclose(stage_motion(stage, own[None], 2e-3, 1e-3, 1e-3, 100)[0], row, rtol=1e-12, atol=1e-18)
