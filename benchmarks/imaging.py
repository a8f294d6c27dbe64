"""How fast images of a segmented and of a round pupil are, and how exact.

Segments: 64 x 64 points at 0.25 wavelength / diameter of the 492 segments of the TMT with random pistons
(35 nm rms), and with random slopes (5 nm rms at a corner): the segment basis, 16 instants at a time, against
poppy, hcipy and prysm if they are installed. The peers transform a pupil sampled at 512 x 512 points, one
instant at a time; their time begins at the phase per segment too. Errors are the largest differences from the
complex128 basis with 28 moments.

Lattice: 128 x 128 points of 468 equal hexagons in 12 rings with random pistons, by sums over the lattice
against the segment basis and the peers. hcipy's segmented mirror makes phases from actuators itself; it is a
peer of all segments, with slopes if there are any.

Round: 128 x 128 points of a pupil of 512 x 512 cells with 45 Zernike terms, 16 instants: the folded transform
on the CPU, alone and summed to an exposure, its NumPy twin, and the peers' transforms; the time of all begins
at the phase of each cell, but that of "from Zernike terms" at the coefficients. Errors are the largest
differences from the NumPy twin.

Exposures: 1000 instants of such a round pupil whose line of sight moves by 1 wavelength / diameter rms, which
a tilt of the pupil ("folded in") or a Fourier shift of every image places, against the images alone.

Strehl ratios alone: pistons of the 492 segments, 4000 instants.

The last table puts the ratios, those of `python -m benchmarks.fourier` included, beside what is demanded.

All run on one thread (set POCL_MAX_PTHREAD_COUNT=1); measurements are interleaved, and medians of same-run
ratios are what to compare between machines.
"""

import os
import time
from collections.abc import Callable, Iterator
from functools import partial

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from threadpoolctl import threadpool_limits

from benchmarks import fourier
from benchmarks._image_peers import (
    DIAMETER,
    PUPIL_POINTS,
    SAMPLING,
    Imager,
    hcipy_mirror,
    peer_imager,
    peers,
    round_images,
)
from benchmarks._verdict import Row, verdict
from benchmarks._warm import warm
from wavequake.imaging.engines.matrix_fourier import matrix_fourier, psf_sum
from wavequake.imaging.engines.matrix_fourier import psf as matrix_psf
from wavequake.imaging.engines.polygon_transform import polygon_areas
from wavequake.imaging.engines.segment_basis import segment_basis
from wavequake.imaging.engines.segment_lattice import SegmentLattice, lattice_psf, segment_lattice
from wavequake.imaging.engines.segment_psf import psf, strehl_exact
from wavequake.imaging.engines.zernike_psf import zernike_imager, zernike_images, zernike_sum
from wavequake.imaging.exposures.exposure_models import full_exposure
from wavequake.imaging.pupils.pupil_function import annular_pupil
from wavequake.imaging.pupils.wavefront_phase import zernike_phase
from wavequake.kernels.device.devices import NUMPY, choose_device
from wavequake.kernels.device.tiles import TILE
from wavequake.kernels.sums.strehl import strehl_ratios
from wavequake.optics.segments.catalog import telescope
from wavequake.optics.segments.layout import Segments, hexagon_ring_segments

Real = NDArray[np.float64]
Seconds = dict[str, NDArray[np.float64]]  # of every repeat, by name

PIXELS, ROUND_PIXELS = 64, 128
STREHL_INSTANTS = 4000
EXPOSED_INSTANTS = 1000
WAVELENGTH = 550.0  # nm
REPEATS = 7
LEAST_SECONDS = 0.05


def phases(segments: Segments, corner_slope: float) -> Real:
    """Phases (16, S, 3) of 35 nm OPD in piston, and of 2 x `corner_slope` nm at a corner in tip and tilt."""
    random = np.random.default_rng(1)
    reach = np.hypot(*np.moveaxis(segments.corners - segments.centers[:, None, :2], -1, 0)).max()
    phase = random.normal(0.0, 1.0, (TILE, len(segments), 3))
    return phase * np.array([35.0, 2 * corner_slope / reach, 2 * corner_slope / reach]) / WAVELENGTH


