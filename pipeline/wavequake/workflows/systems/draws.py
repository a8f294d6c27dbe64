"""How a system moves in a case: of seed, disturbance and realization only."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from wavequake.campaign.schema import study_from_identity
from wavequake.chain.sampling import Plan, plan_of
from wavequake.mechanics.assembly.plant import Plant
from wavequake.mechanics.disturbances.element_motion import (
    ElementDisturbance,
    ElementMotion,
    draw_elements,
)
from wavequake.mechanics.disturbances.source import Source
from wavequake.mechanics.disturbances.streams import Streams
from wavequake.optics.systems.file import build
from wavequake.prepared import prepared
from wavequake.workflows.bodies.uncertain import uncertain_plant
from wavequake.workflows.mirrors.study import FULL
from wavequake.workflows.systems.bench import (
    SystemBench,
    layout_of,
    plants_of_text,
)
from wavequake.workflows.systems.study import SystemStudy
from wavequake.workflows.systems.variants import slot_of

Array = NDArray[np.float64]


def draw(bench: SystemBench, case: int) -> tuple[ElementDisturbance, ElementMotion]:
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
) -> ElementMotion:
    """Return a realization of a population with one of the models that the study compares.

    At its own instants, or at others given as `time`. `watched` gives the plant more outputs, whose motion
    comes beside that of the elements.
    """
    study, streams = bench.study, sampling_plan(bench.text).of(realization)
    plant = uncertain_plant(bench.plants, study.structure, study.study.seed, realization, model)
    if plant is not None and watched is not None:
        plant = watched(plant)
    layout = replace(bench.layout, plant=plant)
    return draw_elements(
        study.disturbance, population, study.study.seed, realization, streams, time, layout=layout
    )


@prepared(maxsize=2)
def sampling_plan(study_text: str) -> Plan:
    """Return what spreads the random numbers of the study with this identity text.

    Raises
    ------
    UserError
        If they are too many for the plan that the study asks for.
    """
    study = study_from_identity(SystemStudy, study_text)
    singles = [entry for entry in study.disturbance if isinstance(entry, Source)]
    layout = replace(layout_of(study, build(study.system)), plant=plants_of_text(study_text).get(FULL))

    def draw_all(streams: Streams) -> None:
        for entry in (one for one in singles if one.random):
            draw_elements(singles, entry, study.study.seed, 0, streams, layout=layout)

    shares = [entry.share for entry in study.disturbance]
    return plan_of(study.campaign, study.study.seed, shares, draw_all, singles)
