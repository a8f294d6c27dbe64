"""How fast rays are traced: against batoid, numba and the processor's limits, and against what is demanded.

The four surfaces of the TMT with 28 or 105 annular Zernike terms on M1. Measurements are interleaved; medians
of same-run ratios are what to compare between machines. `python -m benchmarks.raytrace` starts one process
for each number of threads, of which all have the same number; it takes two minutes.
"""

import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from benchmarks._limits import limit_jobs, limits
from benchmarks._numba_trace import numba_tracer
from benchmarks._verdict import Row, verdict
from benchmarks._warm import warm
from benchmarks.segmented import workload
from wavequake.kernels.device.devices import Device, list_devices
from wavequake.kernels.device.tiles import TILE
from wavequake.kernels.trace.packing import packed_elements
from wavequake.kernels.trace.segmented import trace_segmented
from wavequake.kernels.trace.sequence import Rays, Sequence
from wavequake.kernels.trace.sequential import trace_sequence
from wavequake.memory import keep_freed_memory
from wavequake.optics.catalog.names import optical_system
from wavequake.optics.polynomials.zernike import annular_zernike
from wavequake.optics.rays.packing import moving, pack
from wavequake.optics.segments.catalog import telescope as bundled
from wavequake.optics.segments.wavefront import los_eq339
from wavequake.optics.shapes.shapes import ZernikeDeformation
from wavequake.optics.systems.kinematics import moved_poses
from wavequake.optics.systems.system import OpticalSystem, States
from wavequake.optics.wavefronts.fits import fit_instants, weighted_fit

Array = NDArray[np.float64]
REPEATS, CALLS = 11, 100
RAYS, BATOID_RAYS = 1_000_000, 100_000
BATCH, BATCH_RAYS, BATOID_INSTANTS = 1000, 2000, 3
TILES = 4  # of the segmented trace, which flags failures and searches segments
OUTER, INNER = 15e3, 3e3
M1, K1, M2, K2 = -60e3, -1.0009535, -6227.68, -1.31822813
WANTED = ("path", "x", "y")
# Multiplications, additions and multiply-adds of the algorithm per ray of four surfaces, without status and
# choices; divisions and roots; bytes: three read, three written after they are read, two codes likewise.
ARITHMETIC, DIVISIONS, ROOTS, BYTES = {28: 205, 105: 366}, 5, 2, 76

WAVELENGTH, APERTURE = 550e-6, 1.0 / 30.0

# What is demanded with 28 and 105 terms, and aimed at: the least of a ratio, the most of a share or a time.
DEMANDS = {
    "10^6 rays, times batoid": ("least", (50.0, 90.0), (80.0, 150.0)),
    "1000 instants of 2000 rays, times a batoid loop": ("least", (70.0, 130.0), (120.0, 200.0)),
    "share of the tightest bound": ("least", (0.6, 0.6), (0.8, 0.8)),
    "492 segments, with search and flags, of the plain rate": ("least", (0.5, 0.5), (0.7, 0.7)),
    "host work (poses, packing, fit, line of sight) of the kernel": ("most", (0.25, 0.25), (0.1, 0.1)),
    "one instant of 2000 rays, ms": ("most", (0.3, 0.3), (0.15, 0.15)),
}


def telescope(terms: int) -> OpticalSystem:
    """Return the four surfaces of the thesis' TMT; Zernike terms of the annulus deform M1."""
    system = optical_system("tmt-thesis")
    primary, *others = (surface for surface in system.surfaces if surface.name != "stop")
    deformed = replace(primary, deformation=ZernikeDeformation(terms, OUTER, INNER / OUTER))
    return replace(system, surfaces=(deformed, *others), fields=system.fields[:1])


def disturbed(terms: int, instants: int) -> States:
    """Return states of M1 and M2 that shift and tilt, M1 with terms of 20 nm rms from j = 4."""
    heights = np.random.default_rng(1).normal(0.0, 2e-5, (instants, terms))
    heights[:, :3] = 0.0
    random = np.random.default_rng(2)
    motion = np.zeros((instants, 4, 6))
    motion[:, :2, :3] = random.normal(0.0, 1e-3, (instants, 2, 3))
    motion[:, :2, 3] = random.normal(0.0, 1e-7, (instants, 2))
    return States(motion, (heights, None, None, None), np.zeros((instants, 2)))


