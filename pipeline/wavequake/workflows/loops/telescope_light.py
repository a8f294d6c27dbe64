"""The telescope of ``telescope-loop``: what sensors see of motions, and what a case draws."""

import json
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from wavequake.chain.loops.actuators.m2_rigid import RigidM2
from wavequake.chain.loops.actuators.segments import SegmentActuators
from wavequake.chain.loops.answers import Answer, OwnModes, Put
from wavequake.chain.loops.block import ACTUATORS, Actuator
from wavequake.chain.loops.light import Light
from wavequake.chain.loops.structure import UNITS, Carrying, carrying, node_names
from wavequake.control.linear import Array
from wavequake.errors import UserError
from wavequake.kernels.device.devices import choose_device
from wavequake.kernels.device.tiles import TILE, padded
from wavequake.mechanics.disturbances.motion import Motion, generator
from wavequake.mechanics.disturbances.registry import Disturbance, draw_case, instants_of, parts
from wavequake.optics.derivatives.central import SIGNS, central, checked_derivative
from wavequake.optics.segments import modal
from wavequake.optics.segments.kinematics import carried, in_optics_frame
from wavequake.optics.segments.modal import ModalModel, layout_of
from wavequake.optics.segments.states import SurfaceStates, rest
from wavequake.optics.segments.telescope import SegmentedTelescope
from wavequake.prepared import prepared
from wavequake.workflows.exposures.telescope_control import ControlBench, imaged_bench_of, trace
from wavequake.workflows.loops.telescope_study import TelescopeLoopStudy
from wavequake.workflows.segments.bench import MAS_PER_RAD, MM_PER_M
from wavequake.workflows.segments.launches import CaseDraw
from wavequake.workflows.segments.model import knows, model_of, motion_rows
from wavequake.workflows.segments.study import segment_text
from wavequake.workflows.segments.vignetting import require_all_rays

# Half width of central differences of rigid motions, mm and rad.
_SMALL = 1e-6
# All that may move of segments and of M2, where no actuator does.
_ALL = SegmentActuators(name="all", dofs=("dz", "rx", "ry"))
_M2 = RigidM2(name="m2", dofs=("dx", "dy", "dz", "rx", "ry", "rz"))


@dataclass(frozen=True)
class Optics:
    """A telescope without loops.

    Attributes
    ----------
    control : ControlBench
        Its rays and images.
    model : ModalModel
    light : Light
    sights : dict of ndarray, shape (K, p)
        What sensors see per position of each actuator, by name.
    m2 : ndarray, shape (J - 1, 6), or None
        Light per dx, dy, dz (nm), rx, ry, rz (nrad) of M2, where anything moves it.
    structure : Carrying or None
        As disturbances move it.
    answers : tuple of Answer
        Modes of the structure, then of actuators that bend, as actuators move them.
    times : tuple of ndarray, shape (1 + n,)
        Of each population: 0 and its instants, s.
    """

    control: ControlBench
    model: ModalModel
    light: Light
    sights: dict[str, Array]
    m2: Array | None
    structure: Carrying | None
    answers: tuple[Answer, ...]
    times: tuple[Array, ...]

    @property
    def still(self) -> Array:
        """Noll coefficients 4..J at rest, nm."""
        return np.asarray(self.control.static.zernike[0, 3:] * self.control.study.optics.wavelength_nm)


def optics_of(study: TelescopeLoopStudy) -> Optics:
    """Prepare the telescope of a study, and what sensors see per position of each actuator.

    Raises
    ------
    UserError
        If there are no derivatives, or an actuator does not fit the telescope.
    """
    text = study.exposed.identity_text()
    moved = {dof for one in study.actuator for dof in one.segment_dofs}
    moved |= set(_ALL.segment_dofs) if any(any(one.zernike.values()) for one in study.mode) else set()
    sights = {one.name: _sight(text, json.dumps(one.model_dump(), sort_keys=True)) for one in study.actuator}
    control, model, light = _telescope(text, tuple(sorted(moved)))
    times = tuple(
        np.concatenate([[0.0], instants_of(study.disturbance, entry)]) for entry in study.disturbance
    )
    name = control.bench.system.surfaces[0].name
    m2 = None
    if any(one.m2 for one in study.mode) or any(
        _moves(study, light, entry, name) for entry in study.disturbance
    ):
        m2 = _sight(text, _M2.model_dump_json())
    if study.mode or any(one.sees == "bodies" for one in study.sensor):
        light = replace(light, bodies_too=True, nodes=node_names(study.mode))
        for one in study.actuator:
            by_bodies = _moved_bodies(control, light, one)
            sights[one.name] = np.vstack(
                [sights[one.name], by_bodies, np.zeros((len(light.nodes), by_bodies.shape[1]))]
            )
    structure = carrying(study.mode, light.layout) if study.mode else None
    answers = [] if structure is None else [_of_structure(text, light, structure, m2, sights)]
    for one in study.actuator:
        modes = one.own_modes()
        if modes is not None:
            seen = np.zeros((len(light), len(modes.names)))
            seen[: light.optical] = _sight(text, json.dumps(one.model_dump(), sort_keys=True), True)
            answers.append(Answer(modes.names, modes.dynamics, modes.put, seen, {one.name: modes.drives}))
    return Optics(control, model, light, sights, m2, structure, tuple(answers), times)


