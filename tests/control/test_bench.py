"""The bench against its published figures and against invariants of mechanics."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad

from wavequake.control.bench import (
    GRAVITY,
    SENSITIVITIES,
    bench_model,
    bench_modes,
    fitted_bench,
    image_row,
    mass_and_stiffness,
)
from wavequake.control.hammer import (
    HAMMER,
    equivalent_force,
    hammer_force,
    hammer_velocity,
    impulse,
    mean_delay,
    step_means,
)
from wavequake.control.linear import frequency_response, poles
from wavequake.control.modes import modes
from wavequake.control.plant import swing
from wavequake.errors import UserError


def test_degrees_of_freedom_and_frequencies_are_the_published_ones():
    assert [fitted_bench(active=active).size for active in (False, True)] == [13, 11]
    omega = bench_modes(fitted_bench()).omega
    # Störkle 2018, Fig. 5.4: between approximately 20 and 80 rad/s. More in test_lens_bench.py.
    assert omega[0] == pytest.approx(20, rel=0.02)
    assert omega[-1] == pytest.approx(80, rel=0.02)


@pytest.mark.parametrize("springs", ["initial", "changed"])
def test_every_mode_is_observable_in_lens_4(springs):
    model = bench_model(fitted_bench(springs))
    assert min(mode.observability for mode in modes(replace(model, c=model.c[1:], d=model.d[1:]))) > 1e-4


def test_modes_are_the_poles_of_the_state_space():
    bench = fitted_bench(active=False)
    expected = poles(bench_model(bench))
    expected = expected[expected.imag > 0]
    np.testing.assert_allclose(bench_modes(bench).poles, expected[np.argsort(expected.imag)], rtol=1e-9)


def test_a_free_bench_moves_as_one_body():
    """Without pendulums and ground, all springs are inner ones: a common displacement costs no force."""
    bench = replace(fitted_bench(), housing_spring=0.0)
    masses, stiffness = mass_and_stiffness(bench)
    np.testing.assert_allclose(stiffness @ np.ones(11), masses * GRAVITY / bench.pendulum_m, rtol=1e-12)
    np.testing.assert_array_equal(stiffness, stiffness.T)


def test_image_row_is_the_published_table():
    np.testing.assert_array_equal(image_row(fitted_bench(active=False))[:6], SENSITIVITIES)
    np.testing.assert_array_equal(image_row(fitted_bench())[:6], [*SENSITIVITIES[:4], SENSITIVITIES[5], 0.0])


def test_transfer_function_of_the_undamped_bench_is_the_modal_sum():
    bench = replace(fitted_bench(), alpha=0.0, beta=0.0)
    found = bench_modes(bench)
    omega = np.array([5.0, 22.0, 60.0, 200.0])
    images = image_row(bench) @ found.shapes * found.shapes[-1]
    expected = (images / (found.omega**2 - omega[:, None] ** 2)).sum(axis=1)  # Eq. 5.3
    np.testing.assert_allclose(frequency_response(bench_model(bench), omega)[:, 0, 0], expected, rtol=1e-8)


def test_hammer_has_the_published_momentum_mass_and_force():
    momentum = quad(lambda t: float(hammer_force(HAMMER, t)), 0, 0.05, points=[0.003])[0]
    assert float(impulse(HAMMER)) == pytest.approx(momentum, rel=1e-9)
    assert momentum == pytest.approx(0.0764, rel=0.02)  # measured, Eq. 5.10
    assert hammer_velocity() == pytest.approx(0.51, abs=0.01)  # Eq. 5.12
    assert momentum / hammer_velocity() == pytest.approx(0.150, abs=0.005)  # Eq. 5.13
    assert equivalent_force(HAMMER) == pytest.approx(19, abs=0.5)  # Eq. 5.14
    first = quad(lambda t: t * float(hammer_force(HAMMER, t)), 0, 0.05, points=[0.003])[0]
    assert mean_delay(HAMMER) == pytest.approx(first / momentum, rel=1e-9)
    assert step_means(HAMMER, 0.002, 10).sum() * 0.002 == pytest.approx(momentum, rel=1e-9)
    assert hammer_force(HAMMER, -1.0) == 0.0


def test_image_motion_after_a_blow_is_as_published():
    runs = swing([fitted_bench(), fitted_bench("changed")], np.ones(2), duration=3.0)
    # Störkle 2018, Section 5.2.5 and 5.1.2: about +-4 mm; the stage needs some 100 mm/s and 6 mm of travel.
    assert runs.image[0].max() == pytest.approx(4e-3, rel=0.1)
    assert runs.image[0].min() == pytest.approx(-3e-3, rel=0.1)
    target = -runs.image[0] / SENSITIVITIES[4]
    assert 0.1 < np.abs(np.gradient(target, runs.time)).max() < 0.2
    assert 4e-3 < np.ptp(target) < 6e-3
    # The same blow moves softer springs farther; the text, of unknown masses, has less (Section 5.4.3).
    assert 1.0 < np.ptp(runs.image[1]) / np.ptp(runs.image[0]) < 1.2
    slower = bench_modes(fitted_bench("changed")).omega / bench_modes(fitted_bench()).omega
    assert ((slower > 0.85) & (slower < 1)).all()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"lens_kg": np.ones(5)}, "lens_kg needs 6 values, not 5"),
        ({"couplings": np.ones(6)}, "couplings needs 5 values"),
        ({"ring_kg": np.array([1, 1, 1, 0, 1, 1.0])}, "ring_kg must be finite and positive"),
        ({"lens_springs": np.array([1, 1, np.nan, 0, 1, 1.0])}, "lens_springs must be finite"),
        ({"housing_kg": -1.0}, "housing_kg must be"),
        ({"beta": -1.0}, "damping"),
    ],
)
def test_impossible_benches_are_refused(change, words):
    with pytest.raises(UserError, match=words):
        replace(fitted_bench(), **change)


def test_other_bad_input_is_named():
    with pytest.raises(UserError, match="no spring configuration 'soft'"):
        fitted_bench("soft")
    with pytest.raises(UserError, match="Mode 1 of the bench does not swing"):
        bench_modes(replace(fitted_bench(), beta=0.2))
    with pytest.raises(UserError, match="equally many"):
        swing([fitted_bench(), fitted_bench(active=False)], np.ones(2))
    with pytest.raises(UserError, match=r"too long for a mode of 79\.\d rad/s"):
        swing([fitted_bench()], np.ones(1), step=0.01)
    with pytest.raises(UserError, match="must not be negative"):
        swing([fitted_bench()], np.ones(1), friction=-1.0)
