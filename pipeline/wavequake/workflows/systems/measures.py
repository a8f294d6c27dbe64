"""The measures of a system-disturbance study, one record each, and the dimensions that they have."""

from collections.abc import Iterator, Mapping

import numpy as np

from wavequake.campaign.contract import Fixed
from wavequake.campaign.measures import Axis, Measure, stored
from wavequake.chain.images.camera import camera_axes, camera_measures, frame_axes
from wavequake.chain.images.extended import image_measures, lit_object_words
from wavequake.chain.images.system import expose
from wavequake.workflows.disturbed_study import modal_measures, wavefront_measures
from wavequake.workflows.mirrors.compared_models import ERRORS
from wavequake.workflows.systems.bench import NM_PER_MM, SystemBench, field_name
from wavequake.workflows.systems.measure import shaped, wavefront_numbers
from wavequake.workflows.systems.modal import TRACED_ONLY, modal_errors_of
from wavequake.workflows.systems.study import SystemStudy

_OVER = ("time", "field", "wavelength")


def measures(study: SystemStudy, over_annulus: Mapping[str, str]) -> Iterator[Measure]:
    """Yield the measures of a study; `over_annulus` says over what its polynomials are orthogonal."""
    if study.optics.light == "traced":
        yield from _traced_measures(study, over_annulus)
        return
    yield from (one for one in _traced_measures(study, over_annulus) if one.name not in TRACED_ONLY)
    bound = ", at the primary wavelength; inf where more moves than it knows"
    yield from modal_measures(modal_errors_of(study), bound)


def _traced_measures(study: SystemStudy, over_annulus: Mapping[str, str]) -> Iterator[Measure]:
    rays = "that arrive"
    yield from wavefront_measures(study.wavefront, _OVER, rays, on_sky=False, attrs=over_annulus)
    words = "rms of the wavefront's change from rest, of the fitted Zernikes j >= 4"
    yield stored("wfe_change", "nm", words, _OVER)
    yield stored("lost", "1", "largest number of rays at an instant that do not arrive", _OVER[1:])
    if study.imaging is not None:
        words = "mean of every instant's image at its line of sight, in all wavelengths; 1 = peak of the "
        focus = bool(study.imaging.focus_um)
        yield from image_measures(("field",), study.object, focus, words + "perfect one")
        yield from camera_measures(study.imaging.resolution, study.detector, ("field",))
    if study.reduction is not None:
        for name, (unit, words) in ERRORS.items():
            dims = _OVER[1:] if name != "model_error_image" else ("field",)
            if name != "model_error_image" or study.imaging is not None:
                said = f"difference to the same draw with full models: {words}"
                yield stored(name, unit or "mm", said, dims)


def axes(bench: SystemBench) -> dict[str, Axis]:
    """Return the dimensions of the measures."""
    system, study = bench.system, bench.study
    names = [field_name(system, field) for field in range(len(system.fields))]
    found = {
        "time": Axis(max(population.instants for population in study.disturbance)),
        "field": Axis(names, "field point"),
        "wavelength": Axis(np.round(system.wavelengths * NM_PER_MM, 9), "wavelength", "nm"),  # as written
        "noll": Axis(np.arange(1, study.wavefront.zernike_terms + 1), "Noll index"),
        "axis": Axis(["x", "y"], "axis of the image plane"),
    }
    if bench.imager is not None:
        section = bench.imager.section
        found |= frame_axes(section.pixels, section.sampling)
        if section.focus_um:
            found["focus"] = Axis(np.array(section.focus_um), "distance behind the image", "um")
        found |= camera_axes(bench.imager.camera)
    return found


def fixed(bench: SystemBench, over_annulus: Mapping[str, str]) -> dict[str, Fixed]:
    """Return field points and the wavefronts and images at rest."""
    system = bench.system
    far = bool(np.isinf(system.object_distance))
    points = np.rad2deg(system.fields) if far else system.fields
    unit = {"units": "deg" if far else "mm"}
    found: dict[str, Fixed] = {
        "field_x": (("field",), points[:, 0], {**unit, "long_name": "field point along x"}),
        "field_y": (("field",), points[:, 1], {**unit, "long_name": "field point along y"}),
    }
    rest = [
        wavefront_numbers(prepared, still, still, bench.study.wavefront.basis)
        for row, stills in zip(bench.prepared, bench.static, strict=True)
        for prepared, still in zip(row, stills, strict=True)
    ]
    for name, units, long_name, *more in (
        ("zernike", "nm", "Zernike coefficients at rest", "noll"),
        ("wfe_rms", "nm", "wavefront error rms at rest, j >= 4"),
        ("spot_rms", "um", "rms spot radius at rest"),
        ("strehl", "1", "Strehl ratio at rest"),
        ("vignetted", "1", "rays that openings stop at rest"),
    ):
        values = shaped(bench, [one[name] for one in rest])
        attrs = {"units": units, "long_name": long_name, **(over_annulus if more else {})}
        found[f"{name}_static"] = (
            ("field", "wavelength", *more),
            values[0] if values.ndim > 2 else values,
            attrs,
        )
    return found | _images_at_rest(bench)


def _images_at_rest(bench: SystemBench) -> dict[str, Fixed]:
    if bench.imager is None:
        return {}
    images = [expose(bench.imager, field, row) for field, row in enumerate(bench.static)]
    engine = bench.imager.imagers[0][0].engine
    words = {"units": "1", "long_name": "image at rest; 1 = peak of the perfect one", "engine": engine.name}
    scale = {"units": "mm", "long_name": "lambda/D in the image: primary wavelength over twice the aperture"}
    found: dict[str, Fixed] = {
        "exposure_static": (("field", "y", "x"), np.stack([one["exposure"] for one in images]), words),
        "resolution_mm": ((), np.array(bench.imager.resolution_mm), scale),
    }
    if bench.imager.section.focus_um:
        found["focus_static"] = (
            ("field", "focus", "y", "x"),
            np.stack([one["exposure_focus"] for one in images]),
            {"units": "1", "long_name": "image at rest in planes behind the image"},
        )
    if bench.study.object is not None:
        words = {"units": "1", "long_name": "image at rest of " + lit_object_words(bench.study.object)}
        found["object_static"] = (
            ("field", "y", "x"),
            np.stack([one["object_image"] for one in images]),
            words,
        )
    return found
