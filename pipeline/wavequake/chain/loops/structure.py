"""A structure that carries mirrors: modes by name, what they move, and what moves them."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator, model_validator
from scipy.linalg import expm

from wavequake.campaign.schema import Section
from wavequake.chain.loops.design import Shaken
from wavequake.control.sampled.channel import Dynamics, recoil
from wavequake.errors import UserError
from wavequake.mechanics.disturbances.layout import SegmentLayout
from wavequake.mechanics.disturbances.sources.edge_sensors import planar_axes, segment_radius
from wavequake.optics.derivatives.central import DOFS
from wavequake.optics.polynomials.zernike import annular_zernike_gradient
from wavequake.optics.segments.telescope import M2
from wavequake.optics.systems.system import States

Array = NDArray[np.float64]
NollIndex = Annotated[int, Field(ge=2, le=231, strict=False)]
Dof = Literal["dx", "dy", "dz", "rx", "ry", "rz"]

# nm and nrad to mm and rad.
UNITS = np.repeat([1e-6, 1e-9], 3)
_WHOLE = 1e-9


class ModeSection(Section):
    """A mode of the structure that carries the segments."""

    name: str = Field(
        pattern=r"^[A-Za-z0-9][A-Za-z0-9_. -]*$", description="of the mode in tables, figures and messages"
    )
    hz: float = Field(ge=1e-6, le=1e6, description="eigenfrequency of the mode, undamped")
    zeta: float = Field(gt=0, lt=1, description="damping ratio")
    share: float = Field(
        ge=0, le=1, description="of the mirror's static response in the direction of its shape"
    )
    rms_nm: float = Field(
        default=0.0, ge=0, le=1e12, description="of the surface, shaken by wind and machines"
    )
    zernike: dict[NollIndex, float] = Field(
        description="its shape over the mirror: Noll coefficients over the circle about it, in any unit"
    )


class CarryingMode(ModeSection):
    """A mode of the structure that carries M1 and M2; its size is the rms of M1's surface, nm.

    A mode that does not move M1 has the size in which `m2` and `nodes` are given.
    """

    share: float = Field(
        default=0.0,
        ge=0,
        le=1,
        description="mass of the segments over the modal mass: what moves them by 1 nm"
        " along its shape, fast, moves it by so much to the other side",
    )
    zernike: dict[NollIndex, float] = Field(
        default_factory=dict,
        description="its shape over M1: Noll coefficients over the circle about it, in any unit",
    )
    m2: dict[Dof, float] = Field(
        default_factory=dict,
        description="how M2 moves with it, nm and nrad per nm, as { dx = 2.0, ry = 0.5 }",
    )
    pushed: dict[Dof, float] = Field(
        default_factory=dict,
        description="by how many nm it gives way when M2 is moved fast by 1 nm or nrad: for translations the "
        "mass of M2 over the modal mass, times its entry in m2",
    )
    nodes: dict[str, float] = Field(
        default_factory=dict,
        description="how points of the structure move with it, nm per nm, by names that sensors can take",
    )

    @field_validator("nodes")
    @classmethod
    def _nodes_have_names(cls, value: dict[str, float]) -> dict[str, float]:
        if not all(value):
            raise ValueError("a node needs a name")
        return value

    @model_validator(mode="after")
    def _moves_something(self) -> "CarryingMode":
        shown = (*self.zernike.values(), *self.m2.values(), *self.nodes.values())
        if not any(shown):
            raise ValueError(f"the mode {self.name!r} moves nothing; give zernike, m2 or nodes")
        if self.share and not any(self.zernike.values()):
            raise ValueError(
                f"the mode {self.name!r} has a share of M1, which it does not move; give zernike"
            )
        return self


def zernike_motion(layout: SegmentLayout, radius: Array, shapes: Sequence[Mapping[int, float]]) -> Array:
    """Return piston and slopes times `radius` (S,) of each segment that follows shapes, (N, S, 3)."""
    outer = float(np.linalg.norm(layout.corners_m, axis=2).max())
    x, y = layout.centers_m[:, :2].T / outer
    terms = max(max(one) for one in shapes)
    values, by_x, by_y = annular_zernike_gradient(x, y, terms, 0.0)
    slopes = np.einsum("sij,isn->sjn", planar_axes(layout), np.stack([by_x, by_y])) / outer
    found = []
    for one in shapes:
        size = np.zeros(terms)
        size[[noll - 1 for noll in one]] = list(one.values())
        found.append(np.concatenate([(values @ size)[:, None], (slopes @ size) * radius[:, None]], axis=1))
    return np.array(found)


@dataclass(frozen=True)
class Carrying:
    """Modes of a structure among what they move: dz, rx, ry of all segments, then M2; nm and nrad.

    Attributes
    ----------
    names : tuple of str
    moves : ndarray, shape (3 S + 6, K)
    answers : ndarray, shape (K, 3 S + 6)
        By how much each mode gives way to what is moved fast.
    at : ndarray, shape (N, K)
        How nodes move with modes.
    rms : ndarray, shape (K,)
        nm.
    hertz, zeta : ndarray, shape (K,)
    """

    names: tuple[str, ...]
    moves: Array
    answers: Array
    at: Array
    rms: Array
    hertz: Array
    zeta: Array

    @property
    def dynamics(self) -> tuple[Dynamics, ...]:
        """How each mode answers what moves along it."""
        return tuple(recoil(hertz, zeta) for hertz, zeta in zip(self.hertz, self.zeta, strict=True))

    def expected(self, shown: Array) -> Shaken:
        """Return those that are shaken, by what is seen (N, K) per nm of all."""
        kept = np.flatnonzero(self.rms)
        names = tuple(self.names[k] for k in kept)
        return Shaken(names, self.hertz[kept], self.zeta[kept], shown[:, kept] * self.rms[kept])

    def put(self, states: States, positions: Array) -> None:
        """Add positions of the modes (batch, K) to the first instants of a telescope's states."""
        count, segments = len(positions), states.segment_motion.shape[1]
        moved = positions @ self.moves.T
        local = moved[:, : 3 * segments].reshape(count, 3, segments)
        states.segment_motion[:count, :, 2:5] += np.swapaxes(local, 1, 2) * UNITS[2:5]
        states.surface_motion[:count, M2] += moved[:, 3 * segments :] * UNITS

    def shaken(self, time: Array, random: Sequence[np.random.Generator]) -> Array:
        """Draw modes (n, K) that white forces shake, at rising instants, nm; exact at any steps."""
        found = np.zeros((len(time), len(self.names)))
        steps = np.diff(time)
        for k, (rms, own) in enumerate(zip(self.rms, random, strict=True)):
            if not rms:
                continue
            mode = recoil(float(self.hertz[k]), float(self.zeta[k]))
            # States x and x' / w have equal variances, whatever the damping.
            drawn = own.standard_normal((len(time), 2))
            state = drawn[0]
            found[0, k] = rms * state[0]
            for step, values in enumerate(_steps(mode.a, steps)):
                phi, root = values
                state = phi @ state + root @ drawn[step + 1]
                found[step + 1, k] = rms * state[0]
        return found