def sunflower(count: int) -> Rays:
    i = np.arange(count) + 0.5
    r, phi = np.sqrt(INNER**2 + (OUTER**2 - INNER**2) * i / count), i * np.pi * (3 - np.sqrt(5))
    direction = np.array([1e-4, -5e-5, np.sqrt(1 - 1e-8 - 2.5e-9)])
    return Rays(
        np.stack([r * np.cos(phi), r * np.sin(phi), np.full(count, -1e4)]),
        np.broadcast_to(direction[:, None], (3, count)),
        np.broadcast_to(0.0, count),
    )


def batoid_optic(system: OpticalSystem, heights: Array, motion: Array) -> Any:
    """Return the telescope in meters, for which batoid's tolerances are made."""
    import batoid

    figure = batoid.Zernike(
        np.concatenate([[0.0], 1e-3 * heights]), R_outer=1e-3 * OUTER, R_inner=1e-3 * INNER
    )
    primary = batoid.Sum([batoid.Quadric(1e-3 * M1, K1), figure])
    shapes = [primary, batoid.Quadric(1e-3 * M2, K2), batoid.Plane(), batoid.Plane()]
    kinds = [batoid.Mirror, batoid.Mirror, batoid.Mirror, batoid.Detector]
    position, rotation = moved_poses(system, motion[None])
    parts = zip("1234", kinds, shapes, 1e-3 * position[0], rotation[0], strict=True)
    items = [kind(shape, name=name, coordSys=batoid.CoordSys(*pose)) for name, kind, shape, *pose in parts]
    return batoid.CompoundOptic(items, name="telescope")


def batoid_rays(rays: Rays) -> Any:
    import batoid

    direction = [np.ascontiguousarray(row) for row in rays.direction]
    return batoid.RayVector(*(1e-3 * row for row in rays.position), *direction, np.zeros(rays.path.size))


def interleaved(jobs: dict[str, Callable[[], Any]]) -> dict[str, Array]:
    for job in jobs.values():
        job()
    seconds: dict[str, list[float]] = {name: [] for name in jobs}
    for _ in range(REPEATS):
        for name, job in jobs.items():
            warm(job)
            start = time.perf_counter()
            job()
            seconds[name].append(time.perf_counter() - start)
    return {name: np.array(times) for name, times in seconds.items()}


def successive(job: Callable[[], Any]) -> Array:
    """Return the seconds of each of many calls, one after the other."""
    times = [time.perf_counter()]
    for _ in range(CALLS):
        job()
        times.append(time.perf_counter())
    return np.diff(times)


