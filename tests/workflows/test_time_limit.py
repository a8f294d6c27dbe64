"""A plan that takes long says what it knows, and leaves no alarm behind."""

import dataclasses
import json
import re
import signal
import time

import pytest

import wavequake.workflows.run as campaign
from wavequake.campaign.store.journal import read_journal
from wavequake.campaign.store.store import JOURNAL, MANIFEST
from wavequake.files import folder
from wavequake.words import lasting
from wavequake.workflows.known_times import FILE
from wavequake.workflows.run import plan, run
from wavequake.workflows.study import bundled_studies, load_study
from wavequake.workflows.time_limit import OutOfTimeError, time_limit


def doze(*arguments):
    """Sleep as a campaign works that goes on after a case that failed."""
    end = time.monotonic() + 20.0
    while time.monotonic() < end:
        try:
            time.sleep(0.05)
        except Exception:
            pytest.fail("the end of the time is no failure of a case")


def dozing():
    yield {"cases": "many"}
    doze()


@pytest.mark.parametrize(
    ("slow", "known", "why"),
    [
        ("check", ["study", "cases", "device"], "what all cases share is prepared"),
        ("compute", ["study", "cases", "device", "store"], "a case of the pilot runs"),
    ],
)
def test_a_plan_answers_in_time(monkeypatch, slow, known, why):
    study = load_study("tmt18-history", {"campaign.cases": 60, "study.seed": 9})
    kind = dataclasses.replace(campaign.kind_of(study), **{slow: doze})
    monkeypatch.setattr(campaign, "kind_of", lambda study: kind)
    start = time.monotonic()
    answer = plan(study, seconds=2.0)
    assert time.monotonic() - start < 10.0
    assert list(answer)[: len(known)] == known
    assert list(answer)[-1] == "estimate"
    assert "memory" not in answer
    late = re.fullmatch(rf"not known: {why} still after ([\d.]+) s; --wait (.*)", answer["estimate"])
    assert 2.0 <= float(late[1]) < 10.0
    assert re.search("; as it is bundled, tmt18-history takes [0-9.]+ m?s of one process ", late[2])
    assert answer["cases"].startswith("60")


def test_a_plan_that_is_not_done_tells_what_the_study_took_before(monkeypatch, tmp_path):
    kept, few = tmp_path / "kept", {"study.seed": 9, "wavefront.zernike_terms": 6}
    run(load_study("tmt18-history", few), cases=3, store=kept, on="serial")
    (record,) = read_journal(kept / JOURNAL).records.values()
    spent = (record.timings["compute_s"] + record.timings["write_s"]) / 3

    monkeypatch.setattr(campaign, "_planned", lambda study, device: dozing())
    again = plan(load_study("tmt18-history", {**few, "campaign.cases": 300}), seconds=0.5, store=kept)
    assert again["estimate"].startswith(f"{lasting(300 * spent)} of one process, as 3 cases of {kept} took; ")
    other = plan(load_study("tmt18-history", {**few, "study.seed": 8}), seconds=0.5, store=kept)
    assert other["estimate"].startswith("not known: ")

    measured = json.loads((folder("workflows") / FILE).read_text())
    each = measured["studies"]["tmt18-history"][1]
    bundled = plan("tmt18-history", seconds=0.5, cases=6000, store=tmp_path / "none")["estimate"]
    assert bundled.startswith(f"{lasting(6000 * each)} of one process after ")
    assert f"as measured on {measured['processor']}; what all cases share is prepared still " in bundled


def test_a_plan_answers_beside_a_store_that_cannot_be_read(monkeypatch, tmp_path):
    (tmp_path / MANIFEST).write_text('{"schema": 0}')
    monkeypatch.setattr(campaign, "_planned", lambda study, device: dozing())
    answer = plan("tmt18-history", seconds=0.5, store=tmp_path)
    assert "of one process after " in answer["estimate"]


def test_studies_whose_pilot_takes_long_were_measured():
    measured = json.loads((folder("workflows") / FILE).read_text())["studies"]
    assert set(measured) <= set(bundled_studies())
    assert {"controller-mor", "double-gauss", "mirror-mor", "tmt-ao", "tmt-m1-control"} <= set(measured)
    assert all(set_up > 0.0 and each > 0.0 for set_up, each in measured.values())


def test_a_limit_leaves_nothing_behind():
    before = signal.getsignal(signal.SIGALRM)
    with pytest.raises(OutOfTimeError), time_limit(0.05):
        doze()
    assert signal.getsignal(signal.SIGALRM) is before
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)
    with time_limit(None):
        assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)


def test_so_few_cases_that_a_disturbance_has_none_are_told():
    few = load_study("tmt-segments", {"telescope.name": "tmt-18", "campaign.cases": 2})
    (said,) = [one for one in campaign.notices(few) if "too few" in one]
    assert said.startswith("note: 2 cases are too few for all disturbances: ")
    assert said.endswith(" have none; raise campaign.cases.")
    assert said.count(",") == 1
    enough = load_study("tmt-segments", {"telescope.name": "tmt-18", "campaign.cases": 4})
    assert not any("too few" in one for one in campaign.notices(enough))
