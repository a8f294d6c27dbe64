"""Structures that are not known exactly: which model a case has."""

from collections.abc import Mapping
from dataclasses import replace

from wavequake.chain.uncertain import STREAM
from wavequake.mechanics.assembly.plant import Plant
from wavequake.mechanics.assembly.uncertain import Spread, drawn
from wavequake.mechanics.disturbances.motion import generator
from wavequake.workflows.bodies.plants import measured_modes
from wavequake.workflows.bodies.sections import StructureSection
from wavequake.workflows.mirrors.study import FULL


def uncertain_plant(
    plants: Mapping[str, Plant], structure: StructureSection | None, seed: int, realization: int, model: str
) -> Plant | None:
    """Return the plant of a realization with one of the models that a study compares.

    What is drawn of it depends on seed and realization alone: all disturbances share it.
    """
    plant, uncertain = plants.get(model), structure.uncertain if structure else None
    if plant is None or structure is None or uncertain is None:
        return plant
    spread, modes = (
        Spread(uncertain.frequency, uncertain.damping, uncertain.shapes),
        measured_modes(structure),
    )

    def one(of: Plant) -> Plant:
        return drawn(of, spread, modes, generator(seed, STREAM, realization // uncertain.repeats))

    found = one(plant)
    # All models of a draw are shaken alike, about the resonances of the full one.
    return found if model == FULL else replace(found, resonances=one(plants[FULL]).resonances)
