"""The telescope of ``telescope-loop``: what sensors see of motions, and what a case draws."""

import json
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from wavequake.chain.loops.actuators.m2_figure import MM_PER_NM
from wavequake.chain.loops.actuators.segments import SegmentActuators
from wavequake.chain.loops.answers import Answer, OwnModes, Put
from wavequake.chain.loops.block import ACTUATORS, Actuator
from wavequake.chain.loops.design import Shaken, all_shaken
from wavequake.chain.loops.light import Light
from wavequake.chain.loops.reaction import Pushing
from wavequake.chain.loops.structure import UNITS, Carrying, carrying, node_names
from wavequake.control.linear import Array
from wavequake.errors import UserError
from wavequake.kernels.device.tiles import TILE, padded
from wavequake.mechanics.assembly.answers import moved as split_outputs
from wavequake.mechanics.disturbances.motion import Motion, generator, still
from wavequake.mechanics.disturbances.registry import draw_case, instants_of, on_elements, parts
from wavequake.optics.derivatives.central import DOFS, SIGNS, checked_derivative
from wavequake.optics.segments import modal
from wavequake.optics.segments.at_rest import traced_once
from wavequake.optics.segments.modal import ModalModel, layout_of
from wavequake.optics.segments.telescope import M2
from wavequake.optics.systems.kinematics import rest_states
from wavequake.optics.systems.system import States
from wavequake.prepared import prepared
from wavequake.workflows.bodies.nodes import moved_nodes, node_columns, with_nodes
from wavequake.workflows.bodies.shaken import shaken_bodies
from wavequake.workflows.bodies.stages import movable_bodies, movable_surfaces, stages_push
from wavequake.workflows.exposures.telescope_control import ControlBench, imaged_bench_of
from wavequake.workflows.loops.telescope_study import TelescopeLoopStudy
from wavequake.workflows.segments.bench import MAS_PER_RAD, MM_PER_M, Bench
from wavequake.workflows.segments.launches import CaseDraw, add_surfaces, states_at_rest
from wavequake.workflows.segments.model import knows, model_of, motion_rows
from wavequake.workflows.segments.study import segment_text
from wavequake.workflows.segments.vignetting import require_all_rays

