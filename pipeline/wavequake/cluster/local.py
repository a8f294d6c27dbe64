"""Dask on this machine: one single-threaded worker process per CPU, which answer to nobody else."""

import logging
import multiprocessing
import os
import signal
import socket
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib.util import find_spec
from multiprocessing import forkserver, resource_tracker
from typing import TYPE_CHECKING, Any

from wavequake.cluster.certificate import make_certificate, make_security
from wavequake.cluster.scratch import SETTING, scratch_folder
from wavequake.errors import NoWorkersError, UserError

if TYPE_CHECKING:
    from distributed import Client

# One thread per worker process: more would only get in each other's way, and the last bits of BLAS depend on
# their number.
THREADS = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "NUMBA_NUM_THREADS": "1",
    "POCL_MAX_PTHREAD_COUNT": "1",  # PoCL 3
    "POCL_CPU_MAX_CU_COUNT": "1",  # PoCL 4 and later
}
# Workers say nothing: what went wrong, the driver tells.
WORKER_ENVIRONMENT = {**THREADS, "DASK_LOGGING__DISTRIBUTED": "critical"}
# Would pin the one thread of every worker to the same CPU.
UNSET = ("POCL_AFFINITY",)

NO_HTTP = "wavequake.cluster.no_http"
STEADY_CLOCK = "wavequake.cluster.steady_clock"
_UNSEEN = {
    "distributed.worker.preload": [NO_HTTP, STEADY_CLOCK, "wavequake.cluster.output"],
    "distributed.worker.multiprocessing-method": "forkserver",
}
# What every worker imports: no thread runs afterwards, and OpenCL is not spoken to, so that it may be forked.
# SciPy's transforms load its special functions, its graphs all solvers: a tenth of a second of most studies.
_IMPORTED = (
    "wavequake.cluster.garbage",
    "distributed.nanny",
    NO_HTTP,
    STEADY_CLOCK,
    "wavequake.cluster.output",
    "pyopencl",
    "scipy.fft",
    "scipy.sparse.csgraph",
)

_KNOWN = ("wavequake.", "s3fs")
_prepared: set[int] = set()  # processes that have one to fork workers from

# A task takes seconds: slow clocks save idle CPU time, and as no result stays in memory, nobody has to manage
# it. A worker holds no task but the one it runs, so that its death is blamed on no other.
SETTINGS: dict[str, Any] = {
    "distributed.scheduler.worker-saturation": 1.0,
    "distributed.scheduler.work-stealing": False,  # nothing waits at a worker
    "distributed.scheduler.allowed-failures": 1,
    "distributed.scheduler.active-memory-manager.start": False,
    "distributed.admin.tick.interval": "5s",
    "distributed.admin.tick.cycle": "5s",
    "distributed.admin.tick.limit": "30s",
    "distributed.admin.system-monitor.interval": "30s",
    "distributed.client.scheduler-info-interval": "30s",
    "distributed.worker.profile.enabled": False,
    "distributed.worker.memory.monitor-interval": "1s",
    "distributed.nanny.pre-spawn-environ": {},
    # Workers serve no HTTP, to which everybody of a machine could talk.
    "distributed.worker.http.routes": [],
    "distributed.worker.preload": [NO_HTTP, STEADY_CLOCK],
    "distributed.scheduler.preload": [STEADY_CLOCK],
}
# Without a dashboard, neither does the scheduler.
NO_DASHBOARD: dict[str, Any] = {
    "distributed.scheduler.http.routes": [],
    "distributed.scheduler.preload": [NO_HTTP, STEADY_CLOCK],
}
# Between two reports of a worker. Few workers report twice a second by default, which costs their scheduler
# more than all tasks of a campaign; a death shows at once, by the connection.
_HEARTBEAT_S = 5.0
_LOOK_S = 1.0  # between two looks whether a worker has left
# By the ssl of Python 3.14 with OpenSSL 3.6 (CPython 148594); elsewhere Dask restarts workers undisturbed.
CONNECTIONS_BREAK = sys.version_info >= (3, 14)
_LEFT = ("closing", "closing_gracefully", "closed", "failed")

