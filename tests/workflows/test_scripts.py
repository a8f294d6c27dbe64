"""Scripts that call `wavequake.run` without a guard: on all CPUs, once; or serially, said in a line."""

import os
import subprocess
import sys

import numpy as np
import pytest

import wavequake as wq
from wavequake.campaign.engine.scripts import script_hidden

SCRIPT = """
import os, sys
with open("ran", "a") as file:
    file.write("once\\n")
import wavequake as wq
{before}
keys = {{"optics__rays": 60, "wavefront__zernike_terms": 11, "store__chunk_cases": 3}}
found = wq.run("six-lens.toml", cases=9, store="store"{how}, **keys)
print(float(found.wfe_rms.sum()))
"""
STUDY = """
[study]
name = "six"
workflow = "system-disturbance"
[system]
name = "six-lens"
[[disturbance]]
name = "assembly"
model = "surface-random"
of = ["L3 front"]
rms = { dx_um = 20.0 }
"""
DAEMON = """
import multiprocessing
multiprocessing.current_process()._config["daemon"] = True
"""
OWN = """
from wavequake.campaign.extra import register
from wavequake.campaign.measures import Measure
def one(found):
    return found["wfe_rms"]
register(Measure("mine", "nm", "my own", ("time", "field", "wavelength"), one))
"""


def ran(tmp_path, before="", how=""):
    (tmp_path / "six-lens.toml").write_text(STUDY)
    (tmp_path / "script.py").write_text(SCRIPT.format(before=before, how=how))
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(
        [sys.executable, "script.py"],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "ran").read_text() == "once\n"
    (log,) = (tmp_path / "store" / "log").glob("*.log")
    return done, log.read_text()


@pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="one CPU")
def test_a_script_without_a_guard_uses_all_cpus_and_runs_once(tmp_path):
    done, log = ran(tmp_path)
    assert "on=local" in log
    assert done.stderr == ""
    serial, log = tmp_path / "serial", ""
    serial.mkdir()
    alone, log = ran(serial, how=', on="serial"')
    assert "on=serial" in log
    assert alone.stdout == done.stdout
    assert len(wq.open_store(tmp_path / "store").load().case) == 9


@pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="one CPU")
@pytest.mark.parametrize(
    ("before", "words"),
    [(DAEMON, "this process is a worker itself"), (OWN, "workers do not know what __main__ has registered")],
)
def test_where_workers_would_not_do_it_runs_serially_and_says_so(tmp_path, before, words):
    done, log = ran(tmp_path, before)
    assert "on=serial" in log
    assert done.stderr.startswith("Wavequake runs serially: " + words)
    assert done.stderr.count("\n") == 1


def test_one_chunk_of_cases_starts_no_workers(tmp_path, capsys):
    few = {"optics__rays": 60, "wavefront__zernike_terms": 11, "imaging__pixels": 8}
    found = wq.run("double-gauss", cases=2, store=tmp_path / "s", workers=2, **few)
    assert np.isfinite(found.wfe_rms.isel(time=0)).all()
    (log,) = (tmp_path / "s" / "log").glob("*.log")
    assert "on=serial" in log.read_text()
    assert capsys.readouterr().err == ""


def test_the_script_is_there_again_afterwards():
    script = sys.modules["__main__"]
    with script_hidden():
        assert not hasattr(sys.modules["__main__"], "__file__")
    assert sys.modules["__main__"] is script
