"""Second-order IRKA: tangential interpolation at the mirror images of the reduced model's own poles.

The fixed point of Gugercin, Antoulas and Beattie 2008 in its second-order, symmetric form (SOR-IRKA, Wyatt
2012): of the reduced modes those of the largest residue over damping give pole pairs, and each pair gives two
real columns; the last one of an odd number interpolates at the pair's absolute value. It runs on elastic
modal coordinates, where a solve is a division; rigid motions are split off.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from wavequake.errors import UserError
from wavequake.mechanics.model import Array
from wavequake.reduction.method import Method, Variant, register
from wavequake.reduction.methods.balanced import check_damping, oscillators
from wavequake.reduction.structure import Structure, elastic_modes

_ITERATIONS = 300
_SETTLED = 30
_CHANGE = 1e-6
Complex = NDArray[np.complex128]


def irka(body: Structure, count: int) -> Array:
    """Return the basis at the fixed point, shape (n, count).

    Raises
    ------
    UserError
        If the shifts have not settled after 300 iterations.
    """
    squared, dampings, inputs = oscillators(body)
    shapes = elastic_modes(body, len(squared))[1]
    if count > len(squared):
        raise UserError(f"The model {body.name} has only {len(squared)} elastic coordinates.")
    pairs = (count + 1) // 2
    shifts, directions = _dominant(squared, dampings, inputs, pairs)
    change = np.inf
    for iteration in range(_ITERATIONS):
        basis = _interpolating(squared, dampings, inputs, shifts, directions, count)
        reduced, turn = np.linalg.eigh((basis.T * squared) @ basis)
        rates = body.damping.mass + body.damping.stiffness * reduced
        driven = turn.T @ (basis.T @ inputs)
        # Dominant modes that take turns would go round for ever: follow those of the first iterations, and
        # where they still swing, go part of the way only. The fixed point is the same.
        follow = shifts if iteration >= _SETTLED else None
        wanted, ways = _dominant(reduced, rates, driven, pairs, follow)
        change = float(np.abs(wanted - shifts).max() / np.abs(shifts).max())
        if change < _CHANGE:
            return shapes @ basis
        part = 1.0 if iteration < 2 * _SETTLED else 0.3
        ways = np.where(np.sum(ways * directions, axis=1) < 0, -1.0, 1.0)[:, None] * ways
        shifts, directions = shifts + part * (wanted - shifts), directions + part * (ways - directions)
    raise UserError(
        f"IRKA of {count} elastic coordinates of the model {body.name} did not converge: after {_ITERATIONS} "
        f"iterations the shifts still change by {change:.1e}; choose another order, bt or flbt."
    )


def _dominant(
    squared: Array, dampings: Array, inputs: Array, pairs: int, follow: Complex | None = None
) -> tuple[Complex, Array]:
    """Return the mirrored poles and the directions of the modes that resonate most, by rising frequency.

    With `follow`, of those modes that are nearest to former shifts.
    """
    half = dampings / 2
    shifts = half + np.sqrt((half**2 - squared).astype(complex))
    if follow is None:
        strength = np.einsum("ij,ij->i", inputs, inputs) / (dampings * squared)
        chosen = np.sort(np.argsort(-strength, kind="stable")[:pairs])
    else:
        chosen = linear_sum_assignment(np.abs(follow[:, None] - shifts))[1]
    return shifts[chosen], inputs[chosen]


def _interpolating(
    squared: Array, dampings: Array, inputs: Array, shifts: Complex, directions: Array, count: int
) -> Array:
    """Orthonormal columns of the real and imaginary parts of the tangential solutions."""
    if count % 2:
        # The last one gives one column only: a real shift has no imaginary part to leave out.
        shifts = np.append(shifts[:-1], abs(shifts[-1]))
    solutions = (inputs @ directions.T) / (squared[:, None] + dampings[:, None] * shifts + shifts**2)
    columns = np.stack([solutions.real, solutions.imag], axis=2).reshape(len(squared), -1)[:, :count]
    return np.linalg.qr(columns / np.linalg.norm(columns, axis=0))[0]


def _basis(body: Structure, _: Variant, count: int) -> Array:
    return irka(body, count)


register(Method("irka", _basis, dense=True, check=check_damping))
