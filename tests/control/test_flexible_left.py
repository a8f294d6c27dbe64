"""What loops of modes leave, against closed forms, exact covariances and Lyapunov's equation."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.linalg import solve_discrete_lyapunov
from scipy.optimize import minimize_scalar

from wavequake.control.frames.controllers import integrator
from wavequake.control.frames.disturbance import joined, line, sampled
from wavequake.control.frames.residual import residual
from wavequake.control.sampled.channel import RIGID, Timing, second_order
from wavequake.control.sampled.flexible import (
    FlexibleLoop,
    Structure,
    closed_matrix,
    flexible_controller,
    flexible_plant,
    reduced,
)
from wavequake.control.sampled.flexible_left import (
    covariance,
    flexible_margins,
    frequency_grid,
    left_of,
    noise_left,
    sensitivity_of,
    turns,
)
from wavequake.mechanics.disturbances.spectra import Spectrum, band_variance, resonance

FRAME = 0.02
STILL = Structure(*np.zeros((3, 0)), np.zeros((1, 0)))


def integral(found, density, low, high, breaks=()):
    spectrum = Spectrum(density, low, high, (*breaks, *turns(found)))
    return float(band_variance(spectrum, np.array([low, high]))[0])


def single(gain, latency):
    return reduced(
        FlexibleLoop(Timing(FRAME, FRAME, 1, latency * FRAME), RIGID, np.array([gain]), 0.0, STILL)
    )


@pytest.mark.parametrize("gain", [0.05, 0.125581, 0.4])
@pytest.mark.parametrize("latency", [0, 1, 2])
def test_noise_is_that_of_the_closed_forms(gain, latency):
    g = gain
    expected = {
        0: g / (2 - g),
        1: g * (1 + g) / ((1 - g) * (2 + g)),
        2: g * (1 + g - g**2) / ((2 - g) * (1 - g - g**2)),
    }[latency]
    found = single(gain, latency)
    heard = noise_left(found, covariance(found, np.eye(1)))
    # Below 1e-9 Hz all noise passes.
    assert integral(found, heard, 1e-9, 25.0) + 2 * FRAME * 1e-9 == pytest.approx(expected, rel=1e-11)


def test_a_line_leaves_what_exact_covariances_say():
    # Van Loan and Lyapunov, of the same loop in frames; two frames of delay are one of latency.
    found = single(0.2, 1.0)
    left = left_of(found, covariance(found, np.eye(1)))
    power = resonance(3.0, 0.2, 5.0)
    variance = integral(
        found, lambda f: power.density(f) * left(f)[0], power.low_hz, power.high_hz, power.breaks_hz
    )
    exact = residual(sampled(joined([line(3.0, 0.2, 5.0)]), FRAME), integrator(0.2, 2), 0.0)
    # Beyond 300 f0 2 w / (3 pi f0 300^3) = 5e-10 of the variance is left out; a tenth or more remains.
    assert exact > 5.0 * np.sqrt(0.1)
    assert np.sqrt(variance) == pytest.approx(exact, rel=5e-9)


@pytest.fixture(scope="module")
def mirror():
    random = np.random.default_rng(3)
    shapes = np.linalg.qr(random.standard_normal((9, 2)))[0]
    structure = Structure(np.array([4.0, 8.0]), np.array([0.02, 0.03]), np.array([0.2, 0.1]), shapes)
    gains = np.array([0.02] * 3 + [0.1] * 6)
    timing = Timing(FRAME, FRAME, 1, 1.3 * FRAME)
    return FlexibleLoop(timing, second_order(20.0, 0.5), gains, 0.001, structure)


def test_noise_of_unequal_modes_on_a_structure_is_that_of_lyapunovs_equation(mirror):
    found = reduced(mirror)
    factor = np.diag(np.linspace(1.0, 3.0, 9))
    heard = noise_left(found, covariance(found, factor))
    # All nine modes at once; readings y = P u + n enter u = -H y.
    plant, own = flexible_plant(mirror), flexible_controller(mirror)
    step = closed_matrix(plant, own)
    drive = np.vstack([-plant.b @ own.d, own.b]) @ factor
    states = solve_discrete_lyapunov(step, drive @ drive.T)
    out = np.hstack([plant.c, np.zeros((9, len(own.a)))])
    expected = np.trace(out @ states @ out.T)
    below = 1e-9 * float(heard(np.array([1e-9]))[0])
    assert integral(found, heard, 1e-9, 25.0) + below == pytest.approx(expected, rel=1e-10)


def test_covariances_keep_all_variance_and_their_groups(mirror):
    found, factor = reduced(mirror), np.random.default_rng(1).standard_normal((9, 5))
    of = covariance(found, factor)
    assert of.total == pytest.approx(np.sum(factor**2), rel=1e-12)
    inside = np.trace(found.basis[:3].T @ factor[:3] @ factor[:3].T @ found.basis[:3])
    # Basis directions of the second group have no part in the first three modes.
    assert of.others[0] == pytest.approx(np.sum(factor[:3] ** 2) - inside, rel=1e-12)


def test_margins_are_those_of_the_closed_forms():
    # n = 2: gain margin g_max / g, phase margin pi/2 - 3 asin(g/2), |S| max 2 at a gain of 0.453802.
    gain = 0.453802
    found = flexible_margins(single(gain, 1.0))
    assert found.gain_up == pytest.approx(1.0 / gain, rel=1e-10)
    assert found.phase == pytest.approx(np.pi / 2 - 3 * np.arcsin(gain / 2), rel=1e-10)

    def size(angle):
        s = 2 * np.sin(angle / 2)
        return s / np.sqrt(s**2 + gain**2 - 2 * gain * s * np.sin(1.5 * angle))

    tight = {"xatol": 1e-9}
    top = minimize_scalar(lambda one: -size(one), bounds=(0.1, 3.0), method="bounded", options=tight).x
    assert size(top) == pytest.approx(2.0, abs=2e-6)  # of a gain of six digits
    assert found.peak == pytest.approx(size(top), rel=1e-12)
    assert found.last_omega * FRAME == pytest.approx(2 * np.arcsin(gain / 2), rel=1e-10)


def test_sensitivity_of_every_mode_at_once_is_that_of_few_directions(mirror):
    found = reduced(mirror)
    hertz = frequency_grid(found)[::40]
    largest, along = sensitivity_of(found, hertz)
    plant, own = flexible_plant(mirror), flexible_controller(mirror)
    for place in (3, len(hertz) // 2, len(hertz) - 2):
        z = np.exp(2j * np.pi * hertz[place] * FRAME)
        p = plant.c @ np.linalg.solve(z * np.eye(len(plant.a)) - plant.a, plant.b)
        h = own.c @ np.linalg.solve(z * np.eye(len(own.a)) - own.a, own.b) + own.d
        left = np.linalg.inv(np.eye(9) + p @ h)
        # Sensitivity of readings; gains commute with what is outside of the structure.
        by_shape = np.linalg.norm(left @ mirror.structure.shapes, axis=0)
        np.testing.assert_allclose(along[place], by_shape, rtol=1e-11)
        assert largest[place] == pytest.approx(np.linalg.svd(left, compute_uv=False)[0], rel=1e-11)


def test_bode_integral_of_a_single_mode_is_zero():
    found = single(0.3, 1.0)
    size = lambda f: np.log(sensitivity_of(found, np.array([f]))[0][0])  # noqa: E731
    # Near 0 Hz the size is 2 pi f T / g.
    below = 1e-9 * (np.log(2 * np.pi * 1e-9 * FRAME / 0.3) - 1)
    assert quad(size, 1e-9, 25.0, limit=200, epsabs=1e-10)[0] + below == pytest.approx(0.0, abs=1e-10)
