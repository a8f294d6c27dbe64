"""How a system moves in a case: of seed, disturbance and realization only."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from wavequake.chain.sampling import Plan, plan_of
from wavequake.mechanics.assembly.plant import Plant
from wavequake.mechanics.disturbances.element_motion import ElementDisturbance
from wavequake.mechanics.disturbances.motion import Motion
from wavequake.mechanics.disturbances.registry import draw_case
from wavequake.prepared import prepared
from wavequake.workflows.bodies.uncertain import uncertain_plant
from wavequake.workflows.systems.bench import SystemBench, system_bench
from wavequake.workflows.systems.variants import slot_of

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
