"""How fast the segmented trace is, and whether it agrees with others.

The 492 moving segments of the TMT, 8856 rays, 20 tiles of 16 instants, 4 surfaces per ray: the kernel on
every device, its NumPy twin, and batoid if it is installed. batoid has no segmented mirrors: it traces one
undivided, resting M1, in a loop over instants; its figure is one Zernike surface over all of M1. Measurements
are interleaved; medians of same-run ratios are what to compare between machines.
"""

import os
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from wavequake.kernels.device.devices import NUMPY, list_devices
from wavequake.kernels.device.tiles import TILE
from wavequake.kernels.trace.segmented import trace_segmented
from wavequake.optics.rays.pupils import segment_rays
from wavequake.optics.segments.catalog import telescope
from wavequake.optics.segments.kinematics import after_m1, relative_transforms, segment_poses
from wavequake.optics.segments.prepared import chief_rays, directions, prepare
from wavequake.optics.segments.telescope import M2
from wavequake.optics.systems.kinematics import rest_states
from wavequake.optics.systems.system import OpticalSystem

TILES = 20
REPEATS = 7
SURFACES = 4
WAVELENGTH = 550e-6


def workload(system: OpticalSystem, tiles: int, figure_terms: int = 0, scale: float = 1.0) -> dict[str, Any]:
    """Arguments of `trace_segmented` for random motions of some 10 nm and 10 nrad, times `scale`."""
    prepared = prepare(system, segment_rays(system.segments, 3), WAVELENGTH, 15, figure_terms)
    random = np.random.default_rng(1)
    states = rest_states(prepared.system, tiles * TILE)
    small = np.array([1, 1, 1, 1e-3, 1e-3, 1e-3])
    moving = states.surface_motion[:, M2:]
    states.segment_motion[:] = scale * random.normal(0.0, 3e-5, states.segment_motion.shape) * small
    states.segment_figure[:] = scale * random.normal(0.0, 1e-5, states.segment_figure.shape)
    moving[:] = scale * random.normal(0.0, 1e-4, moving.shape) * small
    states.line_of_sight[:] = scale * random.normal(0.0, 1e-7, states.line_of_sight.shape)
    figure = None
    if figure_terms:
        terms = states.segment_figure.reshape(tiles, TILE, -1, figure_terms).transpose(0, 2, 3, 1)
        figure = prepared.figure_matrix @ terms
    return {
        "train": prepared.train,
        "ray_x": prepared.rays.x,
        "ray_y": prepared.rays.y,
        "start_z": system.stop_z,
        "candidates": prepared.candidates,
        "segment_poses": segment_poses(system.segments, states.segment_motion),
        "figure": figure,
        "surface_poses": relative_transforms(*after_m1(system, states.surface_motion)),
        "directions": directions(prepared, states),
        "chief": chief_rays(prepared, states),
    }


def first_tile(arguments: dict[str, Any]) -> dict[str, Any]:
    moving = ("segment_poses", "figure", "surface_poses", "directions", "chief")
    return arguments | {name: arguments[name][:1] for name in moving if arguments[name] is not None}


def batoid_tracer(
    system: OpticalSystem, arguments: dict[str, Any], figure_terms: int = 0
) -> Callable[[], Any] | None:
    """Return a function that traces the rays once through the resting telescope, or None without batoid."""
    try:
        import batoid
    except ImportError:
        return None
    primary = batoid.Quadric(system.primary.shape.radius, system.primary.shape.conic)
    if figure_terms:
        heights = np.concatenate([[0.0], np.random.default_rng(1).normal(0.0, 1e-5, figure_terms)])
        figure = batoid.Zernike(heights, R_outer=system.annulus.outer, R_inner=system.annulus.inner)
        primary = batoid.Sum([primary, figure])
    items = [batoid.Mirror(primary, name="M1")]
    for surface in system.after_primary:
        flat = np.isinf(surface.shape.radius)
        shape = batoid.Plane() if flat else batoid.Quadric(surface.shape.radius, surface.shape.conic)
        place = batoid.CoordSys(np.array(surface.position), np.array(surface.rotation))
        kind = batoid.Mirror if surface.action == "reflect" else batoid.Detector
        items.append(kind(shape, name=surface.name, coordSys=place))
    optic = batoid.CompoundOptic(items, name=system.name)
    x, y = arguments["ray_x"], arguments["ray_y"]
    z, zero = np.full_like(x, system.stop_z), np.zeros_like(x)
    rays = batoid.RayVector(x, y, z, zero, zero, zero + 1.0, z)
    return lambda: optic.trace(rays.copy())