def measure(device: Device, terms: int, batoid: bool, console: Console) -> dict[str, float]:
    """Print the rates with one number of terms; return what `DEMANDS` are made on."""
    system, states = telescope(terms), disturbed(terms, BATCH)
    heights, motion = states.deformations[0], states.surface_motion
    many, few, some = sunflower(RAYS), sunflower(BATCH_RAYS), sunflower(BATOID_RAYS)
    sequence = pack(system, WAVELENGTH)
    still = States(0 * motion[:1], (heights[:1], None, None, None), np.zeros((1, 2)))
    rest = moving(system, still)
    large = trace_sequence(sequence, many, rest, device, outputs=WANTED)
    # Paths that count from one at rest are differences already.
    base = trace_sequence(sequence, few, rest, device).path[0, 0]
    counted = replace(few, path=np.broadcast_to(-base, BATCH_RAYS))
    batch, spent = batch_work(system, states, sequence, counted, device)
    bound_jobs, amounts = limit_jobs(device)
    small: list[float] = []
    jobs: dict[str, Callable[[], Any]] = {
        "kernel": lambda: trace_sequence(sequence, many, rest, device, outputs=WANTED, out=large),
        # Before the peers, whose threads wait for more work in a loop on the second processor.
        "batch": batch,
        "small": lambda: small.extend(
            successive(lambda: trace_sequence(sequence, few, rest, device, outputs=WANTED))
        ),
        "492 segments": partial(trace_segmented, **workload(bundled("tmt"), TILES, 28), device=device),
    }
    rays = {"kernel": RAYS, "batch": BATCH * BATCH_RAYS, "small": BATCH_RAYS}
    rays["492 segments"] = TILES * TILE * 18 * 492
    layout, limit, _ = packed_elements(sequence, rest, False)
    rotates = [shape.rotates for shape in layout.shapes]
    numba = numba_tracer(sequence.elements[0].deformation_degree, rotates)
    if numba:
        conics = np.array([[1 / M1, 1 + K1], [1 / M2, 1 + K2]])
        out, codes = np.empty((3, RAYS)), np.empty((2, RAYS), np.int8)
        direction = many.direction[:, 0].copy()
        monomials = rest.deformations[0][0]
        limits = (float(np.ravel(limit)[0]), float(layout.numbers[5]))
        given = (conics, rest.poses[0], monomials, 1.0 / OUTER, *limits, many.position, direction)
        arguments = (*given, *out, *codes)
        jobs["numba"], rays["numba"] = lambda: numba(*arguments), RAYS
    else:
        console.print("numba is not installed (pip install numba): that comparison is skipped")
    if batoid:
        optic = batoid_optic(system, heights[0], 0 * motion[0])
        light, light_few = batoid_rays(some), batoid_rays(few)

        def batoid_loop() -> None:
            for i in range(BATOID_INSTANTS):
                batoid_optic(system, heights[i], motion[i]).trace(light_few.copy())

        jobs |= {"batoid": lambda: optic.trace(light.copy()), "batoid loop": batoid_loop}
        rays |= {"batoid": BATOID_RAYS, "batoid loop": BATOID_INSTANTS * BATCH_RAYS}
        agreement(trace_sequence(sequence, few, rest, device), optic.trace(light_few.copy()), console)
    if numba:
        numba(*arguments)
        worst = max(np.abs(getattr(large, name) - row).max() for name, row in zip(WANTED, out, strict=True))
        if not worst < 1e-8 or codes[0].any() or (codes[1] != -1).any():
            raise SystemExit(f"numba's rays differ by up to {worst:.1e} mm; its time says nothing")
        console.print(f"largest difference to numba: {worst:.1e} mm")
    seconds = interleaved(jobs | bound_jobs)
    seconds |= {name: np.array(times[1:]) for name, times in spent.items()} | {"small": np.array(small)}
    return report(seconds, rays, amounts, terms, console)


def batch_work(
    system: OpticalSystem, states: States, sequence: Sequence, rays: Rays, device: Device
) -> tuple[Callable[[], Any], dict[str, list[float]]]:
    """Return what traces and measures a batch, and the seconds that each call takes, by what it does."""
    x, y = rays.position[:2] / OUTER
    fit = weighted_fit(annular_zernike(x, y, 28, INNER / OUTER), np.full(x.size, 1.0 / x.size))
    traced = trace_sequence(sequence, rays, moving(system, states), device, outputs=WANTED)
    spent: dict[str, list[float]] = {"batch": [], "packing": [], "host": []}

    def measures() -> Array:
        center = np.stack([traced.x[:, 0], traced.y[:, 0]], axis=1)
        zernike = fit_instants(fit, traced.path, device) * (1.0 / WAVELENGTH)
        return los_eq339(center, zernike, WAVELENGTH, APERTURE)

    def work() -> None:
        times = [time.perf_counter()]
        light = moving(system, states, device=device)
        times.append(time.perf_counter())
        packed_elements(sequence, light, False)  # as the trace does once more
        times.append(time.perf_counter())
        trace_sequence(sequence, rays, light, device, outputs=WANTED, out=traced)
        times.append(time.perf_counter())
        measures()
        poses, packing, batch, fits = np.diff([*times, time.perf_counter()]).tolist()
        for name, seconds in (("host", poses + fits), ("packing", packing), ("batch", batch)):
            spent[name].append(seconds)

    return work, spent