def imagers(segments: Segments, slopes: bool, console: Console) -> dict[str, Imager]:
    """Return this package's imagers and those of installed peers, by name."""
    found: dict[str, Imager] = {}
    moments = 6 if slopes else 1
    for dtype in (np.complex64, np.complex128):
        start = time.perf_counter()
        basis = segment_basis(
            segments.corners, segments.centers[:, :2], PIXELS, SAMPLING, DIAMETER, moments, dtype
        )
        name = f"{moments} moments, {dtype.__name__}"
        console.print(f"{name}: basis built in {time.perf_counter() - start:.2f} s")
        found[name] = partial(psf, basis, tolerance=0.01)
    for name, transform in peers(PIXELS, console).items():
        found[f"{name} {PUPIL_POINTS}²"] = peer_imager(segments, slopes, transform)
        if name == "hcipy":
            found["hcipy's segmented mirror"] = hcipy_mirror(segments, PIXELS, slopes)
    return found


def compare(segments: Segments, corner_slope: float, console: Console) -> tuple[Table, Seconds]:
    phase = phases(segments, corner_slope)
    candidates = imagers(segments, corner_slope > 0.0, console)
    exact_basis = segment_basis(
        segments.corners, segments.centers[:, :2], PIXELS, SAMPLING, DIAMETER, 28, np.complex128
    )
    exact = psf(exact_basis, phase, tolerance=1e-6)
    errors = {name: np.abs(image(phase) - exact).max() for name, image in candidates.items()}
    return table(candidates, errors, phase)


_NO_LATTICE = "{} cannot image by the lattice: its memory for a work-group does not suffice"


def compare_lattice(console: Console) -> tuple[Table, Seconds]:
    """Image equal hexagons on a regular lattice, which move as pistons."""
    segments = hexagon_ring_segments(680.0, 12, 2.5)
    corners, centers = segments.corners, segments.centers[:, :2]
    grid, phase = (ROUND_PIXELS, SAMPLING, DIAMETER), phases(segments, 0.0)
    candidates: dict[str, Imager] = {}
    for dtype in (np.float64, np.float32):
        for device in (choose_device("cpu"), NUMPY):
            lattice = segment_lattice(corners, centers, *grid, dtype, device)
            if lattice is None:
                console.print(_NO_LATTICE.format(device.name))
                continue
            name = "NumPy lattice" if device is NUMPY else "lattice"
            candidates[f"{name}, {dtype.__name__}"] = partial(lattice_images, lattice)
    candidates["basis, complex128"] = partial(psf, segment_basis(corners, centers, *grid, 1, np.complex128))
    for name, transform in peers(ROUND_PIXELS, console).items():
        candidates[f"{name} {PUPIL_POINTS}²"] = peer_imager(segments, False, transform)
        if name == "hcipy":
            candidates["hcipy's segmented mirror"] = hcipy_mirror(segments, ROUND_PIXELS, False)
    exact = candidates["basis, complex128"](phase)
    errors = {name: np.abs(image(phase) - exact).max() for name, image in candidates.items()}
    return table(candidates, errors, phase)


def compare_tilted_lattice(console: Console) -> tuple[Table, Seconds]:
    """Image equal hexagons on a regular lattice, which tilt, too."""
    segments = hexagon_ring_segments(680.0, 12, 2.5)
    place = segments.corners, segments.centers[:, :2], ROUND_PIXELS, SAMPLING, DIAMETER
    phase, candidates = phases(segments, 5.0), {}
    for dtype in (np.complex64, np.complex128):
        kind = np.float32 if dtype == np.complex64 else np.float64
        lattice = segment_lattice(*place, kind, choose_device("cpu"), 6)
        if lattice is None:
            console.print(_NO_LATTICE.format(choose_device("cpu").name))
        else:
            candidates[f"lattice, {kind.__name__}"] = partial(lattice_images, lattice)
        candidates[f"6 moments, {dtype.__name__}"] = partial(
            psf, segment_basis(*place, 6, dtype), tolerance=0.01
        )
    if "hcipy" in peers(ROUND_PIXELS, console):
        candidates["hcipy's segmented mirror"] = hcipy_mirror(segments, ROUND_PIXELS, True)
    exact = psf(segment_basis(*place, 28, np.complex128), phase, tolerance=1e-6)
    errors = {name: np.abs(image(phase) - exact).max() for name, image in candidates.items()}
    return table(candidates, errors, phase)


def lattice_images(lattice: SegmentLattice, phase: Real) -> Real:
    """Make images (batch, pixels²)."""
    return np.asarray(lattice_psf(lattice, phase).reshape(len(phase), -1))


