"""Exposures of a case while its instants are imaged, in the image, through focus and of an object.

A line of sight that runs on between the instants that are traced leaves a streak, not dots.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wavequake.chain.images.camera import noise_of, seen
from wavequake.chain.images.coherent import LitObject, lit_images, lit_object
from wavequake.chain.images.extended import object_image
from wavequake.imaging.engines.matrix_fourier import samples_needed
from wavequake.imaging.exposures.exposure import encircled_energy_radius
from wavequake.imaging.exposures.exposure_models import cut
from wavequake.imaging.exposures.smear import Smeared, add_smeared, empty_total, smeared_image
from wavequake.imaging.pupils.nyquist import too_few_rays
from wavequake.kernels.device.devices import NUMPY
from wavequake.kernels.device.tiles import TILE
from wavequake.kernels.trace.train import Traced
from wavequake.mechanics.disturbances.registry import parts
from wavequake.optics.polynomials.zernike import noll_to_nm
from wavequake.optics.segments.prepared import chief_rays, trace_states
from wavequake.optics.segments.wavefront import analyse
from wavequake.optics.systems.kinematics import rest_states
from wavequake.optics.wavefronts.record import Wavefront
from wavequake.prepared import prepared
from wavequake.workflows.segments.bench import MAS_PER_RAD, Bench, bench_at, monolithic
from wavequake.workflows.segments.images import (
    CANVAS,
    by_rays,
    camera_of,
    colors,
    energy_scale,
    lit_coherently,
    local_images,
    ray_phase,
    still_images,
    summed_images,
)
from wavequake.workflows.segments.launches import CaseDraw, Piece

Array = NDArray[np.float64]

# Standard deviations of the line of sight that frames should reach.
_REACH = 2.5
# Highest degree of a figure whose rms over a hexagon so many rays give within 5 %.
_FIGURE_DEGREES = {6: 1, 18: 2, 36: 3, 72: 5}


@dataclass(frozen=True)
class Gathered:
    """The exposures of a case while they are gathered.

    Attributes
    ----------
    ways : ndarray, shape (n, m, 2), optional
        Line of sight from the instant before to each of those that are traced, lambda/D, where it moves by
        itself. The last place is first.
    totals : tuple of ndarray or Smeared
        Sums of all images so far, in the image and in planes through focus; with ways, as they move.
    lit : ndarray or Smeared, optional
        The same of an object whose light interferes.
    """

    ways: Array | None
    totals: tuple[Array | Smeared, ...]
    lit: Array | Smeared | None


def frame_notices(bench: Bench) -> Iterator[str]:
    """Yield a sentence for each disturbance whose line of sight leaves the frames of the images."""
    imaging = bench.study.imaging
    if not imaging.enabled:
        return
    unit = bench.unit_mm / (2.0 * bench.system.annulus.outer) * MAS_PER_RAD
    half = 0.5 * imaging.pixels * imaging.sampling * unit
    for entry in bench.study.disturbance:
        moving = [part for part in parts(bench.study.disturbance, entry) if part.sight]
        sights = [part.analytic_rms(bench.layout) for part in moving]
        rms = float(np.sqrt(sum(one[0] ** 2 for one in sights if one)))
        if entry.share and _REACH * rms > half:
            pixels = 2 * int(np.ceil(_REACH * rms / (imaging.sampling * unit)))
            yield (
                f"{entry.name} moves the line of sight by {rms:.3g} mas rms; frames reach {half:.3g} mas, "
                f"so that they lose light of its streak; take imaging.pixels = {pixels}, or larger pixels"
            )


def ray_notices(bench: Bench) -> Iterator[str]:
    """Yield what to say of too few rays for the field of images that are sums over rays."""
    imaging = bench.study.imaging
    if not imaging.enabled or not (by_rays(bench) or lit_coherently(bench)):
        return
    scale = energy_scale(bench)
    field = CANVAS * imaging.pixels * imaging.sampling * max(factor for factor, _ in colors(bench))
    fill = scale["area"] / bench.stopped.light / scale["diameter"] ** 2  # of all glass, as the rays are
    if text := too_few_rays(bench.stopped.rays, fill, samples_needed(0.0, field), field):
        yield text


def coarse_figures(bench: Bench) -> Iterator[str]:
    """Yield what to say of figures that are too fine for the rays of a segment."""
    optics = bench.study.optics
    if optics.sampling != "segments" or monolithic(bench.system) or not bench.figure_terms:
        return
    degree, rays = noll_to_nm(bench.figure_terms)[0], optics.rays_per_segment
    if degree > _FIGURE_DEGREES[rays]:
        enough = [str(count) for count, most in _FIGURE_DEGREES.items() if degree <= most]
        remedy = f"optics.rays_per_segment = {enough[0]}" if enough else "optics.sampling = 'sunflower'"
        yield (
            f"{rays} rays per segment are too few for its figure of j = {bench.figure_terms}, whose rms they "
            f"may miss by more than 5 %; take {remedy}"
        )


def gather(bench: Bench, way: Array | None = None) -> Gathered:
    """Return the exposures of a case of which nothing is imaged yet.

    ``way`` (n, m, 2) is its line of sight between instants in rad, where it moves by itself.

    Raises
    ------
    UserError
        If the line of sight moves too far for an image.
    """
    imaging, ways = bench.study.imaging, None
    size = _frames(bench) * imaging.pixels
    if way is not None and (way != way[0, 0]).any():
        ways = way * (2.0 * bench.system.annulus.outer / bench.unit_mm)

    def none_yet(pixels: int) -> Array | Smeared:
        if ways is None:
            return np.zeros((pixels, pixels))
        return empty_total(CANVAS * imaging.pixels, ways, imaging.sampling, pixels)

    totals = tuple(none_yet(size) for _ in (0.0, *imaging.focus_um))
    return Gathered(ways, totals, none_yet(imaging.pixels) if lit_coherently(bench) else None)


def _frames(bench: Bench) -> int:
    """Return how many frames wide exposures are made: incoherent light of an object moves in from outside."""
    return CANVAS if bench.study.object is not None and not lit_coherently(bench) else 1


def images_of_stills(
    bench: Bench, wavefront: Wavefront, launch: list[Piece], draws: list[CaseDraw], instants: list[int]
) -> dict[int, Array]:
    """Return the images in focus of cases that stand still, by their rows, as far as a tile makes them."""
    there = {one.place: one.row for one in launch if instants[one.row] == 1 and draws[one.row].way is None}
    found = still_images(bench, wavefront, sorted(there), _frames(bench))
    return {there[place]: image for place, image in found.items()}


def add_images(
    bench: Bench,
    gathered: Gathered,
    traced: Traced,
    wavefront: Wavefront,
    piece: Piece,
    focused: Array | None = None,
) -> None:
    """Add the images of a piece of a case to its exposures; raises as `instant_images`.

    That of a single instant may be known in focus, (pixels, pixels).
    """
    imaging, there, ways = bench.study.imaging, slice(piece.first, piece.last), gathered.ways
    for total, behind in zip(gathered.totals, (0.0, *imaging.focus_um), strict=True):
        if isinstance(total, Smeared):
            assert ways is not None  # what is smeared has moved
            size = CANVAS * imaging.pixels
            images = local_images(bench, traced, wavefront, piece.here, ways[there, 0], size, behind)
            add_smeared(total, images, ways[there], imaging.sampling)
        elif focused is not None and not behind:
            total += focused
        else:
            total += summed_images(bench, traced, wavefront, piece.here, behind, _frames(bench))
    if gathered.lit is None:
        return
    diameter = 2.0 * bench.system.annulus.outer
    per_mm = 1.0 / (bench.unit_mm * bench.prepared.focal_length)
    slopes = (wavefront.chief[piece.here] - bench.static.chief[0]) * per_mm
    if ways is not None:
        slopes = slopes - ways[there, 0] / diameter
    lit, first = _lit(bench.text, bench.place, 1 if ways is None else CANVAS), piece.first
    phases = ray_phase(bench, traced, piece.here, slopes) * (bench.unit_mm / bench.prepared.wavelength)
    for images in lit_images(lit, phases):
        last = first + len(images)
        if isinstance(gathered.lit, Smeared):
            assert ways is not None
            add_smeared(gathered.lit, images, ways[first:last], imaging.sampling)
        else:
            gathered.lit[:] += images.sum(axis=0)
        first = last


@prepared(maxsize=4)
def _lit(study_text: str, place: int, canvas: int) -> LitObject:
    """Return the object of a study as the rays of a field point see it, on a canvas of so many frames."""
    bench = bench_at(study_text, place)
    imaging, rays, shown = bench.study.imaging, bench.prepared.rays, bench.study.object
    assert shown is not None
    glass = float(bench.layout.areas_m2.sum()) * 1e6
    # A pupil seems that much larger in shorter light.
    diameter = 2.0 * bench.system.annulus.outer * (bench.prepared.wavelength / bench.unit_mm)
    size = imaging.pixels, imaging.sampling, glass, diameter
    return lit_object(shown, (rays.x, rays.y, bench.prepared.weight), *size, canvas)


def exposed(bench: Bench, gathered: Gathered, instants: int, drawn: CaseDraw) -> dict[str, Array]:
    """Return the exposures of a whole case of so many traced instants, and what a camera makes of them."""
    imaging = bench.study.imaging
    canvas, *through = (_mean(bench, gathered, total, instants) for total in gathered.totals)
    exposure = cut(canvas, imaging.pixels)
    found = {"exposure": exposure, "peak": np.asarray(exposure.max())}
    if through:
        found["exposure_focus"] = np.stack([cut(one, imaging.pixels) for one in through])
    own = f"/{bench.place}" if bench.place else ""  # the detector's noise at each field point
    noise = noise_of(bench.study.study.seed, f"{drawn.population.name}{own}", drawn.realization)
    found |= {name: values[0] for name, values in seen(camera_of(bench), exposure[None], noise).items()}
    if bench.study.object is not None:
        found["object_image"] = _object(bench, gathered, instants)
    return found


def add_energies(bench: Bench, arrays: dict[str, Array], exposures: dict[int, Array], at_least: int) -> None:
    """Write the radii of encircled energy of exposures (pixels, pixels) to their rows, if there are enough.

    Those of many take half the time of each by itself; their bits are the same. What is written is forgotten.
    """
    if len(exposures) < at_least:
        return
    images = np.stack(list(exposures.values()))
    radii = encircled_energy_radius(images, (0.5, 0.8), **energy_scale(bench))
    for name, values in zip(("ee50", "ee80"), radii, strict=True):
        arrays[name][list(exposures)] = values
    exposures.clear()


def object_at_rest(bench: Bench) -> Array:
    """Return the image (pixels, pixels) of the object of a study while nothing moves."""
    gathered = gather(bench)
    still = rest_states(bench.prepared.system, TILE)
    traced = trace_states(bench.prepared, still, NUMPY)
    wavefront = analyse(bench.prepared, traced, chief_rays(bench.prepared, still))
    add_images(bench, gathered, traced, wavefront, Piece(0, 0, 1, 0))
    return _object(bench, gathered, 1)


def _object(bench: Bench, gathered: Gathered, instants: int) -> Array:
    """Return the image of the object over so many instants: by the exposure where its light is incoherent."""
    imaging, shown = bench.study.imaging, bench.study.object
    assert shown is not None
    if gathered.lit is not None:
        return cut(_mean(bench, gathered, gathered.lit, instants), imaging.pixels)
    canvas = _mean(bench, gathered, gathered.totals[0], instants)
    return object_image(shown, canvas, imaging.pixels, **energy_scale(bench))


def _mean(bench: Bench, gathered: Gathered, total: Array | Smeared, instants: int) -> Array:
    """Return the mean of a sum of images."""
    if not isinstance(total, Smeared):
        return np.asarray(total / instants)
    assert gathered.ways is not None
    imaging = bench.study.imaging
    return smeared_image(total, gathered.ways, CANVAS * imaging.pixels, imaging.sampling)
