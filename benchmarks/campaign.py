"""The main job: what a campaign spends its time on, beside the bare computation of the same cases.

``python -m benchmarks.campaign [CASES]``
"""

import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from wavequake.kernels.devices import choose_device
from wavequake.workflows.campaign import WORKFLOWS, profile, run_study
from wavequake.workflows.study import load_study


def main(cases: int = 200) -> None:
    study = load_study("tmt-segments", {"campaign.cases": cases})
    text, device = study.identity_text(), choose_device("auto").name
    workflow, chunk = WORKFLOWS[study.study.workflow], study.store.chunk_cases
    workflow.compute(text, np.arange(chunk), device)  # kernels and tables, which each process builds once
    print(f"campaign: tmt-segments, {cases} cases of 16 instants, one process, on {device}")
    start = time.process_time()
    with threadpool_limits(1):
        for first in range(0, cases, chunk):
            workflow.compute(text, np.arange(first, min(first + chunk, cases)), device)
    bare = time.process_time() - start
    with tempfile.TemporaryDirectory() as folder:
        store = Path(folder) / "store"
        start = time.process_time()
        run_study(study, store, on="serial")
        campaign = time.process_time() - start
        for name, value in profile(store).items():
            print(f"  {name:12} {value}")
    print(f"  bare loop {bare:.2f} s CPU, campaign {campaign:.2f} s CPU: {campaign / bare - 1:+.1%}")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
