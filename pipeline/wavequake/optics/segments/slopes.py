"""Wavefronts from ray slopes alone, without optical path lengths (Störkle 2018, Eq. 4.13-4.20).

A ray leaves the reference sphere at P and meets the image beside the sphere's center by (u, v); its direction
is the normal of its wavefront. As P moves on the sphere by dP = (dx, dy, dz), the path length changes by the
product of the direction and dP; dP is tangential to the sphere, so that only the offset counts:

    d OPD = -n (u dx + v dy) / a,    a: the distance from P to the image along the ray, n: the index there.

This is Rayces' relation between the transverse and the wave aberration, exact at any aperture, and the
difference of slopes in Eq. 4.15 and 4.16, d_x/d_z of the real less that of the ideal ray, times
-d_z: the sign is that of Eq. 4.12, and the equal heights assumed by Eq. 4.14 are not needed. Where P lies for
a ray of the pupil, and how it moves with the ray, is found once for a reference state. Then the offsets are
linear in the coefficients, and one matrix leads from the rays' image points to the coefficients.

Slopes do not see piston: neither that of the pupil nor that of a segment. The steps of a segmented mirror are
missing here, the tilts of its segments are not.

Both methods return the same coefficients as far as the polynomials describe the wavefront. What these leave
out enters differently: a fit of slopes weighs a missing term of degree n about n times as much.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.kernels.device.devices import NUMPY
from wavequake.kernels.device.tiles import TILE
from wavequake.kernels.trace.segmented import Traced, trace_segmented
from wavequake.kernels.trace.status import OK
from wavequake.optics.derivatives.central import gradient
from wavequake.optics.polynomials.zernike import annular_zernike_gradient
from wavequake.optics.segments.aspheres import figures_at_rest
from wavequake.optics.segments.kinematics import after_m1, relative_transforms
from wavequake.optics.segments.prepared import PreparedTrace, chief_rays, directions
from wavequake.optics.segments.telescope import surface_transforms
from wavequake.optics.systems.kinematics import rest_states
from wavequake.optics.systems.system import States
from wavequake.optics.wavefronts.fits import MORE_SEGMENT_RAYS, Fit, fit_tile, weighted_fit

Array = NDArray[np.float64]

# Shifts of the rays in the pupil (x, y) whose differences are the derivatives: the center, then +-x, +-y.
SHIFTS = np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]], dtype=np.float64)
STEP = 1e-4  # of the pupil's radius: its square and rounding over it are both below 1e-8
_UPSTREAM = 0.25  # of the reference sphere's radius: where the second point of a ray's line is taken


def slope_fit(prepared: PreparedTrace, motion: Array | None = None) -> Fit:
    """Return the least-squares fit from the rays' image points to Zernike coefficients j = 2..J.

    It is linear about a reference state: exact there, and elsewhere wrong by as much as the exit pupil has
    changed its shape. For the TMT about rest that is 1e-5 of the largest coefficient when M2 tilts by 1e-4
    rad, but 4e-3 at a field of 5 arcmin, which therefore needs a fit of its own.

    Parameters
    ----------
    prepared : PreparedTrace
        Its terms, its rays and their weights are used.
    motion : ndarray, shape (L, 6), optional
        Motion of the surfaces in the reference (as in `States.surface_motion`); rest if left out.

    Returns
    -------
    Fit
        Of 2 N values: the offsets in x of all rays from the chief ray's image point, then those in y; mm.

    Raises
    ------
    UserError
        If a ray does not reach the image in the reference, the rays do not determine the coefficients, or the
        motion has the wrong shape.
    """
    outer, terms = prepared.system.annulus.outer, prepared.fit.basis.shape[1]
    states = rest_states(prepared.system, TILE)
    shape = states.surface_motion.shape[1:]
    if motion is not None and motion.shape != shape:
        raise UserError(f"the reference's surface motion has the shape {motion.shape}, it must be {shape}")
    states.surface_motion[:] = 0.0 if motion is None else motion
    distance, derivatives, _ = sphere_points(prepared, states)
    _, *by = annular_zernike_gradient(
        prepared.rays.x / outer, prepared.rays.y / outer, terms, prepared.system.pupil.obscuration
    )
    slopes = np.stack(by, axis=1) / outer  # (N, 2, J), per mm of pupil
    scale = -prepared.wavelength * distance
    return offset_fit(slopes, derivatives, scale, prepared.weight, MORE_SEGMENT_RAYS)


def offset_fit(slopes: Array, derivatives: Array, scale: Array, weight: Array, remedy: str) -> Fit:
    """Return the fit from the offsets of N rays, first in x, then in y, to coefficients j = 2..J.

    Parameters
    ----------
    slopes : ndarray, shape (N, 2, J)
        Of the polynomials at the rays, by x and y in the pupil.
    derivatives : ndarray, shape (N, 2, 2)
        Of x and y on the reference sphere (last axis) by x and y in the pupil.
    scale : ndarray, shape (N,)
        Offset per slope of the OPD on the sphere: -wavelength a / n, mm^2.
    weight : ndarray, shape (N,)
    remedy : str
        How there are more rays.

    Raises
    ------
    UserError
        If the rays do not determine the coefficients.
    """
    if slopes.shape[2] < 2:
        raise UserError("slopes do not know piston; ask for at least 2 Zernike terms")
    offsets = np.linalg.solve(derivatives, slopes[:, :, 1:]) * scale[:, None, None]
    return weighted_fit(np.concatenate([offsets[:, 0], offsets[:, 1]]), np.tile(weight, 2), remedy)


def sphere_points(prepared: PreparedTrace, states: States) -> tuple[Array, Array, Array]:
    """Return where rays leave the reference sphere in one state, which every instant of `states` repeats.

    Returns
    -------
    distance : ndarray, shape (N,)
        From the reference sphere to the image along each ray, mm.
    derivatives : ndarray, shape (N, 2, 2)
        Of x and y on the sphere (last axis) by x and y in the pupil.
    points : ndarray, shape (N, 2)
        x and y on the sphere about the chief ray's image point, mm.
    """
    radius, step = prepared.train.sphere_radius, STEP * prepared.system.annulus.outer
    before = _UPSTREAM * abs(radius)
    image, upstream = _two_points(prepared, states, step * SHIFTS, before)
    along = upstream - image
    squared = np.sum(along**2, axis=0) + before**2
    path = to_sphere(image, along, squared, radius)
    sphere = image + path * along
    derivatives = gradient(np.moveaxis(sphere[..., 1:], -1, 0), step)
    if not np.isfinite(sphere).all():
        lost = np.count_nonzero(~np.isfinite(sphere).all(axis=(0, 2)))
        raise UserError(
            f"{lost} of {image.shape[1]} rays do not reach the image of {prepared.system.name} from the "
            f"field {tuple(prepared.point.tolist())} rad, so it has no slopes; choose a smaller field"
        )
    return path[:, 0] * np.sqrt(squared[:, 0]), derivatives.transpose(1, 2, 0), sphere[..., 0].T


def to_sphere(image: Array, along: Array, squared: Array | float, radius: float) -> Array:
    """Return how many times `along` leads from points of the image (x and y, first axis) to the sphere.

    `along` is x and y of a vector against the light, `squared` the square of its length. The sphere about the
    origin lies before the image, or for a radius < 0 behind it, where the number is negative; NaN for a miss.
    """
    inward = np.sum(along * image, axis=0)
    with np.errstate(invalid="ignore"):  # rays that miss the sphere
        root = np.sqrt(inward**2 - squared * (np.sum(image**2, axis=0) - radius**2))
    return np.asarray((np.copysign(root, radius) - inward) / squared)


def _two_points(prepared: PreparedTrace, states: States, shifts: Array, before: float) -> tuple[Array, Array]:
    """Return where rays meet the image plane and a plane `before` it, both (2, N, shifts), in mm.

    Positions count from the chief ray's image point. All lanes of one tile trace the same rays; the telescope
    is shifted against them instead, and half of the lanes have their image plane moved towards the light.
    M1 is its parent surface without edges, so that no shifted ray falls into a gap.
    """
    system, count = prepared.system, len(shifts)
    chief = chief_rays(prepared, states)
    lanes = np.zeros((TILE, 2))
    lanes[: 2 * count] = np.tile(shifts, (2, 1))
    position, rotation = after_m1(system, states.surface_motion)
    shift = np.zeros_like(position)
    shift[:, :, :2] -= lanes[:, None]
    normal = rotation[0, -1, :, 2]
    shift[count : 2 * count, -1] += before * np.sign(surface_transforms(system)[-1, -1]) * normal
    primary = np.zeros((1, 1, 12, TILE))
    primary[:, :, [0, 4, 8]] = 1.0
    primary[0, 0, 9:11] = lanes.T
    parent = replace(
        prepared.train,
        edges=np.zeros((1, 0, 3)),
        figure_frames=np.zeros((1, 4)),
        figure_degree=-1,
        semi_diameters=None,
        mirror_degree=-1 if prepared.aspheres is None else prepared.train.mirror_degree,
    )
    traced = trace_segmented(
        parent,
        prepared.rays.x,
        prepared.rays.y,
        system.stop_z,
        np.zeros((len(prepared.rays), 1), dtype=np.int32),
        primary,
        None,
        relative_transforms(position + shift, rotation),
        directions(prepared, states),
        chief,
        NUMPY,
        figures_at_rest(prepared.aspheres, 1),
    )
    points = np.stack([traced.x[0], traced.y[0]]) - chief[0, :2, None]
    return points[..., :count], points[..., count : 2 * count]


def wavefront_from_slopes(fit: Fit, traced: Traced, chief: Array) -> Array:
    """Return the Zernike coefficients of traced rays from where they meet the image, not from path lengths.

    Parameters
    ----------
    fit : Fit
        From `slope_fit`.
    traced : Traced
        Of T tiles of 16 instants; lost rays are left out.
    chief : ndarray, shape (T, 3, 16)
        From `chief_rays`: the point that the offsets count from.

    Returns
    -------
    ndarray, shape (16 T, J)
        Annular Noll coefficients in waves with the sign of the OPD. The first one, piston, is NaN: slopes do
        not know it. All are NaN for an instant whose remaining rays do not determine them.
    """
    coefficients = np.full((TILE * len(chief), len(fit.matrix) + 1), np.nan)
    coefficients[:, 1:] = np.concatenate(
        [
            fit_tile(fit, np.concatenate([x - center[0], y - center[1]]), np.tile(status == OK, (2, 1))).T
            for x, y, center, status in zip(traced.x, traced.y, chief, traced.status, strict=True)
        ]
    )
    return coefficients
