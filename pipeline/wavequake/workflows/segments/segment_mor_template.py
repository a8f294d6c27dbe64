"""What a store of the workflow ``segment-mor`` holds: names, dimensions, units."""

import numpy as np
from numpy.typing import NDArray

from wavequake.campaign.contract import Template, Variable
from wavequake.workflows.segments.segment_mor_bench import (
    frequencies_of,
    spot_check,
    study_of,
    time_of,
    traced_instants,
)
from wavequake.workflows.segments.segment_mor_study import SegmentMorStudy


def template(study_text: str) -> Template:
    """Return what a store of this study holds."""
    study = study_of(study_text)
    return Template(_per_case(study), _fixed(study, study_text))


def _per_case(study: SegmentMorStudy) -> dict[str, Variable]:
    excitations, instants = len(study.excitation), len(traced_instants(study))
    frequencies, pixels = study.reduction.frequencies, study.imaging.pixels

    def scalar(units: str, long_name: str) -> Variable:
        return Variable((), (), {"units": units, "long_name": long_name})

    def spectrum(units: str, long_name: str) -> Variable:
        return Variable(("frequency",), (frequencies,), {"units": units, "long_name": long_name})

    def history(units: str, long_name: str) -> Variable:
        return Variable(
            ("excitation", "time"), (excitations, instants), {"units": units, "long_name": long_name}
        )

    return {
        "order": scalar("1", "number of coordinates of the variant"),
        "reduce_seconds": Variable(
            (), (), {"units": "s", "long_name": "time of the reduction"}, measured=True
        ),
        "pseudo_frequency_max": scalar("Hz", "largest eigenfrequency of the reduced model"),
        "frf_mech": spectrum("m/N", "Frobenius norm of the receptance at the supports"),
        "eps_mech": spectrum("1", "relative error of the receptance (Störkle 2018, Eq. 2.10)"),
        "frf_opt": spectrum(
            "nm/N",
            "Frobenius norm of the response of the segment's Zernike coefficients, piston and tilt too",
        ),
        "eps_opt": spectrum("1", "relative error of the response of the segment's Zernike coefficients"),
        "wfe_rms": history(
            "nm",
            "rms over the rays on glass of the wavefront relative to rest, best-fit plane removed",
        ),
        "wfe_error": history(
            "nm", "rms over the rays on glass of the difference from the reference's, best-fit plane removed"
        ),
        "wfe_zernike": history(
            "nm", "root of the sum of squares of the annular Zernikes j >= 4, relative to rest"
        ),
        "strehl": history("1", "Strehl ratio in the direction of the best-fit plane"),
        "los_mm": Variable(
            ("excitation", "time", "axis"),
            (excitations, instants, 2),
            {
                "units": "mm",
                "long_name": "line of sight relative to rest, in the image (Störkle 2018, Eq. 3.39)",
            },
        ),
        "los_error": history("mm", "distance from the reference's line of sight"),
        "segment_piston_rms": history(
            "nm", "rms over the shaken segments of the rigid displacement along their normals"
        ),
        "segment_figure_rms": history(
            "nm",
            "rms over the shaken segments of the root of the sum of squares of their figure's coefficients",
        ),
        "exposure": Variable(
            ("excitation", "y", "x"),
            (excitations, pixels, pixels),
            {"units": "1", "long_name": "mean of the instants' images; 1 = peak of the perfect one"},
        ),
        "image_error": Variable(
            ("excitation",),
            (excitations,),
            {"units": "1", "long_name": "L2 norm of the difference of unit-energy exposures"},
        ),
        "resolution_mm": scalar("mm", "lambda/D in the image: wavelength times focal length over diameter"),
    }


def _fixed(
    study: SegmentMorStudy, study_text: str
) -> dict[str, tuple[tuple[str, ...], NDArray[np.generic], dict[str, str]]]:
    pixels = (np.arange(study.imaging.pixels) - study.imaging.pixels // 2) * study.imaging.sampling
    lambda_over_d = {"units": "lambda/D"}
    names = [excitation.name for excitation in study.excitation]
    checked_at, errors = spot_check(study_text)
    checked = {"units": "1", "long_name": "error of the intermediate model against the full one (Eq. 2.10)"}
    return {
        "checked_model": (("checked_model",), np.array(["segment"], dtype=object), {"long_name": "model"}),
        "spot_frequency": (("check",), checked_at, {"units": "Hz", "long_name": "frequency of the check"}),
        "spot_error": (("checked_model", "check"), errors[None], checked),
        "frequency": (("frequency",), frequencies_of(study), {"units": "Hz", "long_name": "frequency"}),
        "time": (
            ("time",),
            time_of(study)[traced_instants(study)],
            {"units": "s", "long_name": "time of the traced instants"},
        ),
        "excitation": (("excitation",), np.array(names, dtype=object), {"long_name": "excitation"}),
        "axis": (("axis",), np.array(["x", "y"], dtype=object), {"long_name": "axis of the image plane"}),
        "y": (("y",), pixels, {**lambda_over_d, "long_name": "image y"}),
        "x": (("x",), pixels, {**lambda_over_d, "long_name": "image x"}),
    }
