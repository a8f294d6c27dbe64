"""The sensor chain against its resolution, and saturation at its ends."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from wavequake.control.sensor import (
    SensorChain,
    adc_codes,
    dac_codes,
    positions,
    quadrature_counts,
    quantized_command,
    read_positions,
    strip_reading,
)
from wavequake.errors import UserError

IDEAL = SensorChain(strip_error=0.0)


def test_floor_of_the_chain_is_that_of_its_steps():
    """Independent uniform errors of edge, 10-bit and 12-bit step and 0.7 steps of noise add up in squares."""
    rng = np.random.default_rng(1)
    position = rng.uniform(-5e-3, 5e-3, 40_000)
    error = read_positions(IDEAL, position, np.zeros(2), rng.standard_normal(40_000)) - position
    steps = np.array([13.6e-6, 16e-3 / 1023, 16e-3 / 4095])
    expected = np.sqrt((steps**2).sum() / 12 + (0.7 * steps[2]) ** 2)
    assert error.std() == pytest.approx(expected, rel=0.05)
    assert error.std() == pytest.approx(6.6e-6, rel=0.05)
    assert abs(error.mean()) < 5e-7


def test_counts_change_by_one_per_edge_and_return():
    there = np.linspace(0, 2e-3, 5000)
    counts = quadrature_counts(IDEAL, np.concatenate([there, there[::-1]]))
    assert set(np.diff(counts)) == {-1, 0, 1}
    assert counts[0] == counts[-1] == 0
    assert counts.max() == round(2e-3 / 13.6e-6)


@given(st.floats(-8e-3, 8e-3), st.lists(st.floats(0, 6.3), min_size=2, max_size=2))
def test_strip_error_is_bounded_and_zero_at_rest(position, phases):
    reading = strip_reading(SensorChain(), np.array([0.0, position]), np.array(phases))
    assert reading[0] == 0.0
    assert abs(reading[1] - position) <= 80e-6


def test_converters_saturate_and_round_trip():
    chain = replace(IDEAL, adc_noise=0.0)
    assert list(dac_codes(chain, np.array([-10_000, 0, 10_000]))) == [0, 512, 1023]
    assert list(adc_codes(chain, np.array([0, 1023]), np.array([-3.0, 3.0]))) == [0, 4095]
    np.testing.assert_allclose(positions(chain, np.array([0, 4095])), [-8e-3, 8e-3])
    np.testing.assert_allclose(quantized_command(np.array([-1.0, 1.0])), [-8e-3, 8e-3])
    command = np.linspace(-7e-3, 7e-3, 301)
    assert np.abs(quantized_command(command) - command).max() <= 8e-3 / 4095 * 1.0001


def test_bad_chains_and_runs_are_refused():
    with pytest.raises(UserError, match="edge and reach must be positive"):
        SensorChain(edge=0.0)
    with pytest.raises(UserError, match="1 to 16 bits"):
        SensorChain(adc_bits=0)
    with pytest.raises(UserError, match="diverged"):
        read_positions(IDEAL, np.array([np.nan]), np.zeros(2), np.zeros(1))
