"""Exposures of a bench: every instant's own point spread function, placed at its line of sight."""

from collections.abc import Iterator
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.imaging.matrix_fourier import samples_needed
from wavequake.imaging.nyquist import too_few_rays
from wavequake.imaging.placement import place
from wavequake.imaging.segment_basis import SegmentBasis, ray_basis, segment_basis
from wavequake.imaging.segment_psf import psf, shift_phase, truncation_error
from wavequake.kernels.tiles import TILE, from_tiles
from wavequake.kernels.train import Traced
from wavequake.optics.wavefront import Wavefront
from wavequake.workflows.segments.bench import Bench, bench_of, monolithic

Array = NDArray[np.float64]

# Moments tried in turn when the study says "auto": few suffice for pistons, many for tilted segments.
_AUTO_MOMENTS = (6, 15, 45)
# Largest error of an image relative to the perfect peak, as a worst-case bound; the real error is 10 to 100
# times less.
_TOLERANCE = 1e-3
# An image that moves is computed on a canvas of twice the frame.
_CANVAS = 2


def image_axis(bench: Bench) -> Array:
    """Return the pixel centers of an image's axis in lambda/D."""
    imaging = bench.study.imaging
    return np.asarray((np.arange(imaging.pixels) - imaging.pixels // 2) * imaging.sampling, dtype=np.float64)


def by_rays(bench: Bench) -> bool:
    """Return whether images are sums over rays: of mirrors without edges, and of segments with a figure.

    Segments without a figure are planes of phase, whose images are exact.
    """
    return monolithic(bench.system) or bench.figure_terms > 0


def refuse_what_cannot_be_imaged(bench: Bench) -> None:
    """Raise UserError if the telescope at rest has no image at this field point and wavelength."""
    if by_rays(bench):
        return
    try:
        _psf(bench, -bench.static.segment_phase[:TILE], bench.study.imaging.pixels)
    except UserError:
        raise UserError(
            f"The telescope {bench.system.name} at rest is too far from focus for an image (its wavefront "
            f"error is {bench.static.rms_raw[0]:.3g} waves rms): bring optics.field_arcmin nearer the axis, "
            "or mend the prescription."
        ) from None


def ray_notices(bench: Bench) -> Iterator[str]:
    """Yield what to say of too few rays for the field of images that are sums over rays."""
    imaging = bench.study.imaging
    if not imaging.enabled or not by_rays(bench):
        return
    scale = energy_scale(bench)
    field = _CANVAS * imaging.pixels * imaging.sampling
    fill = scale["area"] / scale["diameter"] ** 2
    if text := too_few_rays(len(bench.prepared.weight), fill, samples_needed(0.0, field), field):
        yield text


def energy_scale(bench: Bench) -> dict[str, Any]:
    """Return what encircled energies of this pupil need: sampling, glass area and diameter in mm."""
    return {
        "sampling": bench.study.imaging.sampling,
        "area": float(bench.layout.areas_m2.sum()) * 1e6,
        "diameter": 2.0 * bench.system.pupil_outer,
    }


def summed_images(bench: Bench, traced: Traced, wavefront: Wavefront, tiles: slice, instants: int) -> Array:
    """Return the sum (pixels, pixels) of the images of a case's first `instants` in the launch's `tiles`.

    Image axes are those of the image plane: +x is where a positive line of sight moves the image. If the line
    of sight moves by more than lambda/D, its whole pixels are taken out of the phase before the transform and
    put back by placing the image, computed on a larger canvas: segments see only the rest of a common tilt.

    Raises
    ------
    UserError
        If segments are tilted beyond what the moments of the basis can image, or rays of a figured mirror
        are lost.
    """
    imaging, prepared = bench.study.imaging, bench.prepared
    batch = slice(tiles.start * TILE, tiles.stop * TILE)
    diameter = 2.0 * bench.system.pupil_outer
    per_mm = diameter / (prepared.wavelength * prepared.focal_length)
    position = (wavefront.los[batch] - bench.static.los[0]) * per_mm
    moves = bool(np.abs(position).max() > 1.0)
    pixel = np.rint(position / imaging.sampling) if moves else np.zeros_like(position)
    shift = (wavefront.chief[batch] - bench.static.chief[0]) * per_mm - pixel * imaging.sampling
    # A phase that grows along +x moves the image to +x; the OPD of a positive line of sight falls along +x.
    if by_rays(bench):
        phase = -from_tiles(traced.opd[tiles]) / prepared.wavelength
        if np.isnan(phase).any():
            lost = int(np.isnan(phase).any(axis=0).sum())
            raise UserError(f"{lost} rays are lost, so that the image of the figured mirror would have holes")
        places = np.stack([prepared.rays.x, prepared.rays.y], axis=1)
        phase = phase + (shift / diameter) @ places.T
    else:
        phase = shift_phase(
            -wavefront.segment_phase[batch], shift, bench.system.segments.centers[:, :2], diameter
        )
    size = imaging.pixels * (_CANVAS if moves else 1)
    frames = _psf(bench, phase, size).reshape(-1, size, size)[:instants]
    placed: Array = place(frames, pixel[:instants].astype(np.int64), imaging.pixels).sum(axis=0)
    return placed


def _psf(bench: Bench, phase: Array, pixels: int) -> NDArray[np.floating[Any]]:
    """Return the images of a case's phases with as many moments as the study says, or as they need."""
    chosen = bench.study.imaging.moments
    if by_rays(bench):
        return psf(_basis(bench.text, pixels, 1), phase)
    if chosen != "auto":
        return psf(_basis(bench.text, pixels, chosen), phase)
    *quick, last = _AUTO_MOMENTS
    for moments in quick:
        basis = _basis(bench.text, pixels, moments)
        if truncation_error(basis, phase)[-1].max() <= _TOLERANCE:
            return psf(basis, phase, _TOLERANCE)
    return psf(_basis(bench.text, pixels, last), phase, _TOLERANCE)


@lru_cache(maxsize=6)
def _basis(study_text: str, pixels: int, moments: int) -> SegmentBasis:
    bench = bench_of(study_text)
    imaging, system, rays = bench.study.imaging, bench.system, bench.prepared.rays
    grid: dict[str, Any] = {
        "pixels": pixels,
        "sampling": imaging.sampling,
        "diameter": 2.0 * system.pupil_outer,
    }
    if by_rays(bench):
        return ray_basis(rays.x, rays.y, bench.prepared.weight, **grid)
    return segment_basis(system.segments.corners, system.segments.centers[:, :2], moments=moments, **grid)
