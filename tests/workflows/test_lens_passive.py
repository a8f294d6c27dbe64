"""The passive optimization on the engine: bits, the first start, what it finds."""

import numpy as np
import pytest

from wavequake.control.bench import fitted_bench
from wavequake.control.passive import objective
from wavequake.errors import UserError
from wavequake.report.lens import passive as report
from wavequake.report.page import render_page
from wavequake.workflows.lens.passive import KIND, start_of
from wavequake.workflows.run import run
from wavequake.workflows.study import load_study

STUDY = load_study("lens-passive", ["passive.iterations=5"])
TEXT = STUDY.identity_text()


def test_bits_do_not_depend_on_the_chunk():
    together, alone = KIND.compute(TEXT, np.arange(3), "numpy"), KIND.compute(TEXT, np.array([2]), "numpy")
    for name, values in alone.arrays.items():
        np.testing.assert_array_equal(values[0], together.arrays[name][2])
    assert (together.arrays["amplitude_sum"] < 1e3 * objective(fitted_bench(active=False))).any()


def test_the_first_start_is_the_present_bench_and_others_differ():
    assert not start_of(STUDY, 0).any()
    assert len(start_of(STUDY, 1)) == 29
    assert (start_of(STUDY, 1) != start_of(STUDY, 2)).all()
    springs = load_study("lens-passive", ["passive.inertias=false"])
    assert len(start_of(springs, 1)) == 17


def test_report_names_the_best_start(tmp_path):
    dataset = run("lens-passive", cases=3, store=tmp_path / "s", passive__iterations=4).load()
    best = report.best_of(dataset)
    assert dataset["amplitude_sum"].to_numpy()[best] == dataset["amplitude_sum"].min()
    text = render_page(dataset, report.page_of(tmp_path, dataset, "numpy"))
    assert f"{float(dataset['lens_springs'][best, 0]):.0f}" in text
    assert "best of 3 starts" in text
    dataset["status"][:] = 2
    assert report.best_of(dataset) is None
    assert "No start" in report.answer(dataset)
    assert not report.table_of(tmp_path, dataset).rows


def test_a_search_that_changes_nothing_is_refused():
    with pytest.raises(UserError, match="neither springs nor inertias may change"):
        load_study("lens-passive", ["passive.springs=false", "passive.inertias=false"])
