"""What a store of the workflow ``segment-mor`` holds: names, dimensions, units."""

from collections.abc import Iterator

from wavequake.campaign.contract import Template
from wavequake.campaign.measures import Axis, Measure, stored, template_of
from wavequake.chain.images.camera import frame_axes
from wavequake.workflows.mirrors.compared_models import checked_models, reduction_measures
from wavequake.workflows.segments.mor_bench import (
    spot_check,
    study_of,
    traced_instants,
)


def template(study_text: str) -> Template:
    """Return what a store of this study holds."""
    study = study_of(study_text)
    axes = {
        "frequency": Axis(study.reduction.hertz, "frequency", "Hz"),
        "time": Axis(study.time.seconds[traced_instants(study)], "time of the traced instants", "s"),
        "excitation": Axis([excitation.name for excitation in study.excitation], "excitation"),
        "axis": Axis(["x", "y"], "axis of the image plane"),
        **frame_axes(study.imaging.pixels, study.imaging.sampling),
    }
    return template_of(_measures(), axes, checked_models(["segment"], [spot_check(study_text)]))


def _measures() -> Iterator[Measure]:
    history, spectrum = ("excitation", "time"), ("frequency",)
    yield from reduction_measures("supports")
    words = "Frobenius norm of the response of the segment's Zernike coefficients, piston and tilt too"
    yield stored("frf_opt", "nm/N", words, spectrum)
    words = "relative error of the response of the segment's Zernike coefficients"
    yield stored("eps_opt", "1", words, spectrum)
    words = "rms over the rays on glass of the wavefront relative to rest, best-fit plane removed"
    yield stored("wfe_rms", "nm", words, history)
    words = "rms over the rays on glass of the difference from the reference's, best-fit plane removed"
    yield stored("wfe_error", "nm", words, history)
    words = "root of the sum of squares of the annular Zernikes j >= 4, relative to rest"
    yield stored("wfe_zernike", "nm", words, history)
    yield stored("strehl", "1", "Strehl ratio in the direction of the best-fit plane", history)
    words = "line of sight relative to rest, in the image (Störkle 2018, Eq. 3.39)"
    yield stored("los_mm", "mm", words, (*history, "axis"))
    words = "rms over the shaken segments of the rigid displacement along their normals"
    yield stored("segment_piston_rms", "nm", words, history)
    words = "rms over the shaken segments of the root of the sum of squares of their figure's coefficients"
    yield stored("segment_figure_rms", "nm", words, history)
