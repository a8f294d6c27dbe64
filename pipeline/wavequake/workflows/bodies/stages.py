"""What the stages of a segmented telescope push: the bodies with mass that carry what they move."""

from collections.abc import Iterator, Sequence

import numpy as np

from wavequake.chain.loops.block import Actuator
from wavequake.chain.loops.light import Light
from wavequake.chain.loops.reaction import Pushing, coordinates, load_mass, pushed_by
from wavequake.control.linear import Array
from wavequake.errors import UserError
from wavequake.mechanics.assembly.plant import Plant
from wavequake.optics.segments.telescope import M2
from wavequake.optics.systems.bodies import rigid_body
from wavequake.optics.systems.system import OpticalSystem
from wavequake.workflows.bodies.made import MM_PER_M, transported
from wavequake.workflows.bodies.sections import BodySection
from wavequake.workflows.segments.bench import Bench
from wavequake.workflows.segments.launches import states_at_rest

_SI = np.repeat([1.0 / MM_PER_M, 1.0], 3)


def stages_push(
    actuators: Sequence[Actuator], bench: Bench, light: Light, plant: Plant | None
) -> Pushing | None:
    """Return how the bodies of a telescope answer its stages; None: no stage pushes any.

    `plant` is that of the full models, maybe with more outputs.

    Raises
    ------
    UserError
        If a stage says how much mass it moves of what has none.
    """
    if plant is None:
        if one := next((one for one in actuators if getattr(one, "mass_kg", None) is not None), None):
            raise UserError(
                f"actuator.{one.name}.mass_kg: no [[body]] of the study has mass that it could push."
            )
        return None
    rows = _rows(bench, plant)
    each = {one.name: _loads(one, bench, light, plant, rows) for one in actuators}
    loads = {name: load for name, load in each.items() if load is not None}
    return pushed_by(plant, loads) if loads else None


def _rows(bench: Bench, plant: Plant) -> dict[str, Array]:
    """Return the motions (6, r + f) of what bodies carry, in its own frame, per coordinate of the plant."""
    rows, found = coordinates(plant), dict[str, Array]()
    for carrier, one in bench.bodies.carried.items():
        place = plant.outputs.get(("rigid", carrier))
        if place is not None:
            found |= dict(zip(one.names, one.follows @ rows[place], strict=True))
    return found


def _loads(one: Actuator, bench: Bench, light: Light, plant: Plant, rows: dict[str, Array]) -> Array | None:
    """Return loads of the plant's coordinates (r + f, p) per position of an actuator, times s^2."""
    own = _own_body(one, bench, plant)
    if own is not None:
        place, mass = own
        p = len(one.channels(light))
        (motion,) = one.motion(np.eye(p)).values()
        return np.asarray(coordinates(plant)[place].T @ mass @ motion.T)
    if one.carried_kg is None:
        return None
    mass, p = load_mass(one.carried_kg, np.zeros((3, 3)), np.zeros(3)), len(one.channels(light))
    states = states_at_rest(bench, p)
    one.put(light, states, np.eye(p))
    found = []
    for index, name in enumerate(bench.system.segments.names):
        motion = states.segment_motion[:, index] * _SI
        if name in rows and motion.any():
            found.append(rows[name].T @ mass @ motion.T)
    moved = np.flatnonzero(states.surface_motion.any(axis=(0, 2)))
    surfaces = [bench.system.surfaces[index] for index in moved]
    if len(moved) and all(surface.name in rows for surface in surfaces):
        # A lens is where the middle between its first and last vertex is.
        ends = (moved[0], moved[-1])
        turned = [np.kron(np.eye(2), surface.rotation) for surface in (surfaces[0], surfaces[-1])]
        names = (surfaces[0].name, surfaces[-1].name)
        at = np.mean([turn @ rows[name] for turn, name in zip(turned, names, strict=True)], axis=0)
        motion = np.mean(
            [states.surface_motion[:, end] @ turn.T for end, turn in zip(ends, turned, strict=True)], axis=0
        )
        motion = motion * _SI
        found.append(at.T @ mass @ motion.T)
    elif len(moved):
        lost = next(surface.name for surface in surfaces if surface.name not in rows)
        raise UserError(
            f"actuator.{one.name}.mass_kg: no body with mass carries {lost!r}; leave it out, or say "
            "what that body is."
        )
    return np.asarray(np.sum(found, axis=0)) if found else None