def table(candidates: dict[str, Imager], errors: dict[str, float], phase: Real) -> tuple[Table, Seconds]:
    """Time ways to make 16 images; the first is what the others are compared with.

    Fast ones are called several times in a row: what others left in the caches is not theirs to pay.
    """
    seconds: dict[str, list[float]] = {name: [] for name in candidates}
    calls: dict[str, int] = {}
    for _ in range(REPEATS):
        for name, image in candidates.items():
            if name not in calls:
                start = time.perf_counter()
                image(phase)
                calls[name] = max(1, int(LEAST_SECONDS / (time.perf_counter() - start)))
            warm(partial(image, phase))
            start = time.perf_counter()
            for _ in range(calls[name]):
                image(phase)
            seconds[name].append((time.perf_counter() - start) / calls[name])
    first = np.array(next(iter(seconds.values())))
    columns = Table("images", "ms/16 images", "best", "images/s", "time/first", "error/peak", box=None)
    for name, times in seconds.items():
        median, ratio = np.median(times), np.median(np.array(times) / first)
        row = [name, f"{1e3 * median:.2f}", f"{1e3 * min(times):.2f}", f"{TILE / median:.0f}"]
        columns.add_row(*row, f"{ratio:.2f}", f"{errors[name]:.1e}")
    return columns, {name: np.array(times) for name, times in seconds.items()}


def compare_round(console: Console) -> tuple[Table, Seconds]:
    """Image a round pupil of many cells, whose phase is smooth."""
    grid = annular_pupil(PUPIL_POINTS)
    coefficients = np.random.default_rng(1).normal(0.0, 0.02, (TILE, 45))
    phase = zernike_phase(grid, coefficients)
    twin = matrix_fourier(grid, ROUND_PIXELS, SAMPLING)
    exact = matrix_psf(twin, phase)
    device, weights = choose_device("cpu"), np.full(TILE, 1.0 / TILE)
    candidates: dict[str, Imager] = {}
    for dtype in (np.float64, np.float32):
        folded = matrix_fourier(grid, ROUND_PIXELS, SAMPLING, device, dtype)
        candidates[f"folded, {dtype.__name__}"] = partial(matrix_psf, folded)
        candidates[f"their sum, {dtype.__name__}"] = partial(psf_sum, folded, weights=weights)
        imager = zernike_imager(grid, ROUND_PIXELS, SAMPLING, 45, 0.0, device, dtype)
        for name, image in (
            ("from Zernike terms", partial(zernike_images, imager, coefficients)),
            ("sum from Zernike terms", partial(zernike_sum, imager, coefficients, weights)),
        ):
            candidates[f"{name}, {dtype.__name__}"] = partial(without_phase, image)
    candidates["NumPy twin"] = partial(matrix_psf, twin)
    for name, transform in peers(ROUND_PIXELS, console).items():
        candidates[name] = partial(round_images, grid, transform)
    errors = {}
    for name, image in candidates.items():
        expected = exact.mean(axis=0) if "sum" in name else exact
        errors[name] = np.abs(image(phase) - expected).max()
    return table(candidates, errors, phase)


def without_phase(image: Callable[[], Real], phase: Real) -> Real:
    """Make images that know their wavefronts already."""
    return image()


def compare_exposure() -> tuple[Table, Seconds]:
    """Expose moving images of a round pupil: what the placing costs beside the images."""
    random, device = np.random.default_rng(1), choose_device("cpu")
    waves = random.normal(0.0, 0.02, (EXPOSED_INSTANTS, 45))
    los = random.normal(0.0, 1.0, (EXPOSED_INSTANTS, 2))
    waves[:, :3] = 0.0
    placed = waves.copy()
    placed[:, 1:3] = los / 4.0  # a tilt of c waves (Noll) moves the image by 4 c
    imager = zernike_imager(annular_pupil(PUPIL_POINTS), ROUND_PIXELS, SAMPLING, 45, 0.0, device)
    weights = np.full(EXPOSED_INSTANTS, 1.0 / EXPOSED_INSTANTS)

    def images() -> Iterator[Real]:
        for first in range(0, EXPOSED_INSTANTS, TILE):
            yield zernike_images(imager, waves[first : first + TILE])

    jobs: dict[str, Callable[[], object]] = {
        "images alone": lambda: [image[0, 0, 0] for image in images()],
        "exposure, folded in": lambda: zernike_sum(imager, placed, weights),
        "exposure, Fourier shifts": lambda: full_exposure(images(), los, SAMPLING),
    }
    seconds: dict[str, list[float]] = {name: [] for name in jobs}
    for _ in range(REPEATS):
        for name, job in jobs.items():
            start = time.perf_counter()
            job()
            seconds[name].append(time.perf_counter() - start)
    alone = np.array(seconds["images alone"])
    columns = Table("1000 instants at 128²", "instants/s", "best", "rate/images alone", box=None)
    for name, times in seconds.items():
        rates = [f"{EXPOSED_INSTANTS / t:.0f}" for t in (np.median(times), min(times))]
        columns.add_row(name, *rates, f"{np.median(alone / np.array(times)):.2f}")
    return columns, {name: np.array(times) for name, times in seconds.items()}


