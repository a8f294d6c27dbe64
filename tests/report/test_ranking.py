"""Disturbances ranked by any number of a store, against quantiles taken by hand."""

import numpy as np
import pytest

import wavequake as wq
from wavequake.report.answers.ranking import ranking

STUDY = """
[study]
name = "ranked"
workflow = "segment-disturbance"
[telescope]
name = "tmt-18"
[imaging]
pixels = 32
[campaign]
cases = 12
[[disturbance]]
name = "steps"
model = "static-random"
piston_nm = 40.0
[[disturbance]]
name = "sway"
model = "line-of-sight"
spectrum = "tmt-vibration"
instants = 16
duration_s = 60.0
"""


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    folder = tmp_path_factory.mktemp("ranked")
    (folder / "study.toml").write_text(STUDY)
    wq.run(wq.load_study(folder / "study.toml"), store=folder / "store", on="serial")
    return folder / "store"


def test_each_number_ranks_by_its_own_bad_end(store):
    dataset = wq.open_store(store).load()
    peak, error = dataset["peak"].to_numpy(), dataset["wfe_rms"].to_numpy()
    rms = np.sqrt(np.nanmean(error**2, axis=1))
    for by, values, place, sign in (("peak", peak, 0, 1.0), ("wfe_rms", rms, -1, -1.0)):
        wanted = {name: sorted(values[dataset["disturbance"] == name])[place] for name in ("steps", "sway")}
        found = ranking(store, by).found
        assert [one.name for one in found] == sorted(wanted, key=lambda name: sign * wanted[name])
        assert [one.far for one in found] == pytest.approx(sorted(wanted.values(), key=lambda x: sign * x))
        assert {one.cases for one in found} == {6}


def test_the_command_says_what_costs_and_refuses_what_is_no_number(store, wavequake):
    code, out, err = wavequake("report", store, "--by", "los")
    assert (code, err) == (0, "")
    assert "By los sway costs the most." in out
    assert out.index("sway") < out.index("steps")
    code, out, err = wavequake("report", store, "--by", "gone")
    assert (code, out) == (2, "")
    assert "There is no 'gone' to judge; use one of" in err
