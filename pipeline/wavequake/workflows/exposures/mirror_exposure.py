"""The workflow "mirror-exposure": what a detector receives of a vibrating mirror, by reduced model.

A case is one variant of one model, as in mirror-mor. Its image is exposed over the time response to each
excitation, as in Störkle 2018, Fig. 4.32.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wavequake.campaign.measured import Block, CaseTable, one_by_one, study_kind
from wavequake.campaign.measures import Axis, Measure, stored
from wavequake.campaign.stopwatch import Stopwatch
from wavequake.chain.images.coherent import LitObject, lit_by_cells, mean_image
from wavequake.chain.images.extended import check_object, lit_object_words, object_image
from wavequake.chain.images.shortcuts import (
    CANVAS,
    FOCUS,
    exposed,
    exposure_axes,
    exposure_measures,
)
from wavequake.errors import UserError
from wavequake.imaging.engines.matrix_fourier import matrix_fourier
from wavequake.imaging.engines.zernike_psf import zernike_images, zernike_sum
from wavequake.imaging.exposures.exposure_models import cut
from wavequake.imaging.pupils.nyquist import too_coarse, zernike_samples_for
from wavequake.imaging.pupils.pupil_function import annular_pupil
from wavequake.kernels.device.devices import NUMPY, Device, choose_device
from wavequake.optics.polynomials.zernike import annular_zernike
from wavequake.prepared import prepared
from wavequake.workflows.exposures.exposure_study import MirrorExposureStudy
from wavequake.workflows.mirrors.bench import (
    aberrations_over_time,
    bench_of,
    case_labels,
    cases_of,
    check_variants_of,
    imager_of,
    import_notices,
    import_record,
    study_of,
    variant_of,
)
from wavequake.workflows.mirrors.optics import Optics, optical_rows

Array = NDArray[np.float64]

# Instants at once: bounds the memory, however long an exposure is.
_BLOCK = 32


def compute(
    study: MirrorExposureStudy, table: CaseTable, device_name: str, clock: Stopwatch
) -> Iterator[Block]:
    """Expose the images of variants; one that does not suit the model is quarantined."""
    text, device, variants = study.identity_text(), choose_device(device_name), cases_of(study)
    return one_by_one(table["case"], lambda case: exposed_variant(text, *variants[case], device))


def exposed_variant(study_text: str, model: str, variant: str, device: Device = NUMPY) -> dict[str, Any]:
    """Return all stored numbers of one variant of a model."""
    study, optics = study_of(study_text), bench_of(study_text, model).optics
    aberrations = aberrations_of(study_text, model, variant)
    static = next(local_images(study, optics, np.zeros((1, aberrations.shape[2])), device))[0]
    seen = seen_object(study_text, model, device)
    found: dict[str, list[Array]] = {}
    for history in aberrations:
        for name, values in _exposure(study, optics, history, static, device).items():
            found.setdefault(name, []).append(values)
        found.setdefault("exposure_focus", []).append(through_focus(study, optics, history, device))
        if seen is not None:
            phases = seen.phases(_waves(study, optics, history[exposed_instants(study)], placed=True))
            found.setdefault("object_image", []).append(mean_image(seen.lit, phases))
    reference = aberrations_of(study_text, model, study.reduction.reference)
    return {
        **{name: np.stack(values) for name, values in found.items()},
        "wfe_rms": _wavefront_error(aberrations),
        "wfe_error": _wavefront_error(aberrations - reference),
        "los_mm": aberrations[..., :2],
        "exposure_static": cut(static, study.imaging.pixels),
        **_object_at_rest(study, optics, static, seen),
        "resolution_mm": optics.resolution,
    }


@prepared(maxsize=2)
def aberrations_of(study_text: str, model: str, variant: str) -> Array:
    """Return what a variant does over time, (excitation, time, 2 + J): line of sight in mm, terms in nm."""
    bench = bench_of(study_text, model)
    reduced = variant_of(bench, variant)
    return aberrations_over_time(study_of(study_text), reduced, optical_rows(bench.optics, reduced))


def exposed_instants(study: MirrorExposureStudy) -> NDArray[np.intp]:
    """Return the instants of the time response that are exposed, evenly spread."""
    count = study.time.instants
    chosen = np.linspace(0, count - 1, min(study.imaging.instants, count)).round()
    return np.unique(chosen.astype(np.intp))


def local_images(
    study: MirrorExposureStudy, optics: Optics, history: Array, device: Device = NUMPY
) -> Iterator[Array]:
    """Yield images (block, n, n) about the line of sight of aberrations (instants, 2 + J), by blocks.

    The line of sight has no part in them: it places them.
    """
    section = study.imaging
    grid = section.pupil_samples, CANVAS * section.pixels, section.sampling
    imager = imager_of(*grid, history.shape[1] - 2, optics.obscuration, device)
    waves = _waves(study, optics, history, placed=False)
    for first in range(0, len(history), _BLOCK):
        yield zernike_images(imager, waves[first : first + _BLOCK], check=False)  # `notices` did


def through_focus(study: MirrorExposureStudy, optics: Optics, history: Array, device: Device) -> Array:
    """Return exposures (focus, y, x) with defocus added; tilts of the phase place the images."""
    section, shown = study.imaging, history[exposed_instants(study)]
    grid = section.pupil_samples, section.pixels, section.sampling
    imager = imager_of(*grid, shown.shape[1] - 2, optics.obscuration, device)
    waves = _waves(study, optics, shown, placed=True)
    weights, term = np.full(len(waves), 1.0 / len(waves)), np.arange(waves.shape[1]) == 3
    return np.array([zernike_sum(imager, waves - defocus * term, weights, check=False) for defocus in FOCUS])


def _waves(study: MirrorExposureStudy, optics: Optics, history: Array, placed: bool) -> Array:
    """Return the Noll terms (instants, J) of the phase in waves, with tilts that place the image or none."""
    section = study.imaging
    # The OPD of a positive line of sight falls along +x, a phase that moves the image to +x grows.
    waves = -section.scale / study.optics.wavelength_nm * history[:, 2:]
    waves[:, :3] = 0.0
    if placed:  # a tilt moves the image by 4 c / sqrt(1 + eps²) in lambda/D
        los = history[:, :2] * (section.scale / optics.resolution)
        waves[:, 1:3] = 0.25 * np.sqrt(1.0 + optics.obscuration**2) * los
    return np.asarray(waves)


@dataclass(frozen=True)
class SeenObject:
    """An object in coherent or partially coherent light, seen by a mirror.

    Attributes
    ----------
    lit : LitObject
        For the patches of the sampled pupil.
    modes : ndarray, shape (m, J)
        Zernike polynomials there.
    """

    lit: LitObject
    modes: Array

    def phases(self, waves: Array) -> Iterator[Array]:
        """Yield the phases (block, m) in waves of Noll terms (instants, J), by blocks."""
        for first in range(0, len(waves), _BLOCK):
            yield waves[first : first + _BLOCK] @ self.modes.T


@prepared(maxsize=4)
def seen_object(study_text: str, model: str, device: Device = NUMPY) -> SeenObject | None:
    """Return the object of a study, if there is one whose light is coherent or partially so."""
    study, optics = study_of(study_text), bench_of(study_text, model).optics
    if study.object is None or study.object.light == "incoherent":
        return None
    pupil = annular_pupil(study.imaging.pupil_samples, optics.obscuration)
    transform = matrix_fourier(pupil, study.imaging.pixels, study.imaging.sampling, device)
    modes = annular_zernike(pupil.x, pupil.y, optics.terms, optics.obscuration)
    return SeenObject(lit_by_cells(study.object, transform), modes)


def _object_at_rest(
    study: MirrorExposureStudy, optics: Optics, static: Array, seen: SeenObject | None
) -> dict[str, Array]:
    if seen is not None:
        return {"object_static": mean_image(seen.lit, seen.phases(np.zeros((1, optics.terms))))}
    if study.object is None:
        return {}
    imaging = study.imaging
    grid = imaging.pixels, imaging.sampling, *_pupil_size(optics)
    return {"object_static": object_image(study.object, static, *grid)}


def _pupil_size(optics: Optics) -> tuple[float, float]:
    """Return area (mm²) and diameter (mm) of the pupil."""
    return np.pi * optics.radius**2 * (1.0 - optics.obscuration**2), 2.0 * optics.radius


def _exposure(
    study: MirrorExposureStudy, optics: Optics, history: Array, static: Array, device: Device
) -> dict[str, Array]:
    imaging = study.imaging
    shown = history[exposed_instants(study)]
    return exposed(
        local_images(study, optics, shown, device),
        static,
        shown[:, :2] * (imaging.scale / optics.resolution),
        imaging.pixels,
        imaging.sampling,
        *_pupil_size(optics),
        study.object,
    )


def _wavefront_error(aberrations: Array) -> Array:
    return np.asarray(np.sqrt(np.sum(aberrations[..., 5:] ** 2, axis=-1)))


def axes(study: MirrorExposureStudy) -> dict[str, Axis]:
    """Return the dimensions of the measures."""
    return {
        "time": Axis(study.time.seconds, "time", "s"),
        "excitation": Axis([excitation.name for excitation in study.excitation], "excitation"),
        **exposure_axes(study.imaging.pixels, study.imaging.sampling),
    }


def measures(study: MirrorExposureStudy) -> Iterator[Measure]:
    """Yield the measures of a variant."""
    history, frame = ("excitation", "time"), ("y", "x")
    yield stored("wfe_rms", "nm", "wavefront error rms of the fitted Zernikes j >= 4, not scaled", history)
    words = "rms of the difference of wavefronts from the reference's, j >= 4"
    yield stored("wfe_error", "nm", words, history)
    words = "line of sight in the image (Störkle 2018, Eq. 3.39), not scaled"
    yield stored("los_mm", "mm", words, (*history, "axis"))
    yield from exposure_measures("excitation", study.object)
    words = "exposure with defocus added; 1 = peak of the perfect image"
    yield stored("exposure_focus", "1", words, ("excitation", "focus", *frame))
    words = "image at rest; 1 = its peak"
    yield stored("exposure_static", "1", words, frame, attrs={"engine": "matrix"})
    if study.object:
        yield stored("object_static", "1", "image at rest of " + lit_object_words(study.object), frame)
    words = "lambda/D in the image: wavelength times focal length over diameter"
    yield stored("resolution_mm", "mm", words)


def check(study: MirrorExposureStudy) -> None:
    """Raise UserError for a study that no variant of can succeed: model, reference or optics do not fit."""
    text = study.identity_text()
    if study.object:
        check_object(study.object, study.imaging.pixels, study.imaging.sampling)
    imaging = study.imaging
    field = CANVAS * imaging.pixels * imaging.sampling
    if field > imaging.pupil_samples:
        raise UserError(
            f"imaging.pupil_samples is {imaging.pupil_samples}, so that images repeat every "
            f"{imaging.pupil_samples} lambda/D, but those of {imaging.pixels} pixels are computed "
            f"{field:g} lambda/D wide, for light that moves in; set it to at least {int(np.ceil(field))}"
        )
    for name in study.models:
        check_variants_of(study, bench_of(text, name), study.reduction.variants)
        aberrations_of(text, name, study.reduction.reference)


def notices(study: MirrorExposureStudy) -> Iterator[str]:
    """Yield what to check of an imported model, and models whose phases the pupil's samples do not resolve.

    What all variants do is judged by the reference.
    """
    yield from import_notices(study)
    text, section, instants = study.identity_text(), study.imaging, exposed_instants(study)
    for name in study.models:
        optics, needed = bench_of(text, name).optics, dict[int, float]()
        history = aberrations_of(text, name, study.reduction.reference)[:, instants]
        still = np.concatenate([_waves(study, optics, one, placed=False) for one in history])
        placed = np.concatenate([_waves(study, optics, one, placed=True) for one in history])
        term = np.arange(placed.shape[1]) == 3
        images = [(CANVAS * section.pixels, still)]
        images += [(section.pixels, placed - defocus * term) for defocus in (FOCUS[0], FOCUS[-1])]
        if study.object and study.object.light != "incoherent":
            images.append((2 * section.pixels, placed))  # from rim to rim of object and image
        for size, waves in images:
            field = size * section.sampling
            needed[zernike_samples_for(waves, optics.obscuration, field)] = field
        most = max(needed)
        if words := too_coarse(section.pupil_samples, most, needed[most]):
            yield f"{name}: {words}; raise imaging.pupil_samples or lower imaging.scale"


KIND = study_kind(
    "mirror-exposure",
    MirrorExposureStudy,
    cases=case_labels,
    compute=compute,
    measures=measures,
    axes=axes,
    fixed=import_record,
    check=check,
    notices=notices,
)
