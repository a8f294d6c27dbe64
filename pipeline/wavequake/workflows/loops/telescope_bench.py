"""What the cases of ``telescope-loop`` share: light as sensitivities, designed controllers, their events."""

from dataclasses import dataclass

from wavequake.chain.images.extended import check_object
from wavequake.chain.loops.designed import Designed, assembled, designed
from wavequake.chain.loops.judged import (
    refuse_saturated,
    refuse_unstable,
    refuse_unstable_together,
    sampled_loops,
)
from wavequake.control.sampled.stability import SampledLoop
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
    for sensor in study.sensor:
        sensor.labels(optics.light)  # what those cannot read that no controller uses, too
    designs = {one.name: designed(study, optics, one) for one in study.controller}
    linear = sampled_loops(study, optics, designs)
    for name, loop in linear.items():
        refuse_unstable(study, study.study.name, name, loop, optics)
    looks = [time[1:] for time in optics.times]
    controllers = tuple(assembled(study, optics, one, designs, looks) for one in study.controller)
    for one in controllers:
        refuse_unstable_together(study, one)
    first = {
        entry.name: seen_of(study, optics, drawn(study, optics, index, 0))
        for index, entry in enumerate(study.disturbance)
        if entry.share and any(one.stroke is not None for one in study.actuator)
    }
    refuse_saturated(study, optics, first)
    return Bench(study, optics, controllers, linear)
