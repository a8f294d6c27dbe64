"""Integrators for the modes of a mirror on a structure that moves with it: stability and sensitivity.

Every mode of the mirror has a gain. The structure takes part in some directions only: of modes that share a
gain those directions matter one by one, and all others are one loop of one channel. So the loop of 1473 modes
and a dozen structure modes has a few hundred states, and errors of the interaction matrix, which mix all
modes, change a determinant of a dozen rows.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from wavequake.control.linear import Array, LinearModel, frequency_response
from wavequake.control.sampled.channel import Dynamics, Timing, in_series, sampled_channel, second_order
from wavequake.control.sampled.filters import integrator
from wavequake.errors import UserError

Complex = NDArray[np.complex128]
_SAME = 1e-10
# Arguments of the determinant that turn farther in a step are followed more closely.
_TURN, _PASSES = 0.7, 14


@dataclass(frozen=True)
class Structure:
    """Modes of a structure, of which a mirror's motion has a share.

    Attributes
    ----------
    hertz, zeta : ndarray, shape (K,)
    shares : ndarray, shape (K,)
        Of the static response in the direction of a mode: 0 to 1.
    shapes : ndarray, shape (M, K)
        Unit vectors among the modes of the mirror.
    """

    hertz: Array
    zeta: Array
    shares: Array
    shapes: Array


@dataclass(frozen=True)
class FlexibleLoop:
    """Integrators u = u - g z of M modes, whose mean readings by periods are those of positions P u.

    P = A(s) (1 - sum k p p' + sum k p p' w^2 / (s^2 + 2 zeta w s + w^2)), A the actuators, k the shares and
    p the shapes of the structure, so that statically P = 1.

    Attributes
    ----------
    timing : Timing
    dynamics : Dynamics
        A.
    gains : ndarray, shape (M,)
    leak : float
    structure : Structure
    """

    timing: Timing
    dynamics: Dynamics
    gains: Array
    leak: float
    structure: Structure

    def __post_init__(self) -> None:
        shapes = self.structure.shapes * np.sqrt(self.structure.shares)
        size = float(np.linalg.svd(shapes, compute_uv=False).max(initial=0.0) ** 2)
        if size > 1.0 + _SAME:
            raise UserError(
                f"The structure's modes together have {size:.4g} of the static response in one direction "
                "of the mirror; lower their shares to 1 or less."
            )


@dataclass(frozen=True)
class Reduced:
    """What matters one by one of a loop, and what is alike.

    Attributes
    ----------
    loop : FlexibleLoop
        Of N directions, its gains and shapes those along them.
    basis : ndarray, shape (M, N)
        The directions, orthonormal, each of modes of one gain.
    gains : ndarray, shape (G,)
        Of the loops of one channel.
    groups : tuple of ndarray of int
        Modes of each of them.
    """

    loop: FlexibleLoop
    basis: Array
    gains: Array
    groups: tuple[NDArray[np.intp], ...]


def reduced(loop: FlexibleLoop) -> Reduced:
    """Return the directions in which the structure takes part, by gains."""
    distinct, which = np.unique(loop.gains, return_inverse=True)
    groups = tuple(np.flatnonzero(which == one) for one in range(len(distinct)))
    columns, gains = [], []
    for group, gain in zip(groups, distinct, strict=True):
        left, values, _ = np.linalg.svd(loop.structure.shapes[group], full_matrices=False)
        kept = left[:, values > _SAME]
        wide = np.zeros((len(loop.gains), kept.shape[1]))
        wide[group] = kept
        columns.append(wide)
        gains += [gain] * kept.shape[1]
    basis = np.hstack(columns)
    small = replace(loop.structure, shapes=basis.T @ loop.structure.shapes)
    return Reduced(replace(loop, gains=np.array(gains), structure=small), basis, distinct, groups)


def channels(loop: FlexibleLoop) -> tuple[LinearModel, ...]:
    """Return one channel by periods without the structure, then through each of its modes."""
    modes = zip(loop.structure.hertz, loop.structure.zeta, strict=True)
    through = (in_series(loop.dynamics, second_order(hertz, zeta)) for hertz, zeta in modes)
    return tuple(sampled_channel(one, loop.timing) for one in (loop.dynamics, *through))


def flexible_plant(loop: FlexibleLoop) -> LinearModel:
    """Return P by periods, of the modes of a loop (few, as `reduced` has them)."""
    rigid, *through = channels(loop)
    shapes, unit = loop.structure.shapes, np.eye(len(loop.gains))
    share = shapes * loop.structure.shares
    return LinearModel(
        block_diag(np.kron(unit, rigid.a), *(one.a for one in through)),
        np.vstack(
            [np.kron(unit, rigid.b), *(one.b @ row[None] for one, row in zip(through, shapes.T, strict=True))]
        ),
        np.hstack(
            [
                (unit - share @ shapes.T) @ np.kron(unit, rigid.c),
                *(column[:, None] @ one.c for one, column in zip(through, share.T, strict=True)),
            ]
        ),
        np.zeros(unit.shape),
        loop.timing.period,
    )


def flexible_controller(loop: FlexibleLoop) -> LinearModel:
    """Return H of u = -H y by periods."""
    one, unit = integrator(1.0, loop.leak), np.eye(len(loop.gains))
    gains = np.diag(loop.gains)
    return LinearModel(one.a * unit, unit, -one.c * one.b * gains, -one.d * gains, loop.timing.period)


def closed_matrix(plant: LinearModel, controller: LinearModel) -> Array:
    """Return the step of plant and u = -H y together."""
    return np.block(
        [
            [plant.a - plant.b @ controller.d @ plant.c, -plant.b @ controller.c],
            [controller.b @ plant.c, controller.a],
        ]
    )


def poles(found: Reduced) -> Complex:
    """Return the poles by periods of a loop, those of equal channels once."""
    loop = found.loop
    several = np.linalg.eigvals(closed_matrix(flexible_plant(loop), flexible_controller(loop))).astype(
        complex
    )
    return np.concatenate([several, _scalar_poles(loop, found.gains.astype(complex)).ravel()])


def _scalar_poles(loop: FlexibleLoop, gains: Complex) -> Complex:
    """Return the poles (g, n) of loops of one channel without the structure."""
    plant, own = sampled_channel(loop.dynamics, loop.timing), integrator(1.0, loop.leak)
    g = gains[:, None, None]
    top = np.concatenate([plant.a + g * (plant.b @ own.d @ plant.c), g * (plant.b @ own.c)], axis=2)
    below = np.broadcast_to(np.hstack([own.b @ plant.c, own.a]), (len(gains), 1, plant.a.shape[0] + 1))
    return np.asarray(np.linalg.eigvals(np.concatenate([top, below], axis=1)), dtype=np.complex128)


@dataclass(frozen=True)
class Response:
    """A loop over frequency: of N directions, and of each group's other ones.

    Attributes
    ----------
    sensitivity : ndarray of complex, shape (f, N, N)
        What is left of mean readings.
    gain : ndarray of complex, shape (f, N, N)
        The loop gain.
    others : ndarray of complex, shape (f, G)
        Loop gain of one channel, by groups.
    """

    sensitivity: Complex
    gain: Complex
    others: Complex


def response(found: Reduced, hertz: Array) -> Response:
    """Return a loop at some frequencies (f,) in Hz."""
    loop, omega = found.loop, 2 * np.pi * hertz
    rigid, *through = (frequency_response(one, omega)[:, 0, 0] for one in channels(loop))
    shapes, unit = loop.structure.shapes, np.eye(len(loop.gains))
    own = _integrating(loop, hertz)
    plant: Complex = np.asarray(rigid[:, None, None] * unit, dtype=np.complex128)
    for size, share, shape in zip(through, loop.structure.shares, shapes.T, strict=True):
        plant = plant + (share * (size - rigid))[:, None, None] * np.outer(shape, shape)
    gain = (own[:, None] * loop.gains)[:, None, :] * plant
    left = np.asarray(np.linalg.inv(unit + gain), dtype=np.complex128)
    return Response(left, gain, (own * rigid)[:, None] * found.gains)


def _integrating(loop: FlexibleLoop, hertz: Array) -> Complex:
    z = np.exp(2j * np.pi * hertz * loop.timing.period)
    return np.asarray(z / (z - (1.0 - loop.leak)))


@dataclass(frozen=True)
class MixedLoop:
    """A loop whose interaction matrix has errors: modes that are commanded are read as others, too.

    Attributes
    ----------
    loop : FlexibleLoop
        As it was designed.
    values : ndarray of complex, shape (M,)
        Eigenvalues of the gains times the interaction of modes.
    residues : ndarray of complex, shape (M, K, K)
        Of each eigenvalue: the structure's shapes seen through its vectors.
    """

    loop: FlexibleLoop
    values: Complex
    residues: Complex


def mixed(loop: FlexibleLoop, interaction: Array) -> MixedLoop:
    """Decompose a loop whose modes are read through an interaction matrix (M, M)."""
    values, vectors = np.linalg.eig(loop.gains[:, None] * interaction)
    shapes = loop.structure.shapes
    left, right = shapes.T @ vectors, np.linalg.solve(vectors, shapes.astype(vectors.dtype))
    residues = np.einsum("km,mj->mkj", left, right)
    return MixedLoop(loop, values.astype(complex), residues.astype(complex))


def mixed_is_stable(found: MixedLoop, factor: float = 1.0) -> bool:
    """Return whether a loop is stable with all its gains times a factor.

    Without the structure it is as many loops of one channel as there are eigenvalues. The structure
    multiplies the characteristic polynomial by a determinant of K rows; its turns about 0 along the circle
    count what grows.
    """
    loop, values = found.loop, factor * found.values
    if np.abs(_scalar_poles(loop, values)).max() >= 1.0:
        return False
    if not len(loop.structure.hertz):
        return True
    rigid, *through = channels(loop)
    size, shares = len(found.residues[0]), loop.structure.shares
    flat = found.residues.reshape(len(values), -1)

    def determinant(hertz: Array) -> Complex:
        omega = 2 * np.pi * hertz
        base, *modes = (frequency_response(one, omega)[:, 0, 0] for one in (rigid, *through))
        # At 0 Hz an integrator without leak is infinite, and what it leads to is not.
        driven = _integrating(loop, hertz)[:, None] * values
        inner = ((driven / (1.0 + base[:, None] * driven)) @ flat).reshape(-1, size, size)
        change = shares * (np.array(modes).T - base[:, None])
        return np.asarray(np.linalg.det(np.eye(size) + change[:, :, None] * inner), dtype=np.complex128)

    return _turns(determinant, _about(loop)) == 0


def _about(loop: FlexibleLoop) -> Array:
    """Return rising frequencies up to half the rate of commands, closer about the structure's modes."""
    high = 0.5 / loop.timing.period
    found = [np.linspace(1e-6 * high, high, 300), np.geomspace(1e-4 * high, high, 100)]
    for hertz, zeta in zip(loop.structure.hertz, loop.structure.zeta, strict=True):
        folded = abs((hertz + high) % (2 * high) - high)
        found.append(folded + hertz * zeta * np.array([-8, -4, -2, -1, -0.5, 0, 0.5, 1, 2, 4, 8]))
    grid = np.concatenate(found)
    return np.unique(grid[(grid > 0) & (grid <= high)])


def _turns(function: Callable[[Array], Complex], grid: Array) -> int:
    """Return how often a function turns about 0 along a circle; half suffices, it is real at both ends."""
    values = function(grid)
    for _ in range(_PASSES):
        turn = np.angle(values[1:] / values[:-1])
        wide = np.flatnonzero(np.abs(turn) > _TURN)
        if not len(wide):
            break
        between = 0.5 * (grid[wide] + grid[wide + 1])
        grid, values = np.insert(grid, wide + 1, between), np.insert(values, wide + 1, function(between))
    return round(float(np.angle(values[1:] / values[:-1]).sum()) / np.pi)