GUARDED = 'a script that starts processes must do so under `if __name__ == "__main__":`.'
_GUARD = 'a script that runs campaigns must do so under `if __name__ == "__main__":` or with on="serial".'


def start_of_processes() -> str:
    """Return how a process of its own starts: forked as workers are where they are; else anew."""
    return "forkserver" if os.getpid() in _prepared else "spawn"


def leave_if_imported_by_a_worker() -> None:
    """End this process quietly if it is a worker that runs the user's script because that has no guard."""
    if getattr(multiprocessing.current_process(), "_inheriting", False):
        sys.exit(1)


def prepare_workers(*modules: str) -> None:
    """Start the process that workers will be forked from, once, and do not wait for what it imports.

    It has a single thread and ends with this process. A worker that is forked, also in place of one that
    died, has the modules already.

    Raises
    ------
    UserError
        If the path of the folder for temporary files is too long for a socket in it.
    """
    leave_if_imported_by_a_worker()
    with worker_environment(), interrupts_blocked():
        # Modules of plug-ins are no files that can be found there; what fails to load would end that process.
        known = [name for name in modules if name.startswith(_KNOWN)]
        forkserver.set_forkserver_preload([*_IMPORTED, *known])
        try:
            forkserver.ensure_running()
            _prepared.add(os.getpid())
        except OSError as error:
            if "too long" not in str(error):
                raise
            raise UserError(
                f"workers need a socket in the folder for temporary files, and {tempfile.gettempdir()} is "
                "too long a path for that: set TMPDIR to a shorter one, as /tmp, or run with --on serial."
            ) from None


@contextmanager
def local_cluster(workers: int | None = None, dashboard: bool = False) -> Iterator["Client"]:
    """Start worker processes and yield the Dask client that feeds them.

    They listen on loopback, to connections that show the certificate of this run, which no file holds.

    Parameters
    ----------
    workers : int, optional
        Number of worker processes; by default one per CPU that this process may use.
    dashboard : bool
        Whether to serve Dask's dashboard, on loopback; `dashboard_link` of the client says where.

    Raises
    ------
    NoWorkersError
        If the worker processes do not start.
    UserError
        If the dashboard lacks its library.
    """
    if dashboard and find_spec("bokeh") is None:
        raise UserError("The dashboard needs Bokeh: pip install bokeh.")
    import dask
    from dask.system import CPU_COUNT
    from distributed import Client, LocalCluster

    prepare_workers()
    prepare_driver()
    with worker_environment(), dask.config.set(settings(dashboard) | _UNSEEN):
        client = None
        try:
            with interrupts_blocked():
                try:
                    cluster = LocalCluster(
                        n_workers=workers or CPU_COUNT,
                        threads_per_worker=1,
                        processes=True,
                        host="127.0.0.1",
                        dashboard_address=f"127.0.0.1:{_free_port(8787)}" if dashboard else None,
                        # Until it stops to (NO_DASHBOARD), the scheduler listens for HTTP: on loopback.
                        scheduler_kwargs={} if dashboard else {"dashboard_address": "127.0.0.1:0"},
                        security=make_security(make_certificate()),
                        memory_limit=memory_limit() // (workers or CPU_COUNT),
                        env=dict(os.environ),  # it may have changed since that process started
                        silence_logs=logging.CRITICAL,
                        scheduler_sync_interval=_HEARTBEAT_S,
                    )
                    if not dashboard:  # which shows what workers report
                        _calm(cluster.scheduler)
                    if CONNECTIONS_BREAK:
                        _keep(cluster, workers or CPU_COUNT)
                except (RuntimeError, AssertionError, OSError) as error:  # a daemon may have no children
                    raise NoWorkersError(f"The worker processes do not start ({error}): {_GUARD}") from None
                client = Client(cluster, set_as_default=False)
            yield client
        finally:
            if client is not None:
                _stop(client, cluster)


def settings(dashboard: bool) -> dict[str, Any]:
    """Return Dask's settings for campaigns."""
    ours = SETTINGS | {SETTING: scratch_folder()}
    return ours if dashboard else ours | NO_DASHBOARD


