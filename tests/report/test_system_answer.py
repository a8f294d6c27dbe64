"""The sentence that reports of systems begin with."""

from types import SimpleNamespace

import numpy as np

from wavequake.report.systems.report import answer


def population(name, values):
    one = SimpleNamespace(
        field="(0, 0) deg",
        lost=0,
        wfe=values,
        change=values,
        peak=1.0 / (1.0 + values),
        los=SimpleNamespace(radial=0.5),
    )
    return SimpleNamespace(name=name, fields=[one])


def test_sums_of_disturbances_rank_nothing():
    found = [population("floor", np.arange(1.0, 5.0)), population("all", np.arange(11.0, 15.0))]
    assert answer(found).startswith("all changes the wavefront most")
    assert answer(found, frozenset({"all"})).startswith("floor changes the wavefront most")
    assert answer(found[1:], frozenset({"all"})).startswith("all changes the wavefront most")  # nothing else


def test_few_cases_have_no_percentiles():
    words = answer([population("floor", np.arange(1.0, 5.0))])
    assert "in all of its 4 cases by at most 4.00 nm" in words
    assert "in the worst of its 4 cases the peak is at most 0.200 of" in words
    words = answer([population("floor", np.arange(1.0, 101.0))])
    assert "in 95 % of its cases by at most 95." in words
    assert "in 5 % of its cases the peak is at most" in words
