"""Several elastic bodies, joined by springs, dampers and rigid connections, as one linear model. SI units."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import scipy  # its parts load when first used

from wavequake.errors import UserError
from wavequake.mechanics.model import Array, Model, ReducedModel
from wavequake.mechanics.multibody.linear_system import (
    LinearSystem,
    linear_system,
    skew_part,
    symmetric_and_skew,
)
from wavequake.mechanics.vibration.modal import LARGEST, dense

_DEPENDENT = 1e-10


class Place(NamedTuple):
    """An interface node of a body: both count from 0, the node among the interfaces of the body."""

    body: int
    node: int


@dataclass(frozen=True)
class Link:
    """A spring and a damper along the global axes between two interface nodes, or a node and the ground.

    ``stiffness`` in N/m and ``damping`` in N s/m along x, y, z.
    """

    first: Place
    second: Place | None
    stiffness: tuple[float, float, float]
    damping: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Bearing:
    """A link whose forces need not be symmetric: a journal bearing, the internal damping of a rotor.

    The force on the first place is -stiffness u - damping u', u its displacement relative to the second (or
    the ground). ``stiffness`` (3, 3) in N/m and ``damping`` (3, 3) in N s/m; their skew parts are
    circulatory and gyroscopic forces (Störkle 2018, Eq. 2.5).
    """

    first: Place
    second: Place | None
    stiffness: Array
    damping: Array


@dataclass(frozen=True)
class Joint:
    """A rigid connection: two interface nodes, or a node and the ground, move alike in some directions."""

    first: Place
    second: Place | None
    directions: tuple[int, ...] = (0, 1, 2)


def assemble(
    bodies: Sequence[Model], links: Sequence[Link] = (), joints: Sequence[Joint] = (), name: str = "assembly"
) -> ReducedModel:
    """Join bodies in one linear system (Störkle 2018, Eq. 2.4) with the interface of a single body.

    Rigid connections are eliminated by the null space of their equations, so what is left has no constraints.
    All is symmetric: of the parts of Eq. 2.5, D and K; `assemble_system` takes G and N too.

    Parameters
    ----------
    bodies : sequence of models
        Their node coordinates in one common frame.
    links, joints
        At the bodies' interface nodes.

    Returns
    -------
    ReducedModel
        Interfaces and optical surfaces of all bodies, one body after the other.

    Raises
    ------
    UserError
        If there is no body, the bodies together are too large, a link or joint names what is not there, a
        spring or damper is negative or not finite, a joint only repeats others, or forces are not symmetric.
    """
    if any(isinstance(body, LinearSystem) for body in bodies) or any(not isinstance(x, Link) for x in links):
        raise UserError(
            f"a body or link of {name} has gyroscopic or circulatory forces; join them by assemble_system"
        )
    return _assembled(bodies, links, joints, name)[0]


def assemble_system(
    bodies: Sequence[Model | LinearSystem],
    links: Sequence[Link | Bearing] = (),
    joints: Sequence[Joint] = (),
    name: str = "assembly",
    gyroscopic: Any = None,
    circulatory: Any = None,
) -> LinearSystem:
    """Join bodies in one linear system with gyroscopic and circulatory forces (Störkle 2018, Eq. 2.4, 2.5).

    Parameters
    ----------
    bodies : sequence of models or LinearSystem
        Those with forces G and N of their own are made by `linear_system` or `steady_rotation`.
    links, joints
        As of `assemble`; a `Bearing` may have forces that are not symmetric.
    gyroscopic, circulatory : ndarray or sparse array, shape (n, n), optional
        Further G and N of the whole system, in the coordinates of all bodies, one after the other, before
        joints.

    Raises
    ------
    UserError
        As of `assemble`, or if a matrix is not skew-symmetric or a bearing's damping negative.
    """
    systems = [body if isinstance(body, LinearSystem) else linear_system(body) for body in bodies]
    models = [system.model for system in systems]
    plain = [link if isinstance(link, Link) else _symmetric(link) for link in links]
    assembly, basis = _assembled(models, plain, joints, name)
    whole_g, whole_n = (
        skew_part(name, label, matrix, len(basis)) + scipy.linalg.block_diag(*parts)
        for label, matrix, parts in (
            ("gyroscopic", gyroscopic, [system.gyroscopic for system in systems]),
            ("circulatory", circulatory, [system.circulatory for system in systems]),
        )
    )
    inputs = scipy.linalg.block_diag(*[dense(model.inputs) for model in models])
    for link in links:
        if isinstance(link, Bearing):
            apart = _apart(models, inputs, link.first, link.second)
            whole_n += apart @ symmetric_and_skew(np.asarray(link.stiffness, dtype=float))[1] @ apart.T
            whole_g += apart @ symmetric_and_skew(np.asarray(link.damping, dtype=float))[1] @ apart.T
    return linear_system(assembly, basis.T @ whole_g @ basis, basis.T @ whole_n @ basis)


def _assembled(
    bodies: Sequence[Model], links: Sequence[Link | Bearing], joints: Sequence[Joint], name: str
) -> tuple[ReducedModel, Array]:
    """Return the symmetric parts, and the basis (n, n - c) in which the joints hold."""
    if not bodies:
        raise UserError("an assembly needs at least one body")
    order = sum(body.mass.shape[0] for body in bodies)
    if order > LARGEST:
        raise UserError(
            f"the bodies of {name} have {order} coordinates together; at most {LARGEST} can be assembled: "
            "reduce them first (e.g. craigb36)"
        )
    inputs = scipy.linalg.block_diag(*[dense(body.inputs) for body in bodies])
    mass, damping, stiffness = (
        scipy.linalg.block_diag(*[dense(getattr(body, part)) for body in bodies])
        for part in ("mass", "damping_matrix", "stiffness")
    )
    for link in links:
        if isinstance(link, Link):
            _check_link(link)
        apart = _apart(bodies, inputs, link.first, link.second)
        stiffness += apart @ _square(link.stiffness) @ apart.T
        damping += apart @ _square(link.damping) @ apart.T
    basis = _compatible(bodies, inputs, joints, name)
    node_offsets = np.cumsum([0, *(len(body.nodes) for body in bodies)])[:-1]
    widths = np.cumsum([0, *(len(body.interfaces) for body in bodies)])
    assembly = ReducedModel(
        name=name,
        method="assembly",
        mass=basis.T @ mass @ basis,
        stiffness=basis.T @ stiffness @ basis,
        damping_matrix=basis.T @ damping @ basis,
        inputs=basis.T @ inputs,
        surface=scipy.linalg.block_diag(*[dense(body.surface) for body in bodies]) @ basis,
        nodes=np.concatenate([body.nodes for body in bodies]),
        interfaces=_joined(node_offsets, [body.interfaces for body in bodies]),
        surface_nodes=_joined(node_offsets, [body.surface_nodes for body in bodies]),
        surface_weights=np.concatenate([body.surface_weights for body in bodies]) / len(bodies),
        seconds=0.0,
        turns=_joined(widths[:-1], [body.turns for body in bodies]),
    )
    return assembly, basis


def _square(values: Any) -> Array:
    """Matrix (3, 3) of three numbers along the axes, or of a matrix."""
    given = np.asarray(values, dtype=np.float64)
    return np.diag(given) if given.ndim == 1 else given


def _symmetric(bearing: Bearing) -> Bearing:
    """Return what of a bearing is symmetric, after checks."""
    between = f"the bearing between {bearing.first} and {bearing.second or 'the ground'}"
    for label in ("stiffness", "damping"):
        matrix = np.asarray(getattr(bearing, label), dtype=np.float64)
        if matrix.shape != (3, 3) or not np.isfinite(matrix).all():
            raise UserError(f"{between} needs a {label} of shape (3, 3) that is finite")
    stiffness, damping = (
        symmetric_and_skew(np.asarray(part, dtype=np.float64))[0]
        for part in (bearing.stiffness, bearing.damping)
    )
    rates = np.linalg.eigvalsh(damping)
    if rates[0] < -1e-9 * np.abs(rates).max():
        raise UserError(f"{between} has a damping that is negative in some direction")
    return Bearing(bearing.first, bearing.second, stiffness, damping)


def _joined(offsets: np.ndarray, parts: list[np.ndarray]) -> np.ndarray:
    return np.concatenate([offset + part for offset, part in zip(offsets, parts, strict=True)])


def _apart(bodies: Sequence[Model], inputs: Array, first: Place, second: Place | None) -> Array:
    """Columns (n, 3) that give the displacement of one place relative to another, or to the ground."""
    columns = _columns(bodies, inputs, first)
    return columns if second is None else columns - _columns(bodies, inputs, second)


def _columns(bodies: Sequence[Model], inputs: Array, place: Place) -> Array:
    if not 0 <= place.body < len(bodies):
        raise UserError(f"there is no body {place.body}; the assembly has {len(bodies)}, counted from 0")
    widths = [body.inputs.shape[1] for body in bodies]
    if not 0 <= place.node < widths[place.body] // 3:
        raise UserError(
            f"the body {bodies[place.body].name} has no interface node {place.node}; it has "
            f"{widths[place.body] // 3}, counted from 0"
        )
    start = sum(widths[: place.body]) + 3 * place.node
    return inputs[:, start : start + 3]


def _check_link(link: Link) -> None:
    numbers = np.array([*link.stiffness, *link.damping])
    if numbers.shape != (6,) or not np.isfinite(numbers).all() or (numbers < 0).any():
        raise UserError(
            f"the link between {link.first} and {link.second or 'the ground'} needs three stiffnesses and "
            "three dampings that are finite and at least 0"
        )


def _compatible(bodies: Sequence[Model], inputs: Array, joints: Sequence[Joint], name: str) -> Array:
    """Basis (n, n - c) of the motions that the rigid connections allow."""
    if not joints:
        return np.eye(len(inputs))
    for joint in joints:
        if not joint.directions or not set(joint.directions) <= {0, 1, 2}:
            raise UserError(f"a joint has directions {joint.directions}; they are among 0, 1, 2 for x, y, z")
    rows = [_apart(bodies, inputs, joint.first, joint.second)[:, list(joint.directions)] for joint in joints]
    constraints = np.hstack(rows)
    orthogonal, triangle, _ = scipy.linalg.qr(constraints, pivoting=True)
    size = np.abs(np.diag(triangle))
    if constraints.shape[1] > len(inputs) or size[-1] <= _DEPENDENT * size[0]:
        raise UserError(f"the joints of {name} are dependent: one of them repeats what others hold already")
    allowed: Array = orthogonal[:, constraints.shape[1] :]
    return allowed
