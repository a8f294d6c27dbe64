"""What of a segmented telescope has mass: elastic segments, and bodies, what these carry, and their plant.

The plant is that of the telescope's parent, a system of surfaces, whose M1 stands for the segments. What a
body carries follows it, or one of its nodes, as a rigid body does.
"""

import difflib
import fnmatch
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.mechanics.assembly.plant import Plant
from wavequake.mechanics.disturbances.layout import Carried, SegmentLayout
from wavequake.optics.segments.kinematics import carried_segments
from wavequake.optics.segments.parent import parent_system
from wavequake.optics.segments.telescope import footprints
from wavequake.optics.shapes.shapes import ZernikeDeformation
from wavequake.optics.systems.bodies import Body as OpticalBody
from wavequake.optics.systems.bodies import rigid_body
from wavequake.optics.systems.system import OpticalSystem, Surface
from wavequake.workflows.bodies.made import MM_PER_M, transported
from wavequake.workflows.bodies.plants import (
    SEGMENT,
    Masses,
    deforming_terms,
    plants_of,
    reduced_names,
)
from wavequake.workflows.bodies.sections import BodySection, Held
from wavequake.workflows.mirrors.segment_body import segment_plant
from wavequake.workflows.mirrors.study import FULL
from wavequake.workflows.segments.study import SegmentStudy

Array = NDArray[np.float64]

PRIMARY = "M1"
"""All segments together."""

_BEFORE = 2  # surfaces of the parent before those of the telescope: its stop and M1
_ORIGIN = np.zeros(3)
_LENGTHS = np.repeat([MM_PER_M, 1.0], 3)


@dataclass(frozen=True)
class CarryingBodies:
    """Bodies of a telescope: plants by the models that are compared, and what bodies and nodes carry.

    ``optical`` are those that carry something themselves: axes, and where they turn.
    """

    plants: Mapping[str, Plant] = field(default_factory=dict)
    carried: Mapping[str, Carried] = field(default_factory=dict)
    optical: tuple[OpticalBody, ...] = ()


def carrying_bodies(masses: Masses, system: OpticalSystem) -> CarryingBodies:
    """Return the bodies of a telescope.

    Raises
    ------
    UserError
        If a body names what there is not, or is called as an element is, two of them carry one element, one
        would bend M1, or as `plants_of`.
    """
    if not masses.bodies:
        return CarryingBodies()
    _require_names(masses.bodies, system)
    direct = {one.name: _elements(one, one.surfaces, system) for one in masses.bodies}
    held = {one.name: _held(one, system) for one in masses.bodies}
    _require_one_carrier(masses.bodies, direct, held)
    parent = parent_system(system)
    bodies = tuple(_of_parent(one, direct[one.name], held[one.name], system) for one in masses.bodies)
    for one in bodies:
        _require_rigid_primary(one)
    frames = tuple(Surface(node, position=_ORIGIN) for nodes in held.values() for node in nodes)
    parent = replace(parent, surfaces=(*parent.surfaces, *frames))
    optical = [rigid_body(parent, one.name, one.surfaces, one.about_mm) for one in bodies if one.surfaces]
    plants = plants_of(replace(masses, bodies=bodies), _deforming(bodies, parent, system), optical)
    carried = {one.name: _follow(direct[one.name], system, _at_origin(one)) for one in optical}
    for nodes in held.values():
        carried |= {node: _follow(elements, system, np.eye(6)) for node, (_, elements) in nodes.items()}
    return CarryingBodies(plants, carried, tuple(optical))


def _names(system: OpticalSystem) -> tuple[str, ...]:
    others = (*system.bodies, *(surface.name for surface in system.after_primary))
    return tuple(dict.fromkeys((PRIMARY, *system.segments.names, *others)))


def _require_names(bodies: Sequence[BodySection], system: OpticalSystem) -> None:
    taken = set(_names(system))
    for one in bodies:
        if one.name in taken:
            raise UserError(
                f"The body {one.name!r} is called as a part of the telescope {system.name}, or another body, "
                "is; it needs another name."
            )
        taken.add(one.name)


def _elements(one: BodySection, patterns: Iterable[str], system: OpticalSystem) -> tuple[str, ...]:
    """Return the segments and surfaces that patterns name; ``*`` and ``?`` stand for any letters."""
    names, segments = _names(system), system.segments.names
    surfaces = [surface.name for surface in system.after_primary]
    found: list[str] = []
    for pattern in patterns:
        matching = [pattern] if pattern in names else fnmatch.filter((*segments, *surfaces), pattern)
        if not matching:
            near = difflib.get_close_matches(pattern, names, n=1)
            some = f"it has {', '.join((PRIMARY, *surfaces))} and segments {segments[0]} to {segments[-1]}."
            raise UserError(
                f"The body {one.name!r} carries {pattern!r}, but the telescope {system.name} has no such "
                f"segment or surface; {f'did you mean {near[0]!r}?' if near else some}"
            )
        for name in matching:
            if name == PRIMARY:
                found += segments
            elif name in system.bodies:
                found += system.bodies[name]
            else:
                found.append(name)
    return tuple(dict.fromkeys(found))


