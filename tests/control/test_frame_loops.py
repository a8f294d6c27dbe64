"""Loops of frames: a table of residuals, closed forms, integrals over frequency, another recursion."""

import numpy as np
import pytest

from wavequake.control.frames.controllers import FrameController, integrator, largest_gain, predictor
from wavequake.control.frames.disturbance import Sampled, Shaped, joined, line, sampled, wind_shake
from wavequake.control.frames.margins import frame_margins
from wavequake.control.frames.residual import best_gain, passed, residual, run, sensitivity, spectral_radius
from wavequake.errors import UserError
from wavequake.mechanics.disturbances import spectra

MAS = np.pi / 180 / 3600 / 1000
TIP = (5.99, 8.01, 8.46, 8.9, 10.0, 11.2, 13.33, 15.99, 17.22, 24.22, 25.84, 45.5)
RMS = 10 / np.sqrt(12)
WIND = wind_shake(1.158e-11 / MAS**2, 0.08, 0.65, 0.25)
LINES = joined([line(f, 0.2, RMS) for f in TIP])
# Hz, frames: wind with gains 0.3, 0.5; lines with both; best gain, its rms and that of LQG for both together
# with noise of 5 mas per frame.
TABLE = {
    (100, 1): (1.8265, 1.1085, 10.4797, 10.1793, 0.7688, 10.484, 6.650),
    (100, 2): (1.8366, 1.1122, 13.2056, 15.3801, 0.1257, 12.134, 7.611),
    (500, 1): (0.3676, 0.2221, 5.7614, 4.2591, 0.6611, 4.956, 3.226),
    (500, 2): (0.3677, 0.2221, 7.0716, 5.7701, 0.5235, 6.946, 3.748),
    (1000, 1): (0.1839, 0.1110, 3.5578, 2.3569, 0.4776, 3.724, 2.448),
    (1000, 2): (0.1839, 0.1110, 3.9509, 2.5733, 0.3971, 4.426, 2.709),
}


@pytest.mark.parametrize("place", TABLE)
def test_residuals_of_wind_and_lines_are_those_of_the_table(place):
    hertz, frames = place
    wind, lines, both = (sampled(one, 1 / hertz) for one in (WIND, LINES, joined([WIND, LINES])))
    found = [residual(one, integrator(g, frames), 0.0) for one in (wind, lines) for g in (0.3, 0.5)]
    np.testing.assert_allclose(found, TABLE[place][:4], atol=6e-5)
    gain = best_gain(both, 5.0, frames)
    assert gain == pytest.approx(TABLE[place][4], abs=2e-4)
    assert residual(both, integrator(gain, frames), 5.0) == pytest.approx(TABLE[place][5], abs=6e-4)
    assert residual(both, predictor(both, 5.0, frames), 5.0) == pytest.approx(TABLE[place][6], abs=6e-4)


def densities():
    """The spectra from their formulas, over all frequencies."""
    parts = [spectra.windshake(1.158e-11 / MAS**2, 0.08, 0.65, 0.25)]
    parts += [spectra.resonance(f, 0.2, RMS) for f in TIP]
    return [spectra.Spectrum(one.density, 1e-4, 1e5, one.breaks_hz) for one in parts]


@pytest.mark.parametrize(("hertz", "frames"), [(100, 1), (500, 2)])
@pytest.mark.parametrize("kind", ["integrator", "lqg"])
def test_the_covariance_is_the_integral_over_frequency(hertz, frames, kind):
    """Without noise; that of a spectrum's formula times 1 - sinc^2 (1 - |S|^2), to 1e-4 mas."""
    both = sampled(joined([WIND, LINES]), 1 / hertz)
    controller = integrator(0.3, frames) if kind == "integrator" else predictor(both, 5.0, frames)
    factor = passed(controller, 1 / hertz)
    total = 0.0
    for one in densities():
        knots = np.unique([*one.breaks_hz, *np.arange(hertz / 4, 20 * hertz, hertz / 4)])
        left = spectra.Spectrum(
            lambda f, d=one.density: d(f) * factor(f), one.low_hz, one.high_hz, tuple(knots)
        )
        total += spectra.variance(left)
    assert residual(both, controller, 0.0) == pytest.approx(np.sqrt(total), abs=1e-4)


@pytest.mark.parametrize("frames", [1, 2, 3, 4])
def test_an_integrator_is_stable_up_to_the_closed_form(frames):
    most = largest_gain(frames)
    assert most == pytest.approx([2.0, 1.0, 0.618034, 0.445042][frames - 1], abs=1e-6)
    assert spectral_radius(integrator(most * (1 - 1e-6), frames)) < 1
    with pytest.raises(UserError, match=f"with {frames} frames of delay is unstable"):
        integrator(most * (1 + 1e-6), frames)