def _of_structure(
    text: str, light: Light, structure: Carrying, m2: Array | None, sights: dict[str, Array]
) -> Answer:
    """Return how a structure answers actuators."""
    first = 3 * len(light.layout)
    shown = np.zeros((len(light), len(structure.names)))
    if structure.moves[:first].any():
        seen = _sight(text, json.dumps(_ALL.model_dump(), sort_keys=True))
        shown[: light.optical] += seen @ structure.moves[:first]
    if m2 is not None:
        shown[: light.optical] += m2 @ structure.moves[first:]
    shown[light.optical :] = np.vstack([structure.moves, structure.at])
    bodies = slice(light.optical, light.optical + first + 6)
    drives = {name: structure.answers @ sight[bodies] for name, sight in sights.items()}
    return Answer(structure.names, structure.dynamics, structure.put, shown, drives)


def _moves(study: TelescopeLoopStudy, light: Light, entry: Disturbance, surface: str) -> bool:
    """Return whether a disturbance moves a surface."""
    motion = draw_case(
        study.disturbance,
        entry,
        light.layout,
        study.study.seed,
        0,
        time=instants_of(study.disturbance, entry),
    )
    return surface in motion.rigid and bool(motion.rigid[surface].any())


def _moved_bodies(control: ControlBench, light: Light, one: Actuator) -> Array:
    """Return motions of segments (nm, nrad) and M2 per position of an actuator, (3 S + 6, p)."""
    p = len(one.channels(light))
    states = states_at_rest(control, p)
    one.put(light, states, np.eye(p))
    segments = in_nm_and_nrad(states.segment_motion / np.repeat([MM_PER_M, 1.0], 3))
    return np.hstack([segments, states.surface_motion[:, 0] / UNITS]).T


def in_nm_and_nrad(segment_motion: Array) -> Array:
    """Return motions (n, S, 6) in m and rad as dz, rx, ry of all segments, (n, 3 S), in nm and nrad."""
    return np.asarray(1e9 * np.swapaxes(segment_motion[..., 2:5], 1, 2).reshape(len(segment_motion), -1))


def _telescope(text: str, dofs: tuple[int, ...]) -> tuple[ControlBench, ModalModel, Light]:
    control = imaged_bench_of(text)
    require_all_rays(control.bench.stopped, "so that the linear light of loops has no derivatives")
    model = model_of(segment_text(text), "numpy", dofs)
    bench = control.bench
    light = Light(
        model.terms,
        control.prepared.obscuration,
        bench.system.pupil_outer,
        bench.layout,
        movable=_movable(bench.system),
        wavelength_nm=control.study.optics.wavelength_nm,
    )
    return control, model, light


def _movable(system: SegmentedTelescope) -> dict[str, Array]:
    """Return the motions of surfaces (6, L, 6) per motion of each surface after M1, and of each body."""
    unit, count, found = _SMALL * np.eye(6), len(system.surfaces), dict[str, Array]()
    single = {one.name: (place,) for place, one in enumerate(system.surfaces)}
    for name, surfaces in (single | system.bodies).items():
        slopes = central(np.stack([carried(system, surfaces, one) for one in (unit, -unit)]), _SMALL)
        found[name] = np.zeros((6, count, 6))
        found[name][:, surfaces] = slopes
    return found


@prepared(maxsize=8)
def _sight(text: str, actuator: str, of_modes: bool = False) -> Array:
    """Return what sensors see per position of an actuator or of its own modes, (K, p); kept by both texts."""
    record = json.loads(actuator)
    one = ACTUATORS.entries()[record["model"]].model_validate(record, strict=False)
    control, model, light = _telescope(text, one.segment_dofs)
    if of_modes:
        modes: OwnModes = one.own_modes()
        return _traced_sight(control, one, len(modes.names), modes.put)
    if one.segment_dofs:
        return _modal_sight(control, model, light, one)
    return _traced_sight(control, one, len(one.channels(light)), partial(one.put, light))


def seen_units(control: ControlBench, wavelength_nm: float) -> tuple[float, float]:
    """Return the factors of line of sight (mm to mas) and of coefficients (waves to nm)."""
    return MAS_PER_RAD / control.bench.first_order.focal_length, wavelength_nm


def _modal_sight(control: ControlBench, model: ModalModel, light: Light, one: Actuator) -> Array:
    """Return the sight of an actuator of segments, which the modal model has."""
    to_mas, to_nm = seen_units(control, control.study.optics.wavelength_nm)
    places, segments = layout_of(model.terms), len(light.layout)
    unit = rest(1, segments, 1)
    one.put(light, unit, np.ones((1, len(one.channels(light)))))
    rows = []
    for dof in one.segment_dofs:
        first = model.dofs.index(dof) * segments
        block = model.columns[first : first + segments]
        seen = np.hstack([block[:, places.los] * to_mas, block[:, places.zernike][:, 3:] * to_nm])
        rows.append(seen * unit.segment_motion[0, :, dof, None])
    return np.vstack(rows).T


