"""Slurm itself, with two nodes on loopback: needs root and Debian's slurm-wlm and munge."""

import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest
import toy

from wavequake.campaign.store.verify import verify_store
from wavequake.cluster.places import place_of
from wavequake.errors import UserError
from wavequake.files import folder

CONFIGURATION = """\
ClusterName=loop
SlurmctldHost={host}(127.0.0.1)
SlurmUser=root
SlurmdUser=root
AuthType=auth/munge
AuthInfo=socket=/run/munge/munge.socket.2
CredType=cred/munge
SlurmctldPort=16817
SlurmdPort=16818
StateSaveLocation={root}/state
SlurmdSpoolDir={root}/spool/%n
SlurmctldPidFile={root}/slurmctld.pid
SlurmdPidFile={root}/slurmd.%n.pid
SlurmctldLogFile={root}/slurmctld.log
SlurmdLogFile={root}/slurmd.%n.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
JobAcctGatherType=jobacct_gather/none
AccountingStorageType=accounting_storage/none
MpiDefault=none
SwitchType=switch/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core_Memory
SchedulerType=sched/backfill
SlurmctldTimeout=30
SlurmdTimeout=60
InactiveLimit=0
KillWait=3
MinJobAge=300
Waittime=0
ReturnToService=2
NodeName=n1 NodeHostname={host} NodeAddr=127.0.0.1 Port=17001 CPUs=2 RealMemory=4000
NodeName=n2 NodeHostname={host} NodeAddr=127.0.0.1 Port=17002 CPUs=2 RealMemory=4000
PartitionName=debug Nodes=ALL Default=YES MaxTime=INFINITE State=UP
"""

if not (shutil.which("slurmctld") and shutil.which("slurmd") and shutil.which("munged")):
    pytest.skip("Slurm is not installed: apt-get install slurm-wlm munge", allow_module_level=True)
if not os.environ.get("WAVEQUAKE_SLURM"):
    pytest.skip("`make slurm` runs the tests with Slurm", allow_module_level=True)
if os.geteuid():
    pytest.skip("a Slurm of one's own needs root", allow_module_level=True)


def words(*command, **keywords):
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False, **keywords)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def ended(pid):
    if psutil.pid_exists(pid):
        os.kill(pid, signal.SIGKILL)


@pytest.fixture(scope="module")
def slurm(tmp_path_factory):
    root = tmp_path_factory.mktemp("slurm")
    for name in ("state", "spool/n1", "spool/n2"):
        (root / name).mkdir(parents=True)
    file = root / "slurm.conf"
    file.write_text(CONFIGURATION.format(host=socket.gethostname(), root=root))
    patch = pytest.MonkeyPatch()
    patch.setenv("SLURM_CONF", str(file))
    patch.setenv("PYTHONPATH", os.pathsep.join(sys.path))
    own_munge = not Path("/run/munge/munge.socket.2").exists()
    if own_munge:
        words("install", "-d", "-o", "munge", "-g", "munge", "-m755", "/run/munge")
        words("su", "-s", "/bin/sh", "munge", "-c", "/usr/sbin/munged")
    try:
        words("slurmctld", "-f", str(file))
        for node in ("n1", "n2"):
            words("slurmd", "-f", str(file), "-N", node)
        end = time.monotonic() + 30
        while words("sinfo", "-h", "-N", "-o", "%T").split() != ["idle", "idle"]:
            assert time.monotonic() < end, words("sinfo", "-N", "-l")
            time.sleep(0.2)
        yield root
    finally:
        subprocess.run(["scancel", "--user=root"], check=False)
        time.sleep(1)
        for name in ("slurmctld.pid", "slurmd.n1.pid", "slurmd.n2.pid"):
            if (root / name).exists():
                ended(int((root / name).read_text()))
        if own_munge:
            words("su", "-s", "/bin/sh", "munge", "-c", "/usr/sbin/munged --stop")
        patch.undo()


