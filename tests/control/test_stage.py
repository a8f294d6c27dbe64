"""The stage against its closed forms."""

import numpy as np
import pytest

from wavequake.control.linear import frequency_response, poles, static_gain
from wavequake.control.stage import (
    Stage,
    all_pass_inverse,
    low_frequency_delay,
    scaling,
    stage_model,
    stage_response,
)
from wavequake.errors import UserError

OMEGA = np.array([1.0, 20.0, 80.0, 500.0, 3000.0])


def test_state_space_has_the_response_of_zeros_and_poles():
    stage = Stage()
    np.testing.assert_allclose(
        frequency_response(stage_model(stage), OMEGA)[:, 0, 0], stage_response(stage, 1j * OMEGA), rtol=1e-9
    )
    np.testing.assert_allclose(
        np.sort_complex(poles(stage_model(stage))), np.sort_complex(np.array(stage.poles)), rtol=1e-9
    )
    assert static_gain(stage_model(stage))[0, 0] == pytest.approx(0.97)


def test_slow_motion_lags_by_eight_milliseconds():
    # Störkle 2018, Section 5.2.1: about 8 ms.
    assert low_frequency_delay(Stage()) == pytest.approx(8e-3, rel=0.01)
    phase = np.angle(stage_response(Stage(delay=1e-3), 1j * 0.1))
    assert -phase / 0.1 == pytest.approx(low_frequency_delay(Stage(delay=1e-3)), rel=1e-4)


def test_inverse_leaves_an_all_pass():
    stage = Stage()
    product = frequency_response(all_pass_inverse(stage), OMEGA)[:, 0, 0] * stage_response(stage, 1j * OMEGA)
    np.testing.assert_allclose(np.abs(product), 1.0, rtol=1e-9)
    lag = 2 * sum(1 / zero for zero in stage.zeros).real
    assert -np.angle(product[0]) / OMEGA[0] == pytest.approx(lag, rel=1e-3)
    assert poles(all_pass_inverse(stage)).real.max() < 0


def test_scaling_of_the_analog_input():
    # The worked example after Eq. 5.8, whose result is misprinted there: K = 10/22, offset -7.5.
    assert scaling((5.5, 27.5), (-5.0, 5.0)) == (pytest.approx(10 / 22), pytest.approx(-7.5))


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: Stage(poles=(-1.0,)), "more than its 1 poles"),
        (lambda: Stage(poles=(1.0, -2.0, -3.0)), "unstable"),
        (lambda: Stage(zeros=(1 + 1j,)), "conjugate pairs"),
        (lambda: Stage(zeros=(0.0,)), "other than 0"),
        (lambda: all_pass_inverse(Stage(zeros=(1000.0,))), "no proper inverse"),
        (lambda: scaling((1.0, 1.0), (0.0, 1.0)), "empty"),
    ],
)
def test_impossible_stages_are_refused(call, words):
    with pytest.raises(UserError, match=words):
        call()