def _steps(a: Array, steps: Array) -> list[tuple[Array, Array]]:
    """Return the exact step of an oscillator of unit variance, and the root of its noise, for every step."""
    kept: dict[float, tuple[Array, Array]] = {}
    found = []
    for one in np.round(steps / steps.max(), 12) * steps.max():
        if one not in kept:
            phi = expm(a * one)
            values, vectors = np.linalg.eigh(np.eye(len(a)) - phi @ phi.T)
            kept[one] = phi, vectors * np.sqrt(np.maximum(values, 0.0))
        found.append(kept[one])
    return found


def carrying(modes: Sequence[CarryingMode], layout: SegmentLayout) -> Carrying:
    """Return the modes of a structure among what they move.

    Raises
    ------
    UserError
        If they give way by more than what is moved.
    """
    segments, radius = len(layout), segment_radius(layout)
    nodes = node_names(modes)
    moves, answers = np.zeros((3 * segments + 6, len(modes))), np.zeros((len(modes), 3 * segments + 6))
    at = np.zeros((len(nodes), len(modes)))
    for k, one in enumerate(modes):
        if any(one.zernike.values()):
            piston, x_slope, y_slope = zernike_motion(layout, radius, [_about_one(one.zernike)])[0].T
            size = np.sqrt(np.mean(piston**2 + x_slope**2 + y_slope**2))
            # z = slope_x x + slope_y y is the rotation (slope_y, -slope_x).
            moved = np.concatenate([piston, y_slope / radius, -x_slope / radius]) / size
            weight = np.concatenate([np.ones(segments), radius**2, radius**2]) / segments
            moves[: 3 * segments, k] = moved
            answers[k, : 3 * segments] = one.share * weight * moved
        for dof, value in one.m2.items():
            moves[3 * segments + DOFS.index(dof), k] = value
        for dof, value in one.pushed.items():
            answers[k, 3 * segments + DOFS.index(dof)] = value
        for name, value in one.nodes.items():
            at[nodes.index(name), k] = value
    if len(modes):
        largest = float(np.linalg.eigvals(answers @ moves).real.max())
        if largest > 1.0 + _WHOLE:
            raise UserError(
                f"The modes of the structure together give way by {largest:.4g} of what is moved; lower "
                "share or pushed, so that it is 1 or less."
            )
    hertz, zeta, rms = (np.array([getattr(one, key) for one in modes]) for key in ("hz", "zeta", "rms_nm"))
    return Carrying(tuple(one.name for one in modes), moves, answers, at, rms, hertz, zeta)


def _about_one(shape: Mapping[int, float]) -> dict[int, float]:
    """Return a shape whose largest coefficient is about 1: its squares are numbers, and it keeps its bits."""
    power = math.frexp(max(map(abs, shape.values())))[1]
    return {noll: math.ldexp(value, -power) for noll, value in shape.items()}


def node_names(modes: Sequence[CarryingMode]) -> tuple[str, ...]:
    """Return the nodes of a structure by name."""
    return tuple(dict.fromkeys(name for one in modes for name in one.nodes))
