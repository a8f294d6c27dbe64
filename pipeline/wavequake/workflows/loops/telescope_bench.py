"""What the cases of ``telescope-loop`` share: light as sensitivities, designed controllers, their events."""

from dataclasses import dataclass

from wavequake.chain.images.extended import check_object
from wavequake.chain.loops.designed import Designed
from wavequake.chain.loops.judged import judged_loops
from wavequake.control.linear import Array
from wavequake.control.sampled.stability import SampledLoop
from wavequake.workflows.loops.loop_margins import Makers, linear_loops
from wavequake.workflows.loops.telescope_light import Optics, drawn, optics_of, seen_of
from wavequake.workflows.loops.telescope_study import TelescopeLoopStudy


@dataclass(frozen=True)
class Bench:
    """A study with its telescope and controllers.

    Attributes
    ----------
    study : TelescopeLoopStudy
    optics : Optics
    controllers : tuple of Designed
    linear : dict of SampledLoop
        The loops of linear controllers, each alone, by name.
    """

    study: TelescopeLoopStudy
    optics: Optics
    controllers: tuple[Designed, ...]
    linear: dict[str, SampledLoop]


def bench_of(study: TelescopeLoopStudy) -> Bench:
    """Prepare a study.

    Raises
    ------
    UserError
        If a disturbance moves what loops cannot see, a controller cannot be designed, its loop is unstable,
        or a stroke is too short; names the block.
    """
    optics = optics_of(study)
    if study.object is not None:
        check_object(study.object, study.imaging.pixels, study.imaging.sampling)
    for index, entry in enumerate(study.disturbance):
        if entry.share:
            drawn(study, optics, index, 0)  # what no case can do is said before a run
    looks = [time[1:] for time in optics.times]

    def seen(index: int) -> tuple[Array, Array]:
        case = drawn(study, optics, index, 0)
        return case.time, seen_of(study, optics, case)

    return Bench(
        study, optics, *judged_loops(study, study.study.name, optics, study.disturbance, looks, seen)
    )


def loops(study: TelescopeLoopStudy) -> Makers:
    """Return every linear controller that acts, each alone."""
    return linear_loops(study, optics_of(study))