def _calm(scheduler: Any) -> None:
    """Have workers report seldom, and the scheduler not look all the time whether it is idle.

    It tells workers when to report next in its answer to each report.
    """
    answer = scheduler.handlers["heartbeat_worker"]

    def slowly(**report: Any) -> dict[str, Any]:
        return {**answer(**report), "heartbeat-interval": _HEARTBEAT_S}

    scheduler.handlers["heartbeat_worker"] = slowly
    for name in ("idle-timeout", "no-workers-timeout"):  # we set no such limits
        if name in scheduler.periodic_callbacks:
            scheduler.loop.add_callback(scheduler.periodic_callbacks[name].stop)


def _keep(cluster: Any, workers: int) -> None:
    """Start workers in place of those that left though nobody asked them to.

    Dask starts workers again that die. One whose connection to the scheduler breaks leaves for good; under
    Python 3.14 and OpenSSL 3.6 that happens while others connect.
    """
    from tornado.ioloop import PeriodicCallback

    def look() -> None:
        gone = [name for name, nanny in cluster.workers.items() if nanny.status.name in _LEFT]
        if gone and cluster.status.name == "running":
            for name in gone:
                scheduler.loop.add_callback(cluster.workers.pop(name).close)
            cluster.scale(workers)

    scheduler = cluster.scheduler
    scheduler.periodic_callbacks["keep-workers"] = looking = PeriodicCallback(look, 1e3 * _LOOK_S)
    scheduler.loop.add_callback(look)
    scheduler.loop.add_callback(looking.start)


def _stop(client: Any, cluster: Any) -> None:
    """End the workers at once: what they have finished is on disk, and nobody waits for the rest."""
    with interrupts_blocked():
        close(client, 2.0)
        for nanny in list(cluster.workers.values()):
            nanny.auto_restart = False
            if nanny.pid:
                with suppress(ProcessLookupError):
                    os.kill(nanny.pid, signal.SIGKILL)
        close(cluster, 5.0)


def close(what: Any, timeout_s: float) -> None:
    """Close a client or cluster of Dask; on a busy machine it may do the rest by itself."""
    with suppress(TimeoutError):
        what.close(timeout=timeout_s)


def _free_port(wanted: int) -> int:
    """Return `wanted` if nobody listens there, or 0, which means any."""
    with socket.socket() as probe:
        return 0 if probe.connect_ex(("127.0.0.1", wanted)) == 0 else wanted


def memory_limit() -> int:
    """Return the bytes of memory that this process may use: of the machine, or of its container."""
    from distributed.system import MEMORY_LIMIT

    return int(MEMORY_LIMIT)


def prepare_driver() -> None:
    """Keep Dask from logging in this process, and from waiting by a clock that may be set.

    For good, because threads of a closed cluster still log.
    """
    from wavequake.cluster.steady_clock import keep_time

    keep_time()
    for name in ("distributed", "distributed.client"):
        logging.getLogger(name).setLevel(logging.CRITICAL)


@contextmanager
def worker_environment() -> Iterator[None]:
    """Set the environment that worker processes inherit, also those that are started again after a crash."""
    names = (*WORKER_ENVIRONMENT, *UNSET)
    before = {name: os.environ.get(name) for name in names}
    os.environ.update(WORKER_ENVIRONMENT)
    for name in UNSET:
        os.environ.pop(name, None)
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name, None)
            if value is not None:
                os.environ[name] = value


@contextmanager
def interrupts_blocked() -> Iterator[None]:
    """Hold Ctrl-C back until the end, and keep it for good from processes and threads started inside."""
    came: list[int] = []
    in_main = threading.current_thread() is threading.main_thread()
    handler = signal.signal(signal.SIGINT, lambda number, frame: came.append(number)) if in_main else None
    resource_tracker.ensure_running()  # would unblock the signal again when it starts with the first process
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        if handler is not None:
            signal.signal(signal.SIGINT, handler)
        if came:
            signal.raise_signal(signal.SIGINT)
