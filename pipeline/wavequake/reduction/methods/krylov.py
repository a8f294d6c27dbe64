"""Moment matching: second-order Krylov subspaces at several expansion points (Salimbahrami 2005).

The moments of H(s) = B^T (K + s^2 M)^-1 B about s0 are matched by the chain X_1 = A B, X_j = A M X_(j-1) with
A = (K + s0^2 M)^-1; m blocks match 2 m derivatives with respect to s^2, because the projection is symmetric.
Damping is left out: with Rayleigh damping the damped and the undamped chain span nearly the same space, and
one real factorization is enough. Rigid motions are deflated from the inputs and kept exactly. Blocks are
orthogonalized against all before them: bare moments are dependent to working precision. Where the order cuts
a block, the directions that carry most of its moment are kept.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.mechanics.model import Array
from wavequake.reduction.directions import orthonormalize, turn_equal
from wavequake.reduction.method import Method, Variant, register
from wavequake.reduction.structure import Structure, shifted

# Where an order is filled, a direction of which so little is new gives way to the next moment.
_LITTLE = 1e-4


def krylov(
    body: Structure, count: int | None, points: tuple[complex, ...], moments: tuple[int, ...]
) -> Array:
    """Return a mass-orthonormal basis of frequency response modes, shape (n, count).

    Parameters
    ----------
    body : Structure
    count : int or None
        Columns; None takes all that `moments` gives. Without `moments`, the points take turns.
    points : tuple of complex
        Hz; see `wavequake.reduction.names`.
    moments : tuple of int
        Block moments of each point, or empty.

    Raises
    ------
    UserError
        If the points give fewer independent directions than `count`.
    """
    rigid = body.rigid.shape[1]
    wanted = body.order - rigid if count is None else count
    limits = moments or (wanted,) * len(points)
    least = 1e-8 if moments else _LITTLE
    basis = body.rigid
    chains = [np.zeros((body.order, 0)) for _ in points]
    latest = [body.inputs - body.mass @ (body.rigid @ body.rigid.T[:, body.interface]) for _ in points]
    shares: list[NDArray[Any]] = [np.eye(len(body.interface)) for _ in points]
    for level in range(max(limits)):
        grown = basis.shape[1]
        for place, point in enumerate(points):
            if level >= limits[place] or basis.shape[1] >= wanted + rigid or not latest[place].shape[1]:
                continue
            response = body.remove_rigid(
                shifted(body, point)(latest[place] if level == 0 else body.mass @ latest[place])
            )
            block = orthonormalize(body.mass, response, chains[place])
            shares[place] = block.conj().T @ (body.mass @ response) @ shares[place]
            shares[place] /= np.linalg.norm(shares[place]) or 1.0
            latest[place], chains[place] = block, np.hstack([chains[place], block])
            basis = np.hstack([basis, _sorted(body, *_real(block, shares[place]), basis, least)])
        if basis.shape[1] == grown or basis.shape[1] >= wanted + rigid:
            break
    if count is not None and basis.shape[1] < count + rigid:
        raise UserError(
            f"The expansion points and moments give only {basis.shape[1]} independent directions of "
            f"the model {body.name}, fewer than the order {count + rigid}; give more points or moments."
        )
    return basis[:, rigid : rigid + wanted]


def _real(block: NDArray[Any], share: NDArray[Any]) -> tuple[Array, Array]:
    """Return real columns, and real coefficients with which they give the real and imaginary moments."""
    if np.isrealobj(block):
        return block, share
    columns = np.hstack([block.real, block.imag])
    return columns, np.block([[share.real, share.imag], [-share.imag, share.real]])


def _sorted(body: Structure, block: Array, share: Array, basis: Array, least: float) -> Array:
    """Return what is new in a block, by falling part of the moment ``block @ share``; rounding has no say."""
    fresh = orthonormalize(body.mass, block, basis, least)
    turn, parts, _ = np.linalg.svd(fresh.T @ (body.mass @ block) @ share)
    fresh = fresh @ turn
    return turn_equal(parts, fresh, fresh[body.interface])


def _basis(body: Structure, variant: Variant, count: int) -> Array:
    return krylov(body, None if variant.order is None else count, variant.points, variant.moments)


register(Method("krylov", _basis, arguments="points"))
