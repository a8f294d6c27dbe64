"""Nodes of bodies with mass that sensors of loops read."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from fnmatch import fnmatchcase

import numpy as np

from wavequake.chain.loops.block import Actuator, Sensor
from wavequake.chain.loops.light import Light
from wavequake.chain.loops.sensors.displacement import OfBodies
from wavequake.control.linear import Array
from wavequake.errors import UserError
from wavequake.mechanics.assembly.answers import watching
from wavequake.mechanics.assembly.bodies import GROUND
from wavequake.mechanics.assembly.plant import Plant
from wavequake.optics.derivatives.central import DOFS
from wavequake.optics.systems.bodies import Body as OpticalBody
from wavequake.workflows.bodies.made import MM_PER_M, transported

# What outputs of a plant that are nodes are called, before their names.
_NODE = "node "


def with_nodes(names: tuple[str, ...], sensors: Sequence[Sensor], light: Light) -> tuple[Plant | None, Light]:
    """Return the bodies, and light, with the nodes that sensors read; their motions are outputs of the plant.

    `names` are nodes that move by themselves.

    Raises
    ------
    UserError
        If a sensor names a node that is not there.
    """
    plant = light.layout.plant
    if plant is None:
        return None, replace(light, nodes=names)
    ends = {
        f"{node}.{dof}": node
        for node, (_, turns) in plant.places.items()
        if "/" not in node and node.partition(".")[0] != GROUND
        for dof in DOFS[: 3 if turns is None else 6]
    }
    read = [(one.name, pattern) for one in sensors if isinstance(one, OfBodies) for pattern in one.nodes]
    for name, pattern in read:
        if not any(fnmatchcase(known, pattern) for known in (*names, *ends)):
            raise UserError(
                f"sensor.{name}.nodes: there is no node {pattern!r}; there are "
                f"{', '.join([*names, *ends][:12])}{', ...' if len(ends) > 12 else ''}."
            )
    found = tuple(label for label in ends if any(fnmatchcase(label, pattern) for _, pattern in read))
    plant = watching(plant, {_NODE + node: node for node in dict.fromkeys(ends[label] for label in found)})
    return plant, replace(light, layout=replace(light.layout, plant=plant), nodes=(*names, *found))


def moved_nodes(one: Actuator, bodies: Sequence[OpticalBody], light: Light) -> Array:
    """Return how nodes that sensors read move, nm and nrad, per position of an actuator, (N, p).

    Those of a body that it moves do; all others stand still, but for what the bodies answer.
    """
    found = np.zeros((len(light.nodes), len(one.channels(light))))
    name, plant = getattr(one, "of", ""), light.layout.plant
    optical = next((body for body in bodies if body.name == name), None)
    if optical is None or plant is None:
        return found
    (motion,) = one.motion(np.eye(found.shape[1])).values()
    turned = np.kron(np.eye(2), optical.rotation) @ motion.T
    for row, label in enumerate(light.nodes):
        node, _, dof = label.rpartition(".")
        if node in plant.points and (node == name or node.startswith(f"{name}.")):
            moved = transported(turned, optical.point / MM_PER_M, np.eye(3), plant.points[node])
            found[row] = 1e9 * moved[DOFS.index(dof)]
    return found


def node_columns(light: Light, rigid: Mapping[str, Array], count: int) -> Array:
    """Return what nodes do in a motion of rigid elements over so many instants, nm and nrad, (count, N)."""
    found = np.zeros((count, len(light.nodes)))
    for column, label in enumerate(light.nodes):
        node, _, dof = label.rpartition(".")
        if _NODE + node in rigid:
            found[:, column] = 1e9 * rigid[_NODE + node][:, DOFS.index(dof)]
    return found
