"""How fast two-dimensional Fourier transforms are, and how exact.

Square complex images, float32 and float64, one thread: the OpenCL kernels against SciPy, and against MKL
(mkl_fft) and FFTW (pyfftw, planned by measuring) if they are installed. All but SciPy, which cannot, write to
an array that is there already. Measurements are interleaved, each some 50 ms long after 0.1 s of the same;
medians of same-run ratios are what to compare between machines. Run it with POCL_MAX_PTHREAD_COUNT=1. Errors
are the largest differences from SciPy's float64 transform, relative to its largest number.
"""

import os
import time
from collections.abc import Callable

import numpy as np
import scipy.fft
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from benchmarks._verdict import Row, verdict
from benchmarks._warm import warm
from wavequake.kernels.device.devices import choose_device
from wavequake.kernels.device.program import aligned_empty
from wavequake.kernels.transforms.fourier import choose_fourier, fourier_2d

Transform = Callable[[], NDArray[np.complexfloating]]

SHAPES = [(1, 512, 512), (8, 512, 512), (1, 1024, 1024), (1, 2048, 2048), (1, 960, 960)]
REPEATS = 7
STRETCH = 0.05  # seconds
# The least that is demanded of a peer's time over ours, and what is aimed at, for squares of powers of two.
DEMANDS = {"mkl_fft": (0.95, 1.1), "pyfftw": (1.1, 1.3), "scipy": (2.0, 3.0)}


def transforms(values: NDArray[np.complexfloating], console: Console) -> dict[str, Transform]:
    """Return ways to transform the values, by name."""
    device, out = choose_device("cpu"), aligned_empty(values.shape, values.dtype)
    found: dict[str, Transform] = {
        "opencl": lambda: fourier_2d(values, device=device, engine="opencl", out=out),
        "scipy": lambda: scipy.fft.fft2(values),
    }
    os.environ.setdefault("MKL_NUM_THREADS", "1")  # MKL reads it when it is loaded
    try:
        import mkl_fft

        found["mkl_fft"] = lambda: mkl_fft.fft2(values, out=out)
    except ImportError:
        console.print("mkl_fft is not installed (pip install mkl_fft): that comparison is skipped")
    try:
        import pyfftw

        source, target = (pyfftw.empty_aligned(values.shape, values.dtype) for _ in range(2))
        plan = pyfftw.FFTW(source, target, axes=(1, 2), flags=("FFTW_MEASURE",), threads=1)
        source[...] = values
        found["pyfftw"] = lambda: plan()
    except ImportError:
        console.print("pyfftw is not installed (pip install pyfftw): that comparison is skipped")
    return found


def seconds_of(job: Transform, count: int) -> float:
    start = time.perf_counter()
    for _ in range(count):
        job()
    return (time.perf_counter() - start) / count


def compare(console: Console) -> tuple[Table, list[Row]]:
    rows: list[Row] = []
    columns = Table("images", "numbers", "by", "ms", "best", "GFLOP/s", "time/OpenCL", "error", box=None)
    random = np.random.default_rng(1)
    for shape in SHAPES:
        for dtype in (np.complex64, np.complex128):
            values = aligned_empty(shape, dtype)
            values[...] = random.normal(size=shape) + 1j * random.normal(size=shape)
            jobs = transforms(values, console)
            exact = scipy.fft.fft2(values.astype(np.complex128))
            errors = {name: np.abs(job() - exact).max() / np.abs(exact).max() for name, job in jobs.items()}
            counts = {name: max(1, int(STRETCH / seconds_of(job, 1))) for name, job in jobs.items()}
            times = {name: [] for name in jobs}
            for _ in range(REPEATS):
                for name, job in jobs.items():
                    warm(job)
                    times[name].append(seconds_of(job, counts[name]))
            ours = np.array(times["opencl"])
            operations = 5.0 * np.prod(shape) * np.log2(shape[1] * shape[2])
            for name, measured in times.items():
                median, ratio = np.median(measured), np.median(np.array(measured) / ours)
                row = ["x".join(map(str, shape)), np.dtype(dtype).name, name, f"{1e3 * median:.2f}"]
                row += [f"{1e3 * min(measured):.2f}", f"{operations / median / 1e9:.1f}", f"{ratio:.2f}"]
                columns.add_row(*row, f"{errors[name]:.1e}")
            if not shape[1] & (shape[1] - 1):
                words = f"{' x '.join(map(str, shape))} {np.dtype(dtype).name}, times"
                for name, (demanded, aim) in DEMANDS.items():
                    value = float(np.median(np.array(times[name]) / ours)) if name in times else None
                    rows.append((f"{words} {name}", value, demanded, aim))
    for shape in SHAPES:
        chosen = choose_fourier(shape, np.complex128, choose_device("cpu"))
        console.print(f"{'x'.join(map(str, shape))}: auto chooses {chosen.engine}, {chosen.reason}")
    return columns, rows


def main() -> None:
    console = Console(width=120)
    if os.environ.get("POCL_MAX_PTHREAD_COUNT") != "1":
        console.print("POCL_MAX_PTHREAD_COUNT is not 1: the kernels may use several threads, the peers one")
    columns, rows = compare(console)
    console.print(columns)
    console.print(verdict(rows))


if __name__ == "__main__":
    main()