def agreement(traced: Any, light: Any, console: Console) -> None:
    place = max(np.abs(traced.x[0] - 1e3 * light.x).max(), np.abs(traced.y[0] - 1e3 * light.y).max())
    path = np.abs(traced.path[0] - 1e3 * light.t).max()
    console.print(f"difference to batoid: position {place:.1e} mm, path {path:.1e} mm")


def report(
    seconds: dict[str, Array], rays: dict[str, int], amounts: dict[str, float], terms: int, console: Console
) -> dict[str, float]:
    """Print the rates; return what `DEMANDS` are made on, as far as it was measured."""
    rates = {name: 4e-6 * count / seconds[name] for name, count in rays.items()}
    speed = limits({name: amount / float(np.median(seconds[name])) for name, amount in amounts.items()})
    bounds = {
        "multiply-add": 4e-6 * speed["multiply_add"] / ARITHMETIC[terms],
        "division and root": 4e-6 / (DIVISIONS / speed["divide"] + ROOTS / speed["root"]),
        "memory": 4e-6 * speed["move"] / BYTES,
    }
    table = Table("trace", "10^6 ray-surfaces/s", box=None)
    for name, rate in (rates | bounds).items():
        table.add_row(f"limit by {name}" if name in bounds else name, f"{np.median(rate):.1f}")
    # numba does not fuse them without `fastmath`.
    apart = 4e-6 * speed["apart"] / ARITHMETIC[terms]
    table.add_row("limit by multiplying and adding apart", f"{apart:.1f}")
    console.print(table)
    if "numba" in rates:  # compares instruction sets of compilers, and is therefore not demanded
        times = float(np.median(rates["kernel"]) / np.median(rates["numba"]))
        console.print(f"10^6 rays, times the same algorithm in numba: {times:.2f}")
    ratios = {("kernel", "batoid"): 0, ("batch", "batoid loop"): 1}
    names, found = list(DEMANDS), {}
    for (own, peer), place in ratios.items():
        if peer in rates:
            found[names[place]] = float(np.median(rates[own]) / np.median(rates[peer]))
    launched = seconds["batch"] - seconds["packing"]
    found[names[2]] = float(np.median(rates["kernel"])) / min(bounds.values())
    found[names[3]] = float(np.median(rates["492 segments"] / rates["kernel"]))
    found[names[4]] = float(np.median((seconds["host"] + seconds["packing"]) / launched))
    found[names[5]] = 1e3 * float(np.median(seconds["small"]))
    return found


def demands(found: dict[int, dict[str, float]], threads: str) -> list[Row]:
    """Return what was measured with some threads beside what is demanded."""
    return [
        Row(f"{name}; {terms} terms, {threads} threads", measured.get(name), demand, aim, kind == "least")
        for name, (kind, demanded, aims) in DEMANDS.items()
        for (terms, measured), demand, aim in zip(found.items(), demanded, aims, strict=True)
    ]


def main() -> None:
    """Measure with one and with two threads, each in a process of its own."""
    for threads in ("1", "2"):
        names = ("POCL_MAX_PTHREAD_COUNT", "OMP_NUM_THREADS", "NUMBA_NUM_THREADS")
        # OpenBLAS' own threads wait for one another in loops; its products are small here.
        environment = os.environ | dict.fromkeys(names, threads) | {"OPENBLAS_NUM_THREADS": "1"}
        subprocess.run([sys.executable, "-m", "benchmarks.raytrace", threads], env=environment, check=True)


def measure_all(threads: str) -> None:
    console = Console(width=150)
    keep_freed_memory()  # as campaigns do
    devices = [device for device in list_devices() if device.kind == "cpu"]
    if not devices:
        console.print("no OpenCL processor was found: there is nothing to measure")
        return
    try:
        import batoid
    except ImportError:
        batoid = None
        console.print("batoid is not installed (pip install batoid): that comparison is skipped")
    found = {}
    for terms in (28, 105):
        console.print(f"{devices[0].name}, {threads} thread(s), {terms} terms, {RAYS} rays")
        found[terms] = measure(devices[0], terms, batoid is not None, console)
    console.print(verdict(demands(found, threads)))


if __name__ == "__main__":
    if len(sys.argv) > 1:
        measure_all(sys.argv[1])
    else:
        main()
