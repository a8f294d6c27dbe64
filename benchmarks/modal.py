"""Cases per second of the modal model, by disturbance, beside full traces: medians over chunks of cases.

``python -m benchmarks.modal [CASES]``
"""

import sys
import time
from statistics import median

import numpy as np
from rich.console import Console
from threadpoolctl import threadpool_limits

from benchmarks._processor import slowness
from benchmarks._verdict import Row, verdict
from wavequake.campaign.stopwatch import CPU
from wavequake.kernels.device.devices import choose_device
from wavequake.mechanics.disturbances.sources.common_history import (
    CommonHistory,
    amplitudes_of_run,
)
from wavequake.workflows.segments import disturbance as workflow
from wavequake.workflows.segments.study import SegmentStudy
from wavequake.workflows.study import load_study, study_with

CHUNK = 4096
_TOGETHER = 512  # cases that draw at once
# Cases of ten instants that are drawn one by one, and how many of them to time.
OTHERS = {
    "static-random": ({"piston_nm": 20.0, "tip_nrad": 20.0, "tilt_nrad": 20.0}, 1024),
    "segment-history": ({}, 256),
    "segment-wind": ({}, 64),
    "edge-sensor-noise": ({}, 64),
    "line-of-sight": ({}, 256),
}

DEMANDED = ("segment-wind", "edge-sensor-noise")


def seconds_of(study, first: int, cases: int, device: str) -> tuple[float, dict[str, float]]:
    """Return the CPU time of a chunk of cases, and its parts, after what a process does once."""
    text = study.identity_text()
    workflow.KIND.compute(text, np.arange(first - 8, first), device)
    start = time.process_time()
    found = workflow.KIND.compute(text, np.arange(first, first + cases), device)
    return time.process_time() - start, dict(found.timings)


def random_numbers(device: str) -> None:
    parameters = CommonHistory(name="swing")
    for distribution in ("gaussian", "uniform"):
        one = parameters.model_copy(update={"piston_distribution": distribution})
        amplitudes_of_run(one, 492, 1, 0, 1, choose_device(device))  # loads what it takes
        start = time.process_time()
        amplitudes_of_run(one, 492, 1, 1, _TOGETHER, choose_device(device))
        rate = _TOGETHER * 492 / (time.process_time() - start)
        print(f"  random numbers, {distribution:8} {rate / 1e6:8.1f} M/s")


def main(cases: int = 100_000) -> None:
    device = choose_device("auto").name
    million = load_study("tmt-million")
    print(f"modal: 492 segments, ten instants, j <= 45, summaries; CPU time of one process, on {device}")
    with threadpool_limits(1):
        random_numbers(device)
        each, parts = [], {}
        for first in range(CHUNK, CHUNK + cases, CHUNK):
            count = min(CHUNK, CHUNK + cases - first)
            seconds, timings = seconds_of(million, first, count, device)
            each.append(seconds / count * 1e6)
            for name, value in timings.items():
                if name.startswith(CPU):
                    parts[name.removeprefix(CPU)] = parts.get(name.removeprefix(CPU), 0.0) + value
        shares = ", ".join(f"{name} {value / sum(parts.values()):.0%}" for name, value in parts.items())
        case = median(each)
        print(f"  common-history    {cases} cases: {case:7.1f} us per case ({shares})")
        rows = [Row("a certified case of tmt-million, CPU", case, 30.0, 15.0, least=False, unit="us")]
        print(f"                    a million: {case:.0f} s, one in 1000 traced in full")
        for model, (keys, count) in OTHERS.items():
            entry = {"name": model, "model": model, "instants": 10, **keys}
            study = SegmentStudy.model_validate({**million.model_dump(mode="json"), "disturbance": [entry]})
            study = study_with(study, {"optics.modal_sample": 0.0})
            standard = study_with(study, {"optics.light": "traced"})
            modal, full = (
                median(seconds_of(one, 1024 + k * many, many, device)[0] for k in range(5)) / many
                for one, many in ((study, count), (standard, min(count, 64)))
            )
            print(
                f"  {model:17} {modal * 1e6:9.0f} us per case, {1 / modal:7.0f} cases/s; "
                f"full traces {full * 1e6:7.0f} us"
            )
            if model in DEMANDED:
                rows.append(
                    Row(f"a case of {model}, modal, CPU", 1e3 * modal, 1.5, 0.8, least=False, unit="ms")
                )
    slower = slowness()
    print(f"libraries alone take {slower:.2f} times as long as on the Zen 4 that met what is demanded")
    Console(width=120).print(verdict(row._replace(slower=slower) for row in rows))


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
