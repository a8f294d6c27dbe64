"""Clocks that jump, as those of machines do that slept or were set by hand."""

import os
import shutil
import ssl
import subprocess
import sys
import time
from pathlib import Path

import pytest
import toy
from rich.table import Table

from wavequake.campaign.store.journal import read_journal
from wavequake.campaign.store.status import store_status
from wavequake.campaign.store.verify import verify_store
from wavequake.cluster.certificate import make_certificate
from wavequake.report import campaign
from wavequake.report.page import Page
from wavequake.report.written import is_current

CENTURY = 100 * 365 * 86400

STREAM = """
import asyncio, os, sys
from pathlib import Path
from distributed.batched import BatchedSend
from wavequake.cluster.steady_clock import keep_time

class Line:
    sent = []
    closed = staticmethod(lambda: False)

    async def write(self, messages, **options):
        self.sent += messages
        return 1

async def main():
    stream = BatchedSend(0.002)
    stream.start(Line())
    stream.send("before")
    while not Line.sent:
        await asyncio.sleep(0)
    stream.send("after")
    Path(os.environ["JUMP_FILE"]).write_text(sys.argv[1])
    await asyncio.sleep(0.5)
    print(*Line.sent)

keep_time()
asyncio.run(main())
"""

DRIVER = """
import os, sys
from pathlib import Path
import toy

def jump(done, total, quarantined):
    if done >= 20:
        Path(os.environ["JUMP_FILE"]).write_text(sys.argv[2])

if __name__ == "__main__":
    options = {"sleep_s": 0.1, "count": sys.argv[3]}
    found = toy.run(Path(sys.argv[1]), options, cases=240, on="local", workers=2, progress=jump)
    print(found.computed, found.quarantined)
"""


@pytest.fixture(scope="module")
def jumping(tmp_path_factory):
    """The environment of a process whose clock goes by a file."""
    folder = tmp_path_factory.mktemp("clock")
    library, source = folder / "clock.so", Path(__file__).with_name("jumping_clock.c")
    compiler = shutil.which("cc")
    words = [compiler, "-shared", "-fPIC", "-o", str(library), str(source), "-ldl"]
    if not compiler or subprocess.run(words, capture_output=True, check=False).returncode:
        pytest.skip("shifting clocks needs a C compiler")
    return {"LD_PRELOAD": str(library), "JUMP_FILE": str(folder / "shift")}


def test_a_message_does_not_wait_for_a_clock_that_is_put_back(jumping):
    """Dask holds messages for 2 ms after another one by the time of day: for 25 years here."""
    Path(jumping["JUMP_FILE"]).write_text("0")
    words = [sys.executable, "-c", STREAM, str(-CENTURY // 4)]
    found = subprocess.run(words, env=os.environ | jumping, capture_output=True, text=True, check=False)
    assert (found.stdout, found.stderr) == ("before after\n", "")


@pytest.mark.parametrize("seconds", [CENTURY, -CENTURY // 4], ids=["on", "back"])
def test_a_clock_that_jumps_in_a_run_costs_each_worker_one_chunk_at_most(tmp_path, jumping, seconds):
    """Dask looks how long it has not heard of each worker by that clock: here every 10 s instead of 5 min."""
    environment = {
        **os.environ,
        **jumping,
        "PYTHONPATH": os.pathsep.join(sys.path),
        "DASK_DISTRIBUTED__SCHEDULER__WORKER_TTL": "10s",
    }
    path, begun = tmp_path / "s", tmp_path / "begun"
    Path(jumping["JUMP_FILE"]).write_text("0")
    words = [sys.executable, "-c", DRIVER, str(path), str(seconds), str(begun)]
    found = subprocess.run(words, env=environment, capture_output=True, text=True, check=False)
    assert (found.stdout, found.stderr) == ("240 0\n", "")
    assert len(begun.read_text().split()) <= 240 + 10 * 2
    times = [record.time for record in read_journal(path / "done").records.values()]
    assert max(times) - min(times) == pytest.approx(abs(seconds), abs=120)  # it did jump
    assert (
        toy.run(path, {"sleep_s": 0.1, "count": str(begun)}, cases=250).computed == 10
    )  # by the clock of now
    toy.run(tmp_path / "whole", cases=250)
    assert toy.digests(path) == toy.digests(tmp_path / "whole")
    assert store_status(path).quarantined == 0
    assert verify_store(path).ok


def test_no_clock_is_too_early_or_too_late_for_the_certificate_of_a_run(tmp_path):
    file = tmp_path / "certificate.pem"
    file.write_text(make_certificate().certificate)
    dates = ssl._ssl._test_decode_cert(str(file))
    assert ssl.cert_time_to_seconds(dates["notBefore"]) == 0
    assert dates["notAfter"] == "Dec 31 23:59:59 9999 GMT"


@pytest.mark.parametrize("years", [10, -10])
def test_a_report_is_as_new_as_what_it_shows_whatever_the_clock_says(tmp_path, monkeypatch, years):
    path = tmp_path / "s"

    class Plain:
        table_of = staticmethod(lambda store, dataset: Table())

        page_of = staticmethod(
            lambda store, dataset, device: Page("a report", [], "", [], [], [], "case", [])
        )

    monkeypatch.setattr(campaign, "_report_of", lambda workflow: Plain)
    toy.run(path, cases=20)
    assert not is_current(path)
    _, report = campaign.report_store(path)
    then = time.time() + years * 365 * 86400
    os.utime(report, (then, then))
    assert is_current(path)
    toy.run(path, cases=30)
    assert not is_current(path)
    campaign.report_store(path)
    assert is_current(path)
