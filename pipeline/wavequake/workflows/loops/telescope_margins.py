"""The linear loops of a ``telescope-loop`` study, before anything is run."""

from functools import partial

from wavequake.chain.loops.designed import designed
from wavequake.chain.loops.judged import sampled_loops
from wavequake.workflows.loops.loop_margins import Makers, sampled_loop
from wavequake.workflows.loops.telescope_light import optics_of
from wavequake.workflows.loops.telescope_study import TelescopeLoopStudy


def loops(study: TelescopeLoopStudy) -> Makers:
    """Return every linear controller that acts, each alone."""
    optics = optics_of(study)
    designs = {one.name: designed(study, optics, one) for one in study.controller}
    found = sampled_loops(study, optics, designs)
    return {name: partial(sampled_loop, name, loop) for name, loop in found.items()}
