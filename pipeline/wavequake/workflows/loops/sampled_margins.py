"""A sampled loop as one of a study: its parts for other tools, and its margins."""

from functools import partial

from wavequake.chain.loops.closing import grows
from wavequake.control.sampled.stability import (
    SampledLoop,
    controller_model,
    plant_model,
    sampled_margins,
    worst_pole,
)
from wavequake.workflows.loops.loop_margins import LoopMargins, StudyLoop, converted


def sampled_loop(name: str, loop: SampledLoop) -> StudyLoop:
    """Return a loop of this name with its parts."""
    return StudyLoop(plant_model(loop), controller_model(loop), partial(_margins, name, loop))


def _margins(name: str, loop: SampledLoop) -> LoopMargins:
    worst = worst_pole(loop)
    if grows(worst):
        return LoopMargins(name, worst.growth, worst.hertz)
    return converted(name, worst.growth, worst.hertz, sampled_margins(loop))
