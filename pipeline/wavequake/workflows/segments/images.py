"""Exposures of a bench: every instant's own point spread function, placed at its line of sight."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.imaging.engines.division import Division, divide, divided_phase
from wavequake.imaging.engines.matrix_fourier import samples_needed
from wavequake.imaging.engines.segment_basis import SegmentBasis, ray_basis, segment_basis
from wavequake.imaging.engines.segment_psf import amplitude_images, psf, shift_phase, truncation_error
from wavequake.imaging.exposures.placement import place
from wavequake.imaging.pupils.nyquist import too_few_rays
from wavequake.kernels.device.tiles import TILE, from_tiles
from wavequake.kernels.trace.train import Traced, vignetted
from wavequake.optics.segments.wavefront import Wavefront
from wavequake.prepared import prepared
from wavequake.tables import kept
from wavequake.workflows.segments.bench import Bench, bench_of, monolithic

Array = NDArray[np.float64]

# Moments tried in turn when the study says "auto": few suffice for pistons, many for tilted segments.
_AUTO_MOMENTS = (6, 15, 45)
# Largest error of an image relative to the perfect peak, as a worst-case bound; the real error is 10 to 100
# times less.
_TOLERANCE = 1e-3
# Steeper segments are cut into triangles, and these halved, as long as there are not too many of them.
_PARTS_MOMENTS, _HALVINGS, _MOST_PARTS = 28, 3, 4096
# An image that moves is computed on a canvas of twice the frame.
_CANVAS = 2


def image_axis(bench: Bench) -> Array:
    """Return the pixel centers of an image's axis in lambda/D."""
    imaging = bench.study.imaging
    return np.asarray((np.arange(imaging.pixels) - imaging.pixels // 2) * imaging.sampling, dtype=np.float64)


def by_rays(bench: Bench) -> bool:
    """Return whether all images are sums over rays.

    Those of mirrors without edges, of segments with a figure, and of telescopes that stop light at rest are.
    Segments that are planes of phase over all their glass have exact images.
    """
    return monolithic(bench.system) or bench.figure_terms > 0 or bench.stopped.vignetted > 0


def refuse_what_cannot_be_imaged(bench: Bench) -> None:
    """Raise UserError if the telescope at rest has no image at this field point and wavelength.

    Segments of plane phase must not be too steep for exact images, also where stopped light asks for sums.
    """
    if by_rays(bench) and bench.stopped.otherwise:
        raise UserError(
            f"{bench.stopped.words()}, so that images that are sums over rays would have holes: bring "
            "optics.field_arcmin nearer the axis, or set imaging.enabled = false."
        )
    if monolithic(bench.system) or bench.figure_terms:
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
    fill = scale["area"] / bench.stopped.light / scale["diameter"] ** 2  # of all glass, as the rays are
    if text := too_few_rays(bench.stopped.rays, fill, samples_needed(0.0, field), field):
        yield text


def energy_scale(bench: Bench) -> dict[str, Any]:
    """Return what encircled energies need: sampling, area of the glass whose light arrives at rest, diameter.

    Lengths are in mm.
    """
    return {
        "sampling": bench.study.imaging.sampling,
        "area": float(bench.layout.areas_m2.sum()) * 1e6 * bench.stopped.light,
        "diameter": 2.0 * bench.system.pupil_outer,
    }


def summed_images(bench: Bench, traced: Traced, wavefront: Wavefront, here: slice) -> Array:
    """Return the sum (pixels, pixels) of the images of some instants; arguments as `instant_images`."""
    total: Array = instant_images(bench, traced, wavefront, here).sum(axis=0)
    return total


def instant_images(bench: Bench, traced: Traced, wavefront: Wavefront, here: slice) -> Array:
    """Return the images (instants, pixels, pixels) of a case's instants `here` in a launch.

    Image axes are those of the image plane: +x is where a positive line of sight moves the image. If the line
    of sight moves by more than lambda/D, its whole pixels are taken out of the phase before the transform and
    put back by placing the image, computed on a larger canvas: segments see only the rest of a common tilt.
    Glass whose light a mirror stops is dark: images of such instants are sums over the rays that arrive. The
    unit is the peak of the perfect image of the pupil that arrives at rest.

    Raises
    ------
    UserError
        If segments are tilted beyond what the moments of the basis can image, or rays are lost otherwise
        where images are sums over rays.
    """
    imaging, prepared = bench.study.imaging, bench.prepared
    diameter = 2.0 * bench.system.pupil_outer
    per_mm = diameter / (prepared.wavelength * prepared.focal_length)
    position = (wavefront.los[here] - bench.static.los[0]) * per_mm
    moves = bool(np.abs(position).max() > 1.0)
    pixel = np.rint(position / imaging.sampling) if moves else np.zeros_like(position)
    shift = (wavefront.chief[here] - bench.static.chief[0]) * per_mm - pixel * imaging.sampling
    size = imaging.pixels * (_CANVAS if moves else 1)
    dark = wavefront.vignetted[here] > 0
    if by_rays(bench):
        frames = _ray_images(bench, traced, here, shift / diameter, size)
    else:
        centers = bench.system.segments.centers[:, :2]
        frames = _psf(bench, shift_phase(-wavefront.segment_phase[here], shift, centers, diameter), size)
        if dark.any():
            frames[dark] = _ray_images(bench, traced, here, shift / diameter, size)[dark]
    return place(frames.reshape(-1, size, size), pixel.astype(np.int64), imaging.pixels)


def _ray_images(
    bench: Bench, traced: Traced, here: slice, slopes: Array, size: int
) -> NDArray[np.floating[Any]]:
    """Return images (instants, size²) as sums over the rays; rays that mirrors stop are dark.

    ``slopes`` (instants, 2) of the phase, waves/mm, move them. An instant without a dark ray is none the less
    one of `psf`, so that its bits do not depend on those beside it.
    """
    prepared, basis = bench.prepared, _ray_basis(bench.text, size)
    # A phase that grows along +x moves the image to +x; the OPD of a positive line of sight falls along +x.
    tiles = slice(here.start // TILE, -(-here.stop // TILE))
    own = slice(here.start - tiles.start * TILE, here.stop - tiles.start * TILE)
    phase = -from_tiles(traced.opd[tiles])[own] / prepared.wavelength
    unknown = np.isnan(phase)
    if unknown.any():
        stopped = vignetted(prepared.train, np.asarray(traced.status[tiles]))
        arrived = ~stopped.swapaxes(1, 2).reshape(-1, phase.shape[1])[own]
        lost = int((unknown & arrived).any(axis=0).sum())
        if lost:
            raise UserError(
                f"{lost} rays are lost, so that an image that is a sum over rays would have holes"
            )
        phase[unknown] = 0.0
    phase = phase + slopes @ np.stack([prepared.rays.x, prepared.rays.y], axis=1).T
    images = psf(basis, phase)
    dark = unknown.any(axis=1)
    if dark.any():
        fields = np.where(unknown[dark], 0.0, np.exp(2j * np.pi * phase[dark]))
        images[dark] = amplitude_images(basis, fields)
    return images


def _psf(bench: Bench, phase: Array, pixels: int) -> NDArray[np.floating[Any]]:
    """Return the images of a case's segments with as many moments as the study says, or as they need.

    Segments that are too steep for any number of moments are imaged by their parts.
    """
    chosen = bench.study.imaging.moments
    if chosen != "auto":
        return psf(_basis(bench.text, pixels, chosen), phase)
    *quick, last = _AUTO_MOMENTS
    for moments in quick:
        basis = _basis(bench.text, pixels, moments)
        if truncation_error(basis, phase)[-1].max() <= _TOLERANCE:
            return psf(basis, phase, _TOLERANCE)
    whole = _basis(bench.text, pixels, last)
    if truncation_error(whole, phase)[-1].max() > _TOLERANCE:
        for halvings in range(_HALVINGS):
            parts = _division(bench.text, halvings)
            if len(parts.segment) > _MOST_PARTS:
                break
            basis, finer = _parts_basis(bench.text, pixels, halvings), divided_phase(parts, phase)
            if truncation_error(basis, finer)[-1].max() <= _TOLERANCE:
                return psf(basis, finer, _TOLERANCE)
    return psf(whole, phase, _TOLERANCE)


@prepared(maxsize=6)
def _basis(study_text: str, pixels: int, moments: int) -> SegmentBasis:
    bench = bench_of(study_text)
    segments = bench.system.segments
    centers = segments.centers[:, :2]
    return kept(
        SegmentBasis, segment_basis, segments.corners, centers, moments=moments, **_grid(bench, pixels)
    )


@prepared(maxsize=_HALVINGS)
def _division(study_text: str, halvings: int) -> Division:
    segments = bench_of(study_text).system.segments
    return divide(segments.corners, segments.centers[:, :2], halvings)


@prepared(maxsize=2 * _HALVINGS)
def _parts_basis(study_text: str, pixels: int, halvings: int) -> SegmentBasis:
    parts, grid = _division(study_text, halvings), _grid(bench_of(study_text), pixels)
    return kept(SegmentBasis, segment_basis, parts.corners, parts.centers, moments=_PARTS_MOMENTS, **grid)


@prepared(maxsize=4)
def _ray_basis(study_text: str, pixels: int) -> SegmentBasis:
    bench = bench_of(study_text)
    rays, weight = bench.prepared.rays, bench.prepared.weight
    basis = ray_basis(rays.x, rays.y, weight, **_grid(bench, pixels))
    return replace(basis, peak=basis.peak * bench.stopped.light)


def _grid(bench: Bench, pixels: int) -> dict[str, Any]:
    return {
        "pixels": pixels,
        "sampling": bench.study.imaging.sampling,
        "diameter": 2.0 * bench.system.pupil_outer,
    }
