"""macOS and Windows, simulated: PoCL's wheel and what Python has on Linux alone are taken away."""

import subprocess
import sys
from pathlib import Path

import pytest

# psutil of Linux itself needs what Windows lacks; that of Windows does not.
LIKE = """
import os, signal, sys
import psutil
system, *sys.argv = sys.argv[1:]
gone = {"pyopencl", "pocl_binary_distribution"}
del os.sched_getaffinity, os.sched_setaffinity
os.process_cpu_count = os.cpu_count  # as Python 3.13 has it where there is no affinity
if system == "windows":
    gone |= {"fcntl", "resource", "pwd", "grp", "termios"}
    del signal.SIGHUP
class Gone:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in gone:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
sys.meta_path.insert(0, Gone())
for name in gone:
    sys.modules.pop(name, None)
from wavequake.__main__ import main
main()
"""


def on(system, folder, *words):
    return subprocess.run(
        [sys.executable, "-c", LIKE, system, "wavequake", *map(str, words)],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.mark.parametrize("system", ["macos", "windows"])
def test_pictures_and_study_files_need_neither_kernels_nor_locks(system, tmp_path):
    assert "focal length" in on(system, tmp_path, "info", "double-gauss").stdout
    done = on(system, tmp_path, "new", "double-gauss")
    assert (done.returncode, done.stderr) == (0, "")
    done = on(system, tmp_path, "draw", "double-gauss.toml", "-o", "lens.svg")
    assert (done.returncode, done.stderr) == (0, "")
    assert (tmp_path / "lens.svg").read_text().startswith("<?xml")


def test_without_pocl_numpy_runs_on_macos(tmp_path):
    study = (
        "tmt18-history",
        "campaign.cases=2",
        "optics.rays_per_segment=6",
        "disturbance.history.instants=4",
    )
    refused = on("macos", tmp_path, "run", *study, "--on", "serial")
    assert refused.returncode == 2
    assert "no OpenCL device was found: " in refused.stderr
    assert "`campaign.device=numpy`" in refused.stderr
    ran = on("macos", tmp_path, "run", *study, "campaign.device=numpy", "--on", "serial", "--store", "a")
    assert ran.returncode == 0, ran.stderr
    assert Path(tmp_path, "a", "report.html").exists()


def test_on_windows_what_locks_stores_names_wsl(tmp_path):
    done = on("windows", tmp_path, "run", "tmt18-history")
    assert done.returncode == 2
    assert done.stderr.startswith("Error: this needs Linux or macOS")
    assert "WSL" in done.stderr
