"""Jobs of a Slurm that is three shell scripts: what is in their files, and who can talk to their workers."""

import re
import signal
import stat
import sys
import time
from importlib.util import find_spec
from pathlib import Path

import psutil
import pytest
from test_attack import attack, ports
from test_scratch import others_may_write

from wavequake.cluster.places import place_of

if not find_spec("dask_jobqueue"):
    pytest.skip("needs: pip install -e '.[slurm]'", allow_module_level=True)

SBATCH = """\
#!/bin/sh
cp "$1" {jobs}/script
setsid sh {jobs}/script >{jobs}/output 2>&1 &
echo $! > {jobs}/pid
echo "Submitted batch job $!"
"""
SQUEUE = "#!/bin/sh\necho $(cat {jobs}/pid) RUNNING\n"
SCANCEL = "#!/bin/sh\nkill -- -$(cat {jobs}/pid)\n"


@pytest.fixture
def jobs(tmp_path, monkeypatch):
    for name, text in (("sbatch", SBATCH), ("squeue", SQUEUE), ("scancel", SCANCEL)):
        (tmp_path / name).write_text(text.format(jobs=tmp_path))
        (tmp_path / name).chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=":")
    (tmp_path / "shared").mkdir()
    yield tmp_path
    if (tmp_path / "pid").exists():  # the job, were it not cancelled
        job, until = int((tmp_path / "pid").read_text()), time.monotonic() + 60
        while lives(job):  # its workers may still be at their last words
            assert time.monotonic() < until
            time.sleep(0.1)


def lives(process):
    try:
        return psutil.Process(process).status() != "zombie"
    except psutil.NoSuchProcess:
        return False


def test_jobs_have_the_certificate_of_the_run_and_serve_no_http(jobs):
    template = jobs / "cluster.yaml"
    template.write_text(
        f"jobs: 1\nprocesses: 2\nmemory: 2 GiB\nshared_directory: {jobs}/shared\n"
        f"local_directory: {jobs}/local\n"
    )
    before, ctrl_c = set(ports()), signal.getsignal(signal.SIGINT)
    with place_of("slurm", template)(None, False) as client:
        client.wait_for_workers(2, timeout=30)
        assert client.scheduler.address.startswith("tls://127.0.0.1:")
        (folder,) = (jobs / "shared").iterdir()
        assert stat.S_IMODE(folder.stat().st_mode) == 0o700
        script = (jobs / "script").read_text()
        assert "PRIVATE KEY" not in script
        assert set(re.findall(rf"{folder}\S+", script)) == {f"{folder}/run.pem"}
        job = psutil.Process(int((jobs / "pid").read_text()))
        parts = (job, *job.children(recursive=True))
        listening = {
            one.laddr.port for part in parts for one in part.net_connections("tcp") if one.status == "LISTEN"
        } | (set(ports()) - before)
        assert len(listening) == 5  # a scheduler, two nannies, two workers
        assert attack(jobs, *listening) == ""
        for path in client.run(lambda: Path(sys.path[0])).values():
            assert path.is_relative_to(jobs / "local")
            assert not others_may_write(path)
    assert list((jobs / "shared").iterdir()) == []
    assert signal.getsignal(signal.SIGINT) is ctrl_c
