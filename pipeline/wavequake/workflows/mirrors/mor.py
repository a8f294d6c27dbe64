"""The workflow "mirror-mor": variants of model order reduction, compared in optical units.

A case is one variant of one model. Its frequency responses, mode shapes and time responses are compared with
those of the reference, mechanically and in what the mirror does to the light.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from wavequake.campaign.contract import Fixed
from wavequake.campaign.measured import Block, CaseTable, one_by_one, study_kind
from wavequake.campaign.measures import Axis, Measure, stored
from wavequake.campaign.stopwatch import Stopwatch
from wavequake.chain.images.camera import frame_axes
from wavequake.imaging.engines.zernike_psf import zernike_sum
from wavequake.kernels.device.devices import NUMPY, Device, choose_device
from wavequake.mechanics.model import ReducedModel
from wavequake.reduction.metrics import (
    eps_mor,
    eps_of,
    frobenius,
    mac,
    pseudo_frequencies,
    receptance,
    surface_modes,
)
from wavequake.workflows.mirrors.bench import (
    Answers,
    Bench,
    answers_of,
    bench_of,
    case_labels,
    cases_of,
    check_variants_of,
    imager_of,
    import_notices,
    import_record,
    over_time,
    spot_check,
    variant_of,
)
from wavequake.workflows.mirrors.compared_models import (
    checked_models,
    image_error,
    reduction_measures,
    stage_words,
    wavefront_rms,
)
from wavequake.workflows.mirrors.model_store import shown_name
from wavequake.workflows.mirrors.optics import Optics, figure_rows, mode_residuals, optical_rows
from wavequake.workflows.mirrors.shapes import (
    MOST_TERMS,
    SHOWN_MODES,
    mode_shapes,
    node_row,
    rim_angle,
)
from wavequake.workflows.mirrors.study import MirrorStudy

Array = NDArray[np.float64]

# Coefficients whose frequency responses are kept one by one (Störkle 2018, Fig. 4.29), modes of the MAC, and
# modes whose fit is judged.
SHOWN_TERMS = 15
MODES = 40
FITTED_MODES = 120
_UM_PER_MM = 1e3


def compute(study: MirrorStudy, table: CaseTable, device_name: str, clock: Stopwatch) -> Iterator[Block]:
    """Reduce and judge variants; one that does not suit the model is quarantined."""
    text, device, variants = study.identity_text(), choose_device(device_name), cases_of(study)

    def of_case(case: int) -> dict[str, Array | float]:
        name, variant = variants[case]
        return judged(study, bench_of(text, name), answers_of(text, name), variant, device)

    return one_by_one(table["case"], of_case)


def judged(
    study: MirrorStudy, bench: Bench, answers: Answers, variant: str, device: Device
) -> dict[str, Array | float]:
    """Return all stored numbers of one variant."""
    is_reference = variant == study.reduction.reference
    reduced = answers.reference if is_reference else variant_of(bench, variant)
    optics = bench.optics
    rows = optical_rows(optics, reduced)
    frequencies = study.reduction.hertz
    mechanical, (frf_opt, eps_opt) = (
        receptance(reduced, frequencies),
        eps_of(answers.optical, reduced, frequencies, rows[3:]),
    )
    aberrations, node, shapes = over_time(
        study, reduced, rows, node_row(reduced), figure_rows(optics, reduced)
    )
    peaks = wavefront_rms(answers.aberrations).argmax(axis=1)
    figures, wavefronts = mode_shapes(optics, reduced)
    apart = aberrations - answers.aberrations
    images = exposures(study, optics, aberrations, device)
    shown = np.full((len(frequencies), SHOWN_TERMS - 1), np.nan)
    kept = min(SHOWN_TERMS, optics.terms) - 1
    shown[:, :kept] = np.linalg.norm(receptance(reduced, frequencies, rows[3 : 3 + kept]), axis=2)
    return {
        "order": float(reduced.order),
        "reduce_seconds": reduced.seconds,
        "pseudo_frequency_max": float(pseudo_frequencies(reduced)[-1]),
        "frf_mech": frobenius(mechanical),
        "eps_mech": eps_mor(answers.mechanical, mechanical),
        "frf_opt": frf_opt,
        "eps_opt": eps_opt,
        "frf_zernike": shown,
        "mac": _mac(answers.reference, reduced),
        "mode_frequency": _padded(pseudo_frequencies(reduced), MODES),
        "fit_residual": _padded(mode_residuals(optics, reduced), FITTED_MODES),
        "wfe_rms": wavefront_rms(aberrations),
        "wfe_error": wavefront_rms(apart),
        "los_mm": aberrations[..., :2],
        "los_error": np.linalg.norm(apart[..., :2], axis=2),
        "resolution_mm": optics.resolution,
        "exposure": images,
        "image_error": image_error(images, reference_exposures(study, bench, answers, device)),
        "obscuration": optics.obscuration,
        "mode_figure": _padded(figures, SHOWN_MODES, terms_of(study)),
        "mode_wavefront": _padded(wavefronts, SHOWN_MODES, terms_of(study)),
        "peak_wavefront": _padded(aberrations[np.arange(len(peaks)), peaks, 2:], len(peaks), terms_of(study)),
        "peak_figure": _padded(
            _UM_PER_MM * shapes[np.arange(len(peaks)), peaks], len(peaks), terms_of(study)
        ),
        "node_motion": node[..., 0],
        "node_angle": rim_angle(reduced),
    }


def terms_of(study: MirrorStudy) -> int:
    """Return for how many Noll terms the shapes of all models have room."""
    return study.optics.zernike_terms or MOST_TERMS


def _padded(values: Array, *shape: int) -> Array:
    filled = np.full(shape, np.nan)
    kept = tuple(slice(min(own, room)) for own, room in zip(values.shape, shape, strict=True))
    filled[kept] = values[kept]
    return filled


def _mac(whole: ReducedModel, reduced: ReducedModel) -> Array:
    """Return the MAC of a variant's first modes with those of the reference, at the surface nodes."""
    table = np.full((MODES, MODES), np.nan)
    found = mac(surface_modes(reduced)[:, :MODES], surface_modes(whole)[:, :MODES])
    table[: found.shape[0], : found.shape[1]] = found
    return table


