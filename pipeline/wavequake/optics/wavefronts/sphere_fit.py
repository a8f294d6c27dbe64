"""The sphere that fits a wavefront best: the reference where an annular pupil has no chief ray.

Störkle 2018, section 3.3.3: its center stands for the image point, and the line from the pupil's center to it
for the chief ray.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wavequake.kernels.device.tiles import TILE
from wavequake.optics.segments.prepared import PreparedTrace
from wavequake.optics.segments.slopes import sphere_points
from wavequake.optics.systems.kinematics import rest_states
from wavequake.optics.wavefronts.fits import MORE_SEGMENT_RAYS, Fit, weighted_fit

Array = NDArray[np.float64]

_STEPS = 20
_CONVERGED = 1e-14  # a step of the fit, relative to the sphere
_SINGULAR = 1e-9  # smallest pivot of a design, relative to its largest, that still determines a sphere


@dataclass(frozen=True)
class Sphere:
    """Best-fit spheres of a batch of point sets; lengths in the unit of the points.

    Attributes
    ----------
    center : ndarray, shape (batch, 3)
    radius : ndarray, shape (batch,)
        Positive.
    rms : ndarray, shape (batch,)
        Weighted rms distance of the points from the sphere.
    """

    center: Array
    radius: Array
    rms: Array


def fit_sphere(points: Array, weight: Array) -> Sphere:
    """Return the spheres with the least mean square distance from points.

    The linear fit of ``|p|^2 = 2 p c + k`` is where Gauss-Newton steps of the true distances start: noise
    biases the linear one, the more the smaller a part of the sphere the points cover.

    Parameters
    ----------
    points : ndarray, shape (batch, N, 3)
        NaN for a lost ray, whose point is left out.
    weight : ndarray, shape (N,)
        Not negative; need not sum to 1.

    Returns
    -------
    Sphere
        NaN where the points do not determine a sphere: fewer than four, or all in a plane.
    """
    known: NDArray[np.bool_] = np.asarray(np.isfinite(points).all(axis=2))
    share = np.where(known, weight, 0.0)
    total = np.sum(share, axis=1, keepdims=True)
    share = share / np.where(total > 0.0, total, 1.0)
    inside = np.where(known[..., None], points, 0.0)
    middle = np.sum(share[..., None] * inside, axis=1)
    offset = np.where(known[..., None], inside - middle[:, None], 0.0)
    size = np.sqrt(np.sum(share[..., None] * offset**2, axis=(1, 2)))
    size = np.where(size > 0.0, size, 1.0)
    offset /= size[:, None, None]
    root = np.sqrt(share)

    squares = np.sum(offset**2, axis=2)
    design = np.concatenate([2.0 * offset, np.ones_like(squares)[..., None]], axis=2)
    solution, solved = _least_squares(root[..., None] * design, root * squares)
    center = solution[:, :3]
    radius = np.sqrt(np.abs(solution[:, 3] + np.sum(center**2, axis=1)))
    for _ in range(_STEPS):
        ray = offset - center[:, None]
        distance = np.sqrt(np.sum(ray**2, axis=2))
        normal = ray / np.where(distance > 0.0, distance, 1.0)[..., None]
        design = np.concatenate([normal, np.ones_like(distance)[..., None]], axis=2)
        step, regular = _least_squares(root[..., None] * design, root * (distance - radius[:, None]))
        solved &= regular
        center, radius = center + step[:, :3], radius + step[:, 3]
        if not (np.abs(step).max(axis=1) > _CONVERGED * radius).any():
            break
    distance = np.sqrt(np.sum((offset - center[:, None]) ** 2, axis=2))
    rms = np.sqrt(np.sum(share * (distance - radius[:, None]) ** 2, axis=1))
    keep = np.where(solved, 1.0, np.nan)
    return Sphere(
        center=(middle + size[:, None] * center) * keep[:, None],
        radius=size * radius * keep,
        rms=size * rms * keep,
    )


def _least_squares(design: Array, values: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Return the solutions (batch, 4) of weighted designs (batch, N, 4), zero where there is not just one."""
    if design.shape[1] < design.shape[2]:
        return np.zeros((len(design), design.shape[2])), np.zeros(len(design), dtype=np.bool_)
    q, r = np.linalg.qr(design)
    pivots = np.abs(np.diagonal(r, axis1=1, axis2=2))
    solved: NDArray[np.bool_] = pivots.min(axis=1) > _SINGULAR * pivots.max(axis=1)
    r[~solved] = np.eye(design.shape[2])
    right = np.where(solved[:, None], np.sum(q * values[..., None], axis=1), 0.0)
    return np.linalg.solve(r, right[..., None])[..., 0], solved


def reference_fit(prepared: PreparedTrace) -> Fit:
    """Return the fit that finds the image point of a wavefront's best-fit sphere from its OPD.

    Moving the center of the reference sphere by a small d changes the OPD by -n d, with n the unit vector
    from a ray's point on the sphere to the center, and d is small beside the radius: so the sphere that fits
    best is a linear fit of the OPD by 1 and n, without the rounding of coordinates of many meters. The line
    from the pupil's center to the sphere's meets the image at the lateral part of d.

    Parameters
    ----------
    prepared : PreparedTrace

    Returns
    -------
    Fit
        Of N values of the OPD; the coefficients are piston, x and y of the image point times the numerical
        aperture, and defocus.

    Raises
    ------
    UserError
        If a ray does not reach the image, or the rays determine no sphere.
    """
    points = sphere_points(prepared, rest_states(prepared.system, TILE))[2]
    toward = -points / prepared.train.sphere_radius
    chief, aperture = np.zeros(2), prepared.numerical_aperture
    return sphere_basis_fit(toward, chief, aperture, prepared.weight, MORE_SEGMENT_RAYS)


def sphere_basis_fit(toward: Array, chief: Array, aperture: float, weight: Array, remedy: str) -> Fit:
    """Return the fit of OPDs by motions of a sphere's center along and across the chief ray.

    Parameters
    ----------
    toward : ndarray, shape (N, 2)
        x and y of the unit vectors n from the rays' points on the sphere to its center (along the light).
    chief : ndarray, shape (2,)
        Those of the chief ray, c. The center moves along the chief ray by the fourth coefficient, whose
        function is |n - c|^2 / 2: this keeps the line from the pupil's center, hence the image point.
    aperture : float
        By which the functions are scaled: across once, along twice.
    weight : ndarray, shape (N,)
    remedy : str
        How there are more rays.

    Raises
    ------
    UserError
        If the rays determine no sphere.
    """
    across = (toward - chief) / aperture
    here, there = (np.sqrt(1.0 - np.sum(cosines**2, axis=-1)) for cosines in (toward, chief))
    depth = np.sum((toward + chief) * across, axis=1) / (here + there)
    along = 0.5 * (np.sum(across**2, axis=1) + depth**2)
    columns = [np.ones(len(across)), across[:, 0], across[:, 1], along]
    return weighted_fit(np.stack(columns, axis=1), weight, remedy)
