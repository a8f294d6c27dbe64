"""What joins bodies to each other and to the ground: springs, legs and rigid connections. SI units."""

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
import scipy  # its parts load when first used

from wavequake.errors import UserError
from wavequake.mechanics.assembly.bodies import GROUND, Body, Node, with_point
from wavequake.mechanics.model import Array
from wavequake.mechanics.multibody.joined import Bearing, Joint, Place

_TOGETHER = 1e-5  # m: nodes of a spring or rigid connection that are one point
_DEPENDENT = 1e-10
_STIFFEST = 1e18  # N/m and N s/m


class End(NamedTuple):
    """Where a link ends: a node of a body. Without a name it is where the other end is, on a rigid body."""

    body: str
    node: str = ""

    def __str__(self) -> str:
        return f"{self.body}.{self.node}" if self.node else self.body


@dataclass(frozen=True)
class Link:
    """What joins two nodes, or a node and the ground.

    Attributes
    ----------
    name : str
    kind : "spring", "leg" or "rigid"
        A spring and damper along x, y, z of the system between nodes at one point; a leg pulls and pushes
        along the line between nodes apart, as the legs of a hexapod; a rigid connection.
    first, second : End
    stiffness, damping : tuple of float
        N/m and N s/m along x, y, z; of a leg the first number counts.
    """

    name: str
    kind: Literal["spring", "leg", "rigid"]
    first: End
    second: End
    stiffness: tuple[float, float, float] = (0.0, 0.0, 0.0)
    damping: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Joined:
    """Bodies whose nodes are all there, and what joins them, in the terms of `assemble_system`."""

    bodies: tuple[Body, ...]
    bearings: tuple[Bearing, ...]
    joints: tuple[Joint, ...]


def joined(bodies: Sequence[Body], links: Sequence[Link]) -> Joined:
    """Find the ends of all links; rigid bodies get the nodes that their links need.

    Raises
    ------
    UserError
        If a link leads nowhere, joins a body with itself, a spring or rigid connection joins points apart, a
        leg has no length, or a stiffness or damping is negative or not finite.
    """
    found = {body.name: body for body in bodies}
    bearings, joints = [], []
    for link in links:
        found, first, second = _ends(found, link)
        places = (_place(found, link.first, first), _place(found, link.second, second))
        if link.kind == "rigid":
            joints += [Joint(*places)]
            joints += _turning(found, link, first, second)
        else:
            bearings.append(_bearing(link, places, second.point - first.point))
    complete = tuple(found.values())
    return Joined(complete, tuple(bearings), _independent(complete, joints))


def _ends(found: Mapping[str, Body], link: Link) -> tuple[dict[str, Body], Node, Node]:
    """Return the bodies, with the nodes that a link adds to rigid ones, and the nodes at its ends."""
    ends = (link.first, link.second)
    for end in ends:
        _require_end(found, link, end)
    if link.first.body == link.second.body:
        raise UserError(f"the link {link.name!r} joins {link.first.body!r} with itself")
    bodies = dict(found)
    nodes = [_known(bodies, end) for end in ends]
    if nodes[0] is None and nodes[1] is None:
        raise UserError(
            f"the link {link.name!r} joins {link.first} and {link.second} at no point; name a node of one of "
            "them"
        )
    for index, end in enumerate(ends):
        other = nodes[1 - index]
        if nodes[index] is None and other is not None:
            if link.kind == "leg":
                raise UserError(
                    f"the leg {link.name!r} ends somewhere on {end.body!r}; name a node, as {end.body}.foot"
                )
            name = f"{link.name}/{len(bodies[end.body].nodes)}"
            bodies[end.body] = with_point(bodies[end.body], name, other.point)
            nodes[index] = bodies[end.body].nodes[name]
    first, second = nodes
    assert first is not None
    assert second is not None
    apart = float(np.linalg.norm(second.point - first.point))
    if link.kind != "leg" and apart > _TOGETHER:
        raise UserError(
            f"the {link.kind} {link.name!r} joins {link.first} and {link.second}, which are "
            f"{1e3 * apart:.4g} mm apart; join them by a leg, or name no node at the end on "
            "a rigid body"
        )
    if link.kind == "leg" and apart <= _TOGETHER:
        raise UserError(
            f"the leg {link.name!r} from {link.first} to {link.second} has no length, so no direction; join "
            "them by a spring"
        )
    return bodies, first, second


