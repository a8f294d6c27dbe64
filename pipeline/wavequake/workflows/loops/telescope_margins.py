"""The linear loops of a ``telescope-loop`` study, before anything is run."""

from functools import partial

from wavequake.control.sampled.stability import (
    SampledLoop,
    controller_model,
    plant_model,
    sampled_margins,
    worst_pole,
)
from wavequake.workflows.loops.loop_margins import LoopMargins, Makers, StudyLoop, converted
from wavequake.workflows.loops.telescope_bench import designed, grows, sampled_loops
from wavequake.workflows.loops.telescope_light import optics_of
from wavequake.workflows.loops.telescope_study import TelescopeLoopStudy


def loops(study: TelescopeLoopStudy) -> Makers:
    """Return every linear controller that acts, each alone."""
    optics = optics_of(study)
    designs = {one.name: designed(study, optics, one) for one in study.controller}
    found = sampled_loops(study, optics, designs)
    return {name: partial(_made, name, loop) for name, loop in found.items()}


def _made(name: str, loop: SampledLoop) -> StudyLoop:
    return StudyLoop(plant_model(loop), controller_model(loop), partial(_margins, name, loop))


def _margins(name: str, loop: SampledLoop) -> LoopMargins:
    worst = worst_pole(loop)
    if grows(worst):
        return LoopMargins(name, worst.growth, worst.hertz)
    return converted(name, worst.growth, worst.hertz, sampled_margins(loop))
