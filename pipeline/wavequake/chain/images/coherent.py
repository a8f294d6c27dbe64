"""Images of an object whose light is coherent, or partially so, through a pupil of rays or of cells.

The object's spectrum at the frequency of a ray is what that ray carries; the image is the same sum over rays
as a point spread function is. A source is a set of points, each of which shifts the spectrum across the pupil
(Abbe). Amplitudes add, so every instant of an exposure has an image of its own: no mean point spread function
stands for them.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wavequake.chain.images.extended import ObjectSection, object_picture
from wavequake.imaging.engines import matrix_fourier, segment_psf
from wavequake.imaging.engines.matrix_fourier import MatrixFourier
from wavequake.imaging.engines.segment_basis import SegmentBasis, ray_basis
from wavequake.imaging.exposures.smear import add_smeared, empty_total, smeared_image
from wavequake.imaging.objects.formation import Source, disk_source

Array = NDArray[np.float64]

# Points of a source on a grid seem coherent again at a distance in the image, in lambda/D, whose
# wings of the point spread function no longer matter.
_APART = 12.0
_LEAST_ACROSS = 5
# Instants at once: bounds the memory.
_BATCH = 16


@dataclass(frozen=True)
class LitObject:
    """An object in its light, as rays or the cells of a pupil see it.

    Attributes
    ----------
    pupil : SegmentBasis or MatrixFourier
        Of R rays, or of the R patches of a sampled pupil.
    spectra : ndarray, shape (points, R)
        What each of them carries of the object, by point of the source.
    weights : ndarray, shape (points,)
    """

    pupil: SegmentBasis | MatrixFourier
    spectra: NDArray[np.complex128]
    weights: Array


def lit_object(
    section: ObjectSection,
    rays: tuple[Array, Array, Array],
    pixels: int,
    sampling: float,
    area: float,
    diameter: float,
    canvas: int = 1,
) -> LitObject:
    """Prepare an object in coherent or partially coherent light for a pupil of rays.

    Parameters
    ----------
    section : ObjectSection
    rays : tuple of three ndarray, shape (R,)
        x and y in the pupil in mm, and weights.
    pixels, sampling
        Of the frame; sampling in wavelengths / diameter.
    area, diameter
        Of the pupil, mm² and mm.
    canvas : int
        Images are so many frames wide; the object fills the one in the middle.

    Raises
    ------
    UserError
        If the object is impossible or does not fit into the frame.
    """
    x, y, weight = rays
    picture = object_picture(section, pixels, sampling)
    source = source_of(section)
    spectra: list[NDArray[np.complex128]] = []
    for across, up in source.points:
        fx, fy = x / diameter - 0.5 * across, y / diameter - 0.5 * up
        along_x, along_y = (_along(f, pixels, sampling) for f in (fx, fy))
        spectra.append(_squares(sampling, fx, fy) * ((along_x @ picture.T) * along_y).sum(axis=1))
    basis = ray_basis(x, y, weight, canvas * pixels, sampling, diameter)
    return LitObject(basis, np.array(spectra) * (area / diameter**2), source.weights)


def lit_by_cells(section: ObjectSection, transform: MatrixFourier, pixels: int | None = None) -> LitObject:
    """Prepare an object in coherent or partially coherent light for a sampled pupil.

    The object fills a frame of ``pixels``, by default that of the transform. Errors are those of
    `lit_object`.
    """
    pupil, axis = transform.pupil, transform.axis
    sampling, pixels = float(axis[1] - axis[0]), pixels or len(axis)
    picture = object_picture(section, pixels, sampling)
    source = source_of(section)
    spectra: list[NDArray[np.complex128]] = []
    for across, up in source.points:  # of whole cells: their spectrum is separable
        fx, fy = 0.5 * (pupil.axis - across), 0.5 * (pupil.axis - up)
        grid = _along(fy, pixels, sampling) @ picture @ _along(fx, pixels, sampling).T
        spectra.append((_squares(sampling, fx, fy[:, None]) * grid).ravel()[pupil.cells])
    share = pupil.light.sum() / len(pupil.axis) ** 2
    return LitObject(transform, np.array(spectra) * share, source.weights)


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
        Phases of rays or patches in waves; a tilt places the image.
    """
    total, count = np.zeros(()), 0
    for block in phases:
        for images in lit_images(lit, block):
            total = total + images.sum(axis=0)
        count += len(block)
    return np.asarray(total / count)


def smeared_object(lit: LitObject, phases: Array, ways: Array, sampling: float) -> Array:
    """Return the mean image (n, n) over instants of phases (T, R) in waves that move along ways (T, m, 2).

    A tilt moves an image as a whole, so what is exposed between two instants needs no phases of its own.
    """
    pupil, first = lit.pupil, 0
    size = len(pupil.axis) if isinstance(pupil, MatrixFourier) else pupil.pixels
    total = empty_total(size, ways, sampling)
    for images in lit_images(lit, phases):
        add_smeared(total, images, ways[first : first + len(images)], sampling)
        first += len(images)
    return smeared_image(total, ways, size, sampling)


def lit_images(lit: LitObject, phases: Array) -> Iterator[Array]:
    """Yield the images (part, n, n) of the instants whose phases (instants, R) in waves are given, by parts.

    A ray whose phase is NaN is dark.
    """
    for first in range(0, len(phases), _BATCH):
        part = phases[first : first + _BATCH]
        fields = np.exp(2j * np.pi * (part - np.rint(part)))
        fields[np.isnan(part)] = 0.0
        images = np.zeros(())
        for spectrum, weight in zip(lit.spectra, lit.weights, strict=True):
            images = images + weight * _images(lit.pupil, fields * spectrum).astype(np.float64)
        yield images


def _images(pupil: SegmentBasis | MatrixFourier, amplitude: NDArray[np.complex128]) -> NDArray[np.floating]:
    if isinstance(pupil, MatrixFourier):
        return matrix_fourier.amplitude_images(pupil, amplitude)
    return segment_psf.amplitude_images(pupil, amplitude).reshape(-1, pupil.pixels, pupil.pixels)


def _along(frequency: Array, pixels: int, pitch: float) -> NDArray[np.complex128]:
    """Waves (R, pixels) along an axis of the object, in the sign with which a tilt places an image."""
    axis = (np.arange(pixels) - pixels // 2) * pitch
    return np.asarray(np.exp(2j * np.pi * np.outer(frequency, axis)))


def _squares(pitch: float, fx: Array, fy: Array) -> Array:
    """Spectrum of a square pixel."""
    return np.asarray(pitch**2 * np.sinc(pitch * fx) * np.sinc(pitch * fy))
