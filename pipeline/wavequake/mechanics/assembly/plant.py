"""The plant: all bodies of a system with what joins them, in modal form. SI units.

The floor is a rigid body whose six motions are prescribed, so that its shaking is exact, dampers to it
included, and needs no acceleration. Where nothing stands on the ground the assembly floats: motions are those
in its Buckens frame, which elastic modes do not move (`wavequake.mechanics.multibody.floating_frame`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy  # its parts load when first used

from wavequake.errors import UserError
from wavequake.mechanics.assembly.bodies import GROUND, Body, Output, rigid_body
from wavequake.mechanics.assembly.links import Link, connected, joined
from wavequake.mechanics.model import Array, ReducedModel
from wavequake.mechanics.multibody.joined import assemble_system
from wavequake.mechanics.vibration.modal import ModalModel, modal_model
from wavequake.words import counted

FLOOR = slice(0, 6)
"""Inputs of the plant that are the floor's shifts, m, and turns about the origin, rad."""

_FREE = 1e-12
_ENDS = ("first", "second")


@dataclass(frozen=True, eq=False)
class Plant:
    """An assembly of bodies in modal form.

    Attributes
    ----------
    modal : ModalModel
        Of elastic modes only, with all inputs: forces, N, and moments, N m, at nodes, and the floor's motion.
    places : mapping of str to (slice, slice or None)
        By ``body.node``: which inputs are the force and the moment there.
    points : mapping of str to ndarray, shape (3,)
        Where these nodes are, m.
    outputs : mapping of (str, str) to slice
        Which rows are ("rigid", element), six motions in m and rad, and ("figure", surface), coefficients in
        m.
    shapes : ndarray, shape (m, r)
        These rows per modal coordinate.
    carried : ndarray, shape (m, p)
        What of them follows the inputs at once, the floor's motion.
    followed : ndarray, shape (p, p)
        What of the motion of the inputs' nodes follows the inputs at once; the rest is that of the modes,
        `modal.inputs` of forces transposed.
    grounded : bool
        Whether it stands on the floor; inputs begin with the floor's motion then.
    held : tuple of str
        Bodies that are held in space by stiffness of their own, whose supports the floor does not move.
    resonances : ndarray, shape (2, k)
        Angular frequencies, rad/s, and damping ratios about which random vibration is drawn finely: its own
        ones, or those of another plant with which it is compared, so that both are shaken alike.
    free : ndarray, shape (m, f)
        Rows of the outputs per free motion of unit modal mass, of what floats.
    adrift : ndarray, shape (p, f)
        Motion of the inputs' nodes per free motion.
    """

    modal: ModalModel
    places: Mapping[str, tuple[slice, slice | None]]
    points: Mapping[str, Array]
    outputs: Mapping[Output, slice]
    shapes: Array
    carried: Array
    followed: Array
    grounded: bool
    held: tuple[str, ...]
    resonances: Array
    free: Array
    adrift: Array

    @property
    def omega(self) -> Array:
        """Undamped angular frequencies (r,), rad/s, increasing."""
        return np.sqrt(self.modal.squared)


def plant(
    bodies: Sequence[Body],
    links: Sequence[Link],
    ground: Mapping[str, Array] | None = None,
    damping_ratio: float = 0.0,
    name: str = "structure",
) -> Plant:
    """Assemble bodies and return their modal form.

    Parameters
    ----------
    bodies : sequence of Body
    links : sequence of Link
        Those to the body "ground" hold them.
    ground : mapping of str to ndarray of shape (3,), optional
        Named points of the ground, m.
    damping_ratio : float
        Of every mode, beside what bodies and links have: 0.01 is one percent of critical damping.

    Raises
    ------
    UserError
        If a body is not supported, or a link is wrong, as `joined`, or bodies are as `modal_model` has not.
    """
    parts = joined([rigid_body(GROUND, 1.0, np.eye(3), np.zeros(3), ground or {}), *bodies], links)
    grounded = _require_supports(parts.bodies, links, name)
    chosen = parts.bodies if grounded else parts.bodies[1:]
    bearings: Sequence[Any] = parts.bearings if grounded else [*map(_without_floor, parts.bearings)]
    joints: Sequence[Any] = parts.joints if grounded else [*map(_without_floor, parts.joints)]
    model = assemble_system([body.model for body in chosen], bearings, joints, name).model
    assert isinstance(model, ReducedModel)
    prescribed = np.zeros(model.inputs.shape[1], dtype=bool)
    prescribed[FLOOR] = grounded
    try:
        modal = modal_model(model, prescribed)
    except UserError:
        _require_support(model, chosen, grounded, name)
        raise
    if modal.free.sum() != (0 if grounded else 6):
        _require_support(model, chosen, grounded, name)
    free, adrift = (np.asarray(rows @ modal.modes[:, modal.free]) for rows in (model.surface, model.inputs.T))
    modal = _elastic(modal, damping_ratio)
    places, points = _nodes(chosen)
    return Plant(
        modal,
        places,
        points,
        _outputs(chosen),
        np.asarray(model.surface @ modal.modes),
        np.asarray(model.surface @ modal.lift),
        np.asarray(model.inputs.T @ modal.lift),
        grounded,
        tuple(body.name for body in bodies if body.held),
        np.array([omega := np.sqrt(modal.squared), 0.5 * np.diag(modal.damping) / omega]),
        free,
        adrift,
    )


