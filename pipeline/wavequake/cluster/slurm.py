"""Dask workers as jobs of Slurm, by dask-jobqueue; the scheduler is in this process."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib.util import find_spec
from shutil import which
from threading import Event, Thread
from typing import TYPE_CHECKING, Any

from wavequake.cluster.local import SETTINGS, THREADS, UNSET, interrupts_blocked, silence
from wavequake.cluster.template import Slurm, tls_settings
from wavequake.errors import UserError

if TYPE_CHECKING:
    from distributed import Client

LOOK_S = 10.0  # between two looks at what jobs have workers


@contextmanager
def slurm_cluster(template: Slurm, workers: int | None, dashboard: bool) -> Iterator["Client"]:
    """Submit jobs, keep their number while some end, and yield the Dask client; at last end them.

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
        If dask-jobqueue or Slurm's commands are not installed, or Slurm refuses the jobs.
    """
    if find_spec("dask_jobqueue") is None:
        raise UserError("--on slurm needs dask-jobqueue: pip install 'wavequake[slurm]'.")
    if which("sbatch") is None:
        raise UserError("--on slurm needs the command sbatch: run it on a machine that can submit jobs.")
    import dask
    from dask_jobqueue import SLURMCluster
    from distributed import Client
    from distributed.security import Security

    silence()
    jobs = template.jobs if workers is None else -(-workers // template.processes)
    settings = {**SETTINGS, **tls_settings(template.tls)}
    with dask.config.set(settings):
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
                    local_directory=template.local_directory,
                    log_directory=template.log_directory,
                    job_extra_directives=list(template.directives),
                    job_script_prologue=prologue(template),
                    protocol="tls://" if template.tls else "tcp://",
                    security=Security() if template.tls else None,
                    scheduler_options={
                        "interface": template.interface,
                        "dashboard_address": "127.0.0.1:0",
                        "dashboard": dashboard,
                    },
                )
                client = Client(cluster, set_as_default=False)
        except (OSError, RuntimeError, ValueError) as error:
            raise UserError(f"The jobs of Slurm do not start ({' '.join(str(error).split())}).") from None
        over = Event()
        try:
            cluster.scale(jobs=jobs)
            Thread(target=_replace_lost, args=(cluster, jobs, over), daemon=True).start()
            client.wait_for_workers(1)
            yield client
        finally:
            over.set()
            with interrupts_blocked():
                client.close(timeout=2)
                cluster.close(timeout=10)


def _replace_lost(cluster: Any, jobs: int, over: Event) -> None:
    """Submit jobs again whose workers have all gone: they were killed, or came to the end of their time.

    Jobs that wait in Slurm's queue have had no workers yet, and a worker that crashed is back within seconds.
    """
    seen: set[Any] = set()
    lost: set[Any] = set()

    async def close(names: set[Any]) -> None:
        for name in names:
            await cluster.workers.pop(name).close()

    while not over.wait(LOOK_S):
        workers = [str(info["name"]) for info in cluster.scheduler_info["workers"].values()]
        alive = {
            job for job in cluster.workers if any(f"{worker}-".startswith(f"{job}-") for worker in workers)
        }
        lost_before, lost = lost, (seen & set(cluster.workers)) - alive
        seen = (seen | alive) - (gone := lost & lost_before)
        if gone:
            with suppress(RuntimeError, OSError):  # scancel says that the job has gone already
                cluster.sync(close, gone)
            cluster.scale(jobs=jobs)


def prologue(template: Slurm) -> list[str]:
    """Return what a job's script does before it starts workers: modules, and one thread for each of them."""
    return [
        *(f"module load {name}" for name in template.modules),
        *(f"export {name}={value}" for name, value in THREADS.items()),
        *(f"unset {name}" for name in UNSET),
    ]
