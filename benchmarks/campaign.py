"""What a campaign costs beside the bare computation of its cases, by role, and what a second worker gains.

``python -m benchmarks.campaign [CHUNKS_PER_PROCESS [ROUNDS]]`` takes 2 to 3 minutes. Overhead is CPU time
that each process counts itself; what Dask does by the clock (heartbeats) weighs more where other work slows
down the kernels. The gain of a second worker is compared with that of a second process which does nothing but
compute: two CPUs may be threads of one core. Both are measured in turn; medians.
"""

import multiprocessing
import sys
import tempfile
import threading
import time
from collections import defaultdict
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from pathlib import Path
from statistics import median

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from wavequake.cluster.local import worker_environment
from wavequake.kernels.devices import choose_device
from wavequake.workflows.campaign import WORKFLOWS, chunk_of
from wavequake.workflows.contract import ChunkResult
from wavequake.workflows.engine import run_campaign
from wavequake.workflows.journal import read_journal
from wavequake.workflows.study import load_study

STUDY = load_study("tmt-segments", {"campaign.cases": 1000})
TEXT, BARE = STUDY.identity_text(), WORKFLOWS[STUDY.study.workflow]
CHUNK, DEVICE = chunk_of(STUDY), choose_device("auto").name
WARM = 1  # chunks of each process that do not count: kernels and tables are built


def compute(study: str, cases: NDArray[np.int64], device: str) -> ChunkResult:
    """Compute as the workflow does, and note CPU time and clock."""
    clock, cpu, dask = time.time(), time.process_time(), _main_thread_s()
    result = BARE.compute(study, cases, device)
    bare = time.process_time() - cpu - (_main_thread_s() - dask)
    return replace(result, timings={"clock": clock, "cpu": cpu, "bare": bare})


def _main_thread_s() -> float:
    """CPU time of a worker's main thread, which is all Dask's; the chunk is computed in another one."""
    main = threading.main_thread()
    assert main.ident is not None
    if threading.current_thread() is main:
        return 0.0
    return time.clock_gettime(time.pthread_getcpuclockid(main.ident))


@dataclass(frozen=True)
class Measured:
    """Rate in cases/s, and CPU times in ms per chunk by role."""

    rate: float
    roles: dict[str, float]


def of_processes(starts: dict[int, list[float]]) -> float:
    """Return the rate of processes, of which the times when each chunk began are known."""
    return sum(CHUNK / median(np.diff(times[WARM:])) for times in starts.values())


def bare(processes: int, chunks: int) -> Measured:
    context = multiprocessing.get_context("spawn")
    pipes = [context.Pipe() for _ in range(processes)]
    with worker_environment():
        for _, theirs in pipes:
            context.Process(target=_loop, args=(theirs, chunks), daemon=True).start()
    for ours, _ in pipes:
        ours.recv()
    for ours, _ in pipes:
        ours.send("go")
    return Measured(of_processes({index: ours.recv() for index, (ours, _) in enumerate(pipes)}), {})


def _loop(connection: Connection, chunks: int) -> None:
    BARE.compute(TEXT, np.arange(CHUNK), DEVICE)
    connection.send("ready")
    connection.recv()
    starts = []
    with threadpool_limits(1):
        for index in range(chunks):
            starts.append(time.time())
            BARE.compute(TEXT, np.arange(index * CHUNK, (index + 1) * CHUNK), DEVICE)
    connection.send([*starts, time.time()])


def campaign(workers: int, chunks: int) -> Measured:
    noted: list[tuple[float, float]] = []
    workflow = replace(BARE, compute=compute)
    with tempfile.TemporaryDirectory() as folder:
        store = Path(folder) / "store"
        run_campaign(
            *(workflow, TEXT, store),
            **{"cases": workers * (chunks + WARM) * CHUNK, "chunk": CHUNK, "device": DEVICE},
            **{"on": "local", "workers": workers},
            progress=lambda *_: noted.append((time.process_time(), time.thread_time())),
        )
        found = sorted(read_journal(store / "done").records.values(), key=lambda one: one.timings["clock"])
    starts, cpu, alone = defaultdict(list), defaultdict(list), []
    for record in found:
        starts[record.pid].append(record.timings["clock"])
        cpu[record.pid].append(record.timings["cpu"])
        alone.append(record.timings["bare"])
    kernels = median(alone[workers * WARM :])
    busy = median([step for times in cpu.values() for step in np.diff(times[WARM:])])
    # The first call is before anything is done, and others come when chunks are.
    driver, client = np.subtract(noted[-1], noted[workers]) / (len(noted) - 1 - workers)
    roles = {
        "kernels": kernels,
        "workers beside": busy - kernels,
        "scheduler": driver - client,
        "client": client,
    }
    return Measured(of_processes(starts), {name: 1e3 * value for name, value in roles.items()})


def main(chunks: int = 4, rounds: int = 2) -> None:
    print(f"campaign: tmt-segments in chunks of {CHUNK} cases of 16 instants on {DEVICE}; medians")
    gains = []
    for _ in range(rounds):
        found = {(f, n): f(n, chunks) for n in (1, 2) for f in (bare, campaign)}
        for workers in (1, 2):
            roles = found[campaign, workers].roles
            beside = sum(roles.values()) - roles["kernels"]
            parts = ", ".join(f"{name} {value:.1f}" for name, value in roles.items())
            print(
                f"  {workers} worker(s), ms CPU per chunk: {parts}; overhead {beside / roles['kernels']:.2%}"
            )
        speedups = {f: found[f, 2].rate / found[f, 1].rate for f in (bare, campaign)}
        gains.append(speedups[campaign] / speedups[bare])
        rates = ", ".join(f"{f.__name__} x{n} {one.rate:.1f}" for (f, n), one in found.items())
        print(
            f"  cases/s: {rates}; two against one: bare {speedups[bare]:.2f}, campaign "
            f"{speedups[campaign]:.2f}, ratio {gains[-1]:.3f}"
        )
    print(f"  ratio of the gains of a second worker and a second process: {max(gains):.3f} at best")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
