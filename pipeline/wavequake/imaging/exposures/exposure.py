"""Exposures and their resolution: mean of instants, encircled energy, radial profile.

An irradiance is band-limited to the diameter of the pupil, 1 cycle per wavelength / diameter. Its
integral over a disc, or its mean over a circle, is therefore a weighted sum of its pixels, in which a
weight is the disc (or circle) smoothed by any kernel that passes these frequencies and stops those of
the pixels' replicas. The kernel used falls from 1 to 0 as an error function in between, so that its
weights die out within 2 wavelengths / diameter; pixels so count exactly, not as little squares.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy  # its parts load when first used
from numpy.typing import ArrayLike, NDArray

from wavequake.errors import UserError
from wavequake.prepared import prepared
from wavequake.tables import kept

Real = NDArray[np.float64]

# Step of tables in radius, in wavelengths / diameter: cubic interpolation is then good to 1e-6.
_STEP = 1.0 / 128.0
# Beyond this distance (wavelengths / diameter) from the edge of a disc the weights are below 1e-8.
_WING = 6.0
_RADII_PER_PIXEL = 10
# Rows of a table at once, where a radius is looked for.
_ROWS = 16
# A step leaves a few percent of the centroid's error.
_CENTROID_STEPS = 6


def exposure(images: NDArray[np.floating], valid: NDArray[np.bool_]) -> Real:
    """Return the mean image over the instants of an exposure.

    Parameters
    ----------
    images : ndarray, shape (..., instants, P)
        Irradiance of each instant.
    valid : ndarray of bool, shape (..., instants)
        Which instants count; the others (padding, lost instants) may hold anything, NaN too.

    Returns
    -------
    ndarray, shape (..., P)
        NaN where no instant counts.
    """
    counts = np.count_nonzero(valid, axis=-1)[..., None]
    total = np.where(valid[..., None], images, 0.0).sum(axis=-2, dtype=np.float64)
    return np.asarray(np.where(counts > 0, total / np.maximum(counts, 1), np.nan))


def centroid(image: NDArray[np.floating], sampling: float) -> Real:
    """Return the center of irradiance within the largest circle about itself that fits into the frame.

    A circle, because a frame cuts more off the farther wing of an image and so would pull the center back.

    Parameters
    ----------
    image : ndarray, shape (..., n, n)
        Irradiance; the last axis is x, and [n // 2, n // 2] is the origin.
    sampling : float
        Distance of the pixels in wavelengths / diameter.

    Returns
    -------
    ndarray, shape (..., 2)
        x and y in wavelengths / diameter; the origin for an image without light.
    """
    *batch, _, pixels = image.shape
    images = np.asarray(image, dtype=np.float64).reshape(-1, pixels, pixels)
    axis = _axis(pixels, sampling)
    center = np.zeros((len(images), 2))
    for _ in range(_CENTROID_STEPS):
        light = _distance(center, axis)  # then how far inside the circle, then what counts: memory is slow
        np.subtract(_reach(center, axis)[:, None, None], light, out=light)
        light *= 1.0 / sampling
        light += 0.5
        np.clip(light, 0.0, 1.0, out=light)
        light *= images
        sums = np.stack([light.sum(axis=over) for over in (1, 2)])
        total = sums[1].sum(axis=1)
        center = (sums * axis).sum(axis=2).T / np.where(total == 0.0, 1.0, total)[:, None]
    return center.reshape(*batch, 2)


def encircled_energy(
    image: NDArray[np.floating],
    sampling: float,
    area: float,
    diameter: float,
    radii: ArrayLike,
    center: ArrayLike | str = "centroid",
) -> Real:
    """Return the share of all the energy that falls inside circles.

    All the energy is what passes the pupil, inside the frame or not: by Parseval's theorem the integral
    of the image, 1 at the perfect peak, is diameter² / area in (wavelengths / diameter)².

    Parameters
    ----------
    image : ndarray, shape (..., n, n)
        Irradiance relative to the perfect peak; the last axis is x, and [n // 2, n // 2] is the origin.
    sampling : float
        Distance of the pixels in wavelengths / diameter, at most 0.5.
    area : float
        Transmitting area of the pupil in mm².
    diameter : float
        Length in mm that defines the unit wavelength / diameter; not less than the extent of the pupil.
    radii : array_like, shape (R,)
        Radii in wavelengths / diameter.
    center : {"centroid", "origin"} or array_like, shape (2,) or (..., 2)
        Center of the circles: the image's own center of irradiance (default), the image's origin, or x
        and y in wavelengths / diameter.

    Returns
    -------
    ndarray, shape (..., R)
        NaN for circles that leave the frame and for images with NaN. The error is below 1e-7 at a sampling of
        0.25 and 1e-5 at 0.4, but 2e-3 at 0.5; a perfect image adds 3e-6 within 1 wavelength / diameter
        of the frame.

    Raises
    ------
    UserError
        If sampling, area, diameter or a radius is impossible, or the image not square.
    """
    return _weighted_sums(image, sampling, radii, center, disc=True) * _peak_share(area, diameter)


def _peak_share(area: float, diameter: float) -> float:
    """Return the share of all energy that one (wavelength / diameter)² at the perfect peak holds."""
    if not (np.isfinite([area, diameter]).all() and area > 0.0 and diameter > 0.0):
        raise UserError(f"the pupil's area {area} mm² and diameter {diameter} mm must be above 0 and finite")
    return area / diameter**2


def encircled_energy_radius(
    image: NDArray[np.floating],
    fraction: ArrayLike,
    sampling: float,
    area: float,
    diameter: float,
    center: ArrayLike | str = "centroid",
) -> Real:
    """Return the radius of the circle that holds a share of all the energy, as EE50 and EE80.

    Parameters
    ----------
    image : ndarray, shape (..., n, n)
        Irradiance relative to the perfect peak.
    fraction : float or array_like, shape (F,)
        Share of the energy, between 0 and 1; several are found on one curve.
    sampling, area, diameter, center
        As for `encircled_energy`.

    Returns
    -------
    ndarray, shape (...) or (F, ...)
        Radius in wavelengths / diameter; at a sampling of 0.25 within 3e-4 for 50 and 80 % of a perfect
        image; +inf if no circle inside the frame holds the share; NaN for an image with NaN.

    Raises
    ------
    UserError
        If the fraction is not between 0 and 1, or as for `encircled_energy`.
    """
    shares = np.asarray(fraction, dtype=np.float64)
    if not ((shares > 0.0) & (shares < 1.0)).all():
        raise UserError(f"the share of encircled energy must lie between 0 and 1, not be {fraction!r}")
    per_peak = _peak_share(area, diameter)
    radii = np.arange(1, image.shape[-1] * _RADII_PER_PIXEL // 2 + 1) * (sampling / _RADII_PER_PIXEL)
    light = _light_about(image, sampling, radii, center, disc=True)
    found = np.full((shares.size, len(light.spread)), np.nan)
    for which in np.flatnonzero(~light.dark):
        inside = int(np.searchsorted(radii, light.reach[which], side="right"))  # circles in the frame
        found[:, which] = _radii_of(
            shares.ravel() / per_peak, light.table[:inside], light.spread[which], radii
        )
    return np.asarray(found.reshape((*shares.shape, *image.shape[:-2])))


def _radii_of(energies: Real, table: Real, spread: Real, radii: Real) -> Real:
    """Return the first radii with these energies, which rise with the radius: few rows of the table tell."""
    if not len(table):
        return np.full(len(energies), np.inf)
    ends = np.append(np.arange(_ROWS, len(table) + 1, _ROWS), len(table))
    at_ends = np.append(table[_ROWS - 1 :: _ROWS] @ spread, table[-1] @ spread)
    found = np.full(len(energies), np.inf)
    for place, energy in enumerate(energies):
        enough = at_ends >= energy
        if not enough.any():
            continue
        last = int(ends[enough.argmax()])
        first = max(last - _ROWS - 1, 0)
        at, inside = radii[first:last], table[first:last] @ spread
        if not first:
            at, inside = np.concatenate([[0.0], at]), np.concatenate([[0.0], inside])
        above = max(int((inside >= energy).argmax()), 1)
        rise = inside[above] - inside[above - 1]
        found[place] = at[above] - (inside[above] - energy) / rise * radii[0]
    return found


def radial_profile(
    image: NDArray[np.floating], sampling: float, radii: ArrayLike, center: ArrayLike | str = "centroid"
) -> Real:
    """Return the mean irradiance on circles; arguments and NaN as for `encircled_energy`.

    Returns
    -------
    ndarray, shape (..., R)
    """
    return _weighted_sums(image, sampling, radii, center, disc=False)


def _axis(pixels: int, sampling: float) -> Real:
    return np.asarray((np.arange(pixels) - pixels // 2) * sampling)


def _distance(centers: Real, axis: Real) -> Real:
    """Distances (B, n, n) of the pixels from the centers (B, 2)."""
    x, y = axis - centers[:, :1], axis - centers[:, 1:]
    squares = (x**2)[:, None, :] + (y**2)[:, :, None]
    return np.asarray(np.sqrt(squares, out=squares))


def _reach(centers: Real, axis: Real) -> Real:
    """Radii (B,) of the largest circles about the centers inside the frame."""
    gap = np.minimum(centers - axis[0], axis[-1] - centers).min(axis=1)
    return np.asarray(gap + 0.5 * (axis[1] - axis[0]))


def _weighted_sums(
    image: NDArray[np.floating], sampling: float, radii: ArrayLike, center: ArrayLike | str, *, disc: bool
) -> Real:
    """Integrals over discs, or means over circles, (..., R); NaN beyond the frame."""
    radii = np.asarray(radii, dtype=np.float64)
    light = _light_about(image, sampling, radii, center, disc=disc)
    # One matrix-vector product per image: its numbers do not depend on the others.
    sums = (light.table @ light.spread[..., None])[..., 0]
    sums[light.dark[:, None] | (radii > light.reach[:, None])] = np.nan
    return np.asarray(sums.reshape((*image.shape[:-2], radii.size)))


class _Light(NamedTuple):
    """Images by distance from their centers: sums are ``table`` (R, T) @ ``spread`` (B, T).

    ``reach`` (B,) is the radius of the largest circle inside the frame; images with NaN are ``dark`` (B,).
    """

    table: Real
    spread: Real
    reach: Real
    dark: NDArray[np.bool_]


def _light_about(
    image: NDArray[np.floating], sampling: float, radii: Real, center: ArrayLike | str, *, disc: bool
) -> _Light:
    if not 0.0 < sampling <= 0.5:
        raise UserError(f"an image must be sampled at most 0.5 wavelengths/diameter apart, not {sampling}")
    if radii.ndim != 1 or not radii.size or not (np.isfinite(radii) & (radii >= 0.0)).all():
        raise UserError("the radii of circles must be a list of finite numbers of at least 0")
    *batch, height, width = image.shape
    if height != width or width < 2:
        raise UserError(f"an image is square, of at least 2 x 2 pixels, not {height} x {width}")
    images = np.asarray(image, dtype=np.float64).reshape(-1, height, width)
    dark = np.asarray(np.isnan(images).any(axis=(1, 2)))
    images = np.where(dark[:, None, None], 0.0, images)
    centers = _centers(images, sampling, center, tuple(batch))
    axis = _axis(width, sampling)
    table = _table(sampling, tuple(np.minimum(radii, axis[-1] - axis[0]).tolist()), disc)
    spread = sampling**2 * _spread(_distance(centers, axis), images, table.shape[1])
    return _Light(table, spread, _reach(centers, axis), dark)


def _centers(images: Real, sampling: float, center: ArrayLike | str, batch: tuple[int, ...]) -> Real:
    if isinstance(center, str):
        if center == "centroid":
            return centroid(images, sampling)
        if center == "origin":
            return np.zeros((len(images), 2))
        raise UserError(f'a circle\'s center is "centroid", "origin" or x and y, not "{center}"')
    return np.broadcast_to(np.asarray(center, dtype=np.float64), (*batch, 2)).reshape(-1, 2)


def _spread(distance: Real, images: Real, bins: int) -> Real:
    """Histogram (B, bins) of light over distance, spread as cubic interpolation reads an even table."""
    place = np.minimum(distance / _STEP, float(bins))
    first = np.floor(place).astype(np.int64)
    t = place - first
    offset = np.arange(len(images))[:, None, None] * (bins + 3)
    total = np.zeros(len(images) * (bins + 3))
    weights = (
        -t * (t - 1) * (t - 2) / 6,
        (t + 1) * (t - 1) * (t - 2) / 2,
        -(t + 1) * t * (t - 2) / 2,
        (t + 1) * t * (t - 1) / 6,
    )
    for shift, weight in enumerate(weights, start=-1):
        index = offset + np.abs(first + shift)
        total += np.bincount(index.ravel(), (weight * images).ravel(), total.size)
    return np.asarray(total.reshape(len(images), -1)[:, :bins])


@dataclass(frozen=True)
class _Table:
    weights: Real


@prepared(maxsize=8)
def _table(sampling: float, radii: tuple[float, ...], disc: bool) -> Real:
    """Weights (R, T) of a pixel by its distance: Hankel transforms of disc (or circle) times kernel."""
    return kept(_Table, _weights, sampling, radii, disc).weights


def _weights(sampling: float, radii: tuple[float, ...], disc: bool) -> _Table:
    r = np.asarray(radii)
    distance = np.arange(int((r.max() + _WING) / _STEP)) * _STEP
    middle = min(0.5 / sampling, 2.0)
    width = max((middle - 1.0) / 4.5, 0.1)
    last = middle + 6.0 * width
    u, weight = np.polynomial.legendre.leggauss(60 + int(np.pi * last * (r.max() + distance[-1])))
    u, weight = 0.5 * last * (u + 1.0), 0.5 * last * weight
    kernel = 2.0 * np.pi * weight * 0.5 * scipy.special.erfc((u - middle) / (np.sqrt(2.0) * width))
    phase = 2.0 * np.pi * np.outer(r, u)
    source = r[:, None] * scipy.special.j1(phase) if disc else u * scipy.special.j0(phase)
    return _Table(np.asarray((source * kernel) @ scipy.special.j0(2.0 * np.pi * np.outer(u, distance))))
