"""What a store of the workflow ``segment-disturbance`` holds: names, dimensions, units."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from wavequake.campaign.contract import Fixed, Template, Variable
from wavequake.campaign.engine.chunk_size import stored_bytes
from wavequake.campaign.measures import Axis, template_of
from wavequake.chain.images.camera import camera_axes, camera_measures
from wavequake.chain.images.extended import lit_object_words
from wavequake.prepared import prepared
from wavequake.workflows.segments.bench import Bench, bench_of, benches_of, field_names, in_basis
from wavequake.workflows.segments.exposures import object_at_rest
from wavequake.workflows.segments.images import by_rays, camera_of, image_axis
from wavequake.workflows.segments.judged_models import error_variables
from wavequake.workflows.segments.segment_study import SegmentStudy

Array = NDArray[np.float64]

IMAGED = ("exposure", "peak", "ee50", "ee80", "exposure_focus", "object_image")
# What is the same at all field points and wavelengths.
OF_ALL_PLACES = ("time_s", "segment_piston_rms", "segment_motion")
# What the modal model does not know.
TRACED_ONLY = ("wfe_pv", "spot_rms", "strehl", "rayleigh", "vignetted", *IMAGED)


def template(study_text: str) -> Template:
    """Return what a store of this study holds if it keeps every instant."""
    bench = bench_of(study_text)
    found = Template(computed(study_text))
    instants = max(population.instants for population in bench.study.disturbance)
    motion = instants * len(bench.system.segments) * 6 * 8  # of all cases of a chunk at the same time
    return replace(found, fixed=_fixed(bench), working_bytes=stored_bytes(found) + motion)


@prepared(maxsize=2)
def computed(study_text: str) -> dict[str, Variable]:
    """Return what is computed of each case, over all of its instants."""
    variables, study = traced(study_text), bench_of(study_text).study
    if study.rare is not None:
        return variables | _weights()
    if study.optics.light == "traced":
        return variables
    return {name: one for name, one in variables.items() if name not in TRACED_ONLY} | _modal()


@prepared(maxsize=2)
def traced(study_text: str) -> dict[str, Variable]:
    """Return what full traces, and images if the study wants them, tell of each case."""
    variables, places = of_one_place(study_text), places_of(bench_of(study_text).study)
    found = {
        name: one if name in OF_ALL_PLACES else _at_places(one, places) for name, one in variables.items()
    }
    study = bench_of(study_text).study
    return found | (error_variables(study, places) if study.reduction is not None else {})


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


def _at_places(one: Variable, places: dict[str, int]) -> Variable:
    """Return a variable at several places: after its instants, before the rest."""
    axis = place_axis(one)
    return replace(
        one,
        dims=(*one.dims[:axis], *places, *one.dims[axis:]),
        shape=(*one.shape[:axis], *places.values(), *one.shape[axis:]),
    )


def place_axis(one: Variable) -> int:
    """Return where places stand among the dimensions of a variable of one of them."""
    return int(one.dims[:1] == ("time",))


@prepared(maxsize=2)
def of_one_place(study_text: str) -> dict[str, Variable]:
    """Return what is told of each case at one field point and wavelength."""
    bench = bench_of(study_text)
    variables = _variables(bench)
    imaging = bench.study.imaging.enabled
    return {name: variable for name, variable in variables.items() if imaging or name not in IMAGED}


def _weights() -> dict[str, Variable]:
    """Return what undoes that cases are drawn near a limit."""
    weight = "logarithm of the weight of the case: its density over that of the draws, which are near a limit"
    value = "rms over the instants of what [rare] limits, by the modal model, in its unit"
    return {
        "log_weight": Variable((), (), {"units": "1", "long_name": weight}),
        "modal_value": Variable((), (), {"units": "1", "long_name": value}),
    }


def _modal() -> dict[str, Variable]:
    """Return what tells of the modal model's error."""
    largest = "largest {} of the modal model, where the case was traced to measure it"
    errors = {
        "wfe_rms_raw": ("nm", largest.format("error over the instants of the wfe_rms_raw")),
        "wfe_rms": ("nm", largest.format("error over the instants of the wfe_rms")),
        "zernike": ("nm", largest.format("error over instants and terms of the zernike")),
        "los": ("mas", largest.format("error over the instants of the los")),
        "centroid": ("mas", largest.format("error over the instants of the centroid")),
    }
    return {
        "traced": Variable(
            (),
            (),
            {
                "units": "1",
                "long_name": "0: numbers of the modal model; 1: of the modal model, and traced in full to "
                "measure its error; 2: of full traces, as the motion is beyond the model's range",
            },
            dtype="int8",
        ),
        "modal_bound": Variable(
            (),
            (),
            {
                "units": "nm",
                "long_name": "bound of the rms over the rays of the second order that the modal model leaves "
                "out; inf where rays may cross the edge of a segment",
            },
        ),
        **{
            f"modal_error_{name}": Variable((), (), {"units": unit, "long_name": words})
            for name, (unit, words) in errors.items()
        },
    }


