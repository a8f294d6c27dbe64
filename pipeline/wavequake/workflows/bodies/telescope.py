"""What of a study of a segmented telescope has mass: bodies, and segments that are elastic."""

from dataclasses import replace

from wavequake.mechanics.assembly.plant import Plant
from wavequake.mechanics.disturbances.layout import SegmentLayout
from wavequake.optics.systems.system import OpticalSystem
from wavequake.workflows.bodies.plants import Masses, compared_bodies, elastic_names
from wavequake.workflows.bodies.sections import StructureSection
from wavequake.workflows.bodies.segments import CarryingBodies
from wavequake.workflows.mirrors.segment_body import segment_plant
from wavequake.workflows.mirrors.study import FULL
from wavequake.workflows.segments.study import SegmentStudy

_SEGMENT = "segment"


def with_bodies(layout: SegmentLayout, study: SegmentStudy, bodies: CarryingBodies) -> SegmentLayout:
    """Return a layout with bodies, which disturbances can move by name."""
    names = tuple(one.name for one in study.body)
    return replace(
        layout,
        others=(*names, *(layout.others or ())),
        plant=bodies.plants.get(FULL),
        carried=bodies.carried,
    )


def masses_of(study: SegmentStudy) -> Masses:
    """Return what a study says of its bodies with mass."""
    structure = study.structure or StructureSection()
    reduced = tuple(name for name in _compared(study) if name != _SEGMENT)
    compared = study.compared if reduced else (FULL,)
    return Masses(study.study.name, study.body, study.link, structure, compared, reduced)


def _compared(study: SegmentStudy) -> tuple[str, ...]:
    """Return the bodies whose reduced models are compared, and "segment" where those of segments are.

    Raises
    ------
    UserError
        If the study names others.
    """
    if study.reduction is None:
        return ()
    elastic = elastic_names(study.body) + (_SEGMENT,) * (study.segment is not None)
    return compared_bodies(study.reduction.of, elastic)


def elastic_segments(study: SegmentStudy, system: OpticalSystem) -> dict[str, Plant]:
    """Return what stands for every segment of a study, by the models that it compares, if they are elastic.

    Without a comparison the model that the study takes is called full.
    """
    section = study.segment
    if section is None:
        return {}
    found = {FULL: segment_plant(section, system)}
    for name in study.compared[1:] if _SEGMENT in _compared(study) else ():
        found[name] = segment_plant(section.model_copy(update={"reduced": name}), system)
    return found
