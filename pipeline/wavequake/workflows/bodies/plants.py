"""The plant of a study: its bodies behind their surfaces, and what joins them."""

import fnmatch
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from wavequake.errors import UserError
from wavequake.mechanics.assembly.bodies import Body
from wavequake.mechanics.assembly.links import End, Link
from wavequake.mechanics.assembly.plant import Plant, plant
from wavequake.mechanics.assembly.uncertain import Measured, corrected
from wavequake.optics.systems.bodies import Body as OpticalBody
from wavequake.optics.systems.bodies import surface_index
from wavequake.optics.systems.system import OpticalSystem
from wavequake.words import counted
from wavequake.workflows.bodies.made import MM_PER_M, behind, elastic_body, given_body
from wavequake.workflows.bodies.sections import BodySection, LinkSection, StructureSection
from wavequake.workflows.disturbed_study import DisturbedStudy
from wavequake.workflows.mirrors.study import FULL

SEGMENT = "segment"
"""What the elastic model that stands for all segments is called among bodies."""


@dataclass(frozen=True)
class Masses:
    """What a study says of its bodies with mass.

    Attributes
    ----------
    name : str
        Of the study.
    bodies : tuple of BodySection
    links : tuple of LinkSection
    structure : StructureSection
    compared : tuple of str
        Models that are compared, the full one first.
    reduced : tuple of str
        Elastic bodies of which reduced models are taken there.
    """

    name: str
    bodies: tuple[BodySection, ...]
    links: tuple[LinkSection, ...]
    structure: StructureSection
    compared: tuple[str, ...] = (FULL,)
    reduced: tuple[str, ...] = ()


def masses_of(study: DisturbedStudy) -> Masses:
    """Return what a study says of its bodies with mass."""
    structure = study.structure or StructureSection()
    reduced = tuple(name for name in reduced_names(study) if name != SEGMENT)
    compared = study.compared if reduced else (FULL,)
    return Masses(study.study.name, study.body, study.link, structure, compared, reduced)


def reduced_names(study: DisturbedStudy) -> tuple[str, ...]:
    """Return the bodies whose reduced models are compared, and "segment" where those of segments are.

    Raises
    ------
    UserError
        If the study names others.
    """
    if study.reduction is None:
        return ()
    elastic = elastic_names(study.body) + (SEGMENT,) * (getattr(study, "segment", None) is not None)
    return compared_bodies(study.reduction.of, elastic)


def deforming_terms(bodies: Sequence[BodySection], system: OpticalSystem) -> dict[int, int]:
    """Return by how many Noll terms the bodies deform surfaces, by index."""
    found = {}
    for body in bodies:
        section = body.mirror or body.imported or body.modes
        if section is not None and body.surfaces and section.figure_terms:
            found[surface_index(system, body.surfaces[0])] = section.figure_terms
    return found


def elastic_names(bodies: Sequence[BodySection]) -> tuple[str, ...]:
    """Return the names of the bodies of which there are reduced models."""
    return tuple(one.name for one in bodies if one.mirror or one.imported)


def plants_of(masses: Masses, system: OpticalSystem, bodies: Sequence[OpticalBody]) -> dict[str, Plant]:
    """Return the plant of a study by the names of the reduced models that it compares, "full" first.

    `system` can deform as `deforming_terms` says. Without a body of mass there is none.

    Raises
    ------
    UserError
        If a body, a link or a reduced model is not possible, or a surface is carried twice.
    """
    if not any(one.kind for one in masses.bodies):
        return {}
    _require_one_carrier(masses.bodies)
    optical = {body.name: body for body in bodies}
    fixed = {one.name: given_body(one, system, optical.get(one.name)) for one in masses.bodies}
    elastic = {
        one.name: elastic_body(one, masses.structure.last_hz, system)
        for one in masses.bodies
        if one.mirror or one.imported
    }

    def made(one: BodySection, variant: str) -> Body:
        given, section = fixed[one.name], one.mirror or one.imported
        if given is not None:
            return given
        assert section is not None
        name = variant if one.name in masses.reduced and variant != FULL else section.reduced
        return behind(one, elastic[one.name], name, system, optical.get(one.name))

    ground = {name: np.asarray(point) / MM_PER_M for name, point in masses.structure.ground_mm.items()}
    found = {
        variant: plant(
            [made(one, variant) for one in masses.bodies if one.kind],
            _links(masses),
            ground,
            masses.structure.damping_ratio,
            f"the structure of {masses.name}",
        )
        for variant in masses.compared
    }
    if masses.structure.mode:
        found = {name: corrected(one, measured_modes(masses.structure)) for name, one in found.items()}
    # All are shaken alike, whatever their own resonances.
    return {name: replace(one, resonances=found[FULL].resonances) for name, one in found.items()}


def measured_modes(structure: StructureSection) -> list[Measured]:
    """Return the modes of a study's structure that were measured."""
    return [Measured(**one.model_dump()) for one in structure.mode]


def _require_one_carrier(bodies: Sequence[BodySection]) -> None:
    carrier: dict[str, str] = {}
    for body in bodies:
        for surface in (*(body.surfaces if body.kind else ()), *body.carries):
            if surface in carrier:
                raise UserError(
                    f"The surface {surface!r} is carried by the bodies {carrier[surface]!r} and "
                    f"{body.name!r}; it can move with one of them."
                )
            carrier[surface] = body.name


def compared_bodies(patterns: Sequence[str], elastic: tuple[str, ...]) -> tuple[str, ...]:
    """Return the names of what is elastic whose reduced models a study compares: all, or those of patterns.

    Raises
    ------
    UserError
        If there is none, or none for a pattern.
    """
    for pattern in patterns:
        if not fnmatch.filter(elastic, pattern):
            raise UserError(
                f"reduction.of names {pattern!r}, which is no elastic mirror or imported body of this study; "
                f"there are {', '.join(elastic) or 'none'}."
            )
    found = tuple(name for name in elastic if any(fnmatch.fnmatch(name, one) for one in patterns or ("*",)))
    if not found:
        raise UserError(
            "The section [reduction] compares models of elastic bodies, but no body is a mirror or imported."
        )
    return found


def _links(masses: Masses) -> list[Link]:
    found = []
    for section in masses.links:
        kind = {"springs": "spring", "legs": "leg", "rigid": "rigid"}[section.kind]
        stiffness, damping = (
            (one,) * 3 if isinstance(one, float) else one
            for one in (section.stiffness_n_m or 0.0, section.damping_n_s_m)
        )
        for first, second in section.joins:
            found.append(
                Link(section.name, kind, _end(masses, first), _end(masses, second), stiffness, damping)  # type: ignore[arg-type]
            )
    return found


def _end(masses: Masses, text: str) -> End:
    """Return the end that ``body.node`` says; names of bodies may hold dots."""
    names = ["ground", *(body.name for body in masses.bodies)]
    body = max((name for name in names if text == name or text.startswith(f"{name}.")), key=len, default="")
    return End(body, text[len(body) + 1 :]) if body else End(*text.partition(".")[::2])


def standing(plants: Mapping[str, Plant]) -> dict[str, str]:
    """Say what stands where, and its lowest frequencies, for the plan."""
    return {
        f"bodies, {name} models" if len(plants) > 1 else "bodies": (
            f"{counted(len(plant.omega), 'mode')} "
            f"{'on the ground' if plant.grounded else 'floating in space'}, the lowest at "
            + ", ".join(f"{one / (2.0 * np.pi):.4g}" for one in plant.omega[:6])
            + " Hz"
        )
        for name, plant in plants.items()
    }
