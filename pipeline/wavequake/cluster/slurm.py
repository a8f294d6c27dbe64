"""Dask workers as jobs of Slurm, by dask-jobqueue; the scheduler is in this process."""

import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from importlib.util import find_spec
from pathlib import Path
from shutil import which
from subprocess import run
from threading import Event, Thread
from typing import TYPE_CHECKING, Any

from wavequake.cluster.certificate import certificate_file
from wavequake.cluster.local import (
    NO_HTTP,
    STEADY_CLOCK,
    THREADS,
    UNSET,
    close,
    interrupts_blocked,
    prepare_driver,
    settings,
)
from wavequake.cluster.scratch import scratch_lines
from wavequake.cluster.template import Slurm, Tls, tls_settings
from wavequake.errors import UserError

if TYPE_CHECKING:
    from distributed import Client

LOOK_S = 10.0  # between two looks at Slurm's queue


@contextmanager
def slurm_cluster(template: Slurm, workers: int | None, dashboard: bool) -> Iterator["Client"]:
    """Submit jobs, keep their number while some end, and yield the Dask client; at last end them.

    Without certificates in the template, one is made for this run, in a file that the jobs read.

    Parameters
    ----------
    template : Slurm
        What to ask Slurm for.
    workers : int, optional
        Number of worker processes, rounded up to whole jobs; by default those of the template's jobs.
    dashboard : bool
        Whether the dashboard of the scheduler is told of; it listens on loopback.

    Raises
    ------
    UserError
        If dask-jobqueue or Slurm's commands are not installed, Slurm refuses the jobs, or the certificate
        cannot be written.
    """
    if find_spec("dask_jobqueue") is None:
        raise UserError("--on slurm needs dask-jobqueue: pip install dask-jobqueue.")
    if which("sbatch") is None:
        raise UserError("--on slurm needs the command sbatch: run it on a machine that can submit jobs.")
    import dask

    with interrupts_blocked():  # the library takes Ctrl-C for itself, which this undoes
        from dask_jobqueue import SLURMCluster
    from distributed import Client
    from distributed.security import Security

    prepare_driver()
    jobs = template.jobs if workers is None else -(-workers // template.processes)
    with ExitStack() as until_the_end:
        tls = template.tls
        if tls is None:
            shared = Path(template.shared_directory).expanduser()
            file = str(until_the_end.enter_context(certificate_file(shared)))
            tls = Tls.model_construct(ca=file, certificate=file, key=file)
        until_the_end.enter_context(dask.config.set(settings(dashboard) | tls_settings(tls)))
        try:
            with interrupts_blocked():
                cluster = SLURMCluster(
                    queue=template.partition,
                    account=template.account,
                    cores=template.processes,
                    processes=template.processes,
                    memory=template.memory,
                    walltime=template.walltime,
                    interface=template.interface,
                    python=template.python or sys.executable,
                    log_directory=template.log_directory,
                    job_extra_directives=list(template.directives),
                    job_script_prologue=prologue(template),
                    worker_extra_args=["--preload", NO_HTTP, "--preload", STEADY_CLOCK, "--no-dashboard"],
                    protocol="tls://",
                    security=Security(),
                    scheduler_options={
                        "interface": template.interface,
                        "dashboard_address": "127.0.0.1:0",
                        "dashboard": dashboard,
                    },
                )
                client = Client(cluster, set_as_default=False)
        except (OSError, RuntimeError, ValueError) as error:
            raise UserError(f"The jobs of Slurm do not start ({' '.join(str(error).split())}).") from None
        fruitful, over, hopeless = Event(), Event(), Event()
        try:
            cluster.scale(jobs=jobs)
            Thread(target=_replace_lost, args=(cluster, jobs, fruitful, over, hopeless), daemon=True).start()
            _wait(client, hopeless)
            fruitful.set()
            yield client
        finally:
            over.set()
            with interrupts_blocked():
                close(client, 2.0)
                close(cluster, 10.0)


def _replace_lost(cluster: Any, jobs: int, fruitful: Event, over: Event, hopeless: Event) -> None:
    """Submit jobs again that have left Slurm's queue: they were killed, or came to the end of their time.

    Where jobs end although there never was a worker, others would, too: that is hopeless.
    """

    async def close(names: set[Any]) -> None:
        for name in names:
            await cluster.workers.pop(name).close()

    while not over.wait(LOOK_S):
        submitted = dict(cluster.workers)  # before we ask: what comes later is not in the answer
        found = run(["squeue", "--me", "-h", "-o", "%A %T"], capture_output=True, text=True, check=False)
        if found.returncode:
            continue  # Slurm does not answer now
        # Slurm may tidy up for minutes after a job that has ended.
        lines = [line.split() for line in found.stdout.splitlines()]
        queue = {number for number, state in lines if state != "COMPLETING"}
        gone = {name for name, job in submitted.items() if job.job_id and str(job.job_id) not in queue}
        if gone and not fruitful.is_set():
            hopeless.set()
            return
        if gone:
            with suppress(RuntimeError, OSError):  # scancel says that the job has gone already
                cluster.sync(close, gone)
            cluster.scale(jobs=jobs)


def _wait(client: "Client", hopeless: Event) -> None:
    while not client.nthreads():
        with suppress(TimeoutError):
            client.wait_for_workers(1, timeout=2)
        if hopeless.is_set():
            raise UserError(
                "The jobs of Slurm end before they have a worker: their output (log_directory) says why."
            )


def prologue(template: Slurm) -> list[str]:
    """Return what a job's script does before it starts workers.

    Modules, one thread for each worker, and a folder for their files that nobody else can write.
    """
    return [
        *(f"module load {name}" for name in template.modules),
        *(f"export {name}={value}" for name, value in THREADS.items()),
        *(f"unset {name}" for name in UNSET),
        *scratch_lines(template.local_directory),
    ]
