"""Reduced models of bodies as cases: which model a case has, and how far it is from the full one."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from wavequake.chain.sampling import slot
from wavequake.mechanics.disturbances.element_motion import ElementDisturbance
from wavequake.workflows.mirrors.compared_models import model_errors, rms_of
from wavequake.workflows.systems.study import SystemStudy

Array = NDArray[np.float64]


def slot_of(study: SystemStudy, case: int) -> tuple[ElementDisturbance, int, str]:
    """Return disturbance, realization and model of a case: each draw is a case with each of the models."""
    population, place = slot(study.disturbance, case)
    realization, model = divmod(place, len(study.compared))
    return population, realization, study.compared[model]


def errors_of(numbers: Mapping[str, Array], full: Mapping[str, Array]) -> dict[str, Array]:
    """Return the `ERRORS` of a case relative to the same draw with the full model."""
    bent = numbers["zernike"][..., 3:] - full["zernike"][..., 3:]
    sizes = np.sqrt(np.mean(full["wfe_change"] ** 2, axis=0)), rms_of(full["los_mm"])
    return model_errors(bent, numbers["los_mm"] - full["los_mm"], sizes, numbers, full)
