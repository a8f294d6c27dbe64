"""The plant of a study: its bodies behind their surfaces, and what joins them."""

import fnmatch
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from wavequake.chain.nodal import nodal_fit, on_surface
from wavequake.errors import UserError
from wavequake.mechanics.assembly.arrays import Given, from_matrices, from_modes
from wavequake.mechanics.assembly.beams import Tube, beam_frame
from wavequake.mechanics.assembly.bodies import Body, Output, placed, rigid_body
from wavequake.mechanics.assembly.links import End, Link
from wavequake.mechanics.assembly.plant import Plant, plant
from wavequake.mechanics.assembly.uncertain import Measured, corrected
from wavequake.mechanics.mirrors.models import AnnularMirror, annular_mirror, circular_mirror
from wavequake.mechanics.model import FiniteElementModel, ReducedModel, places
from wavequake.optics.shapes.fit import SurfaceFit, apply, separate_pose, surface_fit
from wavequake.optics.shapes.shapes import Shape, ZernikeDeformation
from wavequake.optics.systems.bodies import Body as OpticalBody
from wavequake.optics.systems.bodies import surface_index
from wavequake.optics.systems.system import OpticalSystem
from wavequake.prepared import prepared
from wavequake.reduction.intermediate import Intermediate, intermediate
from wavequake.reduction.names import parse
from wavequake.reduction.two_stage import covers, reduce_variants, reference
from wavequake.workflows.mirrors.mirror_study import FULL
from wavequake.workflows.mirrors.model_store import digest, kept_intermediate, kept_model
from wavequake.workflows.systems.body_mirrors import glass_side, material_of, mirror_behind
from wavequake.workflows.systems.body_sections import (
    BodySection,
    ModesBodySection,
)
from wavequake.workflows.systems.system_study import SystemStudy

Array = NDArray[np.float64]

MM_PER_M = 1e3
_SHIFTS = np.repeat([1.0 / MM_PER_M, 1.0], 3)


@dataclass(frozen=True)
class Elastic:
    """An elastic body before a reduced model of it is chosen.

    Attributes
    ----------
    stage : Intermediate
    full : callable
        Builds the finite-element model, for variants that the intermediate one does not cover.
    flip : ndarray, shape (3, 3)
        From the model's axes to those of the surface.
    """

    stage: Intermediate
    full: Callable[[], FiniteElementModel]
    flip: Array


def deforming_terms(study: SystemStudy, system: OpticalSystem) -> dict[int, int]:
    """Return by how many Noll terms the bodies deform surfaces, by index."""
    found = {}
    for body in study.body:
        section = body.mirror or body.imported or body.modes
        if section is not None and body.surfaces and section.figure_terms:
            found[surface_index(system, body.surfaces[0])] = section.figure_terms
    return found


def has_plant(study: SystemStudy) -> bool:
    """Return whether any body has mass."""
    return any(body.kind for body in study.body)


def plants_of(study: SystemStudy, system: OpticalSystem, bodies: Sequence[OpticalBody]) -> dict[str, Plant]:
    """Return the plant of a study by the names of the reduced models that it compares, "full" first.

    `system` can deform as `deforming_terms` says.

    Raises
    ------
    UserError
        If a body, a link or a reduced model is not possible, or a surface is carried twice.
    """
    if not has_plant(study):
        return {}
    _require_one_carrier(study)
    optical = {body.name: body for body in bodies}
    fixed = {one.name: _given(one, system, optical.get(one.name)) for one in study.body}
    elastic = {one.name: _elastic(study, one, system) for one in study.body if one.mirror or one.imported}
    reduced = _reduced(study, tuple(elastic))

    def made(one: BodySection, variant: str) -> Body:
        given, section = fixed[one.name], one.mirror or one.imported
        if given is not None:
            return given
        assert section is not None
        name = variant if one.name in reduced and variant != FULL else section.reduced
        return _behind(one, elastic[one.name], name, system, optical.get(one.name))

    variants = (FULL, *(study.reduction.variants if study.reduction else ()))
    ground = {name: _m(point) for name, point in study.structure.ground_mm.items()}
    found = {
        variant: plant(
            [made(one, variant) for one in study.body if one.kind],
            _links(study),
            ground,
            study.structure.damping_ratio,
            f"the structure of {study.study.name}",
        )
        for variant in variants
    }
    if study.structure.mode:
        found = {name: corrected(one, measured_modes(study)) for name, one in found.items()}
    # All are shaken alike, whatever their own resonances.
    return {name: replace(one, resonances=found[FULL].resonances) for name, one in found.items()}