def compare_strehl(segments: Segments) -> tuple[Table, Seconds]:
    """Strehl ratios alone, of pistons of the segments."""
    areas = polygon_areas(segments.corners)
    waves = np.random.default_rng(1).normal(0.0, 0.06, (STREHL_INSTANTS, len(segments)))
    phase, device = 2.0 * np.pi * waves, choose_device("cpu")
    jobs: dict[str, Callable[[], Real]] = {
        "OpenCL": lambda: strehl_ratios(phase, areas, device),
        "NumPy twin": lambda: strehl_ratios(phase, areas),
    }
    exact = strehl_exact(areas, waves)
    errors = {name: np.abs(job() - exact).max() for name, job in jobs.items()}
    seconds: dict[str, list[float]] = {name: [] for name in jobs}
    for _ in range(REPEATS):
        for name, job in jobs.items():
            start = time.perf_counter()
            job()
            seconds[name].append(time.perf_counter() - start)
    columns = Table("Strehl ratios", "per s", "best", "error", box=None)
    for name, times in seconds.items():
        rates = [f"{STREHL_INSTANTS / t:.3g}" for t in (np.median(times), min(times))]
        columns.add_row(name, *rates, f"{errors[name]:.1e}")
    return columns, {name: np.array(times) for name, times in seconds.items()}


def ratio(seconds: Seconds, own: str, peer: str) -> float | None:
    """Return how many times as long a peer takes; none if either is missing."""
    return float(np.median(seconds[peer] / seconds[own])) if {own, peer} <= set(seconds) else None


def demands(found: dict[str, Seconds]) -> list[Row]:
    """Return what is demanded of each comparison."""
    tmt, tilted, lattice = found["pistons"], found["tilts"], found["lattice"]
    whole, exposed = found["round"], found["exposure"]
    exact, single, peer = "folded, float64", "folded, float32", f"poppy {PUPIL_POINTS}²"
    mirror = "hcipy's segmented mirror"
    return [
        ("512² to 128² pixels, float64, times poppy", ratio(whole, exact, "poppy"), 8, 15),
        ("the same, times hcipy", ratio(whole, exact, "hcipy"), 4.5, 8),
        ("the same, times prysm", ratio(whole, exact, "prysm"), 4.5, 8),
        ("the same in float32, times poppy", ratio(whole, single, "poppy"), 18, 30),
        (
            "lattice with tilts, float64, times " + mirror,
            ratio(found["tilted"], "lattice, float64", mirror),
            20,
            20,
        ),
        ("the same in float32", ratio(found["tilted"], "lattice, float32", mirror), 20, 60),
        ("lattice, pistons, float64, times poppy", ratio(lattice, "lattice, float64", peer), 200, 200),
        ("the same in float32", ratio(lattice, "lattice, float32", peer), 200, 500),
        ("TMT, pistons, float64, times poppy", ratio(tmt, "1 moments, complex128", peer), 40, 100),
        ("TMT with tilts, float64, times " + mirror, ratio(tilted, "6 moments, complex128", mirror), 6, 20),
        ("Strehl ratios per s", STREHL_INSTANTS / float(np.median(found["strehl"]["OpenCL"])), 1e5, 1e6),
        ("exposures, of the rate of images", ratio(exposed, "exposure, folded in", "images alone"), 0.8, 1),
    ]


def main() -> None:
    console = Console(width=120)
    if os.environ.get("POCL_MAX_PTHREAD_COUNT") != "1":
        console.print("POCL_MAX_PTHREAD_COUNT is not 1: the kernels may use several threads, the peers one")
    segments = telescope("tmt").segments
    comparisons: dict[str, Callable[[], tuple[Table, Seconds]]] = {
        "pistons": partial(compare, segments, 0.0, console),
        "tilts": partial(compare, segments, 5.0, console),
        "lattice": partial(compare_lattice, console),
        "tilted": partial(compare_tilted_lattice, console),
        "round": partial(compare_round, console),
        "exposure": compare_exposure,
        "strehl": partial(compare_strehl, segments),
    }
    found = {}
    with threadpool_limits(1):
        for name, comparison in comparisons.items():
            columns, found[name] = comparison()
            console.print(columns)
        columns, rows = fourier.compare(console)
        console.print(columns)
    console.print(verdict([*rows, *demands(found)]))


if __name__ == "__main__":
    main()