# All that may move of segments, where no actuator does.
_ALL = SegmentActuators(name="all", dofs=("dz", "rx", "ry"))
# Motions at which the light of bodies is taken, m and rad.
_SLIGHT = 1e-8
# Half widths of central differences of surfaces: M2 as a body, others, which may be in slow beams, figures.
_M2, _OTHERS, _FIGURE = 1e3, 2e4, 10.0
_UNSEEN = 0.1  # mas or nm at such a half width: what light shows less is not asked for digits
_ROUNDED = 1e-5  # mas or nm: what light shows by rounding of paths of tens of meters


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
    moved : dict of ndarray, shape (J - 1, 6)
        Light per dx, dy, dz (nm), rx, ry, rz (nrad) of surfaces that anything but actuators moves, by their
        places after M1.
    bent : dict of ndarray, shape (J - 1, terms)
        Light per Noll coefficient (nm) of surfaces that anything but actuators bends.
    structure : Carrying or None
        As disturbances move it.
    shaken : Shaken or None
        Modes that controllers may expect.
    answers : tuple of Answer
        Modes of the structure, of bodies, then of actuators that bend, as actuators move them.
    times : tuple of ndarray, shape (1 + n,)
        Of each population: 0 and its instants, s.
    """

    control: ControlBench
    model: ModalModel
    light: Light
    sights: dict[str, Array]
    moved: dict[int, Array]
    bent: dict[int, Array]
    structure: Carrying | None
    shaken: Shaken | None
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
    bench = imaged_bench_of(text).bench
    dofs = {dof for one in study.actuator for dof in one.segment_dofs}
    dofs |= set(_ALL.segment_dofs) if any(any(one.zernike.values()) for one in study.mode) else set()
    carried = {name for one in bench.bodies.carried.values() for name in one.names}
    dofs |= set(range(len(DOFS))) if carried & set(bench.layout.names) else set()
    sights = {one.name: _sight(text, json.dumps(one.model_dump(), sort_keys=True)) for one in study.actuator}
    control, model, light = _telescope(text, tuple(sorted(dofs)))
    plant, light = with_nodes(node_names(study.mode), study.sensor, light)
    times = tuple(
        np.concatenate([[0.0], instants_of(study.disturbance, entry)]) for entry in study.disturbance
    )
    rigid, bent = _moving(study, bench, light)
    moved, deformed = (
        {place: _surface_sight(text, place, kind) for place in places}
        for kind, places in ((False, rigid), (True, bent))
    )
    if study.mode or plant is not None or any(one.sees == "bodies" for one in study.sensor):
        light = replace(light, bodies_too=True)
        for one in study.actuator:
            moves = _moved_bodies(control, light, one), moved_nodes(one, bench.bodies.optical, light)
            sights[one.name] = np.vstack([sights[one.name], *moves])
    structure = carrying(study.mode, light.layout) if study.mode else None
    optics = Optics(control, model, light, sights, moved, deformed, structure, None, (), times)
    answers, shaken = [], []
    if structure is not None:
        answers.append(_of_structure(text, optics, structure))
        shaken.append(structure.expected(answers[0].shown))
    if plant is not None and any(one.asks_modes for one in study.controller):
        seen_by = partial(_shown, optics)
        shaken.append(shaken_bodies(study.disturbance, plant, study.study.seed, seen_by))
    if (pushing := stages_push(study.actuator, bench, light, plant)) is not None:
        answers.append(_of_bodies(optics, pushing))
    for one in study.actuator:
        modes = one.own_modes()
        if modes is not None:
            seen = np.zeros((len(light), len(modes.names)))
            seen[: light.optical] = _sight(text, json.dumps(one.model_dump(), sort_keys=True), True)
            answers.append(Answer(modes.names, modes.dynamics, modes.put, seen, {one.name: modes.drives}))
    return replace(optics, shaken=all_shaken(shaken), answers=tuple(answers))


def _moving(study: TelescopeLoopStudy, bench: Bench, light: Light) -> tuple[list[int], list[int]]:
    """Return the places of surfaces after M1 that disturbances, modes and bodies may move, and bend."""
    names = [surface.name for surface in bench.system.surfaces]
    carried = {name for one in bench.bodies.carried.values() for name in one.names}
    rigid = {names.index(name) for name in carried & set(names)} if light.layout.plant else set()
    rigid |= {M2} if any(one.m2 for one in study.mode) else set()
    outputs = light.layout.plant.outputs if light.layout.plant else {}
    bent = {names.index(name) for kind, name in outputs if kind == "figure" and name in names}
    for entry in study.disturbance:
        time = instants_of(study.disturbance, entry)
        motion = draw_case(study.disturbance, entry, light.layout, study.study.seed, 0, time=time)
        states, every = states_at_rest(bench, len(time)), slice(0, len(time))
        add_surfaces(states, every, bench, motion, every)
        rigid |= set(np.flatnonzero(states.surface_motion.any(axis=(0, 2))).tolist())
        bent |= {place for place, form in enumerate(states.deformations) if form is not None and form.any()}
    return sorted(rigid), sorted(bent)


def _of_bodies(optics: Optics, pushing: Pushing) -> Answer:
    """Return how bodies with mass answer the stages that push them."""
    bench = optics.control.bench

    def put(states: States, positions: Array) -> None:
        here, moved = slice(0, len(positions)), _carried_by(optics, positions @ pushing.outputs.T)
        states.segment_motion[here] += moved.segment_motion * np.repeat([MM_PER_M, 1.0], 3)
        add_surfaces(states, here, bench, moved, here)

    shown = _shown(optics, pushing.outputs)
    return Answer(pushing.names, pushing.dynamics, put, shown, pushing.drives)


def _carried_by(optics: Optics, outputs: Array) -> Motion:
    """Return the motion of elements that outputs (n, m) of the plant are."""
    layout = optics.light.layout
    assert layout.plant is not None
    rigid, figure = split_outputs(layout.plant, outputs)
    return on_elements(still(len(outputs), len(layout), rigid=rigid, figure=figure), layout)


def _shown(optics: Optics, outputs: Array) -> Array:
    """Return what is seen per mode that moves outputs of the plant (m, M)."""
    sizes = np.abs(outputs).max(axis=0, initial=0.0)
    units = _SLIGHT / np.where(sizes > 0.0, sizes, 1.0)
    return np.ascontiguousarray(_seen(optics, _carried_by(optics, (outputs * units).T)).T / units)


def _of_structure(text: str, optics: Optics, structure: Carrying) -> Answer:
    """Return how a structure answers actuators."""
    light, first = optics.light, 3 * len(optics.light.layout)
    shown = np.zeros((len(light), len(structure.names)))
    if structure.moves[:first].any():
        seen = _sight(text, json.dumps(_ALL.model_dump(), sort_keys=True))
        shown[: light.optical] += seen @ structure.moves[:first]
    if M2 in optics.moved:
        shown[: light.optical] += optics.moved[M2] @ structure.moves[first:]
    moved = np.vstack([structure.moves, structure.at])
    shown[light.optical : light.optical + len(moved)] = moved
    bodies = slice(light.optical, light.optical + first + 6)
    drives = {name: structure.answers @ sight[bodies] for name, sight in optics.sights.items()}
    return Answer(structure.names, structure.dynamics, structure.put, shown, drives)


def _moved_bodies(control: ControlBench, light: Light, one: Actuator) -> Array:
    """Return motions of segments (nm, nrad) and M2 per position of an actuator, (3 S + 6, p)."""
    p = len(one.channels(light))
    states = states_at_rest(control.bench, p)
    one.put(light, states, np.eye(p))
    segments = in_nm_and_nrad(states.segment_motion / np.repeat([MM_PER_M, 1.0], 3))
    return np.hstack([segments, states.surface_motion[:, M2] / UNITS]).T


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
        control.prepared.system.pupil.obscuration,
        bench.system.annulus.outer,
        bench.layout,
        movable=movable_surfaces(bench.system) | movable_bodies(bench),
        wavelength_nm=control.study.optics.wavelength_nm,
    )
    return control, model, light


@prepared(maxsize=8)
def _sight(text: str, actuator: str, of_modes: bool = False) -> Array:
    """Return what sensors see per position of an actuator or of its own modes, (K, p); kept by both texts."""
    record = json.loads(actuator)
    one = ACTUATORS.entries()[record["model"]].model_validate(record, strict=False)
    control, model, light = _telescope(text, one.segment_dofs)
    what = f"the actuator {one.name}"
    if of_modes:
        modes: OwnModes = one.own_modes()
        return _traced_sight(control, what, one.step, len(modes.names), modes.put)
    if one.segment_dofs:
        return _modal_sight(control, model, light, one)
    return _traced_sight(control, what, one.step, len(one.channels(light)), partial(one.put, light))


@prepared(maxsize=16)
def _surface_sight(text: str, place: int, bends: bool) -> Array:
    """Return what is seen per motion (nm, nrad) of a surface after M1, or per Noll coefficient (nm)."""
    control = _telescope(text, ())[0]
    what = f"the surface {control.bench.system.surfaces[place].name}"

    def bend(states: States, positions: Array) -> None:
        form = states.deformations[place]
        assert form is not None
        form[: len(positions)] += positions * MM_PER_NM

    def move(states: States, positions: Array) -> None:
        states.surface_motion[: len(positions), place] += positions * UNITS

    if bends:
        return _traced_sight(control, what, _FIGURE, control.bench.mirror_terms, bend)
    return _traced_sight(control, what, _M2 if place == M2 else _OTHERS, len(UNITS), move)


def seen_units(control: ControlBench, wavelength_nm: float) -> tuple[float, float]:
    """Return the factors of line of sight (mm to mas) and of coefficients (waves to nm)."""
    return MAS_PER_RAD / control.bench.first_order.focal_length, wavelength_nm


def _modal_sight(control: ControlBench, model: ModalModel, light: Light, one: Actuator) -> Array:
    """Return the sight of an actuator of segments, which the modal model has."""
    to_mas, to_nm = seen_units(control, control.study.optics.wavelength_nm)
    places, segments = layout_of(model.terms), len(light.layout)
    unit = rest_states(control.prepared.system)
    one.put(light, unit, np.ones((1, len(one.channels(light)))))
    rows = []
    for dof in one.segment_dofs:
        first = model.dofs.index(dof) * segments
        block = model.columns[first : first + segments]
        seen = np.hstack([block[:, places.los] * to_mas, block[:, places.zernike][:, 3:] * to_nm])
        rows.append(seen * unit.segment_motion[0, :, dof, None])
    return np.vstack(rows).T


def _traced_sight(control: ControlBench, what: str, step: float, p: int, put: Put) -> Array:
    """Return what is seen of p motions that are put into states, by central differences of traces of each."""
    to_mas, to_nm = seen_units(control, control.study.optics.wavelength_nm)
    states = states_at_rest(control.bench, padded(4 * p))
    put(states, np.concatenate([factor * step * np.eye(p) for factor in SIGNS]))
    study = control.study
    known_by = tuple(one.model_dump_json() for one in (study.telescope, study.optics, study.wavefront))
    los, zernike = traced_once(control.prepared, states, known_by)
    values = np.hstack([los * to_mas, zernike[:, 3:] * to_nm])[: 4 * p].reshape(4, p, -1)
    moves = ~(np.ptp(values, axis=0).max(axis=1) <= _ROUNDED)
    slopes = checked_derivative(
        values * moves[:, None], step, what, "use other optics.rays", least=_UNSEEN / step
    )
    return np.ascontiguousarray(slopes.T)


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
    m2 = optics.control.bench.system.surfaces[M2].name
    if not knows(optics.model, replace(motion, rigid={}, figure={})):
        raise UserError(
            f"The disturbance {population.name!r} moves segments in ways that its first case does not, which "
            "the linear light of loops does not know."
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
    states = states_at_rest(optics.control.bench, len(shaken))
    optics.structure.put(states, shaken)
    added = states.segment_motion / np.repeat([MM_PER_M, 1.0], 3)
    moved = states.surface_motion[:, M2] / np.repeat([MM_PER_M, 1.0], 3)
    rigid = motion.rigid | {m2: motion.rigid.get(m2, 0.0) + moved}
    return replace(motion, segment_motion=motion.segment_motion + added, rigid=rigid)


def seen_of(study: TelescopeLoopStudy, optics: Optics, case: CaseDraw) -> Array:
    """Return what sensors see of a disturbance at 0 and its instants, (1 + n, K); mas and nm."""
    seen = _seen(optics, case.motion)
    if optics.structure is not None:
        first = optics.light.optical + 3 * len(optics.light.layout) + 6
        at = _shaken(study, optics, case.time, case.realization) @ optics.structure.at.T
        seen[:, first : first + at.shape[1]] = at
    return seen


def off_straight_lines(study: TelescopeLoopStudy, optics: Optics, index: int) -> float:
    """Return how far light is off straight lines between instants of a first case, of the most that it does.

    The larger of the line of sight and of coefficients, each of its own.
    """
    population, time = study.disturbance[index], optics.times[index]
    if any(part.instants_of_file() is not None for part in parts(study.disturbance, population)):
        return 0.0
    twice = np.interp(np.arange(2 * len(time) - 1) / 2.0, np.arange(len(time)), time)
    motion = draw_case(study.disturbance, population, optics.light.layout, study.study.seed, 0, time=twice)
    seen = _seen(optics, motion)[:, : optics.light.optical]
    off = np.abs(seen[1::2] - 0.5 * (seen[:-1:2] + seen[2::2])).max(axis=0)
    most = np.abs(seen).max(axis=0)
    each = [
        off[part].max(initial=0.0) / max(most[part].max(initial=0.0), _SLIGHT)
        for part in (slice(0, 2), slice(2, None))
    ]
    return float(max(each))


def _seen(optics: Optics, motion: Motion) -> Array:
    """Return what sensors see of a motion, (n, K); of nodes, those of bodies."""
    bench, light, count = optics.control.bench, optics.light, len(motion.mount)
    to_mas, to_nm = seen_units(optics.control, optics.control.study.optics.wavelength_nm)
    places = layout_of(optics.model.terms)
    rows = motion_rows(bench, optics.model, motion, padded(count))
    linear = modal.forms(optics.model, rows, TILE).linear[:count]
    seen = np.hstack([linear[:, places.los] * to_mas, linear[:, places.zernike][:, 3:] * to_nm])
    states = states_at_rest(bench, count)
    add_surfaces(states, slice(0, count), bench, motion, slice(0, count))
    moved = states.surface_motion
    for place, sight in optics.moved.items():
        seen += moved[:, place] / UNITS @ sight.T
    for place, sight in optics.bent.items():
        form = states.deformations[place]
        assert form is not None
        seen += form / MM_PER_NM @ sight.T
    if not light.bodies_too:
        return seen
    m2 = moved[:, M2] / UNITS
    m2[:, 3:5] += motion.m2 @ bench.m2_tilt.T / UNITS[3:5]
    nodes = node_columns(light, motion.rigid, count)
    return np.hstack([seen, in_nm_and_nrad(motion.segment_motion), m2, nodes])
