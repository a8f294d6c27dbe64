import gc
import os
import signal
import subprocess
import sys
import threading
import time
from contextlib import suppress

import psutil
import pytest

from wavequake.cluster.address import connected
from wavequake.cluster.local import interrupts_blocked, local_cluster
from wavequake.errors import UserError


def environment(names):
    return {name: os.environ.get(name) for name in names}


def listening(pid):
    process = psutil.Process(pid)
    return {
        c.laddr.ip
        for p in (process, *process.children(recursive=True))
        for c in p.net_connections("tcp")
        if c.status == "LISTEN"
    }


def test_workers_are_single_threaded_local_and_gone_afterwards(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "8")
    monkeypatch.setenv("POCL_AFFINITY", "1")
    names = (
        "OMP_NUM_THREADS",
        "OPENBLAS_NUM_THREADS",
        "MKL_NUM_THREADS",
        "POCL_MAX_PTHREAD_COUNT",
        "POCL_AFFINITY",
    )
    with local_cluster(2) as client:
        assert list(client.nthreads().values()) == [1, 1]
        for found in client.run(environment, names).values():
            assert list(found.values()) == ["1", "1", "1", "1", None]
        pids = client.run(os.getpid).values()
        assert listening(os.getpid()) == {"127.0.0.1"}
    assert not any(psutil.pid_exists(pid) for pid in pids)
    assert os.environ["OMP_NUM_THREADS"] == "8"
    assert os.environ["POCL_AFFINITY"] == "1"


def test_an_address_without_a_scheduler_is_one_sentence():
    with (
        pytest.raises(UserError, match=r"No Dask scheduler answers at tcp://127.0.0.1:1"),
        connected("tcp://127.0.0.1:1", timeout_s=0.2),
    ):
        pass


def test_a_folder_for_temporary_files_that_is_too_deep_for_sockets_is_one_sentence(tmp_path):
    deep = tmp_path / ("x" * 100)
    deep.mkdir()
    script = (
        "from wavequake.cluster.local import prepare_workers\n"
        "from wavequake.errors import UserError\n"
        "try:\n    prepare_workers()\nexcept UserError as error:\n    print(error)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script],
        env={**os.environ, "TMPDIR": str(deep)},
        capture_output=True,
        text=True,
        check=True,
    )
    assert f"{deep} is too long a path for that: set TMPDIR" in done.stdout


def test_interrupts_wait_until_they_may_come():
    steps = []
    other_threads_take_signals_too = threading.Thread(target=time.sleep, args=(0.2,))
    other_threads_take_signals_too.start()

    def interrupted():
        with interrupts_blocked():
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(0.05)
            steps.append("went on")

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert steps == ["went on"]
    other_threads_take_signals_too.join()


@pytest.mark.parametrize(
    ("module", "absent"),
    [
        ("campaign.engine.driver", ["dask"]),
        # SciPy loads these when they are first used, which few studies do; each takes half a second.
        ("workflows.run", ["dask", "matplotlib", "scipy.signal", "scipy.special", "scipy.stats"]),
        (
            "workflows.segments.disturbance",
            ["pandas", "scipy.optimize", "scipy.spatial", "scipy.special", "zarr"],
        ),
        ("campaign.store.status", ["numcodecs", "xarray", "zarr"]),
        ("report.campaign", ["matplotlib"]),
        ("report.segments.report", ["matplotlib"]),  # whose table a complete store shows again
        (
            "drawing.draw",
            ["wavequake.workflows.mirrors.study", "wavequake.workflows.lens.study"],
        ),
    ],
)
def test_importing_wavequake_is_quick_because_much_stays_out(module, absent):
    code = f"import sys, wavequake.{module}; sys.exit(any(n in sys.modules for n in {absent}))"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    assert subprocess.run([sys.executable, "-c", code], env=environment, check=False).returncode == 0


def test_two_campaigns_run_at_the_same_time():
    with local_cluster(1) as one, local_cluster(1) as other:
        assert one.submit(abs, -1).result() == other.submit(abs, -1).result() == 1


def until(condition, seconds=10.0):
    end = time.monotonic() + seconds
    while not condition() and time.monotonic() < end:
        time.sleep(0.1)
    return condition()


def leave(dask_worker):
    dask_worker.loop.add_callback(dask_worker.close_gracefully, restart=False)


def test_a_worker_that_leaves_unasked_is_replaced(monkeypatch):
    monkeypatch.setattr("wavequake.cluster.local.CONNECTIONS_BREAK", True)  # as under Python 3.14
    with local_cluster(2) as client:
        before = set(client.nthreads())
        gone = min(before)
        client.run(leave, workers=[gone])
        assert until(lambda: gone not in client.nthreads() and len(client.nthreads()) == 2, 20.0)
        time.sleep(2.5)  # looks
        assert set(client.nthreads()) & before == before - {gone}
        assert len(client.nthreads()) == len(client.cluster.worker_spec) == 2


def pause_between_reports(dask_worker):
    return dask_worker.periodic_callbacks["heartbeat"].callback_time / 1e3


def test_workers_take_their_time_between_reports():
    with local_cluster(1) as client:
        assert until(lambda: min(client.run(pause_between_reports).values()) >= 5.0)
        assert client.cluster.scheduler.extensions["amm"].running is False


def test_workers_look_for_garbage_seldom_and_never_in_what_they_share():
    with local_cluster(1) as client:
        assert min(client.run(gc.get_freeze_count).values()) > 50_000
        assert min(client.run(gc.get_threshold).values())[0] == 50_000


def place_in_the_tree(names):
    me = psutil.Process()
    loaded = {name: name in sys.modules for name in names}
    return me.ppid(), me.parent().num_threads(), loaded, "pyopencl" in sys.modules


def test_workers_are_forked_from_a_process_of_one_thread_that_has_loaded():
    """Also in place of one that died; what it may not have done yet is to speak to OpenCL."""
    names = ["distributed.nanny", "wavequake.cluster.output"]
    with local_cluster(1) as client:
        (before,) = client.run(place_in_the_tree, names).values()
        (pid,) = client.run(os.getpid).values()

        def another():
            with suppress(OSError):  # the connection to the one that died
                return [found for found in client.run(os.getpid).values() if found != pid]
            return []

        os.kill(pid, signal.SIGKILL)
        assert until(another, 20.0)
        (after,) = client.run(place_in_the_tree, names).values()
    assert before == after
    parent, threads, loaded, opencl = before
    assert parent != os.getpid()
    assert threads == 1
    assert all(loaded.values())
    assert opencl


def test_what_the_environment_says_reaches_workers_that_are_forked_later(monkeypatch):
    with local_cluster(1):
        pass
    monkeypatch.setenv("WAVEQUAKE_SAYS", "now")
    with local_cluster(1) as client:
        assert list(client.run(environment, ["WAVEQUAKE_SAYS"]).values()) == [{"WAVEQUAKE_SAYS": "now"}]