def emptied(timeout_s):
    """Wait for the end of all jobs; `sbatch --wait` would look ever more rarely."""
    end = time.monotonic() + timeout_s
    while words("squeue", "-h").strip():
        assert time.monotonic() < end, words("squeue")
        time.sleep(0.2)


def cluster_file(root):
    file = root / "cluster.yaml"
    file.write_text(
        f"interface: lo\npartition: debug\njobs: 2\nprocesses: 2\nmemory: 2 GiB\nwalltime: '00:05:00'\n"
        f"log_directory: {root}/jobs\nlocal_directory: {root}/local\n"
    )
    return file


def test_workers_have_one_thread_and_a_job_that_is_killed_is_submitted_again(slurm, monkeypatch):
    monkeypatch.setattr("wavequake.cluster.slurm.LOOK_S", 0.5)

    def environment():
        return [
            os.environ.get(name) for name in ("OMP_NUM_THREADS", "POCL_MAX_PTHREAD_COUNT", "SLURM_JOB_ID")
        ]

    with place_of("slurm", cluster_file(slurm))(1, False) as client:
        client.wait_for_workers(2, timeout=60)  # a whole job
        found = list(client.run(environment).values())
        job = found[0][2]
        assert found == [["1", "1", job]] * 2
        assert listening(os.getpid()) == {"127.0.0.1"}
        words("scancel", "--signal=KILL", "--full", job)
        end = time.monotonic() + 150  # Slurm looks for lost jobs once a minute
        while jobs(client.run(environment, on_error="return")) in (set(), {job}):
            assert time.monotonic() < end, words("squeue")
            time.sleep(0.5)


def test_jobs_that_cannot_start_a_worker_end_the_wait(slurm, monkeypatch):
    monkeypatch.setattr("wavequake.cluster.slurm.LOOK_S", 0.5)
    file = cluster_file(slurm)
    file.write_text(file.read_text() + "python: /bin/false\n")
    with pytest.raises(UserError, match="end before they have a worker"), place_of("slurm", file)(1, False):
        pass


def jobs(answers):
    return {one[2] for one in answers.values() if isinstance(one, list)}  # a worker may die as it is asked


def listening(pid):
    connections = psutil.Process(pid).net_connections("tcp")
    return {one.laddr.ip for one in connections if one.status == "LISTEN"}


def test_jobs_give_the_bits_of_a_serial_run_although_one_is_killed(slurm, tmp_path):
    options, killed = {"sleep_s": 0.05}, []

    def kill_one(done, total, quarantined):
        jobs = words("squeue", "-h", "-t", "R", "-o", "%i").split()
        if done and len(jobs) > 1 and not killed:
            killed.append(jobs[0])
            words("scancel", "--signal=KILL", "--full", jobs[0])

    summary = toy.run(
        tmp_path / "s",
        options,
        cases=200,
        chunk=5,
        on="slurm",
        cluster=cluster_file(slurm),
        progress=kill_one,
    )
    assert (summary.computed, summary.quarantined, len(killed)) == (200, 0, 1)
    toy.run(tmp_path / "serial", cases=200, chunk=5)
    serial = toy.digests(tmp_path / "serial")
    assert toy.digests(tmp_path / "s") == serial
    emptied(20)


def test_a_job_array_of_shards_fills_one_store(slurm, tmp_path):
    script = folder("cluster") / "slurm-array.sh"
    path = tmp_path / "s"
    environment = {
        **os.environ,
        "WAVEQUAKE": f"{sys.executable} -m wavequake",
        "STUDY": "tmt18-history",
        "STORE": str(path),
        "ARGUMENTS": "campaign.cases=8 store.chunk_cases=2 --allow-mixed",
    }
    words(
        "sbatch",
        "--array=0-1",
        "--mem=2000",
        f"--output={slurm}/%A_%a.out",
        str(script),
        env=environment,
    )
    emptied(120)
    report = verify_store(path)
    assert report.ok, report.lines()
    assert report.checked == 4
