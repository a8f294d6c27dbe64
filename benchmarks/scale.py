"""Very many cases: what the engine itself takes, with a workflow that computes nothing.

``python -m benchmarks.scale [CASES [CASES_PER_CHUNK]]``; a million in chunks of 1000 takes a minute.
"""

import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import psutil
from numpy.typing import NDArray

from wavequake.campaign.contract import ChunkResult, StudyKind, Template, Variable
from wavequake.campaign.engine.driver import run_campaign


def template(study: str) -> Template:
    return Template({"x": Variable((), (), {"units": "1", "long_name": "the case itself"})})


def case_table(study: str, first: int, last: int) -> dict[str, NDArray[np.generic]]:
    return {"realization": np.arange(first, last)}


def compute(study: str, cases: NDArray[np.int64], device: str) -> ChunkResult:
    return ChunkResult({"x": cases.astype(float)}, np.ones(len(cases), np.int8), ("",) * len(cases))


def main(cases: int = 100_000, chunk: int = 100) -> None:
    process, memory = psutil.Process(), []

    def watch(done: int, total: int, quarantined: int) -> None:
        if done % (total // 10) < chunk:
            memory.append(process.memory_info().rss / 2**20)

    workflow = StudyKind("nothing", template, case_table, compute)
    print(f"scale: {cases} cases that cost nothing, in {cases // chunk} chunks of {chunk}, 2 workers")
    with tempfile.TemporaryDirectory() as folder:
        begun, cpu = time.perf_counter(), time.process_time()
        summary = run_campaign(
            *(workflow, '{"study":{}}', Path(folder) / "store"),
            **{"cases": cases, "chunk": chunk, "device": "numpy", "on": "local", "workers": 2},
            progress=watch,
        )
        wall, cpu = time.perf_counter() - begun, time.process_time() - cpu
    print(f"  {wall:.1f} s, {cases / wall:.0f} cases/s, {summary.chunks / wall:.0f} chunks/s")
    print(f"  client and scheduler: {cpu / summary.chunks * 1e3:.1f} ms CPU per chunk")
    print(f"  writing: {summary.write_seconds / summary.chunks * 1e3:.1f} ms per chunk of 3 arrays, on disk")
    print("  memory of client and scheduler at every tenth, MB:", *(f"{value:.0f}" for value in memory))


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
