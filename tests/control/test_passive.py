"""Passive optimization: its objective against the swinging bench, its result against the present one."""

from dataclasses import replace

import numpy as np
import pytest

from wavequake.control.bench import bench_modes, fitted_bench
from wavequake.control.hammer import HAMMER, hammer_force
from wavequake.control.passive import directions, modal_amplitudes, objective, objective_and_slope, optimize
from wavequake.control.plant import swing
from wavequake.control.regulator import blow_spectrum
from wavequake.errors import UserError

PASSIVE = fitted_bench(active=False)


def test_spectrum_of_the_blow_is_that_of_its_samples():
    time = np.arange(0, 0.03, 1e-6)
    for omega in (0.0, 40.0, 300.0):
        expected = (hammer_force(HAMMER, time) * np.exp(-1j * omega * time)).sum() * 1e-6
        assert blow_spectrum(HAMMER, np.array([1j * omega]))[0] == pytest.approx(expected, rel=1e-6)


def test_amplitudes_are_those_that_the_image_swings_with():
    """Least squares of the undamped modes' sines and cosines on the simulated image after the blow."""
    bench = replace(PASSIVE, alpha=0.0, beta=0.0)
    run = swing([bench, bench], np.ones(2), duration=20.0, step=2e-3)
    late = run.time > 0.05
    angles = np.outer(run.time[late], bench_modes(bench).omega)
    waves = np.hstack([np.cos(angles), np.sin(angles)])
    found = np.linalg.lstsq(waves, run.image[0, late], rcond=None)[0]
    np.testing.assert_allclose(
        np.hypot(found[:13], found[13:]), modal_amplitudes(bench), rtol=2e-3, atol=1e-6
    )


def test_slope_is_that_of_the_objective():
    names = ("lens_springs", "couplings", "lens_kg", "ring_kg")
    value, slope = objective_and_slope(PASSIVE, *directions(PASSIVE, names))
    assert value == pytest.approx(objective(PASSIVE), rel=1e-12)
    expected = []
    for name in names:
        values = getattr(PASSIVE, name)
        for place in range(len(values)):
            step = np.zeros(len(values))
            step[place] = 1e-5
            ends = [objective(replace(PASSIVE, **{name: values * np.exp(sign * step)})) for sign in (1, -1)]
            expected.append((ends[0] - ends[1]) / 2e-5)
    np.testing.assert_allclose(slope, expected, rtol=1e-4, atol=1e-6 * value)


def test_optimized_bench_moves_the_image_less():
    found = optimize(PASSIVE, start=np.random.default_rng(1).uniform(-1, 1, 29), iterations=25)
    assert found.after < 0.6 * found.before == 0.6 * objective(PASSIVE)
    assert found.after == objective(found.bench)
    runs = swing([PASSIVE, found.bench], np.ones(2), duration=3.0)
    assert np.ptp(runs.image[1]) < 0.8 * np.ptp(runs.image[0])
    for name in ("lens_springs", "ring_springs", "couplings", "lens_kg", "ring_kg"):
        ratio = getattr(found.bench, name) / getattr(PASSIVE, name)
        assert (ratio <= 1.5 * (1 + 1e-12)).all()
        assert (ratio >= 1 / 1.5 * (1 - 1e-12)).all()


def test_only_what_may_change_changes():
    found = optimize(PASSIVE, inertias=False, factor=1.1, iterations=3)
    np.testing.assert_array_equal(found.bench.lens_kg, PASSIVE.lens_kg)
    assert (found.bench.lens_springs != PASSIVE.lens_springs).any()
    assert found.after < found.before


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"springs": False, "inertias": False}, "nothing is left"),
        ({"factor": 1.0}, "above 1"),
        ({"start": np.zeros(3)}, "needs 29 shares"),
    ],
)
def test_searches_that_cannot_be_are_refused(options, words):
    with pytest.raises(UserError, match=words):
        optimize(PASSIVE, **options)