def _held(one: BodySection, system: OpticalSystem) -> dict[str, tuple[Held, tuple[str, ...]]]:
    """Return the nodes of a body that carry elements, and these; ``{}`` in a node is an element's name."""
    found: dict[str, tuple[Held, tuple[str, ...]]] = {}
    for pattern, nodes in one.carries.items():
        for element in _elements(one, [pattern], system):
            own: Held = (
                nodes.replace("{}", element)
                if isinstance(nodes, str)
                else tuple(node.replace("{}", element) for node in nodes)
            )
            name = f"{one.name}.{own if isinstance(own, str) else '+'.join(own)}"
            found[name] = own, (*found.get(name, (own, ()))[1], element)
    return found


def _require_one_carrier(
    bodies: Sequence[BodySection],
    direct: Mapping[str, tuple[str, ...]],
    held: Mapping[str, Mapping[str, tuple[Held, tuple[str, ...]]]],
) -> None:
    carrier: dict[str, str] = {}
    for one in bodies:
        by_nodes = [element for _, elements in held[one.name].values() for element in elements]
        for element in (*(direct[one.name] if one.kind else ()), *by_nodes):
            if element in carrier:
                raise UserError(
                    f"{element!r} is carried by the body {carrier[element]!r} and by {one.name!r}; it can "
                    "move with one of them."
                    if carrier[element] != one.name
                    else f"{element!r} is carried twice by the body {one.name!r}; once is enough."
                )
            carrier[element] = one.name


def _of_parent(
    one: BodySection,
    direct: Sequence[str],
    held: Mapping[str, tuple[Held, tuple[str, ...]]],
    system: OpticalSystem,
) -> BodySection:
    """Return a body whose surfaces are those of the parent, and whose nodes carry frames of their own."""
    segments = set(system.segments.names)
    surfaces = tuple(dict.fromkeys(PRIMARY if name in segments else name for name in direct))
    update: dict[str, object] = {"surfaces": surfaces}
    if held and one.kind:
        carries = {node: nodes for node, (nodes, _) in held.items()}
        update[one.kind] = getattr(one, one.kind).model_copy(update={"carries": carries})
    return one.model_copy(update=update)


def _require_rigid_primary(one: BodySection) -> None:
    bends = one.mirror or one.imported or (one.modes if one.modes and one.modes.figure_terms else None)
    if bends is not None and one.surfaces[:1] == (PRIMARY,):
        raise UserError(
            f"The body {one.name!r} would bend {PRIMARY} behind its segments; carry them by nodes of beams, "
            "matrices or modes, or by a rigid body, and let segments bend by the section [segment]."
        )


def _deforming(bodies: Sequence[BodySection], parent: OpticalSystem, system: OpticalSystem) -> OpticalSystem:
    """Return the parent in which mirrors deform over the axial beam's footprint, as in the telescope."""
    surfaces, radii = list(parent.surfaces), footprints(system)
    for index, terms in deforming_terms(bodies, parent).items():
        after = index - _BEFORE
        if after >= len(radii):
            raise UserError(f"The image, {surfaces[index].name!r}, does not bend; a rigid body can carry it.")
        surfaces[index] = replace(surfaces[index], deformation=ZernikeDeformation(terms, float(radii[after])))
    return replace(parent, surfaces=tuple(surfaces))


def _at_origin(body: OpticalBody) -> Array:
    """Return the motion (6, 6) at M1's vertex, in the system's axes, per motion of a body in its own."""
    axes = np.asarray(np.kron(np.eye(2), body.rotation), dtype=np.float64)
    return transported(axes, body.point / MM_PER_M, np.eye(3), _ORIGIN)


def _follow(elements: Sequence[str], system: OpticalSystem, at_origin: Array) -> Carried:
    """Return how elements move, of which motion (6, 6) at M1's vertex each is, SI units."""
    segments = np.moveaxis(carried_segments(system.segments), 0, 2)  # (S, 6, 6), mm and rad
    segments = segments / _LENGTHS[:, None] * _LENGTHS
    place = {name: index for index, name in enumerate(system.segments.names)}
    surfaces = {surface.name: surface for surface in system.after_primary}
    rows = [
        segments[place[name]]
        if name in place
        else transported(np.eye(6), _ORIGIN, surfaces[name].rotation, surfaces[name].position / MM_PER_M)
        for name in elements
    ]
    return Carried(tuple(elements), np.array(rows).reshape(-1, 6, 6) @ at_origin)


def with_bodies(layout: SegmentLayout, study: SegmentStudy, bodies: CarryingBodies) -> SegmentLayout:
    """Return a layout with bodies, which disturbances can move by name."""
    names = tuple(one.name for one in study.body)
    return replace(
        layout,
        others=(*names, *(layout.others or ())),
        plant=bodies.plants.get(FULL),
        carried=bodies.carried,
    )


def elastic_segments(study: SegmentStudy, system: OpticalSystem) -> dict[str, Plant]:
    """Return what stands for every segment of a study, by the models that it compares, if they are elastic.

    Without a comparison the model that the study takes is called full.
    """
    section = study.segment
    if section is None:
        return {}
    found = {FULL: segment_plant(section, system)}
    for name in study.compared[1:] if SEGMENT in reduced_names(study) else ():
        found[name] = segment_plant(section.model_copy(update={"reduced": name}), system)
    return found
