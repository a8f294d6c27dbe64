"""Instrumental variables give a known stage back, and are not biased by noise as least squares is."""

import numpy as np
import pytest

from wavequake.control.linear import simulate, zero_order_hold
from wavequake.control.stage import Stage, stage_model, stage_response
from wavequake.control.stage_identification import identify_stage, smoothed
from wavequake.errors import UserError

STEP = 2e-4
COMMAND = np.concatenate([np.zeros(100), np.ones(900)])


def record(stage, noise=0.0, seed=1):
    clean = simulate(zero_order_hold(stage_model(stage), STEP), COMMAND)[:, 0]
    return clean + noise * np.random.default_rng(seed).standard_normal(len(COMMAND))


def test_an_exact_record_gives_the_stage_back():
    found = identify_stage(COMMAND, record(Stage()), STEP)
    np.testing.assert_allclose(np.sort_complex(found.stage.poles), np.sort_complex(Stage().poles), rtol=1e-3)
    np.testing.assert_allclose(np.sort_complex(found.stage.zeros), np.sort_complex(Stage().zeros), rtol=1e-3)
    assert found.stage.gain == pytest.approx(0.97, rel=1e-6)
    assert found.fit > 1 - 1e-9


def test_noise_does_not_bias_the_estimate():
    omega = np.array([10.0, 50.0, 100.0])
    truth = stage_response(Stage(), 1j * omega)
    found = [
        stage_response(identify_stage(COMMAND, record(Stage(), 0.01, seed), STEP).stage, 1j * omega)
        for seed in range(12)
    ]
    scatter = np.std(found, axis=0)
    assert (np.abs(np.mean(found, axis=0) - truth) < 4 * scatter / np.sqrt(12) + 1e-3).all()
    assert scatter.max() < 0.02


def test_another_structure_is_found_too():
    stage = Stage(zeros=(500.0,), poles=(-200.0, -150 + 200j, -150 - 200j), gain=2.0)
    found = identify_stage(COMMAND, record(stage), STEP, zeros=1).stage
    np.testing.assert_allclose(found.zeros, [500.0], rtol=1e-6)
    np.testing.assert_allclose(np.sort_complex(found.poles), np.sort_complex(stage.poles), rtol=1e-6)


def test_smoothing_keeps_slow_motion_in_phase():
    time = STEP * np.arange(4000)
    slow, fast = np.sin(2 * np.pi * 5 * time), np.sin(2 * np.pi * 900 * time)
    np.testing.assert_allclose(smoothed(slow + fast, STEP)[500:-500], slow[500:-500], rtol=0, atol=2e-3)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: identify_stage(COMMAND[:20], COMMAND[:20], STEP), "do not identify"),
        (lambda: identify_stage(COMMAND, COMMAND * np.nan, STEP), "must be finite"),
        (lambda: identify_stage(0 * COMMAND, COMMAND, STEP), "must move"),
        (lambda: identify_stage(COMMAND, record(Stage()), STEP, poles=2, zeros=3), "3 zeros do not go"),
        (lambda: smoothed(COMMAND, STEP, 3000.0), "half the sampling rate"),
    ],
)
def test_bad_records_are_refused(call, words):
    with pytest.raises(UserError, match=words):
        call()