def _traced_sight(control: ControlBench, one: Actuator, p: int, put: Put) -> Array:
    """Return what is seen of p motions that are put into states, by central differences of traces of each."""
    to_mas, to_nm = seen_units(control, control.study.optics.wavelength_nm)
    states = states_at_rest(control, padded(4 * p))
    put(states, np.concatenate([factor * one.step * np.eye(p) for factor in SIGNS]))
    found = trace(control.prepared, states, choose_device("numpy"))[1]
    values = np.hstack([found.los * to_mas, found.zernike[:, 3:] * to_nm])[: 4 * p]
    slopes = checked_derivative(
        values.reshape(4, p, -1), one.step, f"the actuator {one.name}", "use other optics.rays"
    )
    return np.ascontiguousarray(slopes.T)


def states_at_rest(control: ControlBench, batch: int) -> SurfaceStates:
    """Return the telescope at rest, at the field point of the study."""
    bench, terms = control.bench, control.study.figure_terms
    still = rest(batch, len(bench.system.segments), len(bench.system.surfaces), bench.figure_terms, terms)
    still.field[:] += bench.field
    return still


def drawn(study: TelescopeLoopStudy, optics: Optics, index: int, realization: int) -> CaseDraw:
    """Draw a case at 0 and at its instants; what is given over time stands still before its first one."""
    population, time = study.disturbance[index], optics.times[index]
    own = any(part.instants_of_file() is not None for part in parts(study.disturbance, population))
    at = time[1:] if own else time
    motion = draw_case(
        study.disturbance, population, optics.light.layout, study.study.seed, realization, time=at
    )
    if own:
        motion = motion.at([0, *range(len(at))])
    m2 = optics.control.bench.system.surfaces[0].name
    others = {name: values for name, values in motion.rigid.items() if name != m2}
    if not knows(optics.model, replace(motion, rigid=others)):
        raise UserError(
            f"The disturbance {population.name!r} moves what the linear light of loops does not know: "
            "other things than M1's segments and M2 as rigid bodies."
        )
    if optics.structure is None:
        return CaseDraw(population, realization, time, motion)
    shaken = _shaken(study, optics, time, realization)
    return CaseDraw(population, realization, time, _carried(motion, optics, m2, shaken))


def _shaken(study: TelescopeLoopStudy, optics: Optics, time: Array, realization: int) -> Array:
    """Draw how white forces shake the modes of the structure, (n, K), nm."""
    assert optics.structure is not None
    random = [generator(study.study.seed, f"mode {name}", realization) for name in optics.structure.names]
    return optics.structure.shaken(time, random)


def _carried(motion: Motion, optics: Optics, m2: str, shaken: Array) -> Motion:
    """Return a motion with what the structure adds."""
    assert optics.structure is not None
    states = states_at_rest(optics.control, len(shaken))
    optics.structure.put(states, shaken)
    added = states.segment_motion / np.repeat([MM_PER_M, 1.0], 3)
    rotation = optics.control.bench.system.surfaces[0].rotation
    moved = in_optics_frame(states.surface_motion[:, 0], rotation.T) / np.repeat([MM_PER_M, 1.0], 3)
    rigid = motion.rigid | {m2: motion.rigid.get(m2, 0.0) + moved}
    return replace(motion, segment_motion=motion.segment_motion + added, rigid=rigid)


def seen_of(study: TelescopeLoopStudy, optics: Optics, case: CaseDraw) -> Array:
    """Return what sensors see of a disturbance at 0 and its instants, (1 + n, K); mas and nm."""
    to_mas, to_nm = seen_units(optics.control, study.optics.wavelength_nm)
    count, places = len(case.time), layout_of(optics.model.terms)
    rows = motion_rows(optics.control.bench, optics.model, case.motion, padded(count))
    linear = modal.forms(optics.model, rows, TILE).linear[:count]
    seen = np.hstack([linear[:, places.los] * to_mas, linear[:, places.zernike][:, 3:] * to_nm])
    bench = optics.control.bench
    surface = bench.system.surfaces[0]
    m2 = np.zeros((count, 6))
    if optics.m2 is not None and surface.name in case.motion.rigid:
        own = case.motion.rigid[surface.name] * np.repeat([MM_PER_M, 1.0], 3)
        m2 += in_optics_frame(own, surface.rotation) / UNITS
        seen += m2 @ optics.m2.T
    if not optics.light.bodies_too:
        return seen
    m2[:, 3:5] += case.motion.m2 @ bench.m2_tilt.T / UNITS[3:5]
    nodes = np.zeros((count, 0))
    if optics.structure is not None:
        nodes = _shaken(study, optics, case.time, case.realization) @ optics.structure.at.T
    return np.hstack([seen, in_nm_and_nrad(case.motion.segment_motion), m2, nodes])
