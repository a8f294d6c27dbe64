"""How good an image is: peak to valley, the criteria of Rayleigh and Marechal, and the size of a ray spot."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError

Array = NDArray[np.float64]

RAYLEIGH = 1 / 4  # largest peak to valley of a diffraction-limited wavefront, waves (Störkle 2018, Eq. 3.54)
MARECHAL = 1 / 14  # largest rms, waves (Eq. 3.55); the Strehl ratio is then about 0.8
_ROUNDING = 1e-12  # sums of weights that reach a fraction but for rounding do reach it


@dataclass(frozen=True)
class Spot:
    """Where the rays of each instant meet the image; lengths in the unit of the positions.

    Attributes
    ----------
    centroid : ndarray, shape (batch, 2)
        Weighted mean position.
    rms : ndarray, shape (batch,)
        Root of the weighted mean square distance from the centroid.
    enclosing : ndarray, shape (batch,)
        Smallest radius about the centroid that holds the asked fraction of the light.
    """

    centroid: Array
    rms: Array
    enclosing: Array


def peak_to_valley(opd: Array) -> Array:
    """Return the largest minus the smallest value of each instant.

    Parameters
    ----------
    opd : ndarray, shape (batch, N)
        At the rays; NaN where a ray is lost.

    Returns
    -------
    ndarray, shape (batch,)
        In the unit of `opd`; NaN where all rays are lost.
    """
    lost = np.isnan(opd)
    largest = np.max(np.where(lost, -np.inf, opd), axis=1, initial=-np.inf)
    smallest = np.min(np.where(lost, np.inf, opd), axis=1, initial=np.inf)
    return np.where(lost.all(axis=1), np.nan, largest - smallest)


def meets_rayleigh(peak_to_valley: Array) -> NDArray[np.bool_]:
    """Return whether wavefronts are diffraction-limited by their peak to valley in waves (Eq. 3.54).

    An unknown (NaN) wavefront is not.
    """
    return np.asarray(peak_to_valley <= RAYLEIGH)


def meets_marechal(rms: Array) -> NDArray[np.bool_]:
    """Return whether wavefronts are diffraction-limited by their rms in waves (Eq. 3.55).

    An unknown (NaN) wavefront is not.
    """
    return np.asarray(rms <= MARECHAL)


def spot(x: Array, y: Array, weight: Array, fraction: float = 0.8) -> Spot:
    """Return centroid and size of the spots that rays make.

    Parameters
    ----------
    x, y : ndarray, shape (batch, N)
        Image points; NaN where a ray is lost, which is then left out.
    weight : ndarray, shape (N,)
        Light of each ray, positive; need not sum to 1.
    fraction : float
        Of the light that is not lost, for the enclosing radius; 0 < fraction <= 1.

    Returns
    -------
    Spot
        NaN where all rays are lost.

    Raises
    ------
    UserError
        If the fraction is not in (0, 1], or a weight is not positive.
    """
    if not 0.0 < fraction <= 1.0:
        raise UserError(f"the fraction of enclosed light is {fraction}, it must lie in (0, 1]")
    if not (np.isfinite(weight) & (weight > 0.0)).all():
        raise UserError("the weights of a spot's rays must all be positive numbers")
    known = np.isfinite(x) & np.isfinite(y)
    light = np.where(known, weight, 0.0)
    total = np.sum(light, axis=1)
    light /= np.where(total > 0.0, total, np.nan)[:, None]
    x, y = np.where(known, x, 0.0), np.where(known, y, 0.0)
    centroid = np.stack([np.sum(light * x, axis=1), np.sum(light * y, axis=1)], axis=1)
    square = np.square(x - centroid[:, :1]) + np.square(y - centroid[:, 1:])
    distance = np.sqrt(square)
    order = np.argsort(np.where(known, distance, np.inf), axis=1)
    enclosed = np.cumsum(np.take_along_axis(light, order, axis=1), axis=1)
    reached = np.argmax(enclosed >= fraction * (1.0 - _ROUNDING), axis=1)
    enclosing = np.take_along_axis(np.take_along_axis(distance, order, axis=1), reached[:, None], axis=1)[
        :, 0
    ]
    return Spot(centroid=centroid, rms=np.sqrt(np.sum(light * square, axis=1)), enclosing=enclosing)
