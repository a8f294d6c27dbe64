"""How fast this processor multiplies and adds, divides, takes roots and moves memory, in OpenCL C."""

from collections.abc import Callable
from functools import partial

import numpy as np

from wavequake.kernels.device.devices import Device
from wavequake.kernels.device.program import launch

ITEMS, ROUNDS, CHAINS = 256, {"multiply_add": 20000, "apart": 20000, "divide": 2000, "root": 2000}, 12
# Twelve vectors of eight are as many registers of AVX-512, of four those of AVX2: the faster one counts.
LANES = (4, 8)
TRIAD = 1 << 23

_STEPS = {
    "multiply_add": "{a} = {a} * factor + offset;",
    "apart": "{a} = {a} * factor; {a} = {a} + offset;",  # as without fused instructions
    "divide": "{a} = offset / {a};",
    "root": "#pragma unroll\n for (int i = 0; i < LANES; ++i) {a}[i] = __builtin_sqrt({a}[i]);",
}


def _source(kind: str, lanes: int) -> str:
    """Write a kernel of twelve independent chains of some lanes each, which hide any latency."""
    chains = [f"a{k}" for k in range(CHAINS)]
    start = " ".join(f"double{lanes} {a} = seed + {k}.0;" for k, a in enumerate(chains))
    body = "\n".join(_STEPS[kind].format(a=a) for a in chains)
    return f"""
#pragma OPENCL EXTENSION cl_khr_fp64 : enable
#pragma OPENCL FP_CONTRACT {"OFF" if kind == "apart" else "ON"}
__kernel void limit(const int rounds, const double seed, const double factor, const double offset,
                    __global double *out)
{{
    {start}
    for (int round = 0; round < rounds; ++round) {{
        {body}
    }}
    double{lanes} sum = {" + ".join(chains)};
    double total = 0.0;
    for (int i = 0; i < LANES; ++i)
        total += sum[i];
    out[get_global_id(1)] = total;
}}
"""


_TRIAD = """
#pragma OPENCL EXTENSION cl_khr_fp64 : enable
typedef double8 loose __attribute__((aligned(8)));
__kernel void triad(const double factor, __global const loose *a, __global const loose *b,
                    __global loose *out)
{
    size_t first = get_global_id(1) * 1024;
    for (int i = 0; i < 1024; ++i)
        out[first + i] = a[first + i] + factor * b[first + i];
}
"""


def limit_jobs(device: Device) -> tuple[dict[str, Callable[[], None]], dict[str, float]]:
    """Return jobs to be timed and what each does: operations (a multiply-add is one), or bytes."""
    out = np.empty(ITEMS)
    a, b, result = np.ones(TRIAD), np.ones(TRIAD), np.ones(TRIAD)

    def calculate(kind: str, lanes: int) -> None:
        numbers = [np.int32(ROUNDS[kind]), np.float64(1.5), np.float64(0.999), np.float64(1.1)]
        size = (1, ITEMS, 1)
        launch(device, "limit", (("LANES", lanes),), size, numbers, [out], _source(kind, lanes), 1)

    def move() -> None:
        size = (1, TRIAD // 8 // 1024, 1)
        launch(device, "triad", (), size, [np.float64(2.0), a, b], [result], _TRIAD, 1)

    jobs: dict[str, Callable[[], None]] = {"move": move}
    amounts = {"move": 24.0 * TRIAD}
    for kind, rounds in ROUNDS.items():
        for lanes in LANES:
            jobs[f"{kind} {lanes}"] = partial(calculate, kind, lanes)
            amounts[f"{kind} {lanes}"] = float(ITEMS * rounds * lanes * CHAINS)
    return jobs, amounts


def limits(speed: dict[str, float]) -> dict[str, float]:
    """Return the best of each kind of operation per second, from the medians of the jobs."""
    best = {kind: max(speed[f"{kind} {lanes}"] for lanes in LANES) for kind in ROUNDS}
    return best | {"move": speed["move"]}
