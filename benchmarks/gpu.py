"""How fast a GPU traces: by its own clock and with all that the host does, beside the limits of the device.

Rates of ray-surfaces in float64. A trace of 492 segments and one of any system, of telescopes whose first
mirror has Zernike terms or none; medians of calls in turns. The limits are measured in the same run:
multiply-adds of independent chains, and what the device reads and writes of its own memory.
"""

import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks._verdict import Row, verdict
from benchmarks.raytrace import (
    ARITHMETIC,
    BATCH,
    BATCH_RAYS,
    BYTES,
    RAYS,
    WANTED,
    WAVELENGTH,
    disturbed,
    sunflower,
)
from benchmarks.raytrace import telescope as four_surfaces
from benchmarks.segmented import workload
from wavequake.kernels.device.devices import Device, list_devices
from wavequake.kernels.device.launches import kernel_launches, launches_since
from wavequake.kernels.device.program import device_copy, device_empty, launch
from wavequake.kernels.device.tiles import TILE
from wavequake.kernels.trace.segmented import trace_segmented
from wavequake.kernels.trace.sequential import trace_sequence
from wavequake.optics.rays.packing import moving, pack
from wavequake.optics.segments.catalog import telescope
from wavequake.optics.systems.system import States

REPEATS = 9
SURFACES = 4
TILES = 36  # as many as are traced in one launch
# Of ray-surfaces per second, demanded and aimed at.
DEMANDED, AIM = 1e10, 3e10
_DEMANDED_OF = ("492 segments, 0 terms", "492 segments, 28 terms", "10^6 rays, 28 terms")

CHAINS, ROUNDS, ITEMS = 8, 4096, 1 << 18
MOVED = 1 << 26
_LIMIT = """
#pragma OPENCL EXTENSION cl_khr_fp64 : enable
#pragma OPENCL FP_CONTRACT ON
__kernel void limit(const int rounds, const double factor, const double offset, __global double *out)
{
    double a[CHAINS];
    for (int k = 0; k < CHAINS; ++k)
        a[k] = get_global_id(1) + k;
    for (int round = 0; round < rounds; ++round)
        #pragma unroll
        for (int k = 0; k < CHAINS; ++k)
            a[k] = a[k] * factor + offset;
    double sum = 0.0;
    for (int k = 0; k < CHAINS; ++k)
        sum += a[k];
    out[get_global_id(1)] = sum;
}
"""
_MOVE = """
#pragma OPENCL EXTENSION cl_khr_fp64 : enable
__kernel void move(__global const double *from, __global double *to)
{
    to[get_global_id(1)] = from[get_global_id(1)];
}
"""


def limit_jobs(device: Device) -> tuple[dict[str, Callable[[], None]], dict[str, float]]:
    """Return jobs that are as fast as the device can be, and what each does: multiply-adds or bytes."""
    out, place = device_empty(device, (ITEMS,)), device_empty(device, (MOVED,))
    held, given = device_copy(device, np.ones(MOVED)), np.ones(MOVED // 8)

    def calculate() -> None:
        numbers = [np.int32(ROUNDS), np.float64(0.999), np.float64(1.1)]
        launch(device, "limit", (("CHAINS", CHAINS),), (1, ITEMS, 1), numbers, [out], _LIMIT, 128)

    def move() -> None:
        launch(device, "move", (), (1, MOVED, 1), [held], [place], _MOVE, 128)

    def bring() -> None:
        device_copy(device, given)

    jobs: dict[str, Callable[[], None]] = {"limit": calculate, "move": move, "bring": bring}
    return jobs, {"limit": float(ITEMS * CHAINS * ROUNDS), "move": 16.0 * MOVED, "bring": 8.0 * given.size}


def trace_jobs(device: Device) -> tuple[dict[str, Callable[[], Any]], dict[str, int]]:
    """Return traces by name, and how many ray-surfaces each is of."""
    jobs: dict[str, Callable[[], Any]] = {}
    counts: dict[str, int] = {}
    for terms in (0, 28):
        arguments = workload(telescope("tmt"), TILES, terms)
        name = f"492 segments, {terms} terms"
        jobs[name] = partial(trace_segmented, **arguments, device=device)
        counts[name] = TILES * TILE * arguments["ray_x"].size * SURFACES
    for terms in (28, 105):
        system, states = four_surfaces(terms), disturbed(terms, BATCH)
        sequence = pack(system, WAVELENGTH)
        motion, heights = states.surface_motion, states.deformations[0]
        still = States(0 * motion[:1], (heights[:1], None, None, None), np.zeros((1, 2)))
        for name, rays, light in (
            (f"10^6 rays, {terms} terms", sunflower(RAYS), moving(system, still)),
            (f"1000 instants of 2000 rays, {terms} terms", sunflower(BATCH_RAYS), moving(system, states)),
        ):
            kept = trace_sequence(sequence, rays, light, device, outputs=WANTED)
            jobs[name] = partial(trace_sequence, sequence, rays, light, device, outputs=WANTED, out=kept)
            counts[name] = SURFACES * rays.path.size * len(light.poses)
    return jobs, counts


def measure(jobs: dict[str, Callable[[], Any]]) -> dict[str, tuple[float, float]]:
    """Return the median seconds of each job: of its kernels by the device's clock, and by the wall."""
    found: dict[str, list[tuple[float, float]]] = {name: [] for name in jobs}
    for turn in range(REPEATS + 1):
        for name, job in jobs.items():
            before, start = kernel_launches(), time.perf_counter()
            job()
            spent = time.perf_counter() - start
            kernels = [s for key, s in launches_since(before).items() if key.startswith("kernel ")]
            if turn:  # the first one builds
                found[name].append((sum(kernels), spent))
    return {name: tuple(np.median(times, axis=0).tolist()) for name, times in found.items()}


def measured(device: Device, console: Console) -> list[Row]:
    """Print the rates of a device; return them beside what is demanded."""
    traces, counts = trace_jobs(device)
    limits, amounts = limit_jobs(device)
    seconds = measure(traces | limits)
    speed = {name: amount / seconds[name][name == "bring"] for name, amount in amounts.items()}
    console.print(
        f"{device.label}: {speed['limit']:.3g} multiply-adds/s, {speed['move']:.3g} bytes/s in its memory, "
        f"{speed['bring']:.3g} bytes/s from the host"
    )
    columns = Table("trace", "10^9 ray-surfaces/s", "with the host", "share of the bound", box=None)
    for name, count in counts.items():
        kernel, wall = seconds[name]
        terms = next((terms for terms in ARITHMETIC if f", {terms} terms" in name), 28)
        bound = SURFACES * min(speed["limit"] / ARITHMETIC[terms], speed["move"] / BYTES)
        columns.add_row(
            name, *(f"{count / s / 1e9:.3g}" for s in (kernel, wall)), f"{count / kernel / bound:.2f}"
        )
    console.print(columns)
    return [
        Row(f"{name}, by the device's clock", counts[name] / seconds[name][0], DEMANDED, AIM, unit="1/s")
        for name in _DEMANDED_OF
    ]


def main() -> None:
    """Measure the first GPU, if there is one."""
    console = Console(width=150)
    devices = [device for device in list_devices() if device.kind == "gpu"]
    if not devices:
        reason = "there is no GPU"
        console.print(verdict([Row("ray-surfaces on a GPU", None, DEMANDED, AIM, True, "1/s", reason)]))
        return
    console.print(verdict(measured(devices[0], console)))


if __name__ == "__main__":
    main()
