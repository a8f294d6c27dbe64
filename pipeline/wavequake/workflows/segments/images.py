"""Exposures of a bench: every instant's own point spread function, placed at its line of sight."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wavequake.chain.images.camera import Camera
from wavequake.errors import UserError
from wavequake.imaging.engines.division import Division, divide, divided_phase
from wavequake.imaging.engines.segment_basis import SegmentBasis, ray_basis, segment_basis
from wavequake.imaging.engines.segment_psf import amplitude_images, psf, shift_phase, truncation_error
from wavequake.imaging.exposures.placement import place
from wavequake.kernels.device.devices import NUMPY, Device
from wavequake.kernels.device.tiles import TILE, from_tiles
from wavequake.kernels.trace.train import Traced, vignetted
from wavequake.optics.wavefronts.record import Wavefront
from wavequake.prepared import prepared
from wavequake.tables import kept
from wavequake.workflows.segments.bench import Bench, bench_at, bench_of, monolithic
from wavequake.workflows.systems.out_of_focus import place_of_image, waves_of_defocus

Array = NDArray[np.float64]

# Moments tried in turn when the study says "auto": few suffice for pistons, many for tilted segments.
_AUTO_MOMENTS = (6, 15, 45)
# Largest error of an image relative to the perfect peak, as a worst-case bound; the real error is 10 to 100
# times less.
_TOLERANCE = 1e-3
# Steeper segments are cut into triangles, and these halved, as long as there are not too many of them.
_PARTS_MOMENTS, _HALVINGS, _MOST_PARTS = 28, 3, 4096
CANVAS = 2
"""An image that moves is computed on a canvas of so many frames."""

_MM_PER_UM = 1e-3


def by_rays(bench: Bench) -> bool:
    """Return whether all images are sums over rays.

    Those of mirrors without edges, of figured segments or mirrors, and of telescopes that stop light at rest
    are. Segments that are planes of phase over all their glass have exact images, unless the study asks for
    sums.
    """
    return bench.study.imaging.engine == "rays" or bool(_why_rays(bench))


def _why_rays(bench: Bench) -> str:
    """Say why images of segments as planes of phase would not be exact; nothing if they are."""
    found = {
        "M1 is of one piece": monolithic(bench.system),
        "segments bend": bench.figure_terms > 0,
        "mirrors after M1 bend": bench.mirror_terms > 0,
        "mirrors stop light at rest": bench.stopped.vignetted > 0,
    }
    return next((why for why, there in found.items() if there), "")


def lit_coherently(bench: Bench) -> bool:
    """Return whether there is an object whose light interferes: its images are sums over rays."""
    shown = bench.study.object
    return shown is not None and shown.light != "incoherent"


def refuse_what_cannot_be_imaged(bench: Bench) -> None:
    """Raise UserError if the telescope at rest has no image at this field point and wavelength.

    Segments of plane phase must not be too steep for exact images, also where stopped light asks for sums.
    """
    if bench.study.imaging.engine == "segments" and (why := _why_rays(bench)):
        raise UserError(
            f"{_at(bench)}imaging.engine = 'segments' has no exact images, as {why}; take 'rays'."
        )
    summed = by_rays(bench) or bench.study.imaging.focus_um or lit_coherently(bench)
    if summed and bench.stopped.otherwise:
        raise UserError(
            f"{_at(bench)}{bench.stopped.words()}, so that images that are sums over rays would have holes: "
            f"bring {_field_key(bench)} nearer the axis, or set imaging.enabled = false."
        )
    if monolithic(bench.system) or bench.figure_terms or bench.mirror_terms:
        return
    try:
        _psf(bench, -bench.static.segment_phase[:TILE], bench.study.imaging.pixels)
    except UserError:
        raise UserError(
            f"{_at(bench)}The telescope {bench.system.name} at rest is too far from focus for an image (its "
            f"wavefront error is {bench.static.rms_raw[0]:.3g} waves rms): {_remedy(bench)}."
        ) from None


def _remedy(bench: Bench) -> str:
    """Say what to do about a wavefront error at rest: that of the image's place if it explains half of it."""
    optics, (*_, last, image) = bench.first_order, ("M1", *(one.name for one in bench.system.after_primary))
    waves = waves_of_defocus(optics.defocus, optics.numerical_aperture, bench.prepared.wavelength)
    if waves < 0.5 * bench.static.rms_raw[0] and not np.any(bench.field):
        return "light along the axis has no common focus; mend a conic"
    if waves < 0.5 * bench.static.rms_raw[0]:
        return f"bring {_field_key(bench)} nearer the axis, or mend the prescription"
    return f"{place_of_image(image, last, optics.defocus, optics.back_focus)}; mend a distance_mm or a radius"