def measured_modes(study: SystemStudy) -> list[Measured]:
    """Return the modes of a study's structure that were measured."""
    return [Measured(**one.model_dump()) for one in study.structure.mode]


def _m(point: Sequence[float] | Array) -> Array:
    return np.asarray(point, dtype=np.float64) / MM_PER_M


def _require_one_carrier(study: SystemStudy) -> None:
    carrier: dict[str, str] = {}
    for body in study.body:
        for surface in (*(body.surfaces if body.kind else ()), *body.carries):
            if surface in carrier:
                raise UserError(
                    f"The surface {surface!r} is carried by the bodies {carrier[surface]!r} and "
                    f"{body.name!r}; it can move with one of them."
                )
            carrier[surface] = body.name


def _reduced(study: SystemStudy, elastic: tuple[str, ...]) -> tuple[str, ...]:
    """Return the names of the bodies whose reduced models are compared."""
    if study.reduction is None:
        return ()
    for pattern in study.reduction.of:
        if not fnmatch.filter(elastic, pattern):
            raise UserError(
                f"reduction.of names {pattern!r}, which is no elastic mirror or imported body of this study; "
                f"there are {', '.join(elastic) or 'none'}."
            )
    chosen = study.reduction.of or ("*",)
    found = tuple(name for name in elastic if any(fnmatch.fnmatch(name, one) for one in chosen))
    if not found:
        raise UserError(
            "The section [reduction] compares models of elastic bodies, but no body is a mirror or imported."
        )
    return found


def _links(study: SystemStudy) -> list[Link]:
    found = []
    for section in study.link:
        kind = {"springs": "spring", "legs": "leg", "rigid": "rigid"}[section.kind]
        stiffness, damping = (
            (one,) * 3 if isinstance(one, float) else one
            for one in (section.stiffness_n_m or 0.0, section.damping_n_s_m)
        )
        for first, second in section.joins:
            found.append(
                Link(section.name, kind, _end(study, first), _end(study, second), stiffness, damping)  # type: ignore[arg-type]
            )
    return found


def _end(study: SystemStudy, text: str) -> End:
    """Return the end that ``body.node`` says; names of bodies may hold dots."""
    names = ["ground", *(body.name for body in study.body)]
    body = max((name for name in names if text == name or text.startswith(f"{name}.")), key=len, default="")
    return End(body, text[len(body) + 1 :]) if body else End(*text.partition(".")[::2])


def _given(one: BodySection, system: OpticalSystem, optical: OpticalBody | None) -> Body | None:
    """Return a body that is rigid, made of beams, or given by arrays; None for others."""
    if one.rigid is not None:
        section = one.rigid
        axes, about = (optical.rotation, optical.point) if optical else (np.eye(3), np.zeros(3))
        if section.center_mm is None and optical is None:
            raise UserError(f"The rigid body {one.name!r} carries no surface; say where it is by center_mm.")
        center = _m(about if section.center_mm is None else section.center_mm)
        inertia = axes @ np.diag(section.inertia_kg_m2) @ axes.T
        nodes = {name: _m(point) for name, point in section.nodes_mm.items()}
        rows = _with(_transported(np.eye(6), center, axes, _m(about)), one.name if optical else None)
        return rigid_body(one.name, section.mass_kg, inertia, center, nodes, rows)
    if one.beams is not None:
        beams = one.beams
        model = beam_frame(
            one.name,
            {name: _m(point) for name, point in beams.nodes_mm.items()},
            beams.members,
            Tube(beams.diameter_mm / MM_PER_M, beams.wall_mm / MM_PER_M),
            material_of(beams),
            beams.pieces,
            beams.masses_kg,
        )
        where = {name: index for index, name in enumerate(beams.nodes_mm)}
        motions = {name: np.eye(model.order)[places(model)[index]] for name, index in where.items()}
        points = {name: _m(point) for name, point in beams.nodes_mm.items()}
        return placed(one.name, model, where, rows=_carried(one, system, motions, points))
    for kind, read in (("matrices", from_matrices), ("modes", from_modes)):
        arrays = getattr(one, kind)
        if arrays is not None:
            found = read(one.name, arrays.file_npz)
            rows = _carried(one, system, found.motions, found.points)
            if one.modes is not None and one.modes.figure_terms:
                rows |= _seen_modes(one, one.modes, found, system, optical)
            return placed(one.name, found.model, found.nodes, rows=rows, turns=found.turns)
    return None


