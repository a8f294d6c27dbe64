"""Light at gratings, binary optics and perfect lenses, which add a path to it, in NumPy. Lengths in mm."""

import numpy as np
from numpy.typing import NDArray

from wavequake.kernels.trace.polynomial_numpy import polynomial
from wavequake.kernels.trace.sequence import Focus, Phase
from wavequake.kernels.trace.surfaces import even_sag_and_slopes

Array = NDArray[np.float64]


def added_path(phase: Phase, x: Array, y: Array) -> tuple[Array, Array, Array]:
    """Return the path that a surface adds at x and y, mm, and its slopes."""
    total = even_sag_and_slopes(x, y, phase.even)
    given = phase.polynomial
    if given is None:
        return total
    more = polynomial(given.degree, given.radius, given.basis, given.coefficients, x, y)
    return total[0] + more[0], total[1] + more[1], total[2] + more[2]


def diffracted(
    phase: Phase, mirror: bool, position: Array, direction: Array, normal: Array, before: float, after: float
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Return the unit directions behind a surface, the added paths, and where the order does not leave.

    Along the surface, n' d' is n d plus the slopes of the added path (the grating equation). Behind a mirror
    light runs back.

    Parameters
    ----------
    phase : Phase
    mirror : bool
    position, direction, normal : ndarray, shape (3, ...)
        Where rays meet the surface; unit vectors.
    before, after : float
        Refractive indices.
    """
    path, slope_x, slope_y = added_path(phase, position[0], position[1])
    vector = before * direction + np.stack([slope_x, slope_y, np.zeros_like(slope_x)])
    along, incident = np.sum(normal * vector, axis=0), np.sum(normal * direction, axis=0)
    radicand = after**2 - np.sum(vector**2, axis=0) + along**2
    across = np.copysign(np.sqrt(radicand), -incident if mirror else incident)
    return (vector + (across - along) * normal) / after, path, radicand < 0.0


def focused(
    lens: Focus, position: Array, direction: Array, before: float, after: float
) -> tuple[Array, Array]:
    """Return the unit directions behind a perfect lens in the plane z = 0, and the added paths.

    All rays from a point of the object plane have equal paths to its image: what the lens adds is the way
    through its center less the ways to and from the place where the ray meets it.
    """
    place, forward = position[:2], np.where(direction[2] < 0.0, -1.0, 1.0)
    slopes = (before * direction[:2] / np.abs(direction[2]) - lens.power * place) / after
    behind = np.stack([*slopes, forward])
    behind /= np.sqrt(np.sum(behind**2, axis=0))
    image = (lens.power - before * lens.vergence) / after
    rays = ((before, -direction, lens.vergence), (after, behind, image))
    ways = [index * _shorter(place, one[:2], vergence * np.abs(one[2])) for index, one, vergence in rays]
    return behind, ways[0] + ways[1]


def _shorter(place: Array, towards: Array, closeness: Array) -> Array:
    """Return how much longer the way to a point is from the lens's center than from a place (2, ...) on it.

    The point lies the reciprocal of `closeness` from the place along `towards`, x and y of a unit vector; for
    a closeness of 0 the difference is that of parallel rays, and nothing cancels for small ones.
    """
    square, along = np.sum(place**2, axis=0), np.sum(place * towards, axis=0)
    root = np.sqrt(1.0 + square * closeness**2 + 2.0 * closeness * along)
    return np.asarray((square * closeness + 2.0 * along) / (1.0 + root))
