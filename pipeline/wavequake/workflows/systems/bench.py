"""What a system-disturbance study prepares once per process: the system, its bodies, rays, fits, and rest."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from wavequake.campaign.schema import study_from_identity
from wavequake.chain.images.system import SystemImager, on_device, prepare_images
from wavequake.chain.nodal import fitted, nodal_grids, nodal_sources
from wavequake.errors import UserError
from wavequake.kernels.device.devices import NUMPY, choose_device
from wavequake.kernels.trace.sequential import trace_sequence
from wavequake.kernels.trace.status import OK
from wavequake.mechanics.assembly.plant import Plant
from wavequake.mechanics.disturbances.layout import NO_SEGMENTS, SegmentLayout
from wavequake.mechanics.disturbances.motion import Motion
from wavequake.mechanics.disturbances.registry import parts
from wavequake.optics.rays.aiming import LOSSES, losses, point_name
from wavequake.optics.rays.pupils import sunflower
from wavequake.optics.shapes.grid_cover import require_cover
from wavequake.optics.shapes.shapes import GridDeformation, ZernikeDeformation
from wavequake.optics.systems.bodies import (
    Body,
    beam_radii,
    rigid_body,
    surface_index,
    with_bodies,
)
from wavequake.optics.systems.file import build
from wavequake.optics.systems.kinematics import at_instant, rest_states
from wavequake.optics.systems.system import OpticalSystem, States
from wavequake.optics.wavefronts.record import Wavefront
from wavequake.optics.wavefronts.wavefront import (
    PreparedSystem,
    incoming_light,
    measure_system,
    prepare_system,
    with_fitted_sphere,
    with_slopes,
)
from wavequake.prepared import prepared
from wavequake.workflows.bodies.plants import (
    Masses,
    compared_bodies,
    deforming_terms,
    elastic_names,
    plants_of,
)
from wavequake.workflows.mirrors.study import FULL
from wavequake.workflows.systems.study import SystemStudy

Array = NDArray[np.float64]

MM_PER_M = 1e3
NM_PER_MM = 1e6
_ROUNDING = 1e-7  # of a wavelength: what the rounding of paths of meters leaves of a perfect wave


@dataclass(frozen=True)
class SystemBench:
    """Everything of a study that does not change from case to case.

    ``text`` is the study's identity text; ``layout`` names what may move; ``prepared`` and ``static`` hold,
    per field and wavelength in that order, what the trace takes and the wavefront at rest (one instant).
    ``imager`` makes exposures, if any. ``plants`` are the bodies with mass by the model that is taken of the
    elastic ones, the full one first, which is that of ``layout``, too.
    """

    text: str
    study: SystemStudy
    system: OpticalSystem
    layout: SegmentLayout
    bodies: tuple[Body, ...]
    prepared: tuple[tuple[PreparedSystem, ...], ...]
    static: tuple[tuple[Wavefront, ...], ...]
    imager: SystemImager | None = None
    plants: Mapping[str, Plant] = field(default_factory=dict)


@prepared(maxsize=2)
def system_bench(study_text: str) -> SystemBench:
    """Prepare the study with this identity text.

    One BLAS thread, so that its bits do not depend on where it is prepared.

    Raises
    ------
    UserError
        If the system, its bodies or what its disturbances name is not as it must be, or too little light
        arrives at rest.
    """
    study = study_from_identity(SystemStudy, study_text)
    system = build(study.system)
    require_cover(system)
    bodies = tuple(
        rigid_body(system, one.name, one.surfaces, one.about_mm) for one in study.body if one.surfaces
    )
    able = deformable(system, deforming_terms(study.body, system))
    plants = plants_of(masses_of(study), able, bodies)
    layout = replace(layout_of(study, system), plant=plants.get(FULL))
    _require_elements(study, system, layout)
    system = _deformable(study, system, layout)
    layout = replace(layout, moved=fitted(system, tuple(nodal_sources(study.disturbance))))
    prepared = tuple(
        tuple(_as_asked(study, one) for one in row)
        for row in prepared_fields(study, system, range(len(system.wavelengths)))
    )
    rest = rest_states(system)
    static = tuple(tuple(measure_system(one, rest, NUMPY) for one in row) for row in prepared)
    for row, found in zip(prepared, static, strict=True):
        for one, wavefront in zip(row, found, strict=True):
            _require_light(one, wavefront, rest)
    imager = _imager(study, prepared, static, rest)
    return SystemBench(study_text, study, system, layout, bodies, prepared, static, imager, plants)


def masses_of(study: SystemStudy) -> Masses:
    """Return what a study says of its bodies with mass; UserError if it compares models of none."""
    reduced = (
        () if study.reduction is None else compared_bodies(study.reduction.of, elastic_names(study.body))
    )
    return Masses(study.study.name, study.body, study.link, study.structure, study.compared, reduced)


def _imager(
    study: SystemStudy,
    prepared: tuple[tuple[PreparedSystem, ...], ...],
    static: tuple[tuple[Wavefront, ...], ...],
    rest: States,
) -> SystemImager | None:
    """Return what makes the exposures of a study, if any; light that is stopped at rest is dark in them."""
    if study.imaging is None:
        return None
    lit = {
        (field, index): _arrives(one, rest)
        for field, row in enumerate(prepared)
        for index, one in enumerate(row)
        if static[field][index].lost[0]
    }
    return prepare_images(study.imaging, prepared, static, lit, study.object, study.detector)


def _arrives(prepared: PreparedSystem, rest: States) -> NDArray[np.bool_]:
    """Return which rays (N,) arrive at rest."""
    traced = trace_sequence(prepared.sequence, prepared.rays, incoming_light(prepared, rest), NUMPY)
    return np.asarray((prepared.status == OK) & (traced.status[0] == OK), dtype=np.bool_)


@prepared(maxsize=4)
def imager_on(study_text: str, device: str) -> SystemImager | None:
    """Return what makes the exposures of a study, with transforms on a device."""
    imager = system_bench(study_text).imager
    return None if imager is None else on_device(imager, choose_device(device))


def prepared_fields(
    study: SystemStudy, system: OpticalSystem, wavelengths: Iterable[int]
) -> tuple[tuple[PreparedSystem, ...], ...]:
    """Return what the trace takes, per field and chosen wavelength: path lengths about the chief ray.

    One program traces all populations, whichever bodies they turn: compiling takes longer than tracing does.
    """
    pupil, terms = sunflower(system.pupil.obscuration, 1.0, study.optics.rays), study.wavefront.zernike_terms
    chosen = [float(system.wavelengths[index]) for index in wavelengths]
    return tuple(
        tuple(
            _turning(prepare_system(system, pupil.x, pupil.y, pupil.weight, terms, field, wavelength))
            for wavelength in chosen
        )
        for field in range(len(system.fields))
    )


def _turning(prepared: PreparedSystem) -> PreparedSystem:
    """Return what is prepared with the program for elements that turn."""
    return replace(prepared, sequence=replace(prepared.sequence, turning=True))


def _as_asked(study: SystemStudy, prepared: PreparedSystem) -> PreparedSystem:
    """Return what is prepared with slopes or the sphere that the study asks for."""
    if study.wavefront.method == "slopes":
        return with_slopes(prepared)
    return with_fitted_sphere(prepared) if study.wavefront.reference == "fitted" else prepared


def layout_of(study: SystemStudy, system: OpticalSystem) -> SegmentLayout:
    """Return what disturbances may move: all bodies and surfaces, by name."""
    names = (*(body.name for body in study.body), *(surface.name for surface in system.surfaces))
    return replace(NO_SEGMENTS, others=names, owner=system.name)


def _require_elements(study: SystemStudy, system: OpticalSystem, layout: SegmentLayout) -> None:
    names = layout.others or ()
    for body in study.body:
        if names.count(body.name) > 1:
            raise UserError(
                f"The body {body.name!r} is called as a surface of {system.name} is; it needs another name."
            )
    for population in study.disturbance:
        for part in parts(study.disturbance, population):
            deforms = {*part.figure_terms(layout), *part.figure_grids()}
            for name in part.elements(layout):
                if names.count(name) > 1:
                    raise UserError(
                        f"The disturbance {part.name!r} acts on {name!r}, but {system.name} has "
                        f"{names.count(name)} surfaces of that name; give each a comment of its own in the "
                        "lens file."
                    )
                if name in deforms and name in (body.name for body in study.body):
                    raise UserError(
                        f"The disturbance {part.name!r} deforms the body {name!r}; only a surface deforms."
                    )


def _deformable(study: SystemStudy, system: OpticalSystem, layout: SegmentLayout) -> OpticalSystem:
    """Return the system whose surfaces can deform as far as the disturbances ask for it."""
    terms: dict[int, int] = {}
    grids: dict[int, GridDeformation] = {}
    for population in study.disturbance:
        for part in parts(study.disturbance, population):
            for name, count in part.figure_terms(layout).items():
                index = surface_index(system, name)
                terms[index] = max(terms.get(index, 0), count)
            for name, given in part.figure_grids().items():
                index, (_, rows, columns) = surface_index(system, name), given.heights.shape
                grid = GridDeformation(rows, columns, *given.spacing_mm)
                if grids.setdefault(index, grid) != grid:
                    raise UserError(
                        f"The disturbance {part.name!r} deforms {name!r} on another grid than one before; "
                        "give all heights of a surface on the same grid."
                    )
    able = deformable(system, dict.fromkeys(grids, 1) | terms, grids)
    further = nodal_grids(able, tuple(nodal_sources(study.disturbance)))
    require_cover(system, grids | further)
    return deformable(able, dict.fromkeys(further, 1), further)


def deformable(
    system: OpticalSystem, terms: Mapping[int, int], grids: Mapping[int, GridDeformation] | None = None
) -> OpticalSystem:
    """Return the system in which surfaces, by index, can deform by at least so many Noll terms, and on grids.

    A surface that could not deform before does so over its semi-diameter, or else over what the beams of all
    fields fill.
    """
    grids = grids or {}
    edges = {
        index: opening.outer + float(np.hypot(*opening.center))
        for index in terms
        if (opening := system.surfaces[index].opening) is not None and np.isfinite(opening.outer)
    }
    able = {i for i in terms if isinstance(system.surfaces[i].deformation, ZernikeDeformation)}
    bare = [index for index in terms if index not in edges and index not in able]
    edges |= dict(zip(bare, map(float, beam_radii(system, bare)), strict=True))
    surfaces = list(system.surfaces)
    for index, count in terms.items():
        form = surfaces[index].deformation
        if isinstance(form, ZernikeDeformation):
            form = replace(form, terms=max(count, form.terms))
        else:
            form = ZernikeDeformation(count, edges[index])
        form = replace(form, residual=grids.get(index, form.residual))
        surfaces[index] = replace(surfaces[index], deformation=form)
    return replace(system, surfaces=tuple(surfaces))


def field_name(system: OpticalSystem, field: int) -> str:
    """Return a field point in words, such as ``(0, 10) deg``."""
    return point_name(system, system.fields[field])


def beyond_rounding(length: float, wavelength: float) -> float:
    """Return a length of the light at rest, or 0 where it is what rounding leaves; both in one unit."""
    return length if abs(length) > _ROUNDING * wavelength else 0.0


def light_of(prepared: PreparedSystem) -> str:
    """Return field and wavelength of what is prepared, in words."""
    field = field_name(prepared.system, prepared.field)
    return f"field {field} at {prepared.wavelength * NM_PER_MM:.6g} nm"


def _require_light(prepared: PreparedSystem, wavefront: Wavefront, rest: States) -> None:
    """Raise UserError if too little light arrives at rest."""
    trouble = failure(prepared, wavefront, rest)
    if trouble:
        left, terms = len(prepared.pupil) - wavefront.lost[0], prepared.fit.basis.shape[1]
        raise UserError(
            f"At rest {trouble[1]}; the {left} that arrive do not determine {terms} wavefront terms: make "
            "the pupil or the field smaller."
        )


def failure(prepared: PreparedSystem, wavefront: Wavefront, states: States) -> tuple[int, str] | None:
    """Return the first instant that has no wavefront, and why; None if all have one."""
    known = np.isfinite(wavefront.zernike[:, 1:]).all(axis=1)  # slopes do not know piston
    bad = ~(np.isfinite(wavefront.chief).all(axis=1) & known)
    if not bad.any():
        return None
    instant = int(np.argmax(bad))
    if not np.isfinite(wavefront.chief[instant]).all():
        return instant, _lost_chief(prepared, states, instant)
    return instant, lost_light(prepared, states, instant)


def _lost_chief(prepared: PreparedSystem, states: States, instant: int) -> str:
    """Say where the chief ray is lost at an instant, and why."""
    light = incoming_light(prepared, at_instant(states, instant))
    traced = trace_sequence(prepared.sequence, prepared.chief, light, NUMPY, ignore_apertures=True)
    why = LOSSES.get(int(traced.status[0, 0]))
    if why is None:
        return f"the chief ray of {light_of(prepared)} misses the reference sphere"
    name = prepared.system.surfaces[int(traced.surface[0, 0])].name
    return f"the chief ray of {light_of(prepared)} is lost at {name}, {why}"


def lost_light(prepared: PreparedSystem, states: States, instant: int) -> str:
    """Say how many rays are lost at an instant, where and why, the most first."""
    one = at_instant(states, instant)
    traced = trace_sequence(prepared.sequence, prepared.rays, incoming_light(prepared, one), NUMPY)
    aimed = prepared.status == OK
    status = np.where(aimed, traced.status[0], prepared.status)
    surface = np.where(aimed, traced.surface[0], prepared.surface)
    behind = surface == len(prepared.system.surfaces)  # the reference sphere
    if behind[status != OK].all():
        return f"rays of {light_of(prepared)} miss the reference sphere"
    return (
        f"{np.count_nonzero(status != OK)} of {len(status)} rays of {light_of(prepared)} are lost, "
        f"{losses(prepared.system, np.where(behind, OK, status), surface)}"
    )


def system_states(bench: SystemBench, drawn: Motion) -> States:
    """Convert a case's motion from SI to the optics (mm), body by body and surface by surface."""
    system = bench.system
    states = rest_states(system, len(drawn.mount))
    for index, surface in enumerate(system.surfaces):
        if surface.name in drawn.rigid:
            states.surface_motion[:, index] = _in_mm(drawn.rigid[surface.name])
        figure, form = drawn.figure.get(surface.name), states.deformations[index]
        if figure is not None and form is not None:
            form[:, : figure.shape[-1]] = figure * MM_PER_M
        heights = drawn.grid.get(surface.name)
        if heights is not None and form is not None:
            form[:, -heights[0].size :] = heights.reshape(len(heights), -1) * MM_PER_M
    carried = [(body, _in_mm(drawn.rigid[body.name])) for body in bench.bodies if body.name in drawn.rigid]
    return States(with_bodies(system, states.surface_motion, carried), states.deformations, drawn.mount)


def _in_mm(motion: Array) -> Array:
    scaled = motion.copy()
    scaled[:, :3] *= MM_PER_M
    return scaled
