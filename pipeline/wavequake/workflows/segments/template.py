"""What a store of the workflow ``segment-disturbance`` holds: names, dimensions, units."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from wavequake.campaign.contract import Fixed, Template, Variable
from wavequake.campaign.measures import Axis, Measure, stored, template_of
from wavequake.chain.images.camera import camera_axes, camera_measures, frame_axes
from wavequake.chain.images.extended import image_measures, lit_object_words
from wavequake.optics.derivatives.central import DOFS
from wavequake.prepared import prepared
from wavequake.workflows.disturbed_study import modal_measures, wavefront_measures
from wavequake.workflows.segments.bench import Bench, bench_of, benches_of, field_names, in_basis
from wavequake.workflows.segments.exposures import object_at_rest
from wavequake.workflows.segments.images import by_rays, camera_of
from wavequake.workflows.segments.judged_models import error_measures
from wavequake.workflows.segments.study import SegmentStudy

Array = NDArray[np.float64]

IMAGED = ("exposure", "peak", "ee50", "ee80", "exposure_focus", "object_image")
# What is the same at all field points and wavelengths.
OF_ALL_PLACES = ("time_s", "segment_piston_rms", "segment_motion")
ERRORS = {"wfe_rms_raw": "nm", "wfe_rms": "nm", "zernike": "nm", "los": "mas", "centroid": "mas"}
_BOUND = "; inf where rays may cross the edge of a segment"
# What the modal model does not know.
TRACED_ONLY = ("wfe_pv", "spot_rms", "strehl", "rayleigh", "vignetted", *IMAGED)


@prepared(maxsize=2)
def template(study_text: str) -> Template:
    """Return what a store of this study holds if it keeps every instant."""
    bench = bench_of(study_text)
    return template_of(measures(bench), axes(bench), fixed(bench))


def memory(bench: Bench) -> int:
    """Return the bytes of the motion of a case: that of all cases of a chunk is there at the same time."""
    instants = max(population.instants for population in bench.study.disturbance)
    return instants * len(bench.system.segments) * 6 * 8


def measures(bench: Bench) -> Iterator[Measure]:
    """Yield what is computed of each case, over all of its instants."""
    study = bench.study
    traced = study.optics.light == "traced"
    yield from (one for one in traced_measures(bench) if traced or one.name not in TRACED_ONLY)
    if study.rare is not None:
        yield from _weights()
    elif not traced:
        yield from modal_measures(ERRORS, _BOUND)


def traced_measures(bench: Bench) -> Iterator[Measure]:
    """Yield what full traces, and images if the study wants them, tell of each case."""
    places = tuple(places_of(bench.study))
    for one in _measures(bench):
        axis = place_axis(one)
        dims = one.dims if one.name in OF_ALL_PLACES else (*one.dims[:axis], *places, *one.dims[axis:])
        yield replace(one, dims=dims)
    if bench.study.reduction is not None:
        yield from error_measures(bench.study, places)


def places_of(study: SegmentStudy) -> dict[str, int]:
    """Return the dimensions of field points and wavelengths, where a study has them, and their lengths."""
    optics, found = study.optics, {}
    if optics.fields_arcmin is not None:
        found["field"] = len(optics.fields_arcmin)
    if optics.wavelengths_nm is not None:
        found["wavelength"] = len(optics.wavelengths_nm)
    return found


def over_places(places: dict[str, int], parts: Sequence[Array], axis: int) -> Array:
    """Return arrays, of each place one, as one array whose dimensions of places begin at an axis."""
    whole = np.stack(parts, axis=axis)
    return whole.reshape(*whole.shape[:axis], *places.values(), *whole.shape[axis + 1 :])


def place_axis(one: Variable | Measure) -> int:
    """Return where places stand among the dimensions of a number at one of them: after its instants."""
    return int(one.dims[:1] == ("time",))


@prepared(maxsize=2)
def of_one_place(study_text: str) -> dict[str, Variable]:
    """Return what is told of each case at one field point and wavelength."""
    bench = bench_of(study_text)
    return dict(template_of(_measures(bench), axes(bench)).per_case)


def _weights() -> Iterator[Measure]:
    """Yield what undoes that cases are drawn near a limit."""
    words = "logarithm of the weight of the case: its density over that of the draws, which are near a limit"
    yield stored("log_weight", "1", words)
    words = "rms over the instants of what [rare] limits, by the modal model, in its unit"
    yield stored("modal_value", "1", words)


def _measures(bench: Bench) -> Iterator[Measure]:
    study, attrs = bench.study, _over_annulus(bench)
    yield from wavefront_measures(study.wavefront, ("time",), "on glass", on_sky=True, attrs=attrs)
    words = "rms over segments of the displacement along their normals"
    yield stored("segment_piston_rms", "nm", words, ("time",))
    if study.imaging.enabled:
        words = "mean of the instants' point spread functions; 1 = peak of the perfect one"
        engine = {"engine": "rays" if by_rays(bench) else "segments"}
        yield from image_measures((), study.object, bool(study.imaging.focus_um), words, engine)
        yield from camera_measures(study.imaging.resolution, study.detector, ())
    if "segment_motion" in study.store.keep:
        words = "rigid motion in the segment's local frame (dz to the sky)"
        yield stored("segment_motion", "m, rad", words, ("time", "segment", "dof"))


def axes(bench: Bench) -> dict[str, Axis]:
    """Return the dimensions of the measures."""
    study, imaging = bench.study, bench.study.imaging
    found = {
        "time": Axis(max(population.instants for population in study.disturbance)),
        "noll": Axis(np.arange(1, study.wavefront.zernike_terms + 1), "Noll index"),
        "axis": Axis(["x", "y"], "axis of the image plane"),
    }
    if study.optics.fields_arcmin is not None:
        found["field"] = Axis(field_names(study.optics.fields_arcmin), "field point")
    if study.optics.wavelengths_nm is not None:
        found["wavelength"] = Axis(study.optics.wavelengths_nm, "wavelength", "nm")
    if imaging.enabled:
        found |= frame_axes(imaging.pixels, imaging.sampling) | camera_axes(camera_of(bench))
        if imaging.focus_um:
            found["focus"] = Axis(imaging.focus_um, "distance behind the image", "um")
    if "segment_motion" in study.store.keep:
        found |= {"segment": Axis(bench.system.segments.names, "segment"), "dof": Axis(DOFS, "motion")}
    return found


def fixed(bench: Bench) -> dict[str, Fixed]:
    """Return field points, wavefronts and images at rest."""
    benches, places = benches_of(bench.text), places_of(bench.study)
    rest = [in_basis(one, one.static.zernike[0]) * one.wavelength_nm for one in benches]
    words = "Zernike coefficients at rest (a_0 of Störkle 2018, Eq. 3.41)"
    found: dict[str, Fixed] = {
        "zernike_static": (
            (*places, "noll"),
            over_places(places, rest, 0) if places else rest[0],
            {"units": "nm", "long_name": words, **_over_annulus(bench)},
        )
    }
    if (points := bench.study.optics.fields_arcmin) is not None:
        for name, values in zip(("field_x", "field_y"), np.array(points).T, strict=True):
            about = {"units": "arcmin", "long_name": f"field point along {name[-1]}"}
            found[name] = (("field",), values, about)
    if bench.study.imaging.enabled and (shown := bench.study.object) is not None:
        still = [object_at_rest(one) for one in benches]
        whole = over_places(places, still, 0) if places else still[0]
        about = {"units": "1", "long_name": "image at rest of " + lit_object_words(shown)}
        found["object_static"] = ((*places, "y", "x"), whole, about)
    return found


def _over_annulus(bench: Bench) -> dict[str, str]:
    """Return over which annulus the polynomials of the stored coefficients are orthogonal, as a label."""
    inner = bench.prepared.system.pupil.obscuration if bench.study.wavefront.basis == "annular" else 0.0
    return {"obscuration": repr(float(inner))}