def _variables(bench: Bench) -> dict[str, Variable]:
    study = bench.study
    instants = max(population.instants for population in study.disturbance)
    terms, pixels = study.wavefront.zernike_terms, study.imaging.pixels
    over_time = ("time",)

    def variable(
        dims: tuple[str, ...], shape: tuple[int, ...], units: str, long_name: str, **more: str
    ) -> Variable:
        return Variable(dims, shape, {"units": units, "long_name": long_name, **more})

    per_case = {
        "time_s": Variable(
            over_time,
            (instants,),
            {"units": "s", "long_name": "time of the instant; NaN beyond the population's instants"},
            coordinate=True,
        ),
        "wfe_rms": variable(
            over_time,
            (instants,),
            "nm",
            "wavefront error rms of the fitted Zernikes j >= 4 (piston and tilt removed)",
        ),
        "wfe_rms_raw": variable(
            over_time, (instants,), "nm", "wavefront error rms over the rays on glass, piston removed"
        ),
        "wfe_pv": variable(
            over_time,
            (instants,),
            "nm",
            "peak to valley of the wavefront over the rays on glass about their best-fit plane",
        ),
        "zernike": replace(
            variable(("time", "noll"), (instants, terms), "nm", _coefficients(study), **_over_annulus(bench)),
            unknown=int(study.wavefront.method == "slopes"),
        ),
        "los": variable(
            ("time", "axis"),
            (instants, 2),
            "mas",
            "line of sight of the best-fit plane relative to rest "
            "(Störkle 2018, Eq. 3.39, annular tilt / sqrt(1 + eps^2))",
        ),
        "centroid": variable(
            ("time", "axis"), (instants, 2), "mas", "geometric centroid of the rays, relative to rest"
        ),
        "spot_rms": variable(
            over_time, (instants,), "mas", "rms distance of the rays' image points from their centroid"
        ),
        "strehl": variable(
            over_time, (instants,), "1", "Strehl ratio in the direction of the best-fit plane"
        ),
        "segment_piston_rms": variable(
            over_time, (instants,), "nm", "rms over segments of the displacement along their normals"
        ),
        "rayleigh": variable(
            (),
            (),
            "1",
            "share of instants with a peak to valley of at most lambda/4 (Störkle 2018, Eq. 3.54)",
        ),
        "marechal": variable(
            (),
            (),
            "1",
            "share of instants with an rms over the rays on glass, piston and tilt removed, of at most "
            "lambda/14 (Störkle 2018, Eq. 3.55)",
        ),
        "vignetted": variable(
            (), (), "1", "largest number of rays at an instant that miss the clear part of a mirror after M1"
        ),
        "peak": variable(
            (),
            (),
            "1",
            "largest irradiance of the exposure, line of sight included; 1 = peak of the perfect image",
        ),
        "ee50": variable(
            (), (), "lambda/D", "radius of 50 % encircled energy of the exposure; inf beyond the frame"
        ),
        "ee80": variable(
            (), (), "lambda/D", "radius of 80 % encircled energy of the exposure; inf beyond the frame"
        ),
        "exposure": variable(
            ("y", "x"),
            (pixels, pixels),
            "1",
            "mean of the instants' point spread functions; 1 = peak of the perfect one",
            engine="rays" if by_rays(bench) else "segments",
        ),
    }
    if study.imaging.focus_um:
        per_case["exposure_focus"] = variable(
            ("focus", "y", "x"),
            (len(study.imaging.focus_um), pixels, pixels),
            "1",
            "exposure in planes behind the image; 1 = peak of the perfect image",
        )
    if study.object is not None:
        words = "exposed image of " + lit_object_words(study.object)
        per_case["object_image"] = variable(("y", "x"), (pixels, pixels), "1", words)
    if study.imaging.resolution or study.detector is not None:
        cameras = camera_measures(study.imaging.resolution, study.detector, ())
        axes = {"axis": Axis(2), **camera_axes(camera_of(bench))}
        per_case |= template_of(cameras, axes).per_case
    if "segment_motion" in study.store.keep:
        shape = (instants, len(bench.system.segments), 6)
        per_case["segment_motion"] = variable(
            ("time", "segment", "dof"),
            shape,
            "m, rad",
            "rigid motion in the segment's local frame (dz to the sky)",
        )
    return per_case


