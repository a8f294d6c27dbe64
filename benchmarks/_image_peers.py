"""How peers make the images of `benchmarks.imaging`: from pupils sampled at 512 x 512 points."""

from collections.abc import Callable
from typing import Any

import numpy as np
from matplotlib.path import Path
from numpy.typing import NDArray
from rich.console import Console

from wavequake.imaging.pupils.pupil_function import PupilGrid
from wavequake.optics.segments.layout import Segments

Real = NDArray[np.float64]
Imager = Callable[[Real], Real]  # segment phases (batch, S, 3) to images (batch, pixels**2)
Transform = Callable[[NDArray[np.complex128]], NDArray[np.complex128]]  # fields (n, n) to (pixels, pixels)

SAMPLING, DIAMETER = 0.25, 30000.0
PUPIL_POINTS = 512


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


def peer_imager(segments: Segments, slopes: bool, transform: Transform) -> Imager:
    """Image a sampled pupil by a peer's transform of complex fields (n, n) to (pixels, pixels)."""
    amplitude, owner, arm = sampled_pupil(segments)
    peak = (np.abs(transform(amplitude + 0j)) ** 2).max()

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


def hcipy_mirror(segments: Segments, pixels: int, slopes: bool) -> Imager:
    """Image by hcipy's segmented mirror, whose modes are made of the same sampled segments."""
    import hcipy
    from scipy.sparse import csr_matrix

    amplitude, owner, _ = sampled_pupil(segments)
    pupil = hcipy.make_pupil_grid(PUPIL_POINTS, 1.0)
    light = hcipy.Field(amplitude.ravel(), pupil)
    masks = [csr_matrix((owner.ravel() == index).astype(float)) for index in range(len(segments))]
    mirror = hcipy.SegmentedDeformableMirror(hcipy.ModeBasis(masks, pupil))
    propagate = hcipy_propagator(pixels)
    peak = propagate(hcipy.Wavefront(light, wavelength=1.0)).power.max()

    def image(phase: Real) -> Real:
        images = []
        for motion in phase:
            # Twice the surface is the path; slopes are per diameter there.
            scale = 0.5 * np.array([1.0, DIAMETER, DIAMETER]) * np.array([1.0, slopes, slopes])
            mirror.actuators = (motion * scale).T.ravel()
            field = propagate(mirror.forward(hcipy.Wavefront(light, wavelength=1.0)))
            images.append(np.asarray(field.power) / peak)
        return np.array(images)

    return image


def poppy_transform(pixels: int) -> Transform:
    from poppy.matrixDFT import matrix_dft

    # Its kernel has the other sign, and its grid is moved to put the origin on pixel [n/2, n/2].
    size = pixels * SAMPLING
    options = {"centering": "ADJUSTABLE", "offset": (0.5, 0.5), "inverse": True}
    return lambda field: matrix_dft(field, size, pixels, **options)


def hcipy_propagator(pixels: int) -> Callable[[Any], Any]:
    import hcipy

    pupil = hcipy.make_pupil_grid(PUPIL_POINTS, 1.0)
    axis = (np.arange(pixels) - pixels // 2) * SAMPLING
    focal = hcipy.CartesianGrid(hcipy.RegularCoords(SAMPLING, [pixels, pixels], [axis[0], axis[0]]))
    return hcipy.FraunhoferPropagator(pupil, focal, focal_length=1.0)


def hcipy_transform(pixels: int) -> Transform:
    import hcipy

    pupil, propagator = hcipy.make_pupil_grid(PUPIL_POINTS, 1.0), hcipy_propagator(pixels)

    def transform(field: NDArray[np.complex128]) -> NDArray[np.complex128]:
        wavefront = hcipy.Wavefront(hcipy.Field(field.ravel(), pupil), wavelength=1.0)
        return np.asarray(propagator(wavefront).electric_field).reshape(pixels, pixels)

    return transform


def prysm_transform(pixels: int) -> Transform:
    from prysm.fttools import mdft

    return lambda field: mdft.dft2(field, 1.0 / SAMPLING, pixels)


def peers(pixels: int, console: Console) -> dict[str, Transform]:
    """Return the transforms of installed peers, by name."""
    found: dict[str, Transform] = {}
    builders = {"poppy": poppy_transform, "hcipy": hcipy_transform, "prysm": prysm_transform}
    for name, build in builders.items():
        try:
            found[name] = build(pixels)
        except ImportError:
            console.print(f"{name} is not installed (pip install {name}): that comparison is skipped")
    return found


def round_images(grid: PupilGrid, transform: Transform, phase: Real) -> Real:
    """Image a round pupil by a peer's transform."""
    full = np.zeros(grid.amplitude.size)
    images = []
    for instant in phase:
        full[grid.cells] = instant
        field = transform(grid.amplitude * np.exp(1j * full.reshape(grid.amplitude.shape)))
        images.append(np.abs(field) ** 2)
    dark = np.abs(transform(grid.amplitude + 0j)[len(images[0]) // 2, len(images[0]) // 2]) ** 2
    return np.array(images) / dark
