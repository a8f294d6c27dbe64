"""Sensors on segments, a mirror of influence functions and more controllers, in loops of a study file."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from small_loops import LIGHT, first_case, written

from wavequake.chain.loops.actuators.m2_influence import InfluencedM2
from wavequake.chain.loops.actuators.segments import SegmentActuators
from wavequake.chain.loops.controllers.state_space import StateSpace
from wavequake.chain.loops.design import Design, Watch
from wavequake.chain.loops.sensors.accelerometer import Accelerometers
from wavequake.chain.loops.sensors.displacement import DisplacementSensors
from wavequake.control.sampled.channel import RIGID, Timing, step_over
from wavequake.control.sampled.regulator import advance, start
from wavequake.control.sampled.stability import SampledLoop, worst_pole
from wavequake.errors import UserError
from wavequake.optics.polynomials.zernike import annular_zernike
from wavequake.optics.segments.catalog import telescope
from wavequake.optics.segments.telescope import with_figures
from wavequake.optics.systems.kinematics import rest_states
from wavequake.workflows.loops.telescope_bench import bench_of, loops

pytest.importorskip("slycot", reason="needs slycot: pip install slycot")

LOOPS = """
[[sensor]]
name = "where"
model = "displacement"
rate_hz = 2000.0
[[sensor]]
name = "acceleration"
model = "accelerometer"
rate_hz = 5000.0
resonance_hz = 1000.0
[[sensor]]
name = "slopes"
model = "slopes"
bandwidth_hz = 400.0
[[actuator]]
name = "pistons"
model = "segments"
[[actuator]]
name = "push"
model = "m2-influence"
across = 5
terms = 15
bandwidth_hz = 300.0
[[controller]]
name = "held"
model = "h-infinity"
sensor = "where"
actuator = "pistons"
latency_frames = 0
bandwidth_hz = 150.0
[[controller]]
name = "placed"
model = "pole-placement"
sensor = "slopes"
actuator = "push"
observer_hz = 60.0
actuator_hz = 250.0
latency_frames = 0
modes = 13
[[controller]]
name = "inertial"
model = "state-space"
each = true
sensor = "acceleration"
actuator = "pistons"
latency_frames = 0
# The reading is summed twice, with a leak of 5 Hz, which gives minus the displacement.
a = [[0.99374, 0.0], [0.0002, 0.99374]]
b = [[0.0002], [4e-8]]
c = [[0.0, -1.0]]
d = [[-2e-8]]
"""


def test_loops_of_segments_and_of_influence_functions_leave_less(tmp_path):
    bench, block, los, wfe = first_case(written(tmp_path, LOOPS))
    # A first-order lag of 150 Hz against 10 to 40 Hz leaves about a fifth of what segments add.
    still = float(np.sqrt(np.sum(bench.optics.still**2)))
    added = {name: np.sqrt(max(value**2 - still**2, 0.0)) for name, value in wfe.items()}
    assert added["held"] < 0.4 * added["off"]
    assert los["held"] < 0.4 * los["off"]
    # What is read twice summed is the displacement that is left: a loop gain of 1 halves it.
    assert added["inertial"] == pytest.approx(0.5 * added["off"], rel=0.05)
    assert wfe["placed"] < 0.8 * wfe["off"]
    assert los["placed"] < 0.9 * los["off"]
    assert block.result["light_error_wfe_rms"].max() < 2e-3
    assert not block.messages


def test_bandwidth_and_margins_are_those_that_were_asked_for(tmp_path):
    found = {name: make().margins() for name, make in loops(written(tmp_path, LOOPS)).items()}
    assert found["held"].peak <= 2.0 * (1 + 1e-6)
    # The slowest pole is the observer's.
    assert found["placed"].growth == pytest.approx(-2 * np.pi * 60.0, rel=1e-6)


def test_sensors_of_segments_read_their_own_segment():
    seen = np.arange(float(LIGHT.bodies))
    names = LIGHT.layout.names
    one = DisplacementSensors(name="d", segments=(names[3], names[5]), dofs=("rx", "dz"))
    assert one.labels(LIGHT) == tuple(f"{dof}[{names[k]}]" for dof in ("rx", "dz") for k in (3, 5))
    np.testing.assert_array_equal(one.matrix(LIGHT) @ seen, [18 + 3, 18 + 5, 3, 5])
    fast = Accelerometers(name="a", segments=(names[3],), resonance_hz=300.0, bandwidth_hz=900.0)
    np.testing.assert_allclose(fast.matrix(LIGHT) @ seen, [3e-9])
    # At 20 Hz it reads -w^2 y; the square of the resonance far above it.
    gain = response(fast.dynamics(), 20.0)
    assert gain.real == pytest.approx(-((2 * np.pi * 20.0) ** 2), rel=0.02)
    assert abs(response(fast.dynamics(), 1e5)) == pytest.approx(
        (2 * np.pi * 300.0) ** 2 * 900 / 1e5, rel=0.01
    )


def response(dynamics, hertz):
    unit = np.eye(len(dynamics))
    return dynamics.c @ np.linalg.solve(2j * np.pi * hertz * unit - dynamics.a, dynamics.b) + dynamics.d


def surface(actuator, commands, x, y):
    states = rest_states(with_figures(telescope("tmt-18"), 0, actuator.terms))
    actuator.put(LIGHT, states, np.array([commands]))
    return annular_zernike(x, y, actuator.terms) @ states.deformations[2][0] * 1e6


def test_influence_functions_are_gaussian_where_enough_terms_describe_them():
    """The sum of Gaussians by hand; the fit gets better with its terms."""
    rng = np.random.default_rng(4)
    radius, angle = np.sqrt(rng.uniform(0, 1, 400)), rng.uniform(0, 2 * np.pi, 400)
    x, y = radius * np.cos(angle), radius * np.sin(angle)
    off = []
    for terms in (28, 66, 120, 231):
        one = InfluencedM2(name="m", across=5, coupling=0.2, terms=terms)
        names = one.channels(LIGHT)
        assert len(names) == 21  # of 25, less the corners
        commands = np.random.default_rng(7).standard_normal(len(names))
        wanted = np.zeros(400)
        for name, command in zip(names, commands, strict=True):
            row, column = map(int, name[1:].split("c"))
            squared = (x - (0.5 * column - 1)) ** 2 + (y - (0.5 * row - 1)) ** 2
            wanted += command * np.exp(np.log(0.2) * squared / 0.25)
        off.append(np.sqrt(np.mean((surface(one, commands, x, y) - wanted) ** 2)) / wanted.std())
    assert off[0] > 2 * off[1] > 4 * off[2]
    assert off[3] < 1e-3


def test_influence_functions_of_a_file_are_the_zernike_actuator(tmp_path):
    """A table that is the identity does what m2-figure does."""
    rows = [f"{k}," + ",".join("1" if j == k else "0" for j in range(2, 16)) for k in range(2, 16)]
    (tmp_path / "table.csv").write_text(
        f"actuator,{','.join(f'z{j}' for j in range(2, 16))}\n" + "\n".join(rows)
    )
    more = """