def _field_key(bench: Bench) -> str:
    return "optics.field_arcmin" if bench.study.optics.fields_arcmin is None else "optics.fields_arcmin"


def _at(bench: Bench) -> str:
    return f"At {bench.where}: " if bench.where else ""


def colors(bench: Bench) -> tuple[tuple[float, float], ...]:
    """Return of each wavelength of the images how much shorter than that of lambda/D it is, and how bright.

    Mirrors make the same path differences for all colors. How bright it is, is the share of the perfect peak.
    """
    imaging, wavelength = bench.study.imaging, bench.study.optics.wavelength_nm
    if imaging.wavelengths_nm is None:
        return ((wavelength / bench.wavelength_nm, 1.0),)
    factors = wavelength / np.array(imaging.wavelengths_nm)
    bright = np.array(imaging.weights or np.ones(len(factors))) * factors**2
    return tuple((float(f), float(b)) for f, b in zip(factors, bright / bright.sum(), strict=True) if b)


def energy_scale(bench: Bench) -> dict[str, Any]:
    """Return what encircled energies need: sampling, area of the glass whose light arrives at rest, diameter.

    Lengths are in mm. In several colors the area is that whose perfect image holds the same light under the
    peak.
    """
    colored = 1.0 / sum(share / factor**2 for factor, share in colors(bench))
    return {
        "sampling": bench.study.imaging.sampling,
        "area": float(bench.layout.areas_m2.sum()) * 1e6 * bench.stopped.light * colored,
        "diameter": 2.0 * bench.system.annulus.outer,
    }


def camera_of(bench: Bench) -> Camera:
    """Return what makes numbers of the exposures of a study."""
    imaging, scale = bench.study.imaging, energy_scale(bench)
    per_mm = scale["diameter"] / (bench.unit_mm * abs(bench.prepared.focal_length))
    size = (scale["area"],), scale["diameter"], 1.0 / per_mm
    return Camera(imaging.pixels, imaging.sampling, *size, imaging.resolution, bench.study.detector)


def summed_images(
    bench: Bench, traced: Traced, wavefront: Wavefront, here: slice, behind_um: float = 0.0, frames: int = 1
) -> Array:
    """Return the sum (pixels, pixels) of the images of some instants; arguments as `instant_images`."""
    total: Array = instant_images(bench, traced, wavefront, here, behind_um, frames).sum(axis=0)
    return total


def instant_images(
    bench: Bench, traced: Traced, wavefront: Wavefront, here: slice, behind_um: float = 0.0, frames: int = 1
) -> Array:
    """Return the images (instants, pixels, pixels) of a case's instants `here` in a launch.

    They are so many ``frames`` wide.

    Image axes are those of the image plane: +x is where a positive line of sight moves the image. If the line
    of sight moves by more than lambda/D, its whole pixels are taken out of the phase before the transform and
    put back by placing the image, computed on a larger canvas: segments see only the rest of a common tilt.
    Glass whose light a mirror stops is dark: images of such instants are sums over the rays that arrive. So
    are those in planes behind the image (along the light), about where the chief ray meets them. The
    unit is the peak of the perfect image of the pupil that arrives at rest.

    Raises
    ------
    UserError
        If segments are tilted beyond what the moments of the basis can image, or rays are lost otherwise
        where images are sums over rays.
    """
    imaging, prepared = bench.study.imaging, bench.prepared
    diameter = 2.0 * bench.system.annulus.outer
    per_mm = diameter / (bench.unit_mm * prepared.focal_length)
    position = (wavefront.los[here] - bench.static.los[0]) * per_mm
    moves = bool(np.abs(position).max() > 1.0)
    pixel = np.rint(position / imaging.sampling) if moves else np.zeros_like(position)
    size = frames * imaging.pixels * (CANVAS if moves else 1)
    images = local_images(bench, traced, wavefront, here, pixel * imaging.sampling, size, behind_um)
    if not moves:
        return images.astype(np.float64)
    return place(images, pixel.astype(np.int64), frames * imaging.pixels)


def local_images(
    bench: Bench,
    traced: Traced,
    wavefront: Wavefront,
    here: slice,
    about: Array,
    size: int,
    behind_um: float = 0.0,
) -> NDArray[np.floating[Any]]:
    """Return images (instants, size, size) about places (instants, 2) in lambda/D; as `instant_images`."""
    per_mm = 2.0 * bench.system.annulus.outer / (bench.unit_mm * bench.prepared.focal_length)
    shift = (wavefront.chief[here] - bench.static.chief[0]) * per_mm - about
    frames = [
        _colored(bench, traced, wavefront, here, shift, size, factor, behind_um)
        for factor, _ in colors(bench)
    ]
    if len(frames) > 1:
        shares = [share for _, share in colors(bench)]
        frames = [np.tensordot(shares, np.stack(frames), axes=1)]
    return np.asarray(frames[0].reshape(-1, size, size))


