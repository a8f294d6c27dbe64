"""Every number of every bundled study at values that nobody means: it is taken, or refused in a sentence."""

from functools import partial

import pytest

from wavequake.errors import UserError
from wavequake.words import MOST, plain
from wavequake.workflows.study import bundled_studies, load_study

EXTREMES = (1e300, -1e300, 1e-300, float("nan"), 10**400)


def numbers_of(record, prefix=""):
    """Yield the keys of all numbers and lists of numbers, and whether each is a list."""
    for key, value in record.items():
        parts = value if isinstance(value, list | tuple) else [value]
        if isinstance(value, dict):
            yield from numbers_of(value, f"{prefix}{key}.")
        elif parts and all(isinstance(one, dict) and "name" in one for one in parts):
            for one in parts:
                yield from numbers_of(one, f"{prefix}{key}.{one['name']}.")
        elif parts and all(isinstance(one, int | float) and not isinstance(one, bool) for one in parts):
            yield f"{prefix}{key}", isinstance(value, list | tuple)


@pytest.mark.parametrize("name", bundled_studies())
def test_numbers_that_nobody_means_are_answered(name):
    keys = [*numbers_of(load_study(name).model_dump())]
    said = [words for key, is_list in keys for words in map(partial(answer, name, key, is_list), EXTREMES)]
    refused = [words for words in said if words]
    assert len(refused) >= 2 * len(keys)  # at least what is no number of a computer
    assert all(len(words) <= MOST and plain(words) == words for words in refused)


def answer(name, key, is_list, value):
    try:
        load_study(name, {key: [value] if is_list else value})
    except UserError as error:
        return str(error)
    return ""


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("loop.rates_hz", [500.0, 1e300], r"a rate is 1e.300 Hz; it must be positive and at most 1e.06 Hz"),
        ("loop.rates_hz", [0.0], "a rate is 0 Hz; it must be positive"),
        ("simulated.settling_s", 1e12, "less than or equal to 3600"),
    ],
)
def test_loops_of_no_rate_or_without_end_are_refused(key, value, words):
    with pytest.raises(UserError, match=words):
        load_study("tip-tilt-vibration", {key: value})
