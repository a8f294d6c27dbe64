"""Resolution measured on images: the dip between two points, the contrast of gratings, and their limits.

Lengths are in wavelengths / diameter, which is wavelength / (2 NA): Rayleigh's distance 0.61 wavelength / NA
(Störkle 2018, Eq. 3.76) is 1.22, Abbe's wavelength / (2 NA) (Eq. 1.1) is 1.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from wavequake.errors import UserError
from wavequake.imaging.objects.formation import (
    Source,
    coherent_image,
    incoherent_image,
    partially_coherent_image,
    star_field_image,
)
from wavequake.imaging.objects.shapes import grating
from wavequake.imaging.pupils.pupil_shape import PupilShape

Real = NDArray[np.float64]

# Pixels of a grating's period.
_PERIOD_PIXELS = 48
# What a contrast has to exceed to be one.
_CONTRAST = 1e-6


def contrast(image: NDArray[np.floating]) -> float:
    """Return (max - min) / (max + min) of an irradiance.

    Raises
    ------
    UserError
        If there is no light, or not all of it is finite.
    """
    low, high = (float(pick(image)) if image.size else 0.0 for pick in (np.min, np.max))
    if not (np.isfinite([low, high]).all() and low + high > 0.0):
        raise UserError("an image without light, or not finite, has no contrast")
    return (high - low) / (high + low)


def saddle(psf: NDArray[np.floating], sampling: float, distance: float) -> float:
    """Return the irradiance between two equal stars over that at the stars: 0.735 at Rayleigh's distance.

    Parameters
    ----------
    psf : ndarray, shape (n, n)
        Image of a star; it should be dark at its border.
    sampling : float
        Distance of its pixels, wavelengths / diameter.
    distance : float
        Of the stars along x.

    Raises
    ------
    UserError
        If the image has no light where the star is, or is no picture.
    """
    # The image is moved instead of the stars, so that each place of interest falls on the middle pixel.
    middle = len(psf) // 2
    half = 0.5 * distance
    pair = np.array([[-half, 0.0], [half, 0.0]])
    between, at_star = (
        float(star_field_image(psf, pair + np.array([shift, 0.0]), np.ones(2), sampling)[middle, middle])
        for shift in (0.0, half)
    )
    if not at_star > 0.0:
        raise UserError("the image of a star has no light at its middle, so that there is no saddle")
    return between / at_star


def two_point_resolution(psf: NDArray[np.floating], sampling: float, dip: float = 0.735) -> float:
    """Return the distance at which two equal stars show a saddle of `dip`: 1.22 for a perfect pupil.

    Raises
    ------
    UserError
        If there is no such distance up to a quarter of the image.
    """
    most = 0.25 * len(psf) * sampling
    distances = np.arange(0.25, most, 0.125)
    saddles = np.array([saddle(psf, sampling, distance) for distance in distances]) - dip
    found = np.flatnonzero((saddles[:-1] > 0.0) & (saddles[1:] <= 0.0))
    if not found.size:
        raise UserError(f"two points up to {most:g} wavelengths/diameter apart show no saddle of {dip:g}")
    first = int(found[0])
    return float(
        brentq(
            lambda one: saddle(psf, sampling, one) - dip, distances[first], distances[first + 1], xtol=1e-6
        )
    )


def grating_image(
    period: float, pupil: PupilShape, source: Source | None = None, coherent: bool = False
) -> Real:
    """Return one period of the image of a grating with equal bars and gaps, along x.

    Its light is coherent along the axis, that of a source, or incoherent if neither is asked for.

    Raises
    ------
    UserError
        If the period is not above 0, or so long that its pixels do not resolve the pupil.
    """
    if not (np.isfinite(period) and period > 0.0):
        raise UserError(f"a grating needs a period above 0, not {period}")
    pixels = max(_PERIOD_PIXELS, 4 * int(np.ceil(period)))
    pitch = period / pixels
    bars = grating((1, pixels), pitch, period)
    if source is not None:
        image = partially_coherent_image(bars, pitch, pupil, source)
    elif coherent:
        image = coherent_image(bars, pitch, pupil)
    else:
        image = incoherent_image(bars, pitch, pupil)
    return image.ravel()


def abbe_resolution(pupil: PupilShape, source: Source | None = None, coherent: bool = False) -> float:
    """Return the smallest period that has any contrast in the image.

    It is 2 in coherent light along the axis (wavelength / NA), 2 / (1 + sigma) with a source of partial
    coherence sigma <= 1, and 1 in incoherent light (wavelength / (2 NA)).
    """

    def resolved(period: float) -> bool:
        return contrast(grating_image(period, pupil, source, coherent)) > _CONTRAST

    low, high = 0.5, 3.0
    if resolved(low) or not resolved(high):
        raise UserError(f"the smallest resolved period is not between {low} and {high} wavelengths/diameter")
    while high - low > 1e-6:
        middle = 0.5 * (low + high)
        low, high = (low, middle) if resolved(middle) else (middle, high)
    return high