def _with(rows: Array, name: str | None) -> dict[Output, Array]:
    return {} if name is None else {("rigid", name): rows}


def _transported(motion: Array, point: Array, axes: Array, about: Array) -> Array:
    """Return motion (6, n) in `axes` of what turns about `about`, m, from that at `point` in the system's.

    A rigid body that turns by e about a point moves another one, a away from it, by e x a.
    """
    away = about - point
    shift = motion[:3] - np.cross(away, motion[3:], axisb=0, axisc=0)
    return np.vstack([axes.T @ shift, axes.T @ motion[3:]])


def _carried(
    one: BodySection, system: OpticalSystem, motions: Mapping[str, Array], points: Mapping[str, Array]
) -> dict[Output, Array]:
    """Return the motion of surfaces that move with nodes, each in its own frame."""
    rows: dict[Output, Array] = {}
    for name, node in one.carries.items():
        surface = system.surfaces[_surface(one, system, name)]
        if node not in motions:
            why = "has no rotations" if node in points else "is no node of it"
            raise UserError(
                f"The body {one.name!r} carries {name!r} at {node!r}, which {why}; choose one of "
                f"{', '.join(motions) or 'none'}."
            )
        rows["rigid", name] = _transported(
            motions[node], points[node], np.asarray(surface.rotation), _m(surface.position)
        )
    return rows


def _surface(one: BodySection, system: OpticalSystem, name: str) -> int:
    try:
        return surface_index(system, name)
    except UserError as error:
        raise UserError(f"The body {one.name!r}: {error}") from None


def _elastic(study: SystemStudy, one: BodySection, system: OpticalSystem) -> Elastic:
    """Return what is reduced of an elastic body; built once, and kept on disk."""
    last = study.structure.last_hz
    if one.imported is not None:
        content = one.imported.content or ""
        full = prepared(maxsize=1)(partial(kept_model, content))
        record: dict[str, object] = {"content": content, "highest_hz": last}
        flip = np.eye(3)
    else:
        assert one.mirror is not None
        index = surface_index(system, one.surfaces[0])
        behind = glass_side(system, index)
        flip = np.diag([1.0, -behind, -behind])  # the model's front looks along its z axis
        mirror = mirror_behind(one.name, one.mirror, system, index, -behind)
        build = annular_mirror if isinstance(mirror, AnnularMirror) else circular_mirror
        full = prepared(maxsize=1)(partial(build, mirror))  # type: ignore[arg-type]
        record = {"body": repr(mirror), "highest_hz": last}
    stage = kept_intermediate(digest(record), lambda: intermediate(full(), highest=last))
    return Elastic(stage, full, flip)