[[actuator]]
name = "table"
model = "m2-influence"
file = "table.csv"
terms = 15
bandwidth_hz = 1000.0
[[controller]]
name = "by-table"
model = "integrator"
sensor = "wavefront"
actuator = "table"
bandwidth_hz = 60.0
latency_frames = 0.5
"""
    _, _, los, wfe = first_case(written(tmp_path, more))
    assert wfe["by-table"] == pytest.approx(wfe["elastic/60/0.5"], rel=1e-9)
    assert los["by-table"] == pytest.approx(los["elastic/60/0.5"], rel=1e-9)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("rate_hz = 2000.0", 'segments = ["Q*"]', "sensor.where.segments: there is no segment 'Q*'"),
        ("bandwidth_hz = 150.0", "bandwidth_hz = 900.0", "held: no controller keeps |S| and |K S| below"),
        ("bandwidth_hz = 150.0", "bandwidth_hz = 1200.0", "is 1200, not below half of its 2000 commands"),
        ('sensor = "where"', 'sensor = "acceleration"', "does not see where things stand; take lqg, lqr,"),
        ("each = true", "each = false", "inertial leads from 1 readings to 1 commands, but the sensor"),
        ("terms = 15", "terms = 28", "actuator.push.terms is 28, more than wavefront.zernike_terms 15"),
    ],
)
def test_parts_that_do_not_fit_are_said_in_a_sentence(old, new, words, tmp_path):
    assert LOOPS.count(old) == 1
    with pytest.raises(UserError) as caught:
        bench_of(written(tmp_path, LOOPS.replace(old, new)))
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("actuator,z2,y3\n1,2,3\n", "the column 'y3' is no term"),
        ("actuator,z2,z2\n1,2,3\n", "the column 'z2' is there twice"),
        ("actuator,z2\n1,nan\n", "is no finite number"),
        ("actuator,z40\n1,2\n", "terms up to z40, beyond terms = 15"),
        ("x,z2\n1,2\n", "its first line must name its columns: actuator"),
    ],
)
def test_tables_of_influence_functions_that_cannot_be_read_are_told(text, words, tmp_path):
    (tmp_path / "table.csv").write_text(text)
    block = '[[actuator]]\nname = "table"\nmodel = "m2-influence"\nfile = "table.csv"\nterms = 15\n'
    with pytest.raises(UserError) as caught:
        written(tmp_path, block)
    assert words in str(caught.value)


def test_a_table_that_is_missing_is_told(tmp_path):
    block = '[[actuator]]\nname = "table"\nmodel = "m2-influence"\nfile = "none.csv"\n'
    with pytest.raises(UserError, match=r"actuator\.table\.file: the file .*none\.csv"):
        written(tmp_path, block)


BESIDE = """
[[sensor]]
name = "other"
model = "line-of-sight"
rate_hz = 500.0
[[actuator]]
name = "shift"
model = "m2-rigid"
dofs = ["dx", "dy"]
[[controller]]
name = "slow"
model = "integrator"
sensor = "other"
actuator = "shift"
gain = {gain}
latency_frames = 1
[[controller]]
name = "two"
model = "integrator"
sensor = "sight"
actuator = "tilt"
gain = {gain}
latency_frames = 1
beside = ["slow"]
"""


def test_loops_that_are_stable_alone_but_not_together_are_refused(tmp_path):
    """Two integrators on one line of sight: each takes all of it away, together twice."""
    with pytest.raises(UserError, match="'two' and 'slow' are stable each alone, but not beside each other"):
        bench_of(written(tmp_path, BESIDE.format(gain=0.6)))
    assert bench_of(written(tmp_path, BESIDE.format(gain=0.2))).controllers[-1].name == "two"


def test_a_stuck_channel_does_not_make_slow_loops_unstable_together(tmp_path):
    """What stands where it is stuck is made up for by 200 periods of a larger motion, which is no growth."""
    turned = BESIDE.format(gain=0.005).replace('["dx", "dy"]', '["rx", "ry"]\nstuck = { ry = 1e6 }')
    moved = '[[actuator]]\nname = "moved"\nmodel = "m2-rigid"\ndofs = ["dx", "dy"]\n'
    study = written(tmp_path, moved + turned.replace('actuator = "tilt"', 'actuator = "moved"'))
    assert bench_of(study).controllers[-1].name == "two"


def test_a_matrix_alone_is_a_controller_without_states():
    given = StateSpace(name="c", d=((-0.1, 0.0), (0.05, -0.2)))
    nothing = np.zeros((2, 0))
    watch = Watch("s", ("x", "y"), np.eye(2), 1.0, RIGID, nothing, nothing)
    asked = Design("c", "a", (watch,), ("p", "q"), RIGID, Timing(1, 1, 1, 0), None, (), nothing.T)
    regulator = given.design(asked)
    commands = advance(regulator, start(regulator, 1), np.array([[1.0], [2.0]]))[1]
    np.testing.assert_allclose(commands, [[-0.1], [-0.35]], rtol=1e-15)
    assert worst_pole(SampledLoop(asked.timing, RIGID, asked.sees, regulator)).growth < 0


def test_a_segment_on_a_spring_moves_as_newton_says():
    """A step of the command: servo, spring and damper integrated by DOP853."""
    kg, stiffness, zeta, servo = 150.0, 10e6, 0.02, 20.0
    one = SegmentActuators(
        name="a", stiffness_n_um=10.0, segment_kg=kg, damping=zeta, bandwidth_hz=servo
    ).dynamics()
    damper = 2 * zeta * np.sqrt(stiffness * kg)

    def rates(_, x):
        foot, place, speed = x
        return [2 * np.pi * servo * (1.0 - foot), speed, (stiffness * (foot - place) - damper * speed) / kg]

    for seconds in (0.003, 0.02, 0.3):
        wanted = solve_ivp(rates, (0, seconds), np.zeros(3), "DOP853", rtol=1e-11, atol=1e-13).y[1, -1]
        assert one.c @ step_over(one, seconds).gamma == pytest.approx(wanted, rel=1e-8)


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"stiffness_n_um": 10.0}, "give stiffness_n_um and segment_kg together"),
        ({"stiffness_n_um": 10.0, "segment_kg": 150.0, "resonance_hz": 40.0}, "leave resonance_hz out"),
        ({"stiffness_n_um": 10.0, "segment_kg": 150.0, "dofs": ("dz", "rx")}, "that of pistons; set dofs"),
    ],
)
def test_springs_that_do_not_fit_are_said_in_a_sentence(keys, words):
    with pytest.raises(ValueError, match=words):
        SegmentActuators(name="a", **keys)
