"""Beams and links of a structure, drawn between nodes that move."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from wavequake.mechanics.assembly.bodies import GROUND
from wavequake.mechanics.assembly.plant import Plant
from wavequake.viewer.film import Array, Integers, Stage
from wavequake.workflows.systems.study import SystemStudy

_BEAM, _LEG = "#8f98a3", "#c2a15a"
_LEG_SHARE = 0.4  # of the thickness of a tube, where links have none
_THIN = 0.004  # of the structure, where there are no tubes


def members_of(study: SystemStudy, plant: Plant) -> list[tuple[str, str, str, float]]:
    """Return ends, color and thickness (m) of all beams and links between two places."""
    tubes = [1e-3 * body.beams.diameter_mm for body in study.body if body.beams is not None]
    places = np.array(list(plant.points.values()))
    thin = _LEG_SHARE * min(tubes) if tubes else _THIN * float(np.ptp(places, axis=0).max(initial=0.0))
    found = [
        (f"{body.name}.{first}", f"{body.name}.{second}", _BEAM, 1e-3 * body.beams.diameter_mm)
        for body in study.body
        if body.beams is not None
        for first, second in body.beams.members
    ]
    found += [(*ends, _LEG, thin) for link in study.link for ends in link.joins]
    return [one for one in found if _apart(plant, one[0], one[1])]


def _apart(plant: Plant, first: str, second: str) -> bool:
    """Return whether there is anything to be drawn between two nodes; the ground is not."""
    both = [name for name in (first, second) if name in plant.points and name.partition(".")[0] != GROUND]
    return len(both) == 2 and bool(np.linalg.norm(plant.points[first] - plant.points[second]) > 0.0)


def nodes_of(members: Sequence[tuple[str, str, str, float]]) -> list[str]:
    """Return the nodes between which members are, each once."""
    return list(dict.fromkeys(name for first, second, *_ in members for name in (first, second)))


def with_members(
    stage: Stage, plant: Plant, members: Sequence[tuple[str, str, str, float]], nodes: Sequence[str]
) -> Stage:
    """Return a stage with members as square bars, and their nodes as bodies after its own."""
    number = {name: len(stage.names) + place for place, name in enumerate(nodes)}
    points, faces, body, colors = [stage.points], [_quads(stage.faces)], [stage.body], list(stage.colors)
    count = len(stage.points)
    around = np.stack([np.arange(4), np.roll(np.arange(4), -1)])
    for first, second, color, thick in members:
        ends = plant.points[first], plant.points[second]
        ring = _ring(ends[1] - ends[0], thick / 2.0)
        points += [end + ring for end in ends]
        body.append(np.repeat([number[first], number[second]], 4))
        quads = np.stack([around[0], around[1], around[1] + 4, around[0] + 4], axis=1)
        faces.append(np.pad(quads + count, ((0, 0), (0, faces[0].shape[1] - 4)), mode="edge"))
        colors += [color] * 4
        count += 8
    return replace(
        stage,
        points=np.concatenate(points),
        faces=np.concatenate(faces),
        body=np.concatenate(body),
        colors=tuple(colors),
        names=(*stage.names, *nodes),
        pivots=np.concatenate([stage.pivots, [plant.points[name] for name in nodes]]),
        axes=np.concatenate([stage.axes, np.broadcast_to(np.eye(3), (len(nodes), 3, 3))]),
    )


def _quads(faces: Integers) -> Integers:
    """Return faces of four corners at least."""
    return np.pad(faces, ((0, 0), (0, max(0, 4 - faces.shape[1]))), mode="edge")


def _ring(along: Array, size: float) -> Array:
    """Return four points (4, 3) about a direction."""
    least = np.eye(3)[int(np.abs(along).argmin())]
    across = np.cross(along, least)
    across *= size / np.linalg.norm(across)
    up = np.cross(along, across) / np.linalg.norm(along)
    return np.stack([across, up, -across, -up])