def _behind(
    one: BodySection, elastic: Elastic, variant: str, system: OpticalSystem, optical: OpticalBody | None
) -> Body:
    """Return a reduced model of an elastic body at its place behind its first surface."""
    model = reference(elastic.stage) if variant == FULL else _variant(one.name, elastic, variant)
    nodes = {str(number + 1): number for number in range(len(model.interfaces))}
    if optical is None:
        return placed(one.name, model, nodes)
    surface = system.surfaces[surface_index(system, one.surfaces[0])]
    rotation, vertex = np.asarray(surface.rotation), _m(surface.position)
    form = surface.deformation
    assert isinstance(form, ZernikeDeformation)
    section = one.mirror or one.imported
    assert section is not None
    fit, rows = _fit(one, model, elastic.flip, section.figure_terms, form, surface.shape)
    shapes = rows.T.reshape(model.order, -1, 3) @ elastic.flip.T
    outputs = _outputs(one, fit, shapes, (rotation, vertex), optical)
    return placed(one.name, model, nodes, rotation @ elastic.flip, vertex, outputs)


def _outputs(
    one: BodySection, fit: SurfaceFit, shapes: Array, frame: tuple[Array, Array], optical: OpticalBody
) -> dict[Output, Array]:
    """Return motion and figure of a body's first surface.

    `shapes` (coordinates, p, 3) are displacements of its nodes in mm, in its `frame`: rotation, vertex in m.
    """
    rotation, vertex = frame
    poses, rest = separate_pose(fit, np.ascontiguousarray(shapes))
    motion = (poses * _SHIFTS).T  # in the surface's frame, about its vertex
    system_motion = np.vstack([rotation @ motion[:3], rotation @ motion[3:]])
    return {
        ("rigid", one.name): _transported(system_motion, vertex, optical.rotation, _m(optical.point)),
        ("figure", one.surfaces[0]): apply(fit, rest).T / MM_PER_M,
    }


def _seen_modes(
    one: BodySection,
    section: ModesBodySection,
    given: Given,
    system: OpticalSystem,
    optical: OpticalBody | None,
) -> dict[Output, Array]:
    """Return motion and figure of the first surface of a body of modes, by the nodes that lie on it."""
    if optical is None:
        raise UserError(f"The body {one.name!r} has no surface to which figure_terms could be fitted.")
    surface = system.surfaces[surface_index(system, one.surfaces[0])]
    rotation, form = np.asarray(surface.rotation), surface.deformation
    assert isinstance(form, ZernikeDeformation)
    points = (np.array(list(given.points.values())) * MM_PER_M - surface.position) @ rotation
    try:
        seen = on_surface(points, form, surface.shape, section.off_mm)
        fit = nodal_fit(points[seen], section.figure_terms, form, surface.shape, one.name)
    except UserError as error:
        raise UserError(f"The body {one.name!r} behind {one.surfaces[0]!r}: {error}") from None
    moved = given.model.inputs[:, : 3 * len(points)].reshape(len(given.model.inputs), -1, 3)[:, seen]
    return _outputs(one, fit, moved * MM_PER_M @ rotation, (rotation, _m(surface.position)), optical)


def _variant(name: str, elastic: Elastic, variant: str) -> ReducedModel:
    try:
        whole = None if covers(elastic.stage, parse(variant)) else elastic.full()
        return reduce_variants(elastic.stage, [variant], whole)[0]
    except UserError as error:
        raise UserError(f"The body {name!r}: {error}") from None


def _fit(
    one: BodySection,
    model: ReducedModel,
    flip: Array,
    terms: int,
    form: ZernikeDeformation,
    shape: Shape,
) -> tuple[SurfaceFit, Array]:
    """Return the fit of the figure over what the optics see, and the rows of its nodes, mm per coordinate."""
    nodes = (model.nodes[model.surface_nodes] * MM_PER_M) @ flip.T
    away = np.hypot(nodes[:, 0], nodes[:, 1]) / form.pupil_radius
    seen = (away <= 1.0 + 1e-9) & (away >= form.obscuration - 1e-9)
    try:
        fit = surface_fit(
            nodes[seen, :2], model.surface_weights[seen], terms, form.pupil_radius, form.obscuration, shape
        )
    except UserError as error:
        raise UserError(f"The body {one.name!r} behind {one.surfaces[0]!r}: {error}") from None
    rows = np.asarray(model.surface).reshape(-1, 3, model.order)[seen] * MM_PER_M
    return fit, rows.reshape(-1, model.order)