def exposures(study: MirrorStudy, optics: Optics, aberrations: Array, device: Device = NUMPY) -> Array:
    """Return the mean image over the time response of each excitation, (excitation, pixels, pixels).

    Image axes are those of the image plane. The line of sight places an image, and c_4 and on shape it: c_2
    and c_3 are about the chief ray, which moves with the mirror.
    """
    section, terms = study.imaging, aberrations.shape[2] - 2
    grid = section.pupil_samples, section.pixels, section.sampling
    imager = imager_of(*grid, terms, optics.obscuration, device)
    count = min(section.instants, aberrations.shape[1])
    instants = np.unique(np.linspace(0, aberrations.shape[1] - 1, count).round().astype(int))
    shown = section.scale * aberrations[:, instants]
    # Beyond the Nyquist frequency of the pupil's cells an image would come back on the other side.
    farthest = 0.5 * section.pupil_samples
    places = np.clip(shown[..., :2] / optics.resolution, -farthest, farthest)
    # A phase that grows along +x moves the image to +x; the OPD of a positive line of sight falls along +x.
    waves = shown[..., 2:] / -study.optics.wavelength_nm
    waves[..., :3] = 0.0
    waves[..., 1:3] = 0.25 * np.sqrt(1.0 + optics.obscuration**2) * places
    shares = np.full(len(instants), 1.0 / len(instants))
    return np.array([zernike_sum(imager, one, shares, check=False) for one in waves])


_REFERENCES: dict[tuple[str, str, str], Array] = {}


def reference_exposures(study: MirrorStudy, bench: Bench, answers: Answers, device: Device) -> Array:
    """Return the exposures of the reference, computed once per process and device."""
    key = (study.identity(), bench.name, device.name)
    if key not in _REFERENCES:
        _REFERENCES[key] = exposures(study, bench.optics, answers.aberrations, device)
    return _REFERENCES[key]


def fixed(study: MirrorStudy) -> dict[str, Fixed]:
    """Return what a store of a study holds beside its measures."""
    checks = [spot_check(study, name) for name in study.models]
    return checked_models(study.models, checks) | import_record(study)


