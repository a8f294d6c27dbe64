"""Aspheres behind a segmented mirror, as what the trace adds to a conic: a polynomial in x and y."""

from dataclasses import replace
from math import comb

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.kernels.device.tiles import TILE
from wavequake.optics.segments.telescope import footprints
from wavequake.optics.shapes.basis import ZernikeBasis
from wavequake.optics.systems.system import OpticalSystem

Array = NDArray[np.float64]


def asphere_polynomials(system: OpticalSystem) -> Array | None:
    """Return the even powers of the mirrors after M1; None if all are conics.

    Returns
    -------
    ndarray, shape (L - 1, M), or None
        Coefficients in mm of u^n, u^(n-1) v, ..., v^n for n = 0, 1, ... to the highest power there is, with u
        and v in units of the mirrors' footprints.
    """
    mirrors = [surface.shape.packed().even for surface in system.after_primary[:-1]]
    degree = 2 * max(map(len, mirrors), default=0)
    if not degree:
        return None
    radii = footprints(system)
    found = np.zeros((len(mirrors), (degree + 1) * (degree + 2) // 2))
    for row, even, radius in zip(found, mirrors, radii, strict=True):
        for half, coefficient in enumerate(even, start=1):
            first = half * (2 * half + 1)  # of the terms of degree 2 half
            row[first : first + 2 * half + 1 : 2] = [
                coefficient * radius ** (2 * half) * comb(half, place) for place in range(half + 1)
            ]
    return found


def with_aspheres(basis: ZernikeBasis, aspheres: Array | None) -> tuple[ZernikeBasis, Array | None]:
    """Return the basis of mirrors' figures and their aspheres, both of the higher of both degrees.

    Raises
    ------
    UserError
        If the figures are of more terms than are sums of powers.
    """
    if aspheres is None:
        return basis, None
    if basis.basis != "monomial":
        raise UserError(
            "Figures of mirrors after M1 have 231 Zernike terms at most where one of them is an asphere."
        )
    degree = max(basis.degree, int(np.sqrt(2 * aspheres.shape[1])) - 1)
    terms = (degree + 1) * (degree + 2) // 2
    matrix = np.zeros((terms, basis.matrix.shape[1]))
    matrix[: len(basis.matrix)] = basis.matrix
    return replace(basis, degree=degree, matrix=matrix), np.pad(
        aspheres, ((0, 0), (0, terms - aspheres.shape[1]))
    )


def figures_at_rest(aspheres: Array | None, tiles: int) -> Array | None:
    """Return the aspheres (L - 1, M) as figures (tiles, L - 1, M, 16) of the trace."""
    if aspheres is None:
        return None
    return np.tile(aspheres[None, :, :, None], (tiles, 1, 1, TILE))
