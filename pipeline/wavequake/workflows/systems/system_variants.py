"""Reduced models of bodies as cases: which model a case has, and how far it is from the full one."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from wavequake.mechanics.disturbances.element_motion import ElementDisturbance
from wavequake.workflows.segments.segment_disturbance import slot
from wavequake.workflows.systems.system_study import SystemStudy

Array = NDArray[np.float64]

ERRORS = {
    "model_error_wfe": (
        "nm",
        ("field", "wavelength"),
        "wavefront (Zernikes j >= 4), rms over instants",
    ),
    "model_error_los": ("mm", ("field", "wavelength"), "line of sight in the image, rms over instants"),
    "model_error": (
        "1",
        ("field", "wavelength"),
        "the larger one of line of sight and wavefront, in parts of what the case does with full models",
    ),
    "model_error_image": ("1", ("field",), "exposure, L2 norm relative to that of the full model"),
}
"""Of what reduced models are judged by: unit, dimensions and words."""


def slot_of(study: SystemStudy, case: int) -> tuple[ElementDisturbance, int, str]:
    """Return disturbance, realization and model of a case: each draw is a case with each of the models."""
    population, place = slot(study.disturbance, case)
    realization, model = divmod(place, len(study.compared))
    return population, realization, study.compared[model]


def model_errors(numbers: Mapping[str, Array], full: Mapping[str, Array]) -> dict[str, Array]:
    """Return the `ERRORS` of a case relative to the same draw with the full model."""
    figure, bent = (one["zernike"][..., 3:] for one in (numbers, full))
    sight, swung = (one["los_mm"] for one in (numbers, full))
    errors = _rms(figure - bent), _rms(sight - swung)
    sizes = np.sqrt(np.mean(full["wfe_change"] ** 2, axis=0)), _rms(swung)
    parts = [
        np.divide(one, size, out=np.zeros_like(one), where=size > 0.0)
        for one, size in zip(errors, sizes, strict=True)
    ]
    found = {
        "model_error_wfe": errors[0],
        "model_error_los": errors[1],
        "model_error": np.maximum(*parts),
    }
    if "exposure" in numbers:
        away = np.linalg.norm(numbers["exposure"] - full["exposure"], axis=(1, 2))
        found["model_error_image"] = away / np.linalg.norm(full["exposure"], axis=(1, 2))
    return found


def _rms(values: Array) -> Array:
    """Return the rms over instants (first axis) of vectors (last axis)."""
    return np.asarray(np.sqrt(np.mean(np.sum(values**2, axis=-1), axis=0)))
