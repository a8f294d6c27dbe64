"""A plan that takes long says what it knows, and leaves no alarm behind."""

import dataclasses
import json
import re
import signal
import subprocess
import sys
import time

import pytest

import wavequake.workflows.planning.plan as campaign
from wavequake.campaign.store.journal import read_journal
from wavequake.campaign.store.store import JOURNAL, MANIFEST
from wavequake.files import folder
from wavequake.kernels.device.devices import choose_device
from wavequake.words import lasting
from wavequake.workflows.planning import known_times
from wavequake.workflows.planning.known_times import FILE, bundled_times
from wavequake.workflows.planning.plan import plan
from wavequake.workflows.planning.time_limit import OutOfTimeError, time_limit
from wavequake.workflows.run import run
from wavequake.workflows.study import bundled_studies, load_study


def doze(*arguments):
    """Sleep as a campaign works that goes on after a case that failed."""
    end = time.monotonic() + 20.0
    while time.monotonic() < end:
        try:
            time.sleep(0.05)
        except Exception:
            pytest.fail("the end of the time is no failure of a case")


def dozing():
    yield {"cases": "many", "device": "one"}
    doze()


@pytest.mark.parametrize(
    ("slow", "known", "why"),
    [
        ("device", ["study", "cases"], "testing the device"),
        ("check", ["study", "cases", "device"], "preparing what all cases share"),
        ("compute", ["study", "cases", "device", "store"], "running first cases"),
    ],
)
def test_a_plan_answers_in_time(monkeypatch, slow, known, why):
    study = load_study("tmt18-history", {"campaign.cases": 60, "study.seed": 9})
    if slow == "device":
        monkeypatch.setattr(campaign, "choose_device", doze)
    else:
        kind = dataclasses.replace(campaign.kind_of(study), **{slow: doze})
        monkeypatch.setattr(campaign, "kind_of", lambda study: kind)
        choose_device("auto")  # tested once in a process
    start = time.monotonic()
    answer = plan(study, seconds=2.0)
    assert time.monotonic() - start < 10.0
    assert list(answer)[: len(known)] == known
    assert list(answer)[-1] == "estimate"
    assert "memory" not in answer
    late = re.fullmatch(rf"not known: {why} was not done after ([\d.]+) s; --wait (.*)", answer["estimate"])
    assert 2.0 <= float(late[1]) < 10.0
    assert re.search("; as it is bundled, tmt18-history takes [0-9.]+ m?s of one process ", late[2])
    assert answer["cases"].startswith("60")


CASSEGRAIN = """
[study]
name = "cassegrain"
workflow = "segment-disturbance"

[telescope]
name = "custom"
primary_radius_mm = -20000.0
polygons_csv = "id,x1_m,y1_m,x2_m,y2_m,x3_m,y3_m,x4_m,y4_m\\none,-1.0,-0.5,-0.1,-0.5,-0.1,0.5,-1.0,0.5\\n"
surfaces = [
    { name = "M2", distance_mm = 8000.0, radius_mm = -5000.0, conic = -2.25 },
    { name = "image", distance_mm = 10000.0 },
]

[imaging]
enabled = false

[[disturbance]]
name = "shake"
model = "surface-vibration"
of = ["M2"]
lines = [{ frequency_hz = 30.0, amplitude = { dx_um = 5.0 } }]
"""


def test_what_is_wrong_is_said_before_the_device_is_tested(monkeypatch, tmp_path):
    path = tmp_path / "cassegrain.toml"
    path.write_text(CASSEGRAIN)
    monkeypatch.setattr(campaign, "choose_device", doze)
    assert "note" not in plan(path, seconds=2.0)
    wrong = load_study(path, {"telescope.primary_radius_mm": -20200.0})  # by 1 %
    said = plan(wrong, seconds=2.0)["note"]
    assert "image stands 3125 mm before the paraxial focus, which is 13125 mm behind M2" in said


def test_a_plan_that_is_not_done_tells_what_the_study_took_before(monkeypatch, tmp_path):
    kept, few = tmp_path / "kept", {"study.seed": 9, "wavefront.zernike_terms": 6}
    run(load_study("tmt18-history", few), cases=3, store=kept, on="serial")
    (record,) = read_journal(kept / JOURNAL).records.values()
    spent = (record.timings["compute_s"] + record.timings["write_s"]) / 3

    monkeypatch.setattr(campaign, "_planned", lambda study: dozing())
    again = plan(load_study("tmt18-history", {**few, "campaign.cases": 300}), seconds=0.5, store=kept)
    assert again["estimate"].startswith(f"{lasting(300 * spent)} of one process, as 3 cases of {kept} took; ")
    other = plan(load_study("tmt18-history", {**few, "study.seed": 8}), seconds=0.5, store=kept)
    assert other["estimate"].startswith("not known: ")

    measured = json.loads((folder("workflows") / FILE).read_text())
    each = measured["studies"]["tmt18-history"][1]
    bundled = plan("tmt18-history", seconds=0.5, cases=6000, store=tmp_path / "none")["estimate"]
    assert bundled.startswith(f"{lasting(6000 * each)} of one process after ")
    assert f"as measured on {measured['processor']}; preparing what all cases share was not done " in bundled


def test_a_plan_answers_beside_a_store_that_cannot_be_read(monkeypatch, tmp_path):
    (tmp_path / MANIFEST).write_text('{"schema": 0}')
    monkeypatch.setattr(campaign, "_planned", lambda study: dozing())
    answer = plan("tmt18-history", seconds=0.5, store=tmp_path)
    assert "of one process after " in answer["estimate"]


def test_every_bundled_study_was_measured_as_it_is_now():
    """Else `python -m benchmarks.bundled_times` has to be called."""
    measured = json.loads((folder("workflows") / FILE).read_text())["studies"]
    now = {name: load_study(name).identity() for name in bundled_studies()}
    assert {name: of for name, (_, _, of) in measured.items()} == now
    assert all(set_up > 0.0 and each > 0.0 for set_up, each, _ in measured.values())


def test_times_of_a_study_that_has_changed_are_not_told(monkeypatch):
    assert bundled_times("tmt18-history").each > 0.0
    monkeypatch.setattr(known_times, "load_study", lambda name: load_study(name, {"study.seed": 11}))
    assert bundled_times("tmt18-history") is None


def test_code_that_cannot_be_interrupted_is_left_to_the_last_word():
    """As a kernel that is built: an alarm is seen after it; the last word ends the process meanwhile."""
    code = (
        "import os, time\n"
        "from wavequake.workflows.planning.time_limit import time_limit\n"
        "end = lambda: os.write(1, b'known') and os._exit(7)\n"
        "with time_limit(0.2, end):\n"
        "    while True:\n"
        "        try:\n"
        "            time.sleep(60)\n"
        "        except BaseException:\n"
        "            pass\n"
    )
    start = time.monotonic()
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, timeout=50, check=False)
    assert (ended.returncode, ended.stdout) == (7, b"known")
    assert time.monotonic() - start < 40.0


def test_a_last_word_is_not_said_by_who_ends_in_time():
    said = []
    with time_limit(0.2, lambda: said.append("too late")):
        pass
    time.sleep(1.2)
    assert said == []


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