def _without_floor(one: Any) -> Any:
    """Return a connection in an assembly whose first body, the floor, is left out."""
    return replace(one, **{end: getattr(one, end)._replace(body=getattr(one, end).body - 1) for end in _ENDS})


def _require_supports(bodies: Sequence[Body], links: Sequence[Link], name: str) -> bool:
    """Return whether the assembly stands on something.

    Raises
    ------
    UserError
        If some bodies do and others do not, or it floats in several pieces.
    """
    held = {body.name for body in bodies if body.held}
    groups = [set(group) for group in connected(bodies, links)]
    standing = [group for group in groups if group & held or (GROUND in group and len(group) > 1)]
    loose = [sorted(group) for group in groups if group not in standing and group != {GROUND}]
    if standing and loose:
        raise UserError(
            f"the body {loose[0][0]!r} of {name} has no support, while others stand on the ground; join it "
            "by a link to another body or to the ground"
        )
    if len(loose) > 1:
        raise UserError(
            f"the bodies {loose[0][0]!r} and {loose[1][0]!r} of {name} are not joined; link them to each "
            "other, or to the ground"
        )
    return bool(standing)


def _require_support(model: ReducedModel, bodies: Sequence[Body], grounded: bool, name: str) -> None:
    """Refuse an assembly of which more moves without stiffness than it has to, and say which body does."""
    squared, shapes = scipy.linalg.eigh(model.stiffness, model.mass)
    free = shapes[:, squared <= _FREE * max(squared[-1], np.finfo(float).tiny)]
    if not grounded and free.shape[1] == 6:
        return
    if grounded:
        free = free @ scipy.linalg.null_space(model.inputs[:, FLOOR].T @ free) if free.size else free
        if not free.size:
            return
    moved = np.abs(model.inputs.T @ free).max(axis=1)
    ends = np.cumsum([body.model.inputs.shape[1] for body in bodies])
    sizes = [part.max(initial=0.0) for part in np.split(moved, ends[:-1])]
    worst = bodies[int(np.argmax(sizes))].name
    count = free.shape[1] - (0 if grounded else 6)
    raise UserError(
        f"{name} has {counted(count, 'motion')} without stiffness, in which {worst!r} moves most; its links "
        "leave it free: six legs, or springs at three points, hold a body"
    )


def _elastic(modal: ModalModel, damping_ratio: float) -> ModalModel:
    """Return the elastic modes, damped further: relative to the floor, which drags them along.

    Static shares of the floor's motion, inputs / squared, move without straining any damper.
    """
    kept = ~modal.free
    if not kept.any():
        raise UserError(f"{modal.name} has no elastic motion; join its bodies by springs or legs")
    squared, inputs = modal.squared[kept], modal.inputs[kept]
    rates = 2.0 * damping_ratio * np.sqrt(squared)
    shares = np.where(modal.prescribed, inputs, 0.0) / squared[:, None]
    return ModalModel(
        modal.name,
        squared,
        modal.damping[np.ix_(kept, kept)] + np.diag(rates),
        inputs,
        modal.input_rates[kept] + rates[:, None] * shares,
        modal.modes[:, kept],
        modal.lift,
        modal.prescribed,
    )


def _nodes(
    bodies: Sequence[Body],
) -> tuple[dict[str, tuple[slice, slice | None]], dict[str, Array]]:
    """Return the inputs and places of all nodes, by ``body.node``."""
    places: dict[str, tuple[slice, slice | None]] = {}
    points: dict[str, Array] = {}
    first = 0
    for body in bodies:
        for label, node in body.nodes.items():
            key = f"{body.name}.{label}" if label else body.name
            moment = None if node.turns is None else _group(first, node.turns)
            places[key], points[key] = (_group(first, node.moves), moment), node.point
        first += body.model.inputs.shape[1]
    return places, points


def _group(first: int, group: int) -> slice:
    return slice(first + 3 * group, first + 3 * group + 3)


def _outputs(bodies: Sequence[Body]) -> dict[Output, slice]:
    found: dict[Output, slice] = {}
    first = 0
    for body in bodies:
        for name, count in body.outputs.items():
            found[name] = slice(first, first + count)
            first += count
    return found