def _own_body(one: Actuator, bench: Bench, plant: Plant) -> tuple[slice, Array] | None:
    """Return which output of the plant a body that a stage moves is, and its mass (6, 6) where it turns."""
    name = getattr(one, "of", "")
    section = next((body for body in bench.study.body if body.name == name), None)
    optical = next((body for body in bench.bodies.optical if body.name == name), None)
    place = plant.outputs.get(("rigid", name))
    if section is None or optical is None or place is None:
        return None
    if one.carried_kg is not None:
        return place, load_mass(one.carried_kg, np.zeros((3, 3)), np.zeros(3))
    if section.rigid is None:
        return None
    center = optical.point if section.rigid.center_mm is None else np.array(section.rigid.center_mm)
    away = optical.rotation.T @ (center - optical.point) / MM_PER_M
    return place, load_mass(section.rigid.mass_kg, np.diag(section.rigid.inertia_kg_m2), away)


def movable_surfaces(system: OpticalSystem) -> dict[str, Array]:
    """Return the motions of surfaces (6, L, 6) per motion of each surface after M1, and of each body."""
    after = [one.name for one in system.after_primary]
    found = {name: np.zeros((6, len(system.surfaces), 6)) for name in (*after, *system.bodies)}
    for place, name in enumerate(after, start=M2):
        found[name][:, place] = np.eye(6)
    for name, surfaces in system.bodies.items():
        body = rigid_body(system, name, surfaces)
        axes = np.asarray(np.kron(np.eye(2), body.rotation), dtype=np.float64)
        for place in body.surfaces:
            one = system.surfaces[place]
            found[name][:, place] = transported(axes, body.point, one.rotation, one.position).T
    return found


def movable_bodies(bench: Bench) -> dict[str, Array]:
    """Return the motions (6, L, 6) of surfaces per motion of each body that carries surfaces alone.

    In mm and rad, as `wavequake.chain.loops.light.Light.movable` has those of surfaces.
    """
    places = {surface.name: index for index, surface in enumerate(bench.system.surfaces)}
    found = {}
    for body in bench.study.body:
        one = bench.bodies.carried.get(body.name)
        if one is None or not all(name in places for name in one.names):
            continue
        found[body.name] = np.zeros((6, len(places), 6))
        for name, follows in zip(one.names, one.follows, strict=True):
            found[body.name][:, places[name]] = (follows / _SI[:, None] * _SI).T
    return found


def stage_notices(actuators: Sequence[Actuator], bench: Bench, light: Light) -> Iterator[str]:
    """Yield which stages move something of a body with mass without that their own mass is known."""
    carriers = _carriers(bench)
    rigid = {body.name for body in bench.study.body if body.rigid}
    for one in actuators:
        if one.carried_kg is not None or getattr(one, "of", "") in rigid:
            continue
        states = states_at_rest(bench, p := len(one.channels(light)))
        one.put(light, states, np.eye(p))
        moved = np.flatnonzero(states.surface_motion.any(axis=(0, 2)))
        names = [bench.system.surfaces[index].name for index in moved]
        segments = np.flatnonzero(states.segment_motion.any(axis=(0, 2)))
        names += [bench.system.segments.names[index] for index in segments]
        if found := next((name for name in names if name in carriers), None):
            key = "mass_kg" if hasattr(one, "mass_kg") else 'model = "optic" with mass_kg'
            key = "stiffness_n_um and segment_kg" if len(segments) else key
            yield (
                f"actuator.{one.name}: the body {carriers[found]!r} carries {found!r}, but how much of its "
                f"mass the stage moves is not said, so that it does not push back; give {key}."
            )


def _carriers(bench: Bench) -> dict[str, str]:
    """Return the bodies with mass by the elements that they, or nodes of theirs, carry."""
    massive: list[BodySection] = [body for body in bench.study.body if body.kind]
    found = dict[str, str]()
    for carrier, one in bench.bodies.carried.items():
        body = next((each.name for each in massive if carrier == each.name), None)
        body = body or next((each.name for each in massive if carrier.startswith(f"{each.name}.")), None)
        if body is not None:
            found |= dict.fromkeys(one.names, body)
    return found
