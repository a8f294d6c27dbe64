"""The check that every motion of an imported model has a mass or a stiffness."""

import numpy as np
import scipy  # its parts load when first used
from scipy.sparse import csc_array, diags_array

from wavequake.errors import UserError
from wavequake.mechanics.importers.checks import describe, refuse
from wavequake.mechanics.importers.entries import Integers
from wavequake.mechanics.vibration.factors import NotDefiniteError, factorize

SINGULAR = 1e-10
"""Eigenvalue of a matrix scaled to a unit diagonal that counts as zero; files have 10 digits and more."""


def check_mass(
    mass: csc_array, stiffness: csc_array, dofs: Integers, sources: tuple[str, str], notes: list[str]
) -> None:
    """Refuse motions that have neither mass nor stiffness, and those with a negative mass.

    Consistent masses of quadratic elements may be singular (C3D10, C3D20R), and rotations often have no
    mass. That is harmless where the stiffness holds such motions: their frequency is infinite. It is noted.

    Parameters
    ----------
    mass, stiffness : csc_array, shape (n, n)
    dofs : ndarray of int, shape (n, 2)
    sources : tuple of str
        Names of the matrices, for messages.
    notes : list of str
        Takes what was found.

    Raises
    ------
    UserError
        With the degree of freedom and what to do.
    """
    massless = mass.diagonal() == 0.0
    if massless.all():
        raise UserError(f"{sources[0]}: no degree of freedom has a mass; give the materials a density")
    if np.diff(mass.indptr)[massless].any():
        refuse(massless, dofs, lambda row: f"{sources[0]} is indefinite at {describe(dofs, row)}")
    heavy = np.flatnonzero(~massless)
    singular = _singular_row(csc_array(mass[heavy][:, heavy]), dofs[heavy], sources[0])
    if singular < 0 and not massless.any():
        return
    # K + s M is positive definite unless a motion has neither; s makes both weigh about the same.
    weight = stiffness.diagonal()[heavy].sum() / mass.diagonal()[heavy].sum()
    least, row = _softest(_scaled(csc_array(stiffness + weight * mass)), 1e-3 * SINGULAR)
    if least < SINGULAR:
        raise UserError(
            f"{sources[0]} and {sources[1]} are singular together: a motion of "
            f"{describe(dofs, row)} has neither mass nor stiffness; parts that are attached "
            "to nothing have such motions, and elements of reduced integration without hourglass control"
        )
    if massless.any():
        first = describe(dofs, int(np.argmax(massless)))
        notes.append(
            f"{int(massless.sum())} degrees of freedom have no mass (the first: {first}) but a stiffness"
        )
    if singular >= 0:
        where = describe(dofs, int(heavy[singular]))
        notes.append(
            f"{sources[0]} is singular (at {where}), as consistent masses of quadratic elements are; the "
            "stiffness holds these motions, so nothing is lost"
        )


def _singular_row(mass: csc_array, dofs: Integers, source: str) -> int:
    """Return the row of the smallest pivot of a singular mass matrix, -1 for a definite one.

    Raises
    ------
    UserError
        If it is indefinite.
    """
    refuse(
        mass.diagonal() < 0.0,
        dofs,
        lambda row: f"the mass at {describe(dofs, row)} is negative",
    )
    scaled = _scaled(mass)
    # Without constraints the three directions do not couple: three small factorizations, not a large one.
    count, part = scipy.sparse.csgraph.connected_components(scaled, directed=False)
    if count > len(dofs) // 3:
        parts = [np.arange(len(dofs))]  # nearly diagonal: cheap in one go
    else:
        parts = [np.flatnonzero(part == index) for index in range(count)]
    where = -1
    for chosen in parts:
        # All pivots of M + e I are positive if no eigenvalue is below -e (Sylvester's law of inertia).
        least, row = _softest(csc_array(scaled[chosen][:, chosen]), SINGULAR)
        if least < 0.0:
            raise UserError(
                f"{source} is indefinite: a motion of {describe(dofs, int(chosen[row]))} has a negative "
                "mass; the matrix is damaged, or not one of masses"
            )
        if least < 3.0 * SINGULAR:
            where = int(chosen[row])
    return where


def _scaled(matrix: csc_array) -> csc_array:
    scale = diags_array(1.0 / np.sqrt(matrix.diagonal()), format="csc")
    return csc_array(scale @ matrix @ scale)


def _softest(matrix: csc_array, shift: float) -> tuple[float, int]:
    """Return the smallest eigenvalue of a matrix plus a shift, and the row that its vector moves most.

    A negative one is known by its sign only.
    """
    shifted = csc_array(matrix + shift * diags_array(np.ones(matrix.shape[0]), format="csc"))
    try:
        factors = factorize(shifted, definite=True)
    except NotDefiniteError as error:
        return -1.0, error.row
    except UserError:
        return 0.0, int(np.argmin(matrix.diagonal()))
    pivots, rows = factors.elimination()
    if pivots.min() < 0.0:
        return -1.0, int(rows[np.argmin(pivots)])
    vector = np.random.default_rng(0).standard_normal(matrix.shape[0])
    for _ in range(4):  # inverse iteration: an eigenvalue of zero stands far below all others
        vector = factors.solve(vector / np.linalg.norm(vector))
    least = float(vector @ (shifted @ vector) / (vector @ vector))
    return least, int(np.argmax(np.abs(vector)))
