"""The linear loops of a ``telescope-loop`` study, before anything is run."""

from wavequake.workflows.loops.loop_margins import Makers, linear_loops
from wavequake.workflows.loops.telescope_light import optics_of
from wavequake.workflows.loops.telescope_study import TelescopeLoopStudy


def loops(study: TelescopeLoopStudy) -> Makers:
    """Return every linear controller that acts, each alone."""
    return linear_loops(study, optics_of(study))
