"""The intermediate model: one rich basis per model from which variants are made by dense algebra.

It holds constraint modes, fixed- and free-interface modes and Krylov vectors at points spread over the band.
Its coordinates are the interface displacements and mass-normalized shapes with the interface at rest, so that
a dense `Structure` is made of it and every method works on it unchanged.
"""

import time
from dataclasses import dataclass, field

import numpy as np

from wavequake.errors import UserError
from wavequake.mechanics.model import NONE, Array, FiniteElementModel, Integers, RayleighDamping
from wavequake.mechanics.vibration.factors import LARGE
from wavequake.reduction.directions import orthonormalize
from wavequake.reduction.methods.component_modes import constraint_modes
from wavequake.reduction.methods.krylov import krylov
from wavequake.reduction.structure import (
    Structure,
    elastic_modes,
    fixed_modes,
    held,
    kept_with,
    structure,
)


@dataclass(frozen=True, eq=False)
class Intermediate:
    """A model of some 200-400 coordinates from which variants are made; plain arrays, to be stored.

    Attributes
    ----------
    name : str
    mass, stiffness : ndarray, shape (r, r)
        The first 3 k coordinates are the interface displacements.
    damping : RayleighDamping
    rigid : ndarray, shape (r, 0..6)
        Rigid motions, mass-orthonormal.
    surface : ndarray, shape (3 p, r)
    nodes, interfaces, surface_nodes, surface_weights, turns
        As in the full model.
    modes : int
        Fixed-interface modes, and as many free-interface modes, that the basis holds.
    highest : float
        Upper end of the band that the basis covers, Hz.
    full_order : int
        Degrees of freedom of the full model.
    seconds : float
        Time of building.
    """

    name: str
    mass: Array
    stiffness: Array
    damping: RayleighDamping
    rigid: Array
    surface: Array
    nodes: Array
    interfaces: Integers
    surface_nodes: Integers
    surface_weights: Array
    modes: int
    highest: float
    full_order: int
    seconds: float
    turns: Integers = field(default_factory=lambda: NONE)

    @property
    def order(self) -> int:
        """Number of coordinates."""
        return len(self.mass)


def intermediate(model: FiniteElementModel, modes: int = 108, highest: float = 1200.0) -> Intermediate:
    """Return the intermediate model; heavy, once per model.

    Parameters
    ----------
    model : FiniteElementModel
    modes : int
        Fixed-interface modes, and free-interface modes; fewer where the model has fewer.
    highest : float
        Frequency in Hz up to which the basis shall be exact to about 1e-9.

    Raises
    ------
    UserError
        If the interface nodes do not hold the body (fewer than three, or on a line), or `highest` is not
        positive.
    """
    start = time.perf_counter()
    if not 0 < highest < np.inf or modes < 1:
        raise UserError(
            f"An intermediate model needs a positive highest frequency and at least one mode, not {highest} "
            f"Hz and {modes}."
        )
    body = structure(model)
    held(body)
    interface = body.interface
    limit = (body.order - len(interface)) if body.is_dense else (body.order - len(interface)) // 2 - 1
    modes = min(modes, limit)
    inner = _inner_basis(body, modes, highest)
    static = constraint_modes(body, interface)
    basis = np.hstack([static, inner])
    mass, stiffness = basis.T @ (body.mass @ basis), basis.T @ (body.stiffness @ basis)
    coordinates = np.zeros((basis.shape[1], body.rigid.shape[1]))
    coordinates[: len(interface)] = body.rigid[interface]
    return Intermediate(
        name=model.name,
        mass=(mass + mass.T) / 2,
        stiffness=(stiffness + stiffness.T) / 2,
        damping=model.damping,
        rigid=coordinates,
        surface=model.surface @ basis,
        nodes=model.nodes,
        interfaces=model.interfaces,
        surface_nodes=model.surface_nodes,
        surface_weights=model.surface_weights,
        modes=modes,
        highest=highest,
        full_order=model.order,
        seconds=time.perf_counter() - start,
        turns=model.turns,
    )


def _inner_basis(body: Structure, modes: int, highest: float) -> Array:
    """Mass-orthonormal shapes with the interface at rest."""
    interface = body.interface
    fixed = fixed_modes(body, modes, interface)[1]
    # Shapes without mass are orthogonal to all others, so nothing at the interface moves them.
    fixed = fixed[:, np.einsum("ij,ij->j", fixed, body.mass @ fixed) > 0.5]
    free = elastic_modes(body, min(modes, body.order - body.rigid.shape[1]))[1]
    points = tuple(complex(highest * part) for part in (0.0, 0.25, 0.5, 0.75, 1.0))
    chosen = body.order if body.order <= 2 * modes else None
    # The factors of a large model fill the memory: one point after the other.
    turns = [points] if body.order < LARGE else [(point,) for point in points]
    chains = [krylov(body, None, turn, (4,) * len(turn)) for turn in turns if chosen is None]
    moments = np.hstack([free[:, :0], *chains])
    rest = np.hstack([free, moments])
    rest = rest - constraint_modes(body, interface) @ rest[interface]
    rest[interface] = 0.0
    return np.hstack([fixed, orthonormalize(body.mass, rest, fixed)])


def dense_structure(model: Intermediate) -> Structure:
    """Return the structure of an intermediate model, the same object while the model lives."""
    interface = np.arange(3 * len(model.interfaces))
    return kept_with(
        model,
        lambda: Structure(model.name, model.mass, model.stiffness, model.damping, interface, model.rigid),
    )
