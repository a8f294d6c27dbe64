"""What another user of the machine can do to a campaign that runs on it: nothing."""

import os
import re
import ssl
import stat
import subprocess
import sys
from pathlib import Path

import dask
import psutil
import pytest
from distributed import Client, LocalCluster
from distributed.security import Security
from test_local import until

from wavequake.cluster.certificate import certificate_file, make_certificate, make_security
from wavequake.cluster.local import local_cluster, prepare_workers
from wavequake.errors import UserError

ATTACK = Path(__file__).with_name("attack.py")


def ports():
    """Return the ports that this process and its children listen on."""
    us = psutil.Process()
    found = [one for process in (us, *us.children(recursive=True)) for one in process.net_connections("tcp")]
    return sorted({one.laddr.port for one in found if one.status == "LISTEN"})


def attack(folder, *where):
    """Attack from a process of its own and return the traces that were left."""
    file = folder / "traces"
    done = subprocess.run(
        [sys.executable, "-W", "ignore", ATTACK, file, *map(str, where)],
        capture_output=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return file.read_text() if file.exists() else ""


def test_nobody_else_runs_code_in_workers_or_driver(tmp_path):
    before = set(ports())
    with local_cluster(2) as client:
        listening = set(ports()) - before
        assert len(listening) == 5  # a scheduler, two workers, and the nannies that watch over them: no HTTP
        assert attack(tmp_path, *listening) == ""
        assert client.submit(abs, -1).result() == 1


class Gullible(Security):
    """Encrypts, and asks nobody for a certificate."""

    def get_listen_args(self, role):
        arguments = super().get_listen_args(role)
        arguments["ssl_context"].verify_mode = ssl.CERT_NONE
        return arguments


@pytest.mark.parametrize(
    ("security", "ways"),
    [
        (Security(), {"tcp, without encryption"}),
        (Gullible.temporary(), {"tls, without certificate", "tls, with a certificate of its own"}),
    ],
    ids=["open", "gullible"],
)
def test_the_attack_succeeds_where_nobody_asks_for_certificates(tmp_path, security, ways):
    prepare_workers()  # a worker that is forked loads nothing
    place = {"host": "127.0.0.1", "dashboard_address": "127.0.0.1:0"}
    with (
        dask.config.set({"distributed.worker.multiprocessing-method": "forkserver"}),
        LocalCluster(1, threads_per_worker=1, security=security, **place) as cluster,
    ):
        scheduler = cluster.scheduler
        parts = [scheduler.address, *scheduler.workers]
        where = [int(address.rpartition(":")[2]) for address in parts]
        traces = attack(tmp_path, *where, scheduler.http_server.port)
    for way in ways:
        scheme, how = way.split(", ")
        assert re.search(rf"command to {scheme}://127.0.0.1:\d+, {how},", traces)
        assert re.search(rf"task of a client of {scheme}://127.0.0.1:\d+, {how},", traces)
    assert "HTTP of 127.0.0.1:" in traces
    assert f"in process {os.getpid()}\n" in traces  # of this process, which holds the scheduler


def test_the_certificate_of_another_run_is_of_no_use():
    with local_cluster(1) as client:
        address = client.scheduler.address
        with pytest.raises(OSError, match=r"certificate|timed out|closed"):
            Client(address, security=make_security(make_certificate()), timeout=2, set_as_default=False)


def test_a_worker_that_is_started_again_serves_no_http_either():
    with local_cluster(1) as client:
        before = set(ports())
        (pid,) = client.run(os.getpid).values()
        psutil.Process(pid).kill()

        def again():
            return client.run(os.getpid, on_error="return").values()

        assert until(lambda: [one for one in again() if isinstance(one, int) and one != pid])
        assert len(set(ports())) == len(before)


def test_a_certificate_in_a_file_is_for_the_user_alone_and_goes_with_the_run(tmp_path):
    with certificate_file(tmp_path) as file:
        assert stat.S_IMODE(file.parent.stat().st_mode) == 0o700
        assert file.read_text().count("-----BEGIN") == 2
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(UserError, match="`shared_directory` in the cluster file must name"):
        certificate_file(tmp_path / "nowhere").__enter__()
