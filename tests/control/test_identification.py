"""Identification of the modal model: exact data give it back, noise gives its known spread."""

from dataclasses import replace

import numpy as np
import pytest

from wavequake.control.bench import fitted_bench
from wavequake.control.identification import Record, identify
from wavequake.control.regulator import modal_model
from wavequake.errors import UserError

NOMINAL = modal_model(fitted_bench())


def record_of(model, noise=0.0, duration=6.0, seed=1):
    rng = np.random.default_rng(seed)
    time, frames = np.arange(0, duration, 0.002), np.arange(0, duration, 0.005)
    states = model.blow[:, None] * np.exp(np.outer(model.poles, time))
    seen = model.blow[:, None] * np.exp(np.outer(model.poles, frames))
    return Record(
        time,
        states.sum(axis=0).real + noise * rng.standard_normal(len(time)),
        frames,
        (model.image @ seen).real + noise * rng.standard_normal(len(frames)),
    )


def other(seed, spread=0.015):
    """Another bench: its springs differ from the nominal ones."""
    rng, bench = np.random.default_rng(seed), fitted_bench()
    return modal_model(
        replace(
            bench,
            lens_springs=bench.lens_springs * np.exp(2 * spread * rng.standard_normal(6)),
            ring_springs=bench.ring_springs * np.exp(2 * spread * rng.standard_normal(6)),
            beta=bench.beta * 1.2,
        )
    )


@pytest.mark.parametrize("seed", range(3))
def test_exact_records_give_the_model_back(seed):
    truth = other(seed)
    found = identify(record_of(truth), NOMINAL, measured_noise=1e-6, image_noise=1e-6)
    np.testing.assert_allclose(found.model.poles, truth.poles, rtol=1e-6)
    np.testing.assert_allclose(found.model.image, truth.image, rtol=0, atol=1e-4 * np.abs(truth.image).max())
    np.testing.assert_allclose(found.model.blow, truth.blow, rtol=0, atol=1e-5 * np.abs(truth.blow).max())
    assert found.measured_rms < 1e-9


def test_noise_leaves_the_noise():
    truth = other(7)
    found = identify(record_of(truth, noise=7e-6), NOMINAL)
    assert found.measured_rms == pytest.approx(7e-6, rel=0.05)
    assert found.image_rms == pytest.approx(7e-6, rel=0.05)
    assert np.abs(found.model.poles - truth.poles).max() < 0.1


def test_spread_over_noise_is_that_of_the_information():
    """The estimate's standard deviation is close to the Cramér-Rao bound of a single sinusoid.

    For Re(A e^{λt}) with N samples per s over a long record, what the amplitude does not explain of t e^{-dt}
    has the energy 1/(2d)³ = ∫t²e^{-2dt} - (∫te^{-2dt})²/∫e^{-2dt}; a real signal has half of it, so that
    var = 16 d³ noise²/(N A²) for decay and frequency alike. Lens and image add their information.
    """
    strong = [int(np.argmax(np.abs(NOMINAL.blow)))]  # the bound is that of little noise
    one = replace(
        NOMINAL, poles=NOMINAL.poles[strong], image=NOMINAL.image[strong], blow=NOMINAL.blow[strong]
    )
    noise, decay = 2e-5, -one.poles[0].real
    found = [
        identify(record_of(one, noise, 12.0, seed), one, measured_noise=noise, image_noise=noise).model.poles[
            0
        ]
        for seed in range(40)
    ]
    amplitude = abs(one.blow[0]) ** 2
    information = 500 * amplitude + 200 * amplitude * abs(one.image[0]) ** 2
    bound = noise * np.sqrt(16 * decay**3 / information)
    assert np.std([pole.imag for pole in found]) == pytest.approx(bound, rel=0.3)
    assert np.std([pole.real for pole in found]) == pytest.approx(bound, rel=0.3)


def test_records_that_cannot_do_are_refused():
    record = record_of(NOMINAL, duration=0.05)
    with pytest.raises(UserError, match="11 modes cannot be identified: the record needs at least 44"):
        identify(record, NOMINAL)
    bad = record_of(NOMINAL)
    bad.measured[100] = np.nan
    with pytest.raises(UserError, match="finite samples"):
        identify(bad, NOMINAL)


def test_a_nominal_model_too_far_off_is_told():
    far = replace(NOMINAL, poles=NOMINAL.poles.real + 2.5j * NOMINAL.poles.imag)
    with pytest.raises(UserError, match=r"identification failed: it leaves .* and mode \d+, nominally at"):
        identify(record_of(NOMINAL, noise=7e-6), far)


@pytest.mark.parametrize("seed", range(4))
def test_a_start_that_is_some_percent_off_is_enough(seed):
    truth = other(seed + 20, spread=0.025)
    found = identify(record_of(truth, noise=1e-5, seed=seed), NOMINAL)
    assert found.measured_rms == pytest.approx(1e-5, rel=0.1)
    assert np.abs(found.model.poles.imag / truth.poles.imag - 1).max() < 5e-3