def _colored(
    bench: Bench,
    traced: Traced,
    wavefront: Wavefront,
    here: slice,
    shift: Array,
    size: int,
    factor: float,
    behind_um: float,
) -> NDArray[np.floating[Any]]:
    """Return images (instants, size²) at a wavelength that is shorter by a factor, moved by lambda/D."""
    diameter, dark = 2.0 * bench.system.annulus.outer, wavefront.vignetted[here] > 0
    if by_rays(bench) or behind_um:
        return _ray_images(bench, traced, here, shift / diameter, size, factor, behind_um, wavefront.device)
    frames = _psf(bench, _planes(bench, wavefront, here, shift) * factor, size, factor, wavefront.device)
    if dark.any():
        lit = _ray_images(bench, traced, here, shift / diameter, size, factor, 0.0, wavefront.device)
        frames[dark] = lit[dark]
    return frames


def _planes(bench: Bench, wavefront: Wavefront, here: slice | NDArray[np.intp], shift: Array) -> Array:
    """Return the phases (instants, S, 3) of segments in waves of lambda/D, moved by lambda/D."""
    centers, waves = bench.system.segments.centers[:, :2], bench.prepared.wavelength / bench.unit_mm
    diameter = 2.0 * bench.system.annulus.outer
    return shift_phase(-waves * wavefront.segment_phase[here], shift, centers, diameter)


def still_images(
    bench: Bench, wavefront: Wavefront, instants: Sequence[int], frames: int
) -> dict[int, Array]:
    """Return images of cases that have a single instant, by its number: as `instant_images`, a tile at once.

    Each takes the moments that it needs by itself, and lanes of a processor's vectors compute alone: bits do
    not depend on the others. Left out are those whose images are made in another way.
    """
    imaging, device = bench.study.imaging, wavefront.device
    (factor, _), *more = colors(bench)
    if device.kind != "cpu" or by_rays(bench) or imaging.moments != "auto" or more:
        return {}
    here = np.array([one for one in instants if not wavefront.vignetted[one]], dtype=np.intp)
    per_mm = 2.0 * bench.system.annulus.outer / (bench.unit_mm * bench.prepared.focal_length)
    here = here[np.abs((wavefront.los[here] - bench.static.los[0]) * per_mm).max(axis=1, initial=0.0) <= 1.0]
    shift = (wavefront.chief[here] - bench.static.chief[0]) * per_mm
    phase, size = _planes(bench, wavefront, here, shift) * factor, frames * imaging.pixels
    found: dict[int, Array] = {}
    for moments in _AUTO_MOMENTS[:-1]:
        if not len(here):
            break
        basis = _basis(bench.text, size, moments, factor)
        bounds = truncation_error(basis, phase)
        enough = bounds <= _TOLERANCE
        needed = np.where(enough[-1], enough.argmax(axis=0), -1)
        for degree in np.unique(needed[enough[-1]]):
            rows = np.flatnonzero(needed == degree)
            images = psf(basis, phase[rows], _TOLERANCE, device, bounds[:, rows]).astype(np.float64)
            found |= zip(here[rows].tolist(), images.reshape(-1, size, size), strict=True)
        here, phase = here[needed < 0], phase[needed < 0]
    return found


def _ray_images(
    bench: Bench,
    traced: Traced,
    here: slice,
    slopes: Array,
    size: int,
    factor: float,
    behind_um: float,
    device: Device,
) -> NDArray[np.floating[Any]]:
    """Return images (instants, size²) as sums over the rays; rays that mirrors stop are dark.

    ``slopes`` (instants, 2) of the phase, waves/mm, move them. An instant without a dark ray is none the less
    one of `psf`, so that its bits do not depend on those beside it.
    """
    basis = _lit_basis(bench.text, bench.place, size, factor)
    return images_of_rays(basis, ray_phase(bench, traced, here, slopes, behind_um) * factor, device)


def images_of_rays(basis: SegmentBasis, phase: Array, device: Device = NUMPY) -> NDArray[np.floating[Any]]:
    """Return images (instants, size²) of phases (instants, R) in waves; a ray whose phase is NaN is dark."""
    unknown = np.isnan(phase)
    images = psf(basis, np.where(unknown, 0.0, phase), device=device)
    dark = unknown.any(axis=1)
    if dark.any():
        fields = np.where(unknown[dark], 0.0, np.exp(2j * np.pi * phase[dark]))
        images[dark] = amplitude_images(basis, fields)
    return images


