"""The long exposure of a wavefront that moves at random, in closed form: no draws."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Beams:
    """Points of a pupil.

    Attributes
    ----------
    places : ndarray, shape (q, 2)
        In diameters of the pupil.
    weights : ndarray, shape (q,)
        Shares of its light.
    """

    places: Array
    weights: Array


def mean_coherence(covariance: Array, wavelength: float) -> Array:
    """Return the mean of exp(i (phase_i - phase_j)) of a Gaussian wavefront of zero mean, (q, q).

    exp(-D / 2), where D is the structure function of the phase (Roddier 1981).

    Parameters
    ----------
    covariance : ndarray, shape (q, q)
        Of the wavefront at points, in the square of the unit of the wavelength.
    wavelength : float
    """
    own = np.diag(covariance)
    apart = np.maximum(own[:, None] + own - 2.0 * covariance, 0.0)
    return np.asarray(np.exp(-0.5 * (2.0 * np.pi / wavelength) ** 2 * apart))


def mean_image(beams: Beams, coherence: Array, angles: Array) -> Array:
    """Return the long exposure, (a, a); 1 is the peak of the image without any wavefront.

    Parameters
    ----------
    beams : Beams
    coherence : ndarray, shape (q, q)
        See `mean_coherence`.
    angles : ndarray, shape (a,)
        Of pixels along x and along y, in wavelengths over diameters.
    """
    along_y, along_x = np.meshgrid(angles, angles, indexing="ij")
    turns = 2.0 * np.pi * (np.outer(along_x, beams.places[:, 0]) + np.outer(along_y, beams.places[:, 1]))
    found = np.zeros(len(turns))
    for part in (np.cos(turns), np.sin(turns)):
        waves = part * beams.weights
        found += np.einsum("aq,aq->a", waves @ coherence, waves)
    return found.reshape(along_x.shape)
