"""Filters by placed poles and by H-infinity: closed forms, a law of conservation, bounds, another tool."""

from importlib.util import find_spec

import numpy as np
import pytest

from wavequake.control.linear import simulate
from wavequake.control.sampled.channel import RIGID, Timing, first_order, second_order
from wavequake.control.sampled.placed import placed
from wavequake.control.sampled.regulator import shared_filter
from wavequake.control.sampled.robust import robust
from wavequake.control.sampled.run import Actuator, Loop, run, schedule
from wavequake.control.sampled.stability import SampledLoop, sampled_margins, worst_pole
from wavequake.errors import UserError

T = 1e-3
NO_SLYCOT = pytest.mark.skipif(not find_spec("slycot"), reason="needs slycot: pip install slycot")
Z = np.exp(2j * np.pi * np.linspace(0, 0.5, 40001)[1:])
HERTZ = np.linspace(0, 500.0, 40001)[1:]


def timing(latency=0.0, integration=1.0):
    return Timing(T, integration * T, 1, latency * T)


def of(model, z=Z):
    """Return K of u = K y from its matrices alone."""
    unit = np.eye(len(model.a))
    return np.array([(model.c @ np.linalg.solve(one * unit - model.a, model.b) + model.d)[0, 0] for one in z])


def lagging(hertz, z=Z):
    """Return a first-order actuator without latency, whose mean over a frame is read: by hand."""
    share = np.exp(-2 * np.pi * hertz * T)
    rest = (1 - share) / (2 * np.pi * hertz * T)
    # q goes from q0 to u: its mean is u + (q0 - u) rest; the command of the last frame acts in this one.
    return ((1 - rest) + rest * (1 - share) / (z - share)) / z


def left(model, frames, looks=40, dynamics=RIGID, latency=0.0):
    """Run the loop on a disturbance of 1; return its positions."""
    loop = Loop(
        timing(latency),
        shared_filter(np.eye(1), model),
        Actuator(dynamics, np.full(1, np.inf), np.inf, np.full(1, np.nan)),
        np.eye(1),
    )
    at = np.linspace(0, frames * T, looks + 1)[1:]
    return run([loop], schedule([loop.timing], at), [np.ones((frames, 1, 1))], looks).positions[:, 0, 0]


@pytest.mark.parametrize("latency", [0, 1, 3])
def test_a_pure_delay_with_an_observer_has_its_closed_form(latency):
    """S = 1 - f z^-(n+1) / (1 - (1 - f) z^-1), what is believed of the disturbance so many frames later."""
    follow = 1 - np.exp(-2 * np.pi * 40.0 * T)
    model = placed(40.0, None, 0.7, RIGID, timing(latency))
    delay = Z ** -(latency + 1.0)
    found = 1 / (1 - of(model) * delay)
    np.testing.assert_allclose(found, 1 - follow * delay / (1 - (1 - follow) / Z), rtol=1e-9)


def test_poles_of_a_lagging_actuator_are_where_they_were_placed():
    """The loop's response to a step of the disturbance is a sum of powers of the placed poles."""
    model = placed(30.0, 120.0, 0.7, first_order(50.0), timing())
    wanted = np.exp(-2 * np.pi * np.array([30.0, 120.0]) * T)
    z = 1.7 * np.exp(2j * np.pi * np.arange(64) / 64)
    ratio = 1 / (1 - of(model, z) * lagging(50.0, z))
    # Times the two poles, and the one of the model, S is a polynomial in 1/z of few terms.
    for pole in (*wanted, np.exp(-2 * np.pi * 50.0 * T)):
        ratio = ratio * (1 - pole / z)
    coefficients = np.fft.fft(ratio) / 64 * 1.7 ** np.arange(64)
    assert np.abs(coefficients[5:20]).max() < 1e-9
    assert np.abs(coefficients[:5]).max() > 0.1


@pytest.mark.parametrize(
    ("dynamics", "hertz"), [(RIGID, None), (second_order(90.0, 0.2), 150.0), (first_order(80.0), 40.0)]
)
@pytest.mark.parametrize("latency", [0.0, 0.6, 2.0])
def test_what_is_constant_is_taken_away(dynamics, hertz, latency):
    model = placed(25.0, hertz, 0.8, dynamics, timing(latency))
    positions = left(model, 200, 200, dynamics, latency)
    np.testing.assert_allclose(positions[-5:], -1.0, rtol=0, atol=1e-9)
    assert np.abs(positions).max() < 1.5