def difference_to_batoid(system: OpticalSystem, trace: Callable[[], Any]) -> tuple[float, float]:
    """Largest differences of image position and OPD (mm) in the resting telescope, kernel against batoid."""
    rest = workload(system, 1, scale=0.0)
    found = trace_segmented(**rest, device=list_devices()[0])
    rays = trace()
    center_x, center_y, opl = rest["chief"][0, :, 0]
    offset = np.stack([rays.x - center_x, rays.y - center_y, rays.z])
    direction = np.stack([rays.vx, rays.vy, rays.vz])
    along = np.sum(offset * direction, axis=0)
    radius = rest["train"].sphere_radius
    back = along + np.sqrt(along**2 - np.sum(offset**2, axis=0) + radius**2)
    position = max(np.abs(found.x[0, :, 0] - rays.x).max(), np.abs(found.y[0, :, 0] - rays.y).max())
    return float(position), float(np.abs(found.opd[0, :, 0] - (opl - (rays.t - back))).max())


def interleaved(jobs: dict[str, Callable[[], Any]]) -> dict[str, list[float]]:
    seconds: dict[str, list[float]] = {name: [] for name in jobs}
    for job in jobs.values():
        job()
    for _ in range(REPEATS):
        for name, job in jobs.items():
            start = time.perf_counter()
            job()
            seconds[name].append(time.perf_counter() - start)
    return seconds


def table(seconds: dict[str, list[float]], instants: dict[str, int], rays: int) -> Table:
    """Medians per instant, and each kernel's gain over its peers (medians of ratios within one round)."""
    columns = Table(*("trace", "ms/instant", "10^6 ray-surfaces/s", "time/kernel"), box=None)
    each = {name: np.array(times) / instants[name] for name, times in seconds.items()}
    for name, times in each.items():
        median = float(np.median(times))
        kernel = each[next(key for key in each if key.endswith(name.rpartition(", ")[2]))]
        rate, ratio = rays * SURFACES / median / 1e6, float(np.median(times / kernel))
        columns.add_row(name, f"{1e3 * median:.4f}", f"{rate:.1f}", f"{ratio:.2f}")
    return columns


def main() -> None:
    console = Console()
    system = telescope("tmt")
    jobs: dict[str, Callable[[], Any]] = {}
    instants: dict[str, int] = {}
    for label, terms in (("conics", 0), ("28-term figure", 28)):
        arguments = workload(system, TILES, terms)
        one_tile = first_tile(arguments)
        for device in list_devices()[:-1]:
            name = f"{device.kind} {device.vector_width} lanes, {label}"
            jobs[name] = partial(trace_segmented, **arguments, device=device)
            instants[name] = TILES * TILE
        jobs[f"NumPy twin, {label}"] = partial(trace_segmented, **one_tile, device=NUMPY)
        instants[f"NumPy twin, {label}"] = TILE
        peer = batoid_tracer(system, arguments, terms)
        if peer is None:
            console.print("batoid is not installed (pip install batoid): that comparison is skipped")
            continue
        jobs[f"batoid, {label}"] = peer
        instants[f"batoid, {label}"] = 1
        if not terms:
            position, opd = difference_to_batoid(system, peer)
            console.print(f"difference to batoid at rest: image {position:.1e} mm, OPD {opd:.1e} mm")
    rays = arguments["ray_x"].size
    several = float(np.mean((arguments["candidates"] >= 0).sum(axis=1) > 1))
    console.print("devices:", ", ".join(device.name for device in list_devices()))
    console.print(f"{rays} rays, {several:.1%} of them with several candidate segments")
    console.print("PoCL threads:", os.environ.get("POCL_MAX_PTHREAD_COUNT", f"all {os.cpu_count()}"))
    console.print(table(interleaved(jobs), instants, rays))


if __name__ == "__main__":
    main()
