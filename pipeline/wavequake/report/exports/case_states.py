"""How the optical system of a stored case moves and deforms over time, by the kind of its study."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from wavequake.campaign.schema import study_from_identity
from wavequake.campaign.store.store import Manifest, read_manifest
from wavequake.chain.sampling import slots
from wavequake.errors import UserError
from wavequake.kernels.device.devices import NUMPY
from wavequake.mechanics.vibration.modal import modal_model
from wavequake.mechanics.vibration.response import respond
from wavequake.optics.segments.alone import segment_systems
from wavequake.optics.shapes.fit import residual_grid
from wavequake.optics.shapes.motion_fit import figures, motion_fit
from wavequake.optics.systems.kinematics import joined, rest_states
from wavequake.optics.systems.system import OpticalSystem, States
from wavequake.workflows.exposures.telescope_control import CONTROLLERS, control_bench_of
from wavequake.workflows.exposures.telescope_exposure import controlled_blocks, scaled_draw
from wavequake.workflows.kinds import study_of
from wavequake.workflows.loops import system_loop, telescope_bench, telescope_light, telescope_loop
from wavequake.workflows.loops.system_loop_study import SystemLoopStudy
from wavequake.workflows.loops.telescope_study import TelescopeLoopStudy
from wavequake.workflows.mirrors import bench as mirrors
from wavequake.workflows.mirrors.base import driven
from wavequake.workflows.mirrors.optics import displacements_mm, with_deformation
from wavequake.workflows.mirrors.residual import coordinates_of, grid_of, left_by
from wavequake.workflows.mirrors.segment_body import variant_of
from wavequake.workflows.mirrors.study import TraceStudy
from wavequake.workflows.segments import mor, mor_bench
from wavequake.workflows.segments.bench import bench_of as segment_bench
from wavequake.workflows.segments.disturbance import draw as draw_segments
from wavequake.workflows.segments.launches import surface_states
from wavequake.workflows.systems.bench import system_bench, system_states
from wavequake.workflows.systems.draws import draw

_ARCMIN = np.pi / 180.0 / 60.0


def telescopes(store: Path) -> bool:
    """Tell whether a store is of a kind whose telescopes have segments."""
    return read_manifest(store).workflow in _SEGMENTED


def disturbed(store: Path, case: int, under: str = "") -> tuple[OpticalSystem, States]:
    """Return the system of a store and how it moves and deforms in a case.

    Raises
    ------
    UserError
        If the store's workflow has no optical system of surfaces, or there is no such case, controller or
        excitation.
    """
    manifest = _manifest(store, case)
    if manifest.workflow not in _SYSTEMS:
        raise UserError(
            f"{store} holds the workflow {manifest.workflow}, of whose cases no lens files are made; they "
            f"are of {', '.join((*_SYSTEMS, *_SEGMENTED))}, and displacements of {', '.join(_SYSTEMS)}."
        )
    return _SYSTEMS[manifest.workflow](manifest.study, case, under)


def segments_at(store: Path, case: int, instant: int, under: str = "") -> dict[str, OpticalSystem]:
    """Return the systems of the segments of a store's telescope at an instant of a case.

    Raises
    ------
    UserError
        If there is no such case, instant, controller or excitation, or the segments deform.
    """
    manifest = _manifest(store, case)
    found = _SEGMENTED[manifest.workflow](manifest.study, case, under)
    if not 0 <= instant < found.instants:
        last = found.instants - 1
        raise UserError(f"There are {found.instants} instants, 0 to {last}; there is no instant {instant}.")
    return dict(segment_systems(found.telescope, found.states, instant, found.wavelengths, found.beside))


def _manifest(store: Path, case: int) -> Manifest:
    manifest = read_manifest(store)
    if case not in range(manifest.cases):
        raise UserError(f"{store} has cases 0 to {manifest.cases - 1}; there is no case {case}.")
    return manifest


def _named(under: str, names: Sequence[str], what: str) -> int:
    """Return which of the names is meant."""
    if under in names:
        return names.index(under)
    if not under and len(names) == 1:
        return 0
    known = ", ".join(names) or "none"
    raise UserError(f"Say by --under which {what} of the case is meant: {known}.")


def _of_system(study: str, case: int, under: str) -> tuple[OpticalSystem, States]:
    bench = system_bench(study)
    if under:
        raise UserError("A case of this store has no controllers or excitations; leave --under out.")
    return bench.system, system_states(bench, draw(bench, case)[1])


def _of_loop(study: str, case: int, under: str) -> tuple[OpticalSystem, States]:
    bench = system_loop.bench_of(study_from_identity(SystemLoopStudy, study))
    one = bench.controllers[_named(under, [each.name for each in bench.controllers], "controller")]
    system = bench.optics.bench
    return system.system, system_states(system, system_loop.motion_left(bench, one, case))


def _of_mirror(text: str, case: int, under: str) -> tuple[OpticalSystem, States]:
    """Return the figure of an excited mirror: polynomials, and, as traced, what they leave on a grid."""
    study = study_of(text)
    excitation = study.excitation[_named(under, [one.name for one in study.excitation], "excitation")]
    model, variant = mirrors.cases_of(study)[case]
    bench = mirrors.bench_of(text, model)
    reduced, optics = mirrors.variant_of(bench, variant), bench.optics
    held, drive = driven(reduced, mirrors.drive_at(excitation, reduced, study), excitation.name)
    response = respond(modal_model(held, drive.prescribed), [drive], study.time.seconds)
    coordinates = coordinates_of(response)
    motion, left = motion_fit(optics.surface, displacements_mm(reduced.surface.T)), left_by(optics, reduced)
    numbers, system = figures(motion, coordinates), optics.prepared.system
    if isinstance(study, TraceStudy) and left.share(coordinates) > study.optics.residual_limit:
        grid = grid_of(optics)
        rough = residual_grid(optics.surface, left.heights, grid).reshape(len(left.heights), -1)
        numbers, system = np.hstack([numbers, coordinates @ rough]), with_deformation(optics, grid).system
    return system, replace(rest_states(system, len(numbers)), deformations=(numbers, None))


_SYSTEMS: dict[str, Callable[[str, int, str], tuple[OpticalSystem, States]]] = {
    "system-disturbance": _of_system,
    "system-loop": _of_loop,
    "mirror-trace": _of_mirror,
    "mirror-mor": _of_mirror,
    "mirror-exposure": _of_mirror,
}


@dataclass(frozen=True)
class _Segmented:
    """How a telescope moves in a case, as `segment_systems` takes it, and at how many instants."""

    telescope: OpticalSystem
    states: States
    instants: int
    wavelengths: Sequence[float]
    beside: Sequence[tuple[float, float]] = ((0.0, 0.0),)


def _of_segments(text: str, case: int, under: str) -> _Segmented:
    if under:
        raise UserError("A case of this store has no controllers or excitations; leave --under out.")
    bench = segment_bench(text)
    drawn, optics = draw_segments(bench, case), bench.study.optics
    count, (first_x, first_y) = len(drawn.time), optics.points_arcmin[0]
    beside = [(_ARCMIN * (x - first_x), _ARCMIN * (y - first_y)) for x, y in optics.points_arcmin]
    colors = [1e-6 * color for color in optics.colors_nm]
    return _Segmented(bench.prepared.system, surface_states(bench, drawn, 0, count), count, colors, beside)


def _of_exposure(text: str, case: int, under: str) -> _Segmented:
    control = control_bench_of(text)
    controller = CONTROLLERS[_named(under, CONTROLLERS, "controller")]
    drawn = scaled_draw(control, case)
    states = joined([one for _, one in controlled_blocks(control, drawn, NUMPY, controller)])
    return _Segmented(control.prepared.system, states, len(drawn.time), [control.prepared.wavelength])


def _of_telescope(text: str, case: int, under: str) -> _Segmented:
    bench = telescope_bench.bench_of(study_from_identity(TelescopeLoopStudy, text))
    one = bench.controllers[_named(under, [each.name for each in bench.controllers], "controller")]
    which, realization = slots([entry.share for entry in bench.study.disturbance], np.array([case]))
    drawn = telescope_light.drawn(bench.study, bench.optics, int(which[0]), int(realization[0]))
    seen = telescope_light.seen_of(bench.study, bench.optics, drawn)
    positions, _, diverged = telescope_loop.positions_of(bench, one, int(which[0]), [drawn], [seen], NUMPY)
    if diverged[0]:
        raise UserError(f"Case {case} diverges under the controller {one.name!r}.")
    count = len(positions[0])
    states = telescope_loop.states_of(bench, one, drawn, positions[0], np.arange(count))
    control = bench.optics.control
    return _Segmented(control.prepared.system, states, count, [control.prepared.wavelength])


def _of_shaken(text: str, case: int, under: str) -> _Segmented:
    study, model = study_of(text), mor_bench.model_of(text)
    disturbed, variant = mor.cases_of(study)[case]
    number = _named(under, [one.name for one in study.excitation], "excitation")
    which = mor_bench.chosen_segments(study, model.bench, disturbed)
    chosen = variant_of(model, variant)
    moved = mor_bench.motions(study, model, chosen, which.tolist())[number]
    states = mor.surface_states(model.bench, which, moved)
    return _Segmented(model.bench.system, states, len(moved), [model.bench.prepared.wavelength])


_SEGMENTED: dict[str, Callable[[str, int, str], _Segmented]] = {
    "segment-disturbance": _of_segments,
    "telescope-exposure": _of_exposure,
    "telescope-loop": _of_telescope,
    "segment-mor": _of_shaken,
}
