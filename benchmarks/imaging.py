"""How fast images of a segmented pupil are, and how exact.

64 x 64 points at 0.25 wavelength / diameter of the 492 segments of the TMT with random pistons (35 nm
rms), and with random slopes (5 nm rms at a corner): the segment basis, 16 instants at a time, against
poppy and hcipy if they are installed. The peers transform a pupil sampled at 512 x 512 points, one
instant at a time; their time begins at the phase per segment too. All run on one thread; measurements
are interleaved, and medians of same-run ratios are what to compare between machines. Errors are the
largest differences from the complex128 basis with 28 moments.
"""

import time
from collections.abc import Callable
from functools import partial

import numpy as np
from matplotlib.path import Path
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from threadpoolctl import threadpool_limits

from wavequake.imaging.segment_psf import psf, segment_basis
from wavequake.kernels.tiles import TILE
from wavequake.optics.segments import Segments
from wavequake.optics.telescopes import telescope

Real = NDArray[np.float64]
Imager = Callable[[Real], Real]  # segment phases (batch, S, 3) to images (batch, PIXELS**2)

PIXELS, SAMPLING, DIAMETER = 64, 0.25, 30000.0
PUPIL_POINTS = 512
WAVELENGTH = 550.0  # nm
REPEATS = 7


def phases(segments: Segments, corner_slope: float) -> Real:
    """Phases (16, S, 3) of 35 nm OPD in piston, and of 2 x `corner_slope` nm at a corner in tip and tilt."""
    random = np.random.default_rng(1)
    reach = np.hypot(*np.moveaxis(segments.corners - segments.centers[:, None, :2], -1, 0)).max()
    phase = random.normal(0.0, 1.0, (TILE, len(segments), 3))
    return phase * np.array([35.0, 2 * corner_slope / reach, 2 * corner_slope / reach]) / WAVELENGTH


def sampled_pupil(segments: Segments) -> tuple[Real, NDArray[np.int64], Real]:
    """Amplitude (n, n), segment of each point and its place (2, n, n) from the segment's center, in mm."""
    axis = (np.arange(PUPIL_POINTS) - (PUPIL_POINTS - 1) / 2) * DIAMETER / PUPIL_POINTS
    y, x = np.meshgrid(axis, axis, indexing="ij")
    points = np.stack([x.ravel(), y.ravel()], axis=1)
    owner = np.full(len(points), -1)
    for index, corners in enumerate(segments.corners):
        low, high = corners.min(axis=0), corners.max(axis=0)
        near = np.flatnonzero(((points >= low) & (points <= high)).all(axis=1))
        owner[near[Path(corners).contains_points(points[near])]] = index
    owner = owner.reshape(x.shape)
    return (
        (owner >= 0).astype(float),
        owner,
        np.stack([x, y]) - np.moveaxis(segments.centers[owner, :2], -1, 0),
    )


def peer_imager(
    segments: Segments, slopes: bool, transform: Callable[[NDArray[np.complex128]], NDArray[np.complex128]]
) -> Imager:
    """Image a sampled pupil by a peer's transform of complex fields (n, n) to (PIXELS, PIXELS)."""
    amplitude, owner, arm = sampled_pupil(segments)
    peak = np.abs(transform(amplitude + 0j)[PIXELS // 2, PIXELS // 2]) ** 2

    def image(phase: Real) -> Real:
        images = []
        for piston, slope_x, slope_y in np.moveaxis(phase, 2, 1):
            waves = piston[owner]
            if slopes:
                waves = waves + slope_x[owner] * arm[0] + slope_y[owner] * arm[1]
            field = transform(amplitude * np.exp(2j * np.pi * waves))
            images.append(np.abs(field.ravel()) ** 2 / peak)
        return np.array(images)

    return image


def poppy_imager(segments: Segments, slopes: bool) -> Imager:
    from poppy.matrixDFT import matrix_dft

    # Its kernel has the other sign, and its grid is moved to put the origin on pixel [n/2, n/2].
    def transform(field: NDArray[np.complex128]) -> NDArray[np.complex128]:
        size = PIXELS * SAMPLING
        return matrix_dft(field, size, PIXELS, centering="ADJUSTABLE", offset=(0.5, 0.5), inverse=True)

    return peer_imager(segments, slopes, transform)


def hcipy_imager(segments: Segments, slopes: bool) -> Imager:
    import hcipy

    pupil = hcipy.make_pupil_grid(PUPIL_POINTS, 1.0)
    axis = (np.arange(PIXELS) - PIXELS // 2) * SAMPLING
    focal = hcipy.CartesianGrid(hcipy.RegularCoords(SAMPLING, [PIXELS, PIXELS], [axis[0], axis[0]]))
    propagator = hcipy.FraunhoferPropagator(pupil, focal, focal_length=1.0)

    def transform(field: NDArray[np.complex128]) -> NDArray[np.complex128]:
        wavefront = hcipy.Wavefront(hcipy.Field(field.ravel(), pupil), wavelength=1.0)
        return np.asarray(propagator(wavefront).electric_field).reshape(PIXELS, PIXELS)

    return peer_imager(segments, slopes, transform)


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
    for name, build in (("poppy", poppy_imager), ("hcipy", hcipy_imager)):
        try:
            found[f"{name} {PUPIL_POINTS}²"] = build(segments, slopes)
        except ImportError:
            console.print(f"{name} is not installed (pip install {name}): that comparison is skipped")
    return found


def compare(segments: Segments, corner_slope: float, console: Console) -> Table:
    phase = phases(segments, corner_slope)
    candidates = imagers(segments, corner_slope > 0.0, console)
    exact_basis = segment_basis(
        segments.corners, segments.centers[:, :2], PIXELS, SAMPLING, DIAMETER, 28, np.complex128
    )
    exact = psf(exact_basis, phase, tolerance=1e-6)
    errors = {name: np.abs(image(phase) - exact).max() for name, image in candidates.items()}
    seconds: dict[str, list[float]] = {name: [] for name in candidates}
    for _ in range(REPEATS):
        for name, image in candidates.items():
            start = time.perf_counter()
            image(phase)
            seconds[name].append(time.perf_counter() - start)
    columns = Table("images", "ms/16 images", "images/s", "time/basis", "error/peak", box=None)
    first = np.array(next(iter(seconds.values())))
    for name, times in seconds.items():
        median, ratio = np.median(times), np.median(np.array(times) / first)
        columns.add_row(
            name, f"{1e3 * median:.2f}", f"{TILE / median:.0f}", f"{ratio:.1f}", f"{errors[name]:.1e}"
        )
    return columns


def main() -> None:
    console = Console()
    segments = telescope("tmt").segments
    with threadpool_limits(1):
        for corner_slope in (0.0, 5.0):
            console.print(compare(segments, corner_slope, console))


if __name__ == "__main__":
    main()