def ray_phase(bench: Bench, traced: Traced, here: slice, slopes: Array, behind_um: float = 0.0) -> Array:
    """Return the phases (instants, R) of rays in waves of the first wavelength; NaN: a mirror stops it.

    ``slopes`` (instants, 2), waves/mm, are added; so is what the light gains on its way to a plane behind the
    image.

    Raises
    ------
    UserError
        If rays are lost otherwise.
    """
    # A phase that grows along +x moves the image to +x; the OPD of a positive line of sight falls along +x.
    prepared, tiles = bench.prepared, slice(here.start // TILE, -(-here.stop // TILE))
    own = slice(here.start - tiles.start * TILE, here.stop - tiles.start * TILE)
    phase = np.asarray(-from_tiles(traced.opd[tiles])[own] / bench.unit_mm)
    unknown = np.isnan(phase)
    if unknown.any():
        stopped = vignetted(prepared.train, np.asarray(traced.status[tiles]))
        arrived = ~stopped.swapaxes(1, 2).reshape(-1, phase.shape[1])[own]
        lost = int((unknown & arrived).any(axis=0).sum())
        if lost:
            raise UserError(
                f"{lost} rays are lost, so that an image that is a sum over rays would have holes"
            )
    phase = phase + slopes @ np.stack([prepared.rays.x, prepared.rays.y], axis=1).T
    if behind_um:  # a plane wave gains s cos(angle) on its way s along the axis, by Abbe's sine condition
        sine2 = (prepared.rays.x**2 + prepared.rays.y**2) / prepared.focal_length**2
        phase = phase + (np.sqrt(1.0 - sine2) - 1.0) * (behind_um * _MM_PER_UM / bench.unit_mm)
    return phase


def _psf(
    bench: Bench, phase: Array, pixels: int, factor: float = 1.0, device: Device = NUMPY
) -> NDArray[np.floating[Any]]:
    """Return the images of a case's segments with as many moments as the study says, or as they need.

    Segments that are too steep for any number of moments are imaged by their parts.
    """
    chosen = bench.study.imaging.moments
    if chosen != "auto":
        return psf(_basis(bench.text, pixels, chosen, factor), phase, device=device)
    *quick, last = _AUTO_MOMENTS
    for moments in quick:
        basis = _basis(bench.text, pixels, moments, factor)
        bounds = truncation_error(basis, phase)
        if bounds[-1].max() <= _TOLERANCE:
            return psf(basis, phase, _TOLERANCE, device, bounds)
    whole = _basis(bench.text, pixels, last, factor)
    if truncation_error(whole, phase)[-1].max() > _TOLERANCE:
        for halvings in range(_HALVINGS):
            parts = _division(bench.text, halvings)
            if len(parts.segment) > _MOST_PARTS:
                break
            basis, finer = _parts_basis(bench.text, pixels, halvings, factor), divided_phase(parts, phase)
            if truncation_error(basis, finer)[-1].max() <= _TOLERANCE:
                return psf(basis, finer, _TOLERANCE, device)
    return psf(whole, phase, _TOLERANCE, device)


@prepared(maxsize=18)
def _basis(study_text: str, pixels: int, moments: int, factor: float) -> SegmentBasis:
    bench = bench_of(study_text)
    segments = bench.system.segments
    centers = segments.centers[:, :2]
    grid = _grid(bench, pixels, factor)
    return kept(SegmentBasis, segment_basis, segments.corners, centers, moments=moments, **grid)


@prepared(maxsize=_HALVINGS)
def _division(study_text: str, halvings: int) -> Division:
    segments = bench_of(study_text).system.segments
    return divide(segments.corners, segments.centers[:, :2], halvings)


@prepared(maxsize=2 * _HALVINGS)
def _parts_basis(study_text: str, pixels: int, halvings: int, factor: float) -> SegmentBasis:
    parts, grid = _division(study_text, halvings), _grid(bench_of(study_text), pixels, factor)
    return kept(SegmentBasis, segment_basis, parts.corners, parts.centers, moments=_PARTS_MOMENTS, **grid)


@prepared(maxsize=12)
def _ray_basis(study_text: str, pixels: int, factor: float) -> SegmentBasis:
    bench = bench_of(study_text)
    rays, weight = bench.prepared.rays, bench.prepared.weight
    return ray_basis(rays.x, rays.y, weight, **_grid(bench, pixels, factor))


@prepared(maxsize=128)
def _lit_basis(study_text: str, place: int, pixels: int, factor: float) -> SegmentBasis:
    """Return the basis of rays for the light that arrives of a field point; its arrays are those of all."""
    basis = _ray_basis(study_text, pixels, factor)
    return replace(basis, peak=basis.peak * bench_at(study_text, place).stopped.light)


def _grid(bench: Bench, pixels: int, factor: float) -> dict[str, Any]:
    return {
        "pixels": pixels,
        "sampling": bench.study.imaging.sampling * factor,
        "diameter": 2.0 * bench.system.annulus.outer,
    }
