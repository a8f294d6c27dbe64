"""A body of a study at its place: its model, and how what it carries moves with it."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from wavequake.chain.nodal import nodal_fit, on_surface
from wavequake.errors import UserError
from wavequake.mechanics.assembly.arrays import Given, from_matrices, from_modes
from wavequake.mechanics.assembly.beams import Tube, beam_frame
from wavequake.mechanics.assembly.bodies import Body, Output, placed, rigid_body
from wavequake.mechanics.mirrors.models import AnnularMirror, annular_mirror, circular_mirror
from wavequake.mechanics.model import FiniteElementModel, ReducedModel, places, rigid_modes, shifts
from wavequake.optics.shapes.fit import SurfaceFit, apply, separate_pose, surface_fit
from wavequake.optics.shapes.shapes import Shape, ZernikeDeformation
from wavequake.optics.systems.bodies import Body as OpticalBody
from wavequake.optics.systems.bodies import surface_index
from wavequake.optics.systems.system import OpticalSystem
from wavequake.prepared import prepared
from wavequake.reduction.intermediate import Intermediate, intermediate
from wavequake.workflows.bodies.mirrors import glass_side, material_of, mirror_behind
from wavequake.workflows.bodies.sections import BodySection, ModesBodySection
from wavequake.workflows.mirrors.compared_models import reduced_model
from wavequake.workflows.mirrors.model_store import digest, kept_intermediate, kept_model

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


def _m(point: Sequence[float] | Array) -> Array:
    return np.asarray(point, dtype=np.float64) / MM_PER_M


def given_body(one: BodySection, system: OpticalSystem, optical: OpticalBody | None) -> Body | None:
    """Return a body that is rigid, made of beams, or given by arrays; None for others."""
    if one.rigid is not None:
        section = one.rigid
        axes, about = (optical.rotation, optical.point) if optical else (np.eye(3), np.zeros(3))
        if section.center_mm is None and optical is None:
            raise UserError(f"The rigid body {one.name!r} carries no surface; say where it is by center_mm.")
        center = _m(about if section.center_mm is None else section.center_mm)
        inertia = axes @ np.diag(section.inertia_kg_m2) @ axes.T
        nodes = {name: _m(point) for name, point in section.nodes_mm.items()}
        rows = _with(transported(np.eye(6), center, axes, _m(about)), one.name if optical else None)
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
        shifts = {name: motion[:3] for name, motion in motions.items()}
        points = {name: _m(point) for name, point in beams.nodes_mm.items()}
        return placed(one.name, model, where, rows=_carried(one, system, motions, shifts, points))
    for kind, read in (("matrices", from_matrices), ("modes", from_modes)):
        arrays = getattr(one, kind)
        if arrays is not None:
            found = read(one.name, arrays.file_npz)
            shifts = {name: found.model.inputs.T[3 * row :][:3] for name, row in found.nodes.items()}
            rows = _carried(one, system, found.motions, shifts, found.points)
            if one.modes is not None and one.modes.figure_terms:
                rows |= _seen_modes(one, one.modes, found, system, optical)
            return placed(one.name, found.model, found.nodes, rows=rows, turns=found.turns)
    return None


def _with(rows: Array, name: str | None) -> dict[Output, Array]:
    return {} if name is None else {("rigid", name): rows}


def transported(motion: Array, point: Array, axes: Array, about: Array) -> Array:
    """Return motion (6, n) in `axes` of what turns about `about`, m, from that at `point` in the system's.

    A rigid body that turns by e about a point moves another one, a away from it, by e x a.
    """
    away = about - point
    shift = motion[:3] - np.cross(away, motion[3:], axisb=0, axisc=0)
    return np.vstack([axes.T @ shift, axes.T @ motion[3:]])


def _carried(
    one: BodySection,
    system: OpticalSystem,
    motions: Mapping[str, Array],
    shifts: Mapping[str, Array],
    points: Mapping[str, Array],
) -> dict[Output, Array]:
    """Return the motion of surfaces that move with nodes, each in its own frame.

    Nodes have `motions` (6, n) where they can turn, `shifts` (3, n) and places, m.
    """
    rows: dict[Output, Array] = {}
    for name, held in one.carries.items():
        surface = system.surfaces[_surface(one, system, name)]
        if isinstance(held, str):
            _require_nodes(one, [held], motions, points)
            motion, at = motions[held], points[held]
        else:
            _require_nodes(one, held, points, points)
            motion, at = _held_by(one, [shifts[node] for node in held], [points[node] for node in held])
        rows["rigid", name] = transported(motion, at, np.asarray(surface.rotation), _m(surface.position))
    return rows


def _require_nodes(
    one: BodySection, wanted: Sequence[str], able: Mapping[str, Array], known: Mapping[str, Array]
) -> None:
    for node in wanted:
        if node not in able:
            why = "has no rotations: name three nodes" if node in known else "is no node of it"
            raise UserError(
                f"The body {one.name!r} carries parts at {node!r}, which {why}; choose among "
                f"{', '.join(able if able or node not in known else known)}."
            )


def _held_by(one: BodySection, shifts: Sequence[Array], points: Sequence[Array]) -> tuple[Array, Array]:
    """Return the rigid motion (6, n) that fits the displacements of nodes best, and about which point."""
    middle = np.mean(points, axis=0)
    moves = rigid_modes(np.array(points), middle)
    if np.linalg.matrix_rank(moves) < 6:
        raise UserError(
            f"The body {one.name!r} carries parts at nodes on one line; name three that are not on one."
        )
    return np.asarray(np.linalg.pinv(moves) @ np.vstack(shifts)), middle


def _surface(one: BodySection, system: OpticalSystem, name: str) -> int:
    try:
        return surface_index(system, name)
    except UserError as error:
        raise UserError(f"The body {one.name!r}: {error}") from None


def elastic_body(one: BodySection, last_hz: float, system: OpticalSystem) -> Elastic:
    """Return what is reduced of an elastic body; built once, and kept on disk."""
    if one.imported is not None:
        content = one.imported.content or ""
        full = prepared(maxsize=1)(partial(kept_model, content))
        record: dict[str, object] = {"content": content, "highest_hz": last_hz}
        flip = np.eye(3)
    else:
        assert one.mirror is not None
        index = surface_index(system, one.surfaces[0])
        behind = glass_side(system, index)
        flip = np.diag([1.0, -behind, -behind])  # the model's front looks along its z axis
        mirror = mirror_behind(one.name, one.mirror, system, index, -behind)
        build = annular_mirror if isinstance(mirror, AnnularMirror) else circular_mirror
        full = prepared(maxsize=1)(partial(build, mirror))  # type: ignore[arg-type]
        record = {"body": repr(mirror), "highest_hz": last_hz}
    stage = kept_intermediate(digest(record), lambda: intermediate(full(), highest=last_hz))
    return Elastic(stage, full, flip)


def behind(
    one: BodySection, elastic: Elastic, variant: str, system: OpticalSystem, optical: OpticalBody | None
) -> Body:
    """Return a reduced model of an elastic body at its place behind its first surface."""
    try:
        model = reduced_model(elastic.stage, elastic.full, variant)
    except UserError as error:
        raise UserError(f"The body {one.name!r}: {error}") from None
    nodes = {str(number + 1): int(place) for number, place in enumerate(shifts(model))}
    turns = {str(number + 1): int(place) for number, place in enumerate(model.turns)}
    if optical is None:
        return placed(one.name, model, nodes, turns=turns)
    surface = system.surfaces[surface_index(system, one.surfaces[0])]
    rotation, vertex = np.asarray(surface.rotation), _m(surface.position)
    form = surface.deformation
    assert isinstance(form, ZernikeDeformation)
    section = one.mirror or one.imported
    assert section is not None
    fit, rows = _fit(one, model, elastic.flip, section.figure_terms, form, surface.shape)
    shapes = rows.T.reshape(model.order, -1, 3) @ elastic.flip.T
    outputs = _outputs(one, fit, shapes, (rotation, vertex), optical)
    return placed(one.name, model, nodes, rotation @ elastic.flip, vertex, outputs, turns)


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
        ("rigid", one.name): transported(system_motion, vertex, optical.rotation, _m(optical.point)),
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
