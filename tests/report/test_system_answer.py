"""The sentence that reports of systems begin with."""

from types import SimpleNamespace

import numpy as np

from wavequake.report.systems.answer import answer


def population(name, values, field="(0, 0) deg", at_rest=1.0):
    one = SimpleNamespace(
        field=field,
        lost=0,
        wfe=values,
        change=values,
        peak=at_rest / (1.0 + values),
        peak_at_rest=at_rest,
        los=SimpleNamespace(radial=0.5),
    )
    return SimpleNamespace(name=name, fields=[one])


def test_sums_of_disturbances_rank_nothing():
    found = [population("floor", np.arange(1.0, 5.0)), population("all", np.arange(11.0, 15.0))]
    assert answer(found).startswith("all changes the wavefront most")
    assert answer(found, frozenset({"all"})).startswith("floor changes the wavefront: ")
    assert answer(found[1:], frozenset({"all"})).startswith("all changes the wavefront: ")  # nothing else


def test_few_cases_have_no_percentiles():
    words = answer([population("floor", np.arange(1.0, 5.0))])
    assert "in all of its 4 cases by at most 4.00 nm" in words
    assert "in the worst of its 4 cases the peak is 0.200 of" in words
    words = answer([population("floor", np.arange(1.0, 101.0))])
    assert "in 95 % of its cases by at most 95." in words
    assert "in 5 % of its cases the peak is at most" in words


def test_what_the_design_has_at_rest_is_no_cost_of_a_disturbance():
    """A field that is dim at rest and keeps nine tenths loses less than one that keeps half of much."""
    dim, bright = population("a", np.full(2, 1 / 9), "dim", 0.02), population("b", np.ones(2), "bright", 0.8)
    words = answer([dim, bright])
    assert "b costs most: at field bright in the worst of its 2 cases the peak is 0.400" in words
    assert "0.800 at rest" in words


def test_the_only_disturbance_is_not_the_most_of_all():
    words = answer([population("floor", np.ones(2))])
    assert words.startswith("floor changes the wavefront: in all of its 2 cases")
    assert "blurs, too, at field" in words
    words = answer([population("floor", np.ones(1))])
    assert words.startswith("floor changes the wavefront: in its only case by 1.00 nm rms")
    assert "in its only case the peak is 0.500 of" in words
