"""A plan that takes long says what it knows, and leaves no alarm behind."""

import dataclasses
import signal
import time

import pytest

import wavequake.workflows.run as campaign
from wavequake.workflows.run import plan
from wavequake.workflows.study import load_study
from wavequake.workflows.time_limit import OutOfTimeError, time_limit


def doze(*arguments):
    """Sleep as a campaign works that goes on after a case that failed."""
    end = time.monotonic() + 20.0
    while time.monotonic() < end:
        try:
            time.sleep(0.05)
        except Exception:
            pytest.fail("the end of the time is no failure of a case")


@pytest.mark.parametrize(
    ("slow", "known", "why"),
    [
        ("check", ["study", "cases", "device"], "what all cases share is prepared"),
        ("compute", ["study", "cases", "device", "store"], "a case of the pilot runs"),
    ],
)
def test_a_plan_answers_in_time(monkeypatch, slow, known, why):
    study = load_study("tmt18-history", {"campaign.cases": 60})
    kind = dataclasses.replace(campaign.kind_of(study), **{slow: doze})
    monkeypatch.setattr(campaign, "kind_of", lambda study: kind)
    start = time.monotonic()
    answer = plan(study, seconds=2.0)
    assert time.monotonic() - start < 10.0
    assert list(answer)[: len(known)] == known
    assert list(answer)[-1] == "estimate"
    assert "memory" not in answer
    assert answer["estimate"].startswith(f"not known: {why} still after 2 s; --wait ")
    assert answer["cases"].startswith("60")


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
