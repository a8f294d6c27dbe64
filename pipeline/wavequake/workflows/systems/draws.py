"""Which disturbance, realization and models of bodies a case has, and how a system moves in it."""

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from wavequake.chain.sampling import Plan, plan_of, slot
from wavequake.mechanics.assembly.plant import Plant
from wavequake.mechanics.disturbances.element_motion import ElementDisturbance
from wavequake.mechanics.disturbances.motion import Motion
from wavequake.mechanics.disturbances.registry import draw_case
from wavequake.prepared import prepared
from wavequake.workflows.bodies.uncertain import uncertain_plant
from wavequake.workflows.mirrors.compared_models import model_errors, rms_of
from wavequake.workflows.systems.bench import SystemBench, system_bench
from wavequake.workflows.systems.study import SystemStudy

Array = NDArray[np.float64]


def draw(bench: SystemBench, case: int) -> tuple[ElementDisturbance, Motion]:
    """Return the population of a case and its motion: of seed, disturbance and realization only."""
    population, realization, model = slot_of(bench.study, case)
    return population, drawn_with(bench, population, realization, model)


def drawn_with(
    bench: SystemBench,
    population: ElementDisturbance,
    realization: int,
    model: str,
    time: Array | None = None,
    watched: Callable[[Plant], Plant] | None = None,
) -> Motion:
    """Return a realization of a population with one of the models that the study compares.

    At its own instants, or at others given as `time`. `watched` gives the plant more outputs, whose motion
    comes beside that of the elements.
    """
    study, streams = bench.study, sampling_plan(bench.text).of(realization)
    plant = uncertain_plant(bench.plants, study.structure, study.study.seed, realization, model)
    if plant is not None and watched is not None:
        plant = watched(plant)
    layout = replace(bench.layout, plant=plant)
    return draw_case(study.disturbance, population, layout, study.study.seed, realization, streams, time)


@prepared(maxsize=2)
def sampling_plan(study_text: str) -> Plan:
    """Return what spreads the random numbers of the study with this identity text.

    Raises
    ------
    UserError
        If they are too many for the plan that the study asks for.
    """
    bench = system_bench(study_text)
    return plan_of(bench.study.campaign, bench.study.study.seed, bench.study.disturbance, bench.layout)


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
