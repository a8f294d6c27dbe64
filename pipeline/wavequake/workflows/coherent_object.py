"""Images of an object whose light is coherent, or partially so, through a pupil of rays.

The object's spectrum at the frequency of a ray is what that ray carries; the image is the same sum over rays
as a point spread function is. A source is a set of points, each of which shifts the spectrum across the pupil
(Abbe). Amplitudes add, so every instant of an exposure has an image of its own: no mean point spread function
stands for them.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wavequake.imaging.image_formation import Source, disk_source
from wavequake.imaging.segment_basis import SegmentBasis, ray_basis
from wavequake.imaging.segment_psf import amplitude_images
from wavequake.workflows.exposed_object import ObjectSection, object_picture

Array = NDArray[np.float64]

# Points of a source on a grid seem coherent again at a distance in the image, in lambda/D, whose
# wings of the point spread function no longer matter.
_APART = 12.0
_LEAST_ACROSS = 5


@dataclass(frozen=True)
class LitObject:
    """An object in its light, as rays see it.

    Attributes
    ----------
    basis : SegmentBasis
        Of the rays.
    spectra : ndarray, shape (points, R)
        What each ray carries of the object, by point of the source.
    weights : ndarray, shape (points,)
    """

    basis: SegmentBasis
    spectra: NDArray[np.complex128]
    weights: Array


def lit_object(
    section: ObjectSection,
    rays: tuple[Array, Array, Array],
    pixels: int,
    sampling: float,
    area: float,
    diameter: float,
) -> LitObject:
    """Prepare an object in coherent or partially coherent light.

    Parameters
    ----------
    section : ObjectSection
    rays : tuple of three ndarray, shape (R,)
        x and y in the pupil in mm, and weights.
    pixels, sampling
        Of the frame; sampling in wavelengths / diameter.
    area, diameter
        Of the pupil, mm² and mm.

    Raises
    ------
    UserError
        If the object is impossible or does not fit into the frame.
    """
    x, y, weight = rays
    picture = object_picture(section, pixels, sampling)
    source = source_of(section)
    axis = np.asarray((np.arange(pixels) - pixels // 2) * sampling, dtype=np.float64)
    spectra = [
        _spectrum(picture, axis, sampling, x / diameter + 0.5 * across, y / diameter + 0.5 * up)
        for across, up in source.points
    ]
    basis = ray_basis(x, y, weight, pixels, sampling, diameter)
    return LitObject(basis, np.array(spectra) * (area / diameter**2), source.weights)


def source_of(section: ObjectSection) -> Source:
    """Return the source that lights an object coherently or partially so."""
    if section.sigma is None:
        return Source(np.zeros((1, 2)), np.ones(1))
    across = max(_LEAST_ACROSS, int(np.ceil(_APART * section.sigma)) | 1)
    return disk_source(section.sigma, across=across)


def mean_image(lit: LitObject, phases: Iterable[Array]) -> Array:
    """Return the mean image (n, n) over the instants of an exposure.

    Parameters
    ----------
    lit : LitObject
    phases : iterable of ndarray, shape (block, R)
        Phases of the rays in waves; a tilt places the image.
    """
    size, count = lit.basis.pixels, 0
    total = np.zeros(size * size)
    for block in phases:
        fields = np.exp(2j * np.pi * (block - np.rint(block)))
        for spectrum, weight in zip(lit.spectra, lit.weights, strict=True):
            total += weight * amplitude_images(lit.basis, fields * spectrum).sum(axis=0, dtype=np.float64)
        count += len(block)
    return np.asarray(total.reshape(size, size) / count)


def _spectrum(picture: Array, axis: Array, pitch: float, x: Array, y: Array) -> NDArray[np.complex128]:
    """Transform square pixels at frequencies x and y (R,), in the sign with which a tilt places an image."""
    along_x, along_y = (np.exp(2j * np.pi * np.outer(f, axis)) for f in (x, y))
    squares = pitch**2 * np.sinc(pitch * x) * np.sinc(pitch * y)
    return np.asarray(squares * ((along_x @ picture.T) * along_y).sum(axis=1))