def _fixed(bench: Bench) -> dict[str, Fixed]:
    axis = image_axis(bench)
    benches, places = benches_of(bench.text), places_of(bench.study)
    rest = [in_basis(one, one.static.zernike[0]) * one.wavelength_nm for one in benches]
    fixed: dict[str, Fixed] = {
        "noll": (
            ("noll",),
            np.arange(1, bench.study.wavefront.zernike_terms + 1),
            {"long_name": "Noll index"},
        ),
        "axis": (("axis",), np.array(["x", "y"], dtype=object), {"long_name": "axis of the image plane"}),
        "zernike_static": (
            (*places, "noll"),
            over_places(places, rest, 0) if places else rest[0],
            {
                "units": "nm",
                "long_name": "Zernike coefficients at rest (a_0 of Störkle 2018, Eq. 3.41)",
                **_over_annulus(bench),
            },
        ),
    }
    if (points := bench.study.optics.fields_arcmin) is not None:
        fixed["field"] = (
            ("field",),
            np.array(field_names(points), dtype=object),
            {"long_name": "field point"},
        )
        for name, values in zip(("field_x", "field_y"), np.array(points).T, strict=True):
            words = {"units": "arcmin", "long_name": f"field point along {name[-1]}"}
            fixed[name] = (("field",), values, words)
    if (colors := bench.study.optics.wavelengths_nm) is not None:
        fixed["wavelength"] = (("wavelength",), np.array(colors), {"units": "nm", "long_name": "wavelength"})
    if bench.study.imaging.enabled:
        for name in ("y", "x"):
            fixed[name] = ((name,), axis, {"units": "lambda/D", "long_name": f"image {name}"})
        if focus := bench.study.imaging.focus_um:
            words = {"units": "um", "long_name": "distance behind the image"}
            fixed["focus"] = (("focus",), np.array(focus), words)
        fixed.update(template_of((), camera_axes(camera_of(bench))).fixed)
        if (shown := bench.study.object) is not None:
            words = {"units": "1", "long_name": "image at rest of " + lit_object_words(shown)}
            still = [object_at_rest(one) for one in benches]
            whole = over_places(places, still, 0) if places else still[0]
            fixed["object_static"] = ((*places, "y", "x"), whole, words)
    if "segment_motion" in bench.study.store.keep:
        fixed["segment"] = (
            ("segment",),
            np.array(bench.system.segments.names, dtype=object),
            {"long_name": "segment"},
        )
        fixed["dof"] = (
            ("dof",),
            np.array(["dx", "dy", "dz", "rx", "ry", "rz"], dtype=object),
            {"long_name": "motion"},
        )
    return fixed


def _over_annulus(bench: Bench) -> dict[str, str]:
    """Return over which annulus the polynomials of the stored coefficients are orthogonal, as a label."""
    inner = bench.prepared.obscuration if bench.study.wavefront.basis == "annular" else 0.0
    return {"obscuration": repr(float(inner))}


def _coefficients(study: SegmentStudy) -> str:
    """Say what the stored Zernike coefficients are."""
    wavefront = study.wavefront
    basis = {
        "annular": "annular Noll Zernike coefficients, total",
        "circular": "equivalent circular Noll Zernike coefficients (Störkle 2018, Eq. 3.53), total",
    }[wavefront.basis]
    return basis + wavefront_source(wavefront.method, wavefront.reference)


def wavefront_source(method: str, reference: str) -> str:
    """Say what coefficients are from and about, where it is not the path lengths about the chief ray."""
    slopes = ", from the slopes of the rays (Störkle 2018, Eq. 4.20), which do not know piston"
    fitted = ", about the best-fit sphere's image point (Störkle 2018, section 3.3.3)"
    return slopes * (method == "slopes") + fitted * (reference == "fitted")
