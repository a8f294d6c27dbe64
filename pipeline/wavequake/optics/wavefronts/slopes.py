"""Wavefronts of any optical system from where rays meet the image and whither, without path lengths.

The relation is that of `wavequake.optics.segments.slopes`; it is exact at any aperture and for near and far
objects. What it needs of a ray is where it leaves the reference sphere, and how that point moves with the
ray's place in the pupil. Image point and direction of a traced ray give the first at every instant. The
second is known at rest by differences; its change is the slope of the polynomials that fit the motion of the
points. So moving elements cost no accuracy: offsets become those that the same slopes make in the exit pupil
at rest, from which one matrix leads to the coefficients.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wavequake.kernels.sums.ray_sums_numpy import times_instants
from wavequake.kernels.trace.sequence import TracedRays
from wavequake.optics.derivatives.central import gradient
from wavequake.optics.polynomials.zernike import annular_zernike_gradient
from wavequake.optics.segments.slopes import SHIFTS, STEP, offset_fit, to_sphere
from wavequake.optics.wavefronts.fits import MORE_RAYS, Fit, fit_instants

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SystemSlopes:
    """What leads from image points and directions of N rays to J - 1 coefficients.

    Attributes
    ----------
    fit : Fit
        Of 2 N offsets from the chief ray's image point at rest.
    pupil : Fit
        Of N values to J polynomials.
    gradient : ndarray, shape (2, N, J)
        Of the polynomials by x and y in the pupil.
    radius : float
        Of the reference sphere, signed, mm.
    distance : ndarray, shape (N,)
        From the sphere to the image along each ray at rest, mm.
    points : ndarray, shape (2, N)
        x and y on the sphere at rest about its center, mm.
    inverse : ndarray, shape (N, 2, 2)
        Derivatives of x and y in the pupil (first index) by those on the sphere at rest, 1/mm.
    """

    fit: Fit
    pupil: Fit
    gradient: Array
    radius: float
    distance: Array
    points: Array
    inverse: Array


def on_sphere(traced: TracedRays, chief: Array, radius: float) -> tuple[Array, Array]:
    """Return x and y (2, T, N) on the spheres about the chief rays' image points, and the distances (T, N).

    Parameters
    ----------
    traced : TracedRays
        N rays at T instants.
    chief : ndarray, shape (T, 2)
        Center of the sphere, mm.
    radius : float
        Negative where the light meets the sphere behind the image.
    """
    image = np.stack([traced.x - chief[:, :1], traced.y - chief[:, 1:]])
    against = np.stack([-traced.u, -traced.v])
    distance = to_sphere(image, against, 1.0, radius)
    return image + distance * against, distance


def system_slopes(
    pupil: Array,
    points: Array,
    distance: Array,
    fit: Fit,
    radius: float,
    wavelength: float,
    obscuration: float,
) -> SystemSlopes:
    """Return what leads from image points and directions to coefficients.

    Parameters
    ----------
    pupil : ndarray, shape (N, 2)
        In units of its radius.
    points : ndarray, shape (2, N, 5)
        x and y on the sphere at rest of the rays, shifted in the pupil by ``STEP * SHIFTS``; NaN for one that
        does not arrive, which is left out.
    distance : ndarray, shape (N,)
    fit : Fit
        Of the polynomials.
    radius, wavelength, obscuration : float
        The wavelength before the image, mm.

    Raises
    ------
    UserError
        If the rays do not determine the coefficients.
    """
    terms = fit.basis.shape[1]
    _, *by = annular_zernike_gradient(pupil[:, 0], pupil[:, 1], terms, obscuration)
    derivatives = gradient(np.moveaxis(points[..., 1:], -1, 0), STEP).transpose(1, 2, 0)
    known = np.isfinite(points[0]).all(axis=1)
    derivatives = np.where(known[:, None, None], derivatives, np.eye(2))
    scale = np.where(known, -wavelength * distance, 0.0)
    weight = np.where(known, fit.weight, 0.0)
    return SystemSlopes(
        fit=offset_fit(np.stack(by, axis=1), derivatives, scale, weight, MORE_RAYS),
        pupil=fit,
        gradient=np.stack(by),
        radius=radius,
        distance=np.where(known, distance, np.nan),
        points=points[..., 0],
        inverse=np.asarray(np.linalg.inv(derivatives), dtype=np.float64),
    )


def shifted_pupil(pupil: Array) -> tuple[Array, Array]:
    """Return x and y (5 N,) of the rays (N, 2) whose points on the sphere `system_slopes` takes."""
    shifted = (pupil[:, None] + STEP * SHIFTS).reshape(-1, 2)
    return shifted[:, 0], shifted[:, 1]


def slope_coefficients(slopes: SystemSlopes, traced: TracedRays, chief: Array) -> Array:
    """Return Noll coefficients (T, J) in waves with the sign of the OPD; the first one, piston, is NaN.

    Parameters
    ----------
    slopes : SystemSlopes
    traced : TracedRays
        Its lost rays, NaN, are left out.
    chief : ndarray, shape (T, 2)
        Image points of the chief ray, from which offsets count; mm.
    """
    points, distance = on_sphere(traced, chief, slopes.radius)
    offset = np.stack([traced.x - chief[:, :1], traced.y - chief[:, 1:]])
    known = np.isfinite(distance)
    offset[:, ~known] = np.nan
    moved = [fit_instants(slopes.pupil, now - then) for now, then in zip(points, slopes.points, strict=True)]
    # How the derivatives of the points have changed, times the offsets: by x and by y in the pupil.
    change = [
        times_instants(by, moved[0]) * offset[0] + times_instants(by, moved[1]) * offset[1]
        for by in slopes.gradient
    ]
    scale = slopes.distance / distance
    inverse = slopes.inverse
    alike = [
        scale * (offset[i] + inverse[:, i, 0] * change[0] + inverse[:, i, 1] * change[1]) for i in (0, 1)
    ]
    coefficients = np.full((len(distance), len(slopes.fit.matrix) + 1), np.nan)
    coefficients[:, 1:] = fit_instants(slopes.fit, np.concatenate(alike, axis=1))
    return coefficients
