"""What sensor noise moves: closed forms of integrators, and Lyapunov's equation of whole loops."""

import numpy as np
import pytest
from sampled_loops import T, scalar, timing
from scipy.linalg import solve_discrete_lyapunov

from wavequake.control.sampled.alike import coupled
from wavequake.control.sampled.channel import RIGID, in_series, recoil, sampled_channel, second_order
from wavequake.control.sampled.filters import integrator
from wavequake.control.sampled.propagated import noise_spectra
from wavequake.control.sampled.regulator import model_of, shared_filter, whole
from wavequake.control.sampled.stability import SampledLoop, Sight, parts_of, plant_model

# Midpoints of even steps: sums over them are integrals to rounding, spectra being periodic.
HERTZ = (np.arange(4000) + 0.5) / 4000 * 0.5 / T


def variance(loop, look, noise):
    """Return the variances (r,) by the integral of the spectra (Parseval)."""
    return noise_spectra(loop, look, noise, HERTZ).sum(axis=0) * (HERTZ[1] - HERTZ[0])


@pytest.mark.parametrize("gain", [0.1, 0.5, 1.2])
def test_an_integrator_passes_the_noise_of_the_closed_form(gain):
    """u[k + 1] = (1 - g) u[k] - g n[k]: g / (2 - g)."""
    found = variance(scalar(gain), Sight(RIGID, np.array([[3.0]])), np.array([2.0]))
    assert found == pytest.approx([36.0 * gain / (2 - gain)], rel=1e-12)


@pytest.mark.parametrize("gain", [0.1, 0.5])
def test_a_period_of_latency_passes_more(gain):
    """u[k + 1] = u[k] - g u[k - 1] - g n[k], an autoregression of second order."""
    found = variance(scalar(gain, 1), Sight(RIGID, np.eye(1)), np.ones(1))
    assert found == pytest.approx([gain * (1 + gain) / ((1 - gain) * (2 + gain))], rel=1e-12)
    size = np.exp(2j * np.pi * HERTZ * T)
    wanted = 2 * T * np.abs(gain / (size * (size - 1) + gain)) ** 2
    shown = noise_spectra(scalar(gain, 1), Sight(RIGID, np.eye(1)), np.ones(1), HERTZ)[:, 0]
    np.testing.assert_allclose(shown, wanted, rtol=1e-9)


def by_lyapunov(loop, look, noise):
    """Return the variances (r,) by the covariance of all states, by periods."""
    plant, own = plant_model(loop), model_of(loop.regulator, loop.timing.period)
    channels = tuple(
        sampled_channel(one, loop.timing)
        for one in (look.dynamics, *(in_series(look.dynamics, mode) for mode in loop.structure))
    )
    seen = coupled(channels, look.sees, look.shown, loop.modes()[1])
    # u = own (plant + n): the states of plant, of what is looked at, and of the regulator.
    p, s, r = len(plant.a), len(seen.a), len(own.a)
    a = np.zeros((p + s + r, p + s + r))
    through = own.d @ plant.c
    a[:p, :p], a[p : p + s, p : p + s], a[p + s :, p + s :] = plant.a, seen.a, own.a
    a[:p, :p] += plant.b @ through
    a[p : p + s, :p] += seen.b @ through
    a[:p, p + s :], a[p : p + s, p + s :] = plant.b @ own.c, seen.b @ own.c
    a[p + s :, :p] = own.b @ plant.c
    b = np.vstack([plant.b @ own.d, seen.b @ own.d, own.b]) * noise
    held = solve_discrete_lyapunov(a, b @ b.T)[p : p + s, p : p + s]
    return np.diag(seen.c @ held @ seen.c.T)


@pytest.mark.parametrize("shared", [True, False])
@pytest.mark.parametrize("count", [3, 9])
def test_many_channels_on_a_structure_have_the_noise_of_lyapunovs_equation(count, shared):
    rng = np.random.default_rng(count)
    modes = tuple(recoil(hertz, 0.05) for hertz in (20.0, 60.0))
    sees = np.eye(count) + 0.02 * np.outer(rng.standard_normal(count), rng.standard_normal(count))
    drives, shown = 0.1 * rng.standard_normal((2, count)), rng.standard_normal((count, 2))
    regulator = shared_filter(np.eye(count), integrator(0.15, leak=0.01))
    if not shared:
        regulator = whole(model_of(regulator, T))
    servo = second_order(150.0, 0.7)
    loop = SampledLoop(timing(0.4), servo, sees, regulator, modes, drives, shown)
    assert (parts_of(loop) is not None) == shared
    assert not (shared and count == 9) or parts_of(loop).value == 1.0  # few directions are left
    look = Sight(servo, rng.standard_normal((2, count)), rng.standard_normal((2, 2)))
    noise = rng.uniform(0.5, 2.0, count)
    np.testing.assert_allclose(variance(loop, look, noise), by_lyapunov(loop, look, noise), rtol=1e-9)


def test_beyond_half_the_rate_nothing_is_known():
    found = noise_spectra(scalar(0.3), Sight(RIGID, np.eye(1)), np.ones(1), np.array([10.0, 250.0, 251.0]))
    assert np.isfinite(found[:, 0]).tolist() == [True, True, False]