def measures(study: MirrorStudy) -> Iterator[Measure]:
    """Yield the measures of a variant."""
    history, spectrum = ("excitation", "time"), ("frequency",)
    yield from reduction_measures("interfaces")
    words = "Frobenius norm of the mechanical-optical response, c_2 and on (Störkle 2018, Eq. 4.23)"
    yield stored("frf_opt", "nm/N", words, spectrum)
    yield stored("eps_opt", "1", "relative error of the mechanical-optical response", spectrum)
    words = "norm over the inputs of each coefficient's response"
    yield stored("frf_zernike", "nm/N", words, ("frequency", "noll"))
    words = "modal assurance criterion at the optical surface"
    yield stored("mac", "1", words, ("mode", "reference_mode"))
    yield stored("mode_frequency", "Hz", "eigenfrequencies of the variant", ("mode",))
    words = "share of each mode that the Zernikes miss (Störkle 2018, Eq. 4.11)"
    yield stored("fit_residual", "1", words, ("own_mode",))
    yield stored("wfe_rms", "nm", "wavefront error rms of the fitted Zernikes j >= 4", history)
    words = "rms of the difference of wavefronts from the reference's, j >= 4"
    yield stored("wfe_error", "nm", words, history)
    words = "line of sight in the image (Störkle 2018, Eq. 3.39)"
    yield stored("los_mm", "mm", words, (*history, "axis"))
    yield stored("obscuration", "1", "inner over outer radius of the pupil")
    shapes, peaks = ("elastic_mode", "term"), ("excitation", "term")
    words = "Noll coefficients of modes on the mirror, heights of rms 1"
    yield stored("mode_figure", "1", words, shapes)
    words = "Noll coefficients of the wavefronts of these modes at 1 um rms"
    yield stored("mode_wavefront", "nm/um", words, shapes)
    words = "Noll coefficients of the wavefront when that of the reference is worst"
    yield stored("peak_wavefront", "nm", words, peaks)
    words = "Noll coefficients of the mirror's figure, along the light, then"
    yield stored("peak_figure", "um", words, peaks)
    yield stored("node_angle", "deg", "where on the rim this node is, about the axis from x")
    words = "motion along z of a node on the rim, far from the mounts"
    yield stored("node_motion", "m", words, history)


def axes(study: MirrorStudy) -> dict[str, Axis]:
    """Return the dimensions of the measures."""
    return {
        "frequency": Axis(study.reduction.hertz, "frequency", "Hz"),
        "time": Axis(study.time.seconds, "time", "s"),
        "excitation": Axis([excitation.name for excitation in study.excitation], "excitation"),
        "term": Axis(np.arange(1, terms_of(study) + 1), "Noll index of a shape"),
        "noll": Axis(np.arange(2, SHOWN_TERMS + 1), "Noll index"),
        "axis": Axis(["x", "y"], "axis of the image plane"),
        **frame_axes(study.imaging.pixels, study.imaging.sampling),
        **dict.fromkeys(("mode", "reference_mode"), Axis(MODES)),
        "own_mode": Axis(FITTED_MODES),
        "elastic_mode": Axis(SHOWN_MODES),
    }


def describe(study: MirrorStudy) -> dict[str, str]:
    """Return the models and how well their intermediate bases stand for them, for the plan."""
    text, lines = study.identity_text(), {}
    for name in study.models:
        stage = bench_of(text, name).stage
        words = stage_words(stage, *spot_check(study, name))
        lines[f"model {shown_name(study.model.content, name)}"] = words
    return lines


def check(study: MirrorStudy) -> None:
    """Raise UserError where model, variants, excitations or optics do not fit."""
    text = study.identity_text()
    for name in study.models:
        check_variants_of(study, bench_of(text, name), study.reduction.variants)
        answers_of(text, name)


KIND = study_kind(
    "mirror-mor",
    MirrorStudy,
    cases=case_labels,
    compute=compute,
    measures=measures,
    axes=axes,
    fixed=fixed,
    describe=describe,
    check=check,
    notices=import_notices,
)
