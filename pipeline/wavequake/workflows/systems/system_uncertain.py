"""Studies whose structure is not known exactly: which model a case has."""

from dataclasses import replace

from wavequake.chain.uncertain import STREAM
from wavequake.mechanics.assembly.plant import Plant
from wavequake.mechanics.assembly.uncertain import Spread, drawn
from wavequake.mechanics.disturbances.motion import generator
from wavequake.workflows.mirrors.mirror_study import FULL
from wavequake.workflows.systems.system_bench import SystemBench
from wavequake.workflows.systems.system_plant import measured_modes


def uncertain_plant(bench: SystemBench, realization: int, model: str) -> Plant | None:
    """Return the plant of a realization with one of the models that the study compares.

    What is drawn of it depends on seed and realization alone: all disturbances share it.
    """
    plant, uncertain = bench.plants.get(model), bench.study.structure.uncertain
    if plant is None or uncertain is None:
        return plant
    spread = Spread(uncertain.frequency, uncertain.damping, uncertain.shapes)

    def one(of: Plant) -> Plant:
        random = generator(bench.study.study.seed, STREAM, realization // uncertain.repeats)
        return drawn(of, spread, measured_modes(bench.study), random)

    found = one(plant)
    # All models of a draw are shaken alike, about the resonances of the full one.
    return found if model == FULL else replace(found, resonances=one(bench.plants[FULL]).resonances)