@pytest.mark.parametrize("frames", [1, 2, 3])
def test_margins_of_an_integrator_are_those_of_closed_forms(frames):
    g, frame = 0.25, 0.01
    found = frame_margins(integrator(g, frames), frame)
    assert found.gain_up == pytest.approx(largest_gain(frames) / g, rel=1e-9)
    assert found.gain_down == 0.0
    phase = np.pi / 2 - (2 * frames - 1) * np.arcsin(g / 2)
    assert found.phase == pytest.approx(phase, rel=1e-8)
    crossover = 2 * np.arcsin(g / 2) / frame
    assert found.delay == pytest.approx(phase / crossover, rel=1e-8)
    assert found.last_omega == pytest.approx(crossover, rel=1e-8)
    if frames == 1:
        assert found.peak == pytest.approx(2 / (2 - g), rel=1e-6)


def test_noise_and_random_walk_of_integrators_are_those_of_closed_forms():
    g, variance, step = 0.3, 4.0, 0.7
    wanted = {
        1: g / (2 - g),
        2: g * (1 + g) / ((1 - g) * (2 + g)),
        3: g * (1 + g - g * g) / ((2 - g) * (1 - g - g * g)),
    }
    one = np.eye(1)
    still = Sampled(1.0, 0.5 * one, np.zeros(1), one, np.zeros(1), 0.0, 0.0, 0.0)
    # A random walk that is held over frames, as slow an AR process as its variance allows.
    slow = Sampled(1.0, (1 - 1e-9) * one, np.ones(1), step * one, np.zeros(1), 0.0, 0.0, 0.0)
    for frames, n in wanted.items():
        controller = integrator(g, frames)
        assert residual(still, controller, 2.0) ** 2 == pytest.approx(n * variance, rel=1e-12)
        assert residual(slow, controller, 0.0) ** 2 == pytest.approx(n * step / g**2, rel=1e-5)


@pytest.mark.parametrize("frames", [1, 2, 3])
def test_sensitivity_of_an_integrator_is_the_closed_form_and_keeps_bodes_integral(frames):
    g, w = 0.25, (np.arange(200_000) + 0.5) * np.pi / 200_000
    s = 2 * np.sin(w / 2)
    found, _ = sensitivity(integrator(g, frames), 1.0, w / 2 / np.pi)
    wanted = s**2 / (s**2 + g**2 - 2 * g * s * np.sin((frames - 0.5) * w))
    np.testing.assert_allclose(found, wanted, rtol=1e-9)
    assert np.mean(np.log(found)) == pytest.approx(0.0, abs=1e-4)


def test_the_predictor_of_a_held_random_walk_is_the_integrator_of_the_kalman_gain():
    q, r = 0.3, 2.0
    walk = Sampled(1.0, np.eye(1), np.ones(1), q * np.eye(1), np.zeros(1), 0.0, 0.0, 0.0)
    found = predictor(walk, np.sqrt(r), 1)
    gain = (-q + np.sqrt(q * q + 4 * q * r)) / (2 * r)
    np.testing.assert_allclose(found.b, [gain], rtol=1e-9)
    np.testing.assert_allclose(found.a, [[1.0]], rtol=1e-12)


def test_nothing_beats_the_predictor():
    both = sampled(joined([WIND, LINES]), 0.002)
    best = predictor(both, 5.0, 2)
    least = residual(both, best, 5.0)
    rng = np.random.default_rng(0)
    for _ in range(5):
        other = FrameController(best.a, best.b, best.c * (1 + 1e-3 * rng.normal(size=best.c.shape)))
        assert residual(both, other, 5.0) >= least


def test_a_run_is_the_recursion_of_its_definition():
    readings = np.random.default_rng(2).normal(size=400)
    g, frames = 0.3, 3
    command, error = np.zeros(400), np.zeros(400)
    for k in range(400):
        command[k] = (command[k - 1] if k else 0.0) + (g * error[k - frames] if k >= frames else 0.0)
        error[k] = readings[k] - command[k]
    np.testing.assert_allclose(run(integrator(g, frames), readings), command, atol=1e-12)


def test_van_loans_sampling_of_one_state_is_the_closed_form():
    """An Ornstein-Uhlenbeck process of rate 2 and variance 1 over frames of 0.3 s."""
    rate, t = 2.0, 0.3
    found = sampled(Shaped(np.array([[-rate]]), np.array([[np.sqrt(2 * rate)]]), np.ones(1)), t)
    x = np.exp(-rate * t)
    assert found.phi[0, 0] == pytest.approx(x)
    assert found.q[0, 0] == pytest.approx(1 - x * x)
    assert found.row[0] == pytest.approx((1 - x) / (rate * t))
    mean = 2 * (rate * t - 1 + x) / (rate * t) ** 2
    assert found.row[0] ** 2 + found.r == pytest.approx(mean)
    assert found.within == pytest.approx(1 - mean)


def test_bad_loops_are_told():
    both = sampled(WIND, 0.01)
    with pytest.raises(UserError, match="The noise of the sensor is 0; a filter needs a positive one"):
        predictor(both, 0.0, 1)
    with pytest.raises(UserError, match="The delay is 0 frames"):
        integrator(0.3, 0)
    wild = FrameController(np.eye(1), np.array([3.0]), np.ones(1))
    with pytest.raises(UserError, match="The loop is unstable: an eigenvalue of a step has the size 2"):
        residual(both, wild, 0.0)
