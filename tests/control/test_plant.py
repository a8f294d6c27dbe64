"""Swinging benches against direct integration, energy balance and bits."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from wavequake.control.bench import (
    bench_model,
    fitted_bench,
    image_row,
    mass_and_stiffness,
    measured_row,
)
from wavequake.control.hammer import HAMMER, hammer_force, step_means
from wavequake.control.linear import simulate, zero_order_hold
from wavequake.control.plant import CREEP, swing
from wavequake.errors import UserError


def test_without_friction_it_is_the_sampled_state_space():
    bench, step, count = fitted_bench(), 1e-3, 1500
    force = np.zeros(count)
    force[:30] = step_means(HAMMER, step, 30)
    expected = simulate(zero_order_hold(bench_model(bench), step), force)
    found = swing([bench], np.ones(1), duration=1.499)
    np.testing.assert_allclose(found.image[0], expected[:, 0], rtol=0, atol=1e-12)
    np.testing.assert_allclose(found.measured[0], expected[:, 1], rtol=0, atol=1e-12)


def test_with_friction_it_converges_to_the_integrated_equations():
    bench, friction = fitted_bench(), 5e-3
    masses, stiffness = mass_and_stiffness(bench)
    damping = bench.alpha * np.diag(masses) + bench.beta * stiffness
    lenses = np.arange(11) < 5

    def rates(t, x):
        q, v = x[:11], x[11:]
        force = -stiffness @ q - damping @ v - friction * lenses * np.tanh(v / CREEP)
        force[-1] += hammer_force(HAMMER, t)
        return np.concatenate([v, force / masses])

    time = np.arange(601) * 1e-3
    exact = solve_ivp(rates, (0, 0.6), np.zeros(22), t_eval=time, rtol=1e-8, atol=1e-11, max_step=2e-3).y[:11]
    errors = []
    for step in (1e-3, 5e-4):
        found = swing([bench], np.ones(1), friction=friction, duration=0.6, step=step)
        every = round(1e-3 / step)
        errors.append(np.abs(found.image[0, ::every] - image_row(bench) @ exact).max())
        assert np.abs(found.measured[0, ::every] - measured_row(bench) @ exact).max() < 2e-5
    rubbed = np.abs(swing([bench], np.ones(1), duration=0.6).image[0] - image_row(bench) @ exact).max()
    assert errors[1] < 0.6 * errors[0] < 0.02 * rubbed


def test_friction_takes_energy_and_a_blow_scales():
    bench = fitted_bench()
    free, doubled = swing([bench, bench], np.array([1.0, 2.0]), duration=3.0).image
    np.testing.assert_allclose(doubled, 2 * free, rtol=1e-12, atol=1e-18)
    rubbed = swing([bench], np.ones(1), friction=3e-3, duration=3.0).image[0]
    assert rubbed[2000:].std() < 0.97 * free[2000:].std()


def test_a_late_trigger_shifts_the_run():
    """What began 3 ms before the first instant is 3 ms ahead; 2.5 ms lie between those of a finer run."""
    bench = fitted_bench()
    late = swing([bench] * 3, np.ones(3), duration=0.5, late=np.array([0.0, 3e-3, 2.5e-3]))
    fine = swing([bench], np.ones(1), duration=0.51, step=1e-4)
    for row, shift in enumerate((0, 30, 25)):
        expected = fine.image[0, shift : shift + 5001 : 10]
        assert np.abs(late.image[row] - expected).max() < 2e-3 * np.ptp(expected)
    np.testing.assert_array_equal(late.image[0], swing([bench] * 2, np.ones(2), duration=0.5).image[0])
    with pytest.raises(UserError, match="late must not be negative"):
        swing([bench], np.ones(1), late=np.array([-1e-3]))


def test_bits_do_not_depend_on_the_neighbors():
    benches = [
        replace(fitted_bench(), lens_springs=fitted_bench().lens_springs * (1 + 0.01 * k)) for k in range(5)
    ]
    together = swing(benches, np.ones(5), friction=3e-4, duration=0.5)
    for k in (0, 3):
        # At least two columns: a single one makes the arrays' last axis vanish for the sums.
        alone = swing([benches[k], benches[4]], np.ones(2), friction=3e-4, duration=0.5)
        np.testing.assert_array_equal(alone.image[0], together.image[k])
        np.testing.assert_array_equal(alone.measured[0], together.measured[k])