def _require_end(found: Mapping[str, Body], link: Link, end: End) -> None:
    if end.body not in found:
        near = difflib.get_close_matches(end.body, found, n=1)
        hint = f"did you mean {near[0]!r}?" if near else f"there are {', '.join(found)}."
        raise UserError(f"the link {link.name!r} leads to {end.body!r}, which is no body; {hint}")
    body = found[end.body]
    if end.node in body.nodes or (not end.node and body.anywhere):
        return
    names = [name for name in body.nodes if name and "/" not in name]
    near = difflib.get_close_matches(end.node, names, n=1)
    hint = f"did you mean {near[0]!r}?" if near else f"it has {', '.join(names) or 'none'}."
    what = f"the node {end.node!r}" if end.node else "a node without a name"
    raise UserError(f"the link {link.name!r} leads to {what} of {end.body!r}; {hint}")


def _known(bodies: Mapping[str, Body], end: End) -> Node | None:
    return bodies[end.body].nodes[end.node] if end.node else None


def _place(bodies: Mapping[str, Body], end: End, node: Node, turns: bool = False) -> Place:
    group = node.turns if turns else node.moves
    assert group is not None
    return Place(list(bodies).index(end.body), group)


def _turning(bodies: Mapping[str, Body], link: Link, first: Node, second: Node) -> list[Joint]:
    """Return what lets nodes that can turn do so alike."""
    if first.turns is None or second.turns is None:
        return []
    return [Joint(_place(bodies, link.first, first, True), _place(bodies, link.second, second, True))]


def _bearing(link: Link, places: tuple[Place, Place], along: Array) -> Bearing:
    numbers = np.array([*link.stiffness, *link.damping])
    if numbers.shape != (6,) or not ((numbers >= 0.0) & (numbers <= _STIFFEST)).all():
        raise UserError(f"the link {link.name!r} needs stiffnesses and dampings from 0 to {_STIFFEST:g}")
    if not numbers.any():
        raise UserError(f"the link {link.name!r} has neither stiffness nor damping; give it stiffness_n_m")
    if link.kind == "leg":
        direction = along / np.linalg.norm(along)
        line = np.outer(direction, direction)
        return Bearing(*places, link.stiffness[0] * line, link.damping[0] * line)
    return Bearing(*places, np.diag(link.stiffness), np.diag(link.damping))


def _independent(bodies: Sequence[Body], joints: Sequence[Joint]) -> tuple[Joint, ...]:
    """Leave out what rigid connections repeat: between rigid bodies, two points hold what three do."""
    if not joints:
        return ()
    inputs = scipy.linalg.block_diag(*[body.model.inputs for body in bodies])
    widths = np.cumsum([0, *(body.model.inputs.shape[1] for body in bodies)])

    def columns(place: Place) -> Array:
        start = widths[place.body] + 3 * place.node
        return np.asarray(inputs[:, start : start + 3])

    apart = [
        columns(joint.first) - (0.0 if joint.second is None else columns(joint.second)) for joint in joints
    ]
    constraints = np.hstack(apart)
    _, triangle, order = scipy.linalg.qr(constraints, mode="economic", pivoting=True)
    size = np.abs(np.diag(triangle))
    kept = set(order[: len(size)][size > _DEPENDENT * size[0]].tolist())
    found = [
        Joint(joint.first, joint.second, tuple(axis for axis in range(3) if 3 * index + axis in kept))
        for index, joint in enumerate(joints)
    ]
    return tuple(joint for joint in found if joint.directions)


def connected(bodies: Sequence[Body], links: Sequence[Link]) -> list[tuple[str, ...]]:
    """Return the groups of bodies that links join, by names; one that holds the ground comes first."""
    group = {body.name: {body.name} for body in bodies}
    for link in links:
        both = group[link.first.body] | group[link.second.body]
        for name in both:
            group[name] = both
    found = {tuple(name for name in group if name in one) for one in group.values()}
    return sorted(found, key=lambda names: (GROUND not in names, names))
