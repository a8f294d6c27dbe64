"""Which bodies with mass the stages of a system push, and how these answer."""

from collections.abc import Iterator

import numpy as np

from wavequake.chain.loops.block import Actuator
from wavequake.chain.loops.light import Light
from wavequake.chain.loops.reaction import Pushing, coordinates, load_mass, pushed_by
from wavequake.control.linear import Array
from wavequake.errors import UserError
from wavequake.mechanics.assembly.plant import Plant
from wavequake.workflows.bodies.made import MM_PER_M, transported
from wavequake.workflows.bodies.sections import BodySection
from wavequake.workflows.loops.system_loop_study import SystemLoopStudy
from wavequake.workflows.mirrors.study import FULL
from wavequake.workflows.systems.bench import SystemBench


def pushing_of(study: SystemLoopStudy, bench: SystemBench, light: Light) -> Pushing | None:
    """Return how the bodies of a system answer its stages; None: no stage pushes any."""
    plant = bench.plants.get(FULL)
    if plant is None and (
        wrong := next((one for one in study.actuator if getattr(one, "mass_kg", None)), None)
    ):
        raise UserError(
            f"actuator.{wrong.name}.mass_kg: no [[body]] of the study has mass that it could push."
        )
    if plant is None:
        return None
    each = {one.name: _loads(study, bench, plant, light, one) for one in study.actuator}
    loads = {name: load for name, load in each.items() if load is not None}
    return pushed_by(plant, loads) if loads else None


def _loads(
    study: SystemLoopStudy, bench: SystemBench, plant: Plant, light: Light, one: Actuator
) -> Array | None:
    """Return loads of the plant's coordinates (r + f, p) per position of an actuator, times s^2.

    Raises
    ------
    UserError
        If it says how much mass it moves of what has none.
    """
    channels = len(one.channels(light))
    found = None
    for element, motion in one.motion(one.step * np.eye(channels)).items():
        rows, mass = _rows(bench, plant, element), _mass(study, bench, one, element)
        if rows is None and getattr(one, "mass_kg", None) is not None:
            raise UserError(
                f"actuator.{one.name}.mass_kg: no body with mass carries {element!r}; leave it out, or say "
                "what that body is."
            )
        if rows is not None and mass is not None:
            pushed = rows.T @ mass @ motion.T / one.step
            found = pushed if found is None else found + pushed
    return found


def _rows(bench: SystemBench, plant: Plant, element: str) -> Array | None:
    """Return the motion (6, r + f) of an element per coordinate of the plant; None: no mass carries it."""
    rows = coordinates(plant)
    if (place := plant.outputs.get(("rigid", element))) is not None:
        return np.asarray(rows[place])
    for body in bench.bodies:
        place = plant.outputs.get(("rigid", body.name))
        surface = next((bench.system.surfaces[k] for k in body.surfaces if _called(bench, k, element)), None)
        if place is not None and surface is not None:
            moved = np.kron(np.eye(2), body.rotation) @ rows[place]
            at = surface.position / MM_PER_M
            return transported(moved, body.point / MM_PER_M, surface.rotation, at)
    return None


def _called(bench: SystemBench, index: int, name: str) -> bool:
    return bench.system.surfaces[index].name == name


def _mass(study: SystemLoopStudy, bench: SystemBench, one: Actuator, element: str) -> Array | None:
    """Return the mass (6, 6) of an element about where it turns; None: it is not known."""
    given = getattr(one, "mass_kg", None)
    if given is not None:
        return load_mass(given, np.zeros((3, 3)), np.zeros(3))
    section = _rigid(study, element)
    optical = next((body for body in bench.bodies if body.name == element), None)
    if section is None or section.rigid is None or optical is None:
        return None
    center = optical.point if section.rigid.center_mm is None else np.array(section.rigid.center_mm)
    away = optical.rotation.T @ (center - optical.point) / MM_PER_M
    return load_mass(section.rigid.mass_kg, np.diag(section.rigid.inertia_kg_m2), away)


def _rigid(study: SystemLoopStudy, name: str) -> BodySection | None:
    return next((one for one in study.body if one.name == name and one.rigid), None)


def pushing_notices(study: SystemLoopStudy) -> Iterator[str]:
    """Yield which stages move something of a body with mass without that their own mass is known."""
    carried = {
        name: one for one in study.body if one.kind for name in (one.name, *one.surfaces, *one.carries)
    }
    for one in study.actuator:
        name = getattr(one, "of", "")
        if name in carried and _rigid(study, name) is None and getattr(one, "mass_kg", None) is None:
            yield (
                f"actuator.{one.name}: the body {carried[name].name!r} carries {name!r}, but how much of its "
                "mass the stage moves is not said, so that it does not push back; give mass_kg."
            )
