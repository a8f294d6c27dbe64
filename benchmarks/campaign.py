"""What a campaign costs beside the bare computation of its cases, by role, and what a second worker gains.

``python -m benchmarks.campaign [CHUNKS_PER_PROCESS [ROUNDS]]`` takes 3 to 4 minutes. Overhead is CPU time
that each process counts itself; what Dask does by the clock (heartbeats) weighs more where other work slows
down the kernels. The gain of a second worker is compared with that of a second process which does nothing but
compute: two CPUs may be threads of one core. Campaigns and bare processes take turns, which of them is first
changes from round to round, and what counts are medians over the rounds.
"""

import multiprocessing
import sys
import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from multiprocessing.connection import Connection
from pathlib import Path
from statistics import median

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from wavequake.campaign.contract import ChunkResult
from wavequake.campaign.engine.driver import run_campaign
from wavequake.campaign.store.journal import read_journal
from wavequake.cluster.local import worker_environment
from wavequake.kernels.device.devices import choose_device
from wavequake.workflows.kinds import find_kind
from wavequake.workflows.run import chunk_of
from wavequake.workflows.study import load_study

STUDY = load_study("tmt-segments", {"campaign.cases": 4000})
TEXT, BARE = STUDY.identity_text(), find_kind(STUDY.study.workflow)
CHUNK, DEVICE = chunk_of(STUDY), choose_device("auto").name
WARM = 1  # chunks of each worker that do not count: kernels and tables are built


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
    """Rate in cases/s, CPU time in ms per chunk of all processes, and of that beside the kernels by role."""

    rate: float
    cpu: float
    beside: dict[str, float] = field(default_factory=dict)


def rate_of(starts: Iterable[Sequence[float]]) -> float:
    """Return the rate of processes, of which the times when each chunk began are known."""
    return sum(CHUNK / median(np.diff(times)) for times in starts)


@contextmanager
def bare_processes(most: int) -> Iterator[Callable[[int, int], Measured]]:
    """Start processes that only compute; yield what lets some of them compute so many chunks each."""
    context = multiprocessing.get_context("spawn")
    pipes = [context.Pipe() for _ in range(most)]
    processes = [context.Process(target=_loop, args=(theirs,), daemon=True) for _, theirs in pipes]
    with worker_environment():
        for process in processes:
            process.start()
    for ours, _ in pipes:
        ours.recv()

    def bare(count: int, chunks: int) -> Measured:
        for ours, _ in pipes[:count]:
            ours.send(chunks)
        found = [ours.recv() for ours, _ in pipes[:count]]
        cpu = median(step for _, times in found for step in np.diff(times))
        return Measured(rate_of(starts for starts, _ in found), 1e3 * cpu)

    yield bare
    for process in processes:
        process.kill()


def _loop(connection: Connection) -> None:
    BARE.compute(TEXT, np.arange(CHUNK), DEVICE)
    connection.send("ready")
    with threadpool_limits(1):
        while True:
            starts, cpu = [], []
            for index in range(connection.recv() + 1):
                starts.append(time.time())
                cpu.append(time.process_time())
                BARE.compute(TEXT, np.arange(index * CHUNK, (index + 1) * CHUNK), DEVICE)
            connection.send((starts, cpu))


def campaign(workers: int, chunks: int) -> Measured:
    """Run a campaign of so many chunks per worker, and those that do not count."""
    noted: list[tuple[float, float]] = []
    workflow = replace(BARE, compute=compute)
    with tempfile.TemporaryDirectory() as folder:
        store = Path(folder) / "store"
        run_campaign(
            *(workflow, TEXT, store),
            **{"cases": workers * (WARM + chunks + 1) * CHUNK, "chunk": CHUNK, "device": DEVICE},
            **{"on": "local", "workers": workers},
            progress=lambda *_: noted.append((time.process_time(), time.thread_time())),
        )
        found = sorted(read_journal(store / "done").records.values(), key=lambda one: one.timings["clock"])
    by_process: dict[int, list[Mapping[str, float]]] = defaultdict(list)
    for record in found:
        by_process[record.pid].append(record.timings)
    counted = [chunks[WARM:] for chunks in by_process.values()]
    busy = [step for some in counted for step in np.diff([one["cpu"] for one in some])]
    kernels = [one["bare"] for some in counted for one in some[:-1]]
    # The first call is before anything is done, and others come when chunks are.
    driver, client = np.subtract(noted[-1], noted[workers]) / (len(noted) - 1 - workers)
    beside = {
        "workers": median(np.subtract(busy, kernels)),
        "scheduler": driver - client,
        "client": client,
    }
    return Measured(
        rate_of([one["clock"] for one in some] for some in counted),
        1e3 * (median(busy) + driver),
        {name: 1e3 * value for name, value in beside.items()},
    )


def main(chunks: int = 3, rounds: int = 3) -> None:
    """Print each round, and the medians over all of them."""
    print(
        f"campaign: tmt-segments of {STUDY.cases} cases of 16 instants, in chunks of {CHUNK} (the default), "
        f"on {DEVICE}; {chunks} chunks per process and round"
    )
    overheads: dict[int, list[float]] = defaultdict(list)
    ratios = []
    with bare_processes(2) as bare:
        for index in range(rounds):
            ways = (bare, campaign) if index % 2 else (campaign, bare)
            found = {(way.__name__, n): way(n, chunks) for n in (1, 2) for way in ways}
            for workers in (1, 2):
                alone, ours = found["bare", workers], found["campaign", workers]
                overheads[workers].append(sum(ours.beside.values()) / alone.cpu)
                parts = ", ".join(f"{name} {value:.1f}" for name, value in ours.beside.items())
                print(
                    f"  {workers} worker(s): bare {alone.cpu:.0f} ms CPU per chunk; beside it {parts}: "
                    f"{overheads[workers][-1]:.2%} (all CPU time {ours.cpu / alone.cpu - 1:+.1%})"
                )
            gains = {way: found[way, 2].rate / found[way, 1].rate for way in ("bare", "campaign")}
            ratios.append(gains["campaign"] / gains["bare"])
            rates = ", ".join(f"{way} x{n} {one.rate:.1f}" for (way, n), one in sorted(found.items()))
            print(
                f"  cases/s: {rates}; two against one: bare {gains['bare']:.2f}, campaign "
                f"{gains['campaign']:.2f}, ratio {ratios[-1]:.3f}"
            )
    for workers, values in overheads.items():
        print(f"  overhead with {workers} worker(s): {median(values):.2%} (median of {rounds} rounds)")
    print(f"  gain of a second worker over that of a second process: {median(ratios):.3f} (median)")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
