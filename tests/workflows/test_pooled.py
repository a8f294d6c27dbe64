"""Quantiles of what memory holds and of what it does not, bit by bit, where numbers are odd."""

from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from wavequake.campaign.statistics import pooled
from wavequake.campaign.statistics.quantiles import quantile, share_error

INF = np.inf
ODD = [-INF, -1.7e308, -1.0, -5e-324, -0.0, 0.0, 5e-324, 0.1, 1.0, 1.7e308, INF, np.nan]


def both(values, probability, sets=None, step=2):
    """Return the quantile of cases, held and streamed, as bits and as numbers."""
    values = np.asarray(values, dtype=np.float64)
    labels = None if sets is None else np.asarray(sets)

    def parts():
        for first in range(0, len(values), step):
            some = slice(first, first + step)
            yield "a", values[some], None if labels is None else labels[some]

    held = pooled.pooled_quantiles(parts, probability)["a"]
    with patch.object(pooled, "HELD", 0):
        streamed = pooled.pooled_quantiles(parts, probability)["a"]
    numbers = [np.array([one.value, one.low, one.high]) for one in (held, streamed)]
    # NaN is NaN, whatever its bits.
    return held, *(np.where(np.isnan(one), np.nan, one).tobytes() for one in numbers)


@settings(max_examples=30)
@given(
    st.lists(st.lists(st.sampled_from(ODD), min_size=2, max_size=2), min_size=1, max_size=12),
    st.sampled_from([0.0, 0.1, 0.5, 0.77, 1.0]),
    st.none() | st.lists(st.integers(0, 4), min_size=12, max_size=12),
)
def test_odd_numbers_have_the_same_bits_held_and_streamed(values, probability, sets):
    _, held, streamed = both(values, probability, None if sets is None else sets[: len(values)])
    assert held == streamed


@pytest.mark.parametrize("zeros", [[0.0, -0.0, -0.0, 0.0], [-0.0, 0.0, 0.0], [-0.0], [-0.0] * 5])
@pytest.mark.parametrize("probability", [0.0, 0.4, 0.5, 1.0])
def test_zeros_have_no_sign(zeros, probability):
    found, held, streamed = both(np.array(zeros)[:, None], probability)
    assert held == streamed
    assert (found.value, np.signbit(found.value)) == (0.0, False)


@pytest.mark.parametrize(
    ("values", "value"),
    [
        ([-INF, INF], np.nan),
        ([-INF, 1.0], -INF),
        ([1.0, INF], INF),
        ([INF, INF], INF),
        ([-INF, -INF], -INF),
        ([-INF, 3.0, INF], 3.0),
        ([-1.6e308, 1.6e308], 0.0),
    ],
)
@pytest.mark.parametrize("sets", [None, [1, 0, 2]])
def test_medians_of_infinities_and_of_what_overflows(values, value, sets):
    labels = None if sets is None else sets[: len(values)]
    found, held, streamed = both(np.array(values)[:, None], 0.5, labels)
    assert held == streamed
    np.testing.assert_equal(found.value, value)
    np.testing.assert_equal(quantile(np.array(values), 0.5).value, value)


def test_the_error_of_shares_is_summed_in_the_order_of_the_sets():
    """Sums of floats depend on their order: the sets come in another one than they are sorted in."""
    random = np.random.default_rng(4)
    for _ in range(40):
        count = int(random.integers(20, 60))
        values, sets = random.standard_normal((count, 1)), random.integers(0, 9, count)[::-1]
        level = float(random.standard_normal())
        parts = [("a", values[i : i + 1], sets[i : i + 1]) for i in range(count)]
        found = pooled._errors(lambda parts=parts: parts, {"a": level})["a"]
        assert found == share_error(values, sets, np.array([level]))[0]


@pytest.mark.parametrize(("sets", "readings"), [(None, 5), (np.arange(9) % 3, 10)])
def test_values_are_read_as_often_as_is_said(monkeypatch, sets, readings):
    read = []

    def parts():
        read.append(1)
        yield "a", np.random.default_rng(0).standard_normal((9, 2)), sets

    pooled.pooled_quantiles(parts, 0.9)
    assert len(read) == 1
    monkeypatch.setattr(pooled, "HELD", 4)
    pooled.pooled_quantiles(parts, 0.9)
    assert len(read) == 1 + readings
