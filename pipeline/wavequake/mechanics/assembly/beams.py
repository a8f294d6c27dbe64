"""A structure of straight beams: Euler and Bernoulli's, with round hollow sections. SI units.

Nodes have three displacements and three rotations. Stiffness and consistent mass are those of cubic bending,
linear stretching and linear twisting (Przemieniecki, Theory of Matrix Structural Analysis, 1968, chapters 5
and 11), so a member is exact under loads at its ends.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.sparse import csc_array

from wavequake.errors import UserError
from wavequake.mechanics.mirrors.material import Material
from wavequake.mechanics.model import Array, FiniteElementModel, RayleighDamping

# Of shifts and turns at both ends, the turns times the length.
_BEND = np.array(
    [[12.0, 6.0, -12.0, 6.0], [6.0, 4.0, -6.0, 2.0], [-12.0, -6.0, 12.0, -6.0], [6.0, 2.0, -6.0, 4.0]]
)
_BEND_MASS = np.array(
    [
        [156.0, 22.0, 54.0, -13.0],
        [22.0, 4.0, 13.0, -3.0],
        [54.0, 13.0, 156.0, -22.0],
        [-13.0, -3.0, -22.0, 4.0],
    ]
)
_BEND_MASS /= 420.0
_LINE, _LINE_MASS = np.array([[1.0, -1.0], [-1.0, 1.0]]), np.array([[2.0, 1.0], [1.0, 2.0]]) / 6.0


@dataclass(frozen=True)
class Tube:
    """A round hollow section: outer diameter and wall thickness, m."""

    diameter: float
    wall: float

    def __post_init__(self) -> None:
        if not 0.0 < self.wall <= self.diameter / 2.0:
            raise UserError(
                f"a tube of {self.diameter} m diameter cannot have a wall of {self.wall} m; it lies "
                "between 0 and half the diameter"
            )

    @property
    def area(self) -> float:
        """Area of the section, m^2."""
        return math.pi * self.wall * (self.diameter - self.wall)

    @property
    def bending(self) -> float:
        """Second moment of area about any axis across, m^4; twisting has twice as much."""
        inner = self.diameter - 2.0 * self.wall
        return math.pi / 64.0 * (self.diameter**4 - inner**4)


def beam_frame(
    name: str,
    nodes: Mapping[str, Array],
    members: Sequence[tuple[str, str]],
    section: Tube,
    material: Material,
    pieces: int = 1,
    masses: Mapping[str, float] | None = None,
) -> FiniteElementModel:
    """Return the free model of a frame whose members are welded at its nodes.

    Parameters
    ----------
    nodes : mapping of str to ndarray of shape (3,)
        m; they are the interfaces of the model, in this order.
    members : sequence of (str, str)
        Which nodes a beam joins.
    section : Tube
    material : Material
    pieces : int
        Elements along a member.
    masses : mapping of str to float, optional
        kg at nodes, beside those of the members.

    Raises
    ------
    UserError
        If a member leads nowhere, has no length or is given twice, or a node belongs to no member.
    """
    points, pairs = _mesh(name, nodes, members, pieces)
    count = len(points)
    stiffness, mass = _assembled(points, pairs, section, material)
    for label, extra in (masses or {}).items():
        if label not in nodes:
            raise UserError(f"the frame {name!r} has a mass at {label!r}, which is no node of it")
        place = 6 * list(nodes).index(label)
        mass[place : place + 3, place : place + 3] += extra * np.eye(3)
    named = np.arange(len(nodes))
    return FiniteElementModel(
        name=name,
        mass=csc_array(mass),
        stiffness=csc_array(stiffness),
        damping=RayleighDamping(0.0, 0.0),
        nodes=points,
        dof_node=np.repeat(np.arange(count), 6),
        dof_direction=np.tile(np.arange(6), count),
        interfaces=named,
        surface_nodes=named,
        surface_weights=np.full(len(named), 1.0 / len(named)),
    )


def _mesh(
    name: str, nodes: Mapping[str, Array], members: Sequence[tuple[str, str]], pieces: int
) -> tuple[Array, list[tuple[int, int]]]:
    """Return all points, the named ones first, and the ends of all elements."""
    index = {label: number for number, label in enumerate(nodes)}
    points, pairs, seen = [np.asarray(one, dtype=np.float64) for one in nodes.values()], [], set()
    for member in members:
        for label in member:
            if label not in index:
                raise UserError(f"a beam of the frame {name!r} leads to {label!r}, which is no node of it")
        first, last = (index[label] for label in member)
        between = f"the beam from {member[0]!r} to {member[1]!r} of the frame {name!r}"
        if np.linalg.norm(points[last] - points[first]) <= 0.0:
            raise UserError(f"{between} has no length")
        if frozenset(member) in seen:
            raise UserError(f"{between} is given twice")
        seen.add(frozenset(member))
        chain = [first, *range(len(points), len(points) + pieces - 1), last]
        steps = np.arange(1, pieces)[:, None] / pieces
        points += list(points[first] + steps * (points[last] - points[first]))
        pairs += list(pairwise(chain))
    lonely = set(range(len(nodes))) - {end for pair in pairs for end in pair}
    if lonely:
        raise UserError(f"no beam of the frame {name!r} reaches its node {list(nodes)[min(lonely)]!r}")
    return np.array(points), pairs


def _assembled(
    points: Array, pairs: Sequence[tuple[int, int]], section: Tube, material: Material
) -> tuple[Array, Array]:
    size = 6 * len(points)
    stiffness, mass = np.zeros((size, size)), np.zeros((size, size))
    for first, last in pairs:
        along = points[last] - points[first]
        length = float(np.linalg.norm(along))
        axes = np.kron(np.eye(4), _axes(along / length))
        places = np.concatenate([6 * first + np.arange(6), 6 * last + np.arange(6)])
        local = _element(length, section, material)
        for whole, part in zip((stiffness, mass), local, strict=True):
            whole[np.ix_(places, places)] += axes.T @ part @ axes
    return stiffness, mass


def _axes(along: Array) -> Array:
    """Return the axes of a beam as rows, the first one along it."""
    across = np.eye(3)[int(np.argmin(np.abs(along)))]
    second = np.cross(along, across)
    second /= np.linalg.norm(second)
    return np.array([along, second, np.cross(along, second)])


def _element(length: float, section: Tube, material: Material) -> tuple[Array, Array]:
    """Return stiffness and mass (12, 12) in the beam's axes: x, y, z, and turns about them, at both ends."""
    shear = material.lame[1]
    stiffness, mass = np.zeros((12, 12)), np.zeros((12, 12))
    line, density = material.density * section.area * length, material.density
    for places, modulus, weight in (
        ([0, 6], material.young * section.area, line),
        ([3, 9], shear * 2.0 * section.bending, density * 2.0 * section.bending * length),
    ):
        stiffness[np.ix_(places, places)] += modulus / length * _LINE
        mass[np.ix_(places, places)] += weight * _LINE_MASS
    # Shifts along y turn about +z, those along z about -y.
    for places, sign in (([1, 5, 7, 11], 1.0), ([2, 4, 8, 10], -1.0)):
        scale = np.diag([1.0, sign * length, 1.0, sign * length])
        bend = material.young * section.bending / length**3
        stiffness[np.ix_(places, places)] += bend * scale @ _BEND @ scale
        mass[np.ix_(places, places)] += line * scale @ _BEND_MASS @ scale
    return stiffness, mass