@NO_SLYCOT
@pytest.mark.parametrize(
    ("dynamics", "latency", "bandwidth"),
    [(RIGID, 0, 80.0), (RIGID, 1, 40.0), (RIGID, 2, 20.0), (first_order(50.0), 0, 30.0)],
)
def test_h_infinity_keeps_its_bounds_at_every_frequency(dynamics, latency, bandwidth):
    """With plants by hand; |S| at most f / f_b and 1.9, |K S| at most 3, and Bode's integral is zero."""
    model = robust(bandwidth, 1.9, 3.0, dynamics, timing(latency))
    plant = lagging(50.0) if len(dynamics) else Z ** -(latency + 1.0)
    own = of(model)
    s = 1 / (1 - plant * own)
    assert np.abs(s).max() <= 1.9 * (1 + 1e-6)
    assert np.abs(own * s).max() <= 3.0 * (1 + 1e-6)
    # The bilinear map of the weight bends frequencies by less than its tangent.
    bent = np.tan(np.pi * HERTZ * T) / np.tan(np.pi * bandwidth * T)
    assert (np.abs(s) <= np.hypot(bent, 1e-4) * (1 + 1e-6)).all()
    positions = left(model, 400, 400, dynamics, latency)
    assert positions[-1] == pytest.approx(-1.0, abs=3e-4)
    # No pole outside the circle: what is won at low frequencies is lost at high ones.
    assert np.trapezoid(np.log(np.abs(s)), HERTZ) == pytest.approx(0.0, abs=0.2)
    assert np.abs(np.linalg.eigvals(model.a)).max() <= 1 + 1e-12


@NO_SLYCOT
def test_what_cannot_be_kept_is_told_with_the_least_that_can():
    """Against python-control's mixed-sensitivity synthesis of the same delay, in the same plane."""
    control = pytest.importorskip("control", reason="needs python-control: pip install control")
    a, b = -2.0, 4.0  # 1/z in the plane s = 2 (z - 1) / (z + 1): (2 - s) / (2 + s)
    plant = control.ss(a, b, 1.0, -1.0)
    warped = 2 * np.tan(np.pi * 200.0 * T)
    weight = control.ss(control.tf([1 / 1.5, warped], [1.0, 1e-4 * warped]))
    with pytest.warns(FutureWarning):
        least = control.mixsyn(plant, weight, control.ss([], [], [], [[0.2]]))[2][0]
    with pytest.raises(UserError) as caught:
        robust(200.0, 1.5, 5.0, RIGID, timing())
    assert f"the best exceeds it {least:.3g} times" in str(caught.value)


@NO_SLYCOT
def test_a_controller_that_is_itself_unstable_closes_a_stable_loop_down_to_a_least_gain():
    """Bode's integral is then pi times what grows of the controller, per period; margins tell the least."""
    model = robust(45.0, 1.9, 8.0, RIGID, timing(2))
    grows = np.linalg.eigvals(model.a)
    grows = grows[np.abs(grows) > 1]
    assert len(grows) > 0
    s = 1 / (1 - Z**-3.0 * of(model))
    assert np.abs(s).max() <= 1.9 * (1 + 1e-6)
    # Over one half of the circle, in Hz: half of the rate times the sum of ln|p|.
    assert np.trapezoid(np.log(np.abs(s)), HERTZ) == pytest.approx(
        np.log(np.abs(grows)).sum() * 0.5 / T, abs=0.3
    )
    loop = SampledLoop(timing(2), RIGID, np.eye(1), shared_filter(np.eye(1), model))
    found = sampled_margins(loop)
    assert abs(worst_pole(loop).value) < 1
    assert 0.01 < found.gain_down < 1 < found.gain_up
    assert abs(worst_pole(loop, 0.999 * found.gain_down).value) > 1


def test_filters_step_as_their_matrices_say():
    """A filter's commands in a run are those of its model alone, where nothing acts back."""
    model = placed(25.0, 60.0, 0.8, second_order(90.0, 0.2), timing())
    loop = Loop(
        timing(),
        shared_filter(np.eye(1), model),
        Actuator(RIGID, np.full(1, np.inf), np.inf, np.full(1, np.nan)),
        np.zeros((1, 1)),
    )
    rng = np.random.default_rng(2)
    seen = rng.standard_normal((30, 1, 1))
    found = run([loop], schedule([loop.timing], (np.arange(30) + 1.5) * T), [seen[:30]], 30)
    np.testing.assert_allclose(found.positions[:29, 0, 0], simulate(model, seen[:29, :, 0])[:, 0], rtol=1e-9)
