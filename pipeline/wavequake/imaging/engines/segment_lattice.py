"""Exact point spread functions of equal segments on a regular lattice, from pistons and slopes.

Where all segments have one shape, the field is the transform of that shape times the sum over segments of
exp(2πi p_s) exp(-2πi f·x_s). On a lattice that sum is separable: first along y in every column, then along x.
Rows and columns are folded about the middle of the lattice into even and odd parts, which are transformed by
cosines and sines at half of the frequencies only: a quarter of the products, all of them real. An OpenCL
processor makes each image in one go (`wavequake.kernels.transforms.lattice`), and adds slopes moment by
moment, as `wavequake.imaging.engines.segment_psf` does.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from wavequake.errors import UserError
from wavequake.imaging.engines.polygon_transform import polygon_areas, polygon_transform
from wavequake.imaging.engines.segment_basis import MOMENTS
from wavequake.imaging.engines.segment_moments import largest_means, moments_on_grid
from wavequake.kernels.device.devices import NUMPY, Device
from wavequake.kernels.transforms.lattice import LatticeKernel, lattice_images, lattice_kernel

Real = NDArray[np.float64]
Floating = NDArray[np.float32] | NDArray[np.float64]

# Segments are equal and on the lattice if nothing is off by more than this share of the pupil: rounding.
_ROUNDING = 1e-14
# Images at once, whose fields a processor's cache holds.
_TILE = 2
# A lattice has at most this many places per segment: hexagons fill half of theirs.
_PLACES = 8


@dataclass(frozen=True)
class SegmentLattice:
    """What all images of one lattice on one grid have in common.

    Attributes
    ----------
    pixels : int
        An image has pixels x pixels points, axis 0 is y; [pixels // 2, pixels // 2] is the origin.
    shape : tuple of int
        Columns C and rows R of the lattice.
    places : ndarray of int, shape (S,)
        Place of each segment among the R * C.
    along_x, along_y : tuple of ndarray, shape (K, half of C or R)
        Cosines and sines of the columns' and rows' places at the K = pixels // 2 + 1 frequencies f >= 0.
    envelope : ndarray, shape (pixels, pixels)
        Irradiance of a segment relative to the peak of the whole pupil.
    remainders : ndarray, shape (degrees, 1)
        As those of a `SegmentBasis`; what is left out beyond the moments of the last degree.
    kernel : LatticeKernel, optional
        The same for an OpenCL processor, which then makes the images.
    """

    pixels: int
    shape: tuple[int, int]
    places: NDArray[np.intp]
    along_x: tuple[Floating, Floating]
    along_y: tuple[Floating, Floating]
    envelope: Floating
    remainders: Real
    kernel: LatticeKernel | None = None


def segment_lattice(
    corners: Real,
    centers: Real,
    pixels: int,
    sampling: float,
    diameter: float,
    dtype: DTypeLike = np.float64,
    device: Device = NUMPY,
    moments: int = 1,
) -> SegmentLattice | None:
    """Prepare the images of equal segments on a lattice; none if these are not, or slopes are too much.

    Rows and columns of the lattice must lie along x and y, as those of hexagons do whose corners or edges do.

    Parameters
    ----------
    corners : ndarray, shape (S, V, 2)
        Projected corners in mm, counter-clockwise.
    centers : ndarray, shape (S, 2)
        Points in mm to which the pistons belong.
    pixels : int
        An image has pixels x pixels points.
    sampling : float
        Distance of the points in units of wavelength / `diameter`.
    diameter : float
        Length in mm that defines the unit wavelength / diameter.
    dtype : float64 or float32
        Precision: errors are below 1e-12 or 2e-6 of the perfect peak.
    device : Device
        An OpenCL processor, unless the images are to be made by NumPy; a GPU leaves them to it.
    moments : {1, 6, 15, ...}
        As for `wavequake.imaging.engines.segment_basis.segment_basis`: 1 for pistons; more only on an OpenCL
        processor.

    Raises
    ------
    UserError
        If a polygon is clockwise, empty or not finite, or the centers or the grid impossible.
    """
    if moments not in MOMENTS:
        raise UserError(f"an image takes {', '.join(map(str, MOMENTS))} moments per segment, not {moments}")
    if pixels < 2 or not (np.isfinite([sampling, diameter]).all() and sampling > 0.0 and diameter > 0.0):
        raise UserError(
            f"an image needs 2 x 2 points and a sampling and diameter above 0, not {pixels} points at "
            f"{sampling:g} wavelengths / {diameter:g} mm"
        )
    areas = polygon_areas(corners)
    if centers.shape != (len(corners), 2) or not np.isfinite(centers).all():
        raise UserError(f"{len(corners)} segments need as many finite centers, not {centers.shape}")
    rounding = _ROUNDING * float(np.abs(corners).max())
    own = corners - centers[:, None]
    columns, rows = (_line(centers[:, axis], 10.0 * rounding) for axis in (0, 1))
    if np.abs(own - own[0]).max() > 10.0 * rounding or columns is None or rows is None:
        return None
    (column, along_x), (row, along_y) = columns, rows
    shape = len(along_x), len(along_y)
    if shape[0] * shape[1] > _PLACES * len(centers):
        return None
    axis = np.asarray((np.arange(pixels) - pixels // 2) * (sampling / diameter), dtype=np.float64)
    y, x = np.meshgrid(axis, axis, indexing="ij")
    field = polygon_transform(own[:1], x.ravel(), y.ravel()).reshape(1, pixels, pixels) / areas.sum()
    envelope = (field[0].real ** 2 + field[0].imag ** 2).astype(dtype)
    degree, middle, scale = 2 * MOMENTS.index(moments), np.zeros((1, 2)), float(np.hypot(*own[0].T).max())
    if degree:
        field = moments_on_grid(own[:1], middle, axis, axis, degree, scale).T.reshape(-1, pixels, pixels)
        field = field / areas.sum()
    frequencies = np.asarray(np.arange(pixels // 2 + 1) * (sampling / diameter), dtype=np.float64)
    waves_x, waves_y = (_folded_waves(frequencies, along, dtype) for along in (along_x, along_y))
    places, lines = (column, row), (along_x, along_y)
    kernel = lattice_kernel(places, lines, field, scale, sampling / diameter, device, dtype)
    if kernel is None and degree:
        return None
    remainders = largest_means(own[:1], middle, degree) / areas.sum()
    number = row * shape[0] + column
    return SegmentLattice(pixels, shape, number, waves_x, waves_y, envelope, remainders, kernel)


def lattice_psf(lattice: SegmentLattice, segment_phase: ArrayLike) -> Floating:
    """Return point spread functions, whose unit is the peak of the perfect one.

    Parameters
    ----------
    lattice : SegmentLattice
    segment_phase : array_like, shape (batch, S) or (batch, S, 3)
        Pistons in waves at the centers, or these and slopes in waves per mm, as
        `wavequake.imaging.engines.segment_psf.psf` takes them; slopes count where the lattice has moments of
        them (`wavequake.imaging.engines.segment_psf.truncation_error` says how well). An instant with a NaN
        gives an image of NaN.

    Returns
    -------
    ndarray, shape (batch, pixels, pixels), float32 or float64
    """
    phase = np.asarray(segment_phase, dtype=np.float64)
    if phase.ndim == 2:
        phase = np.pad(phase[..., None], ((0, 0), (0, 0), (0, 2)))
    if phase.ndim != 3 or phase.shape[1:] != (lattice.places.size, 3):
        raise ValueError(f"segment_phase has the shape {phase.shape}, not (batch, {lattice.places.size}, 3)")
    if lattice.kernel:
        return lattice_images(lattice.kernel, phase)
    piston = phase[..., 0]
    images = np.empty((len(piston), lattice.pixels, lattice.pixels), dtype=lattice.envelope.dtype)
    workspace = _workspace(lattice)
    for first in range(0, len(piston), _TILE):  # products of constant shape: bits do not depend on the batch
        part = piston[first : first + _TILE]
        tile = np.zeros((_TILE, piston.shape[1]))
        tile[: len(part)] = part
        _tile_images(lattice, workspace, tile, images[first : first + _TILE])
    return images


def _workspace(lattice: SegmentLattice) -> tuple[Floating, ...]:
    """Return memory for the fields of a tile: fresh memory would cost more time than the sums themselves."""
    pixels, (columns, _), dtype = lattice.pixels, lattice.shape, lattice.envelope.dtype
    folded, frequencies = (columns + 1) // 2, pixels // 2 + 1
    lengths = (columns, folded, folded, frequencies, frequencies)
    return (
        *(np.empty((2, _TILE, pixels, length), dtype=dtype) for length in lengths),
        np.empty((_TILE, pixels, frequencies), dtype=dtype),
        np.empty((_TILE, pixels, frequencies), dtype=dtype),
    )


def _tile_images(
    lattice: SegmentLattice, workspace: tuple[Floating, ...], piston: Real, images: Floating
) -> None:
    """Write the images of one tile (2, S), which it may change; there may be fewer images than that."""
    dtype, pixels = lattice.envelope.dtype, lattice.pixels
    columns, rows = lattice.shape
    broken = np.asarray(~np.isfinite(piston).all(axis=1))
    piston[broken] = 0.0  # a product would spread what is no number
    phase = (2.0 * np.pi * (piston - np.rint(piston))).astype(dtype)
    amplitude = np.zeros((2, _TILE, rows * columns), dtype=dtype)  # real and imaginary parts
    amplitude[0][:, lattice.places], amplitude[1][:, lattice.places] = np.cos(phase), np.sin(phase)
    upper, lower = _halves(amplitude.reshape(2, _TILE, rows, columns).swapaxes(2, 3))
    cosines, sines = lattice.along_y
    # (2, tile, frequency, column)
    te, to = cosines @ (upper + lower).swapaxes(2, 3), sines @ (upper - lower).swapaxes(2, 3)
    middle, last = pixels // 2, pixels - pixels // 2
    field, even, odd, pe, po, cross, part = workspace
    above, below = slice(None, last), slice(middle, 0, -1)
    np.add(te[0, :, above], to[1, :, above], out=field[0, :, middle:])
    np.subtract(te[1, :, above], to[0, :, above], out=field[1, :, middle:])
    np.subtract(te[0, :, below], to[1, :, below], out=field[0, :, :middle])
    np.add(te[1, :, below], to[0, :, below], out=field[1, :, :middle])
    upper, lower = _halves(field)
    np.add(upper, lower, out=even)
    np.subtract(upper, lower, out=odd)
    cosines, sines = lattice.along_x
    flat, waves = (-1, even.shape[3]), (-1, pe.shape[3])
    np.matmul(even.reshape(flat), cosines.T, out=pe.reshape(waves))
    np.matmul(odd.reshape(flat), sines.T, out=po.reshape(waves))
    np.multiply(pe[0], po[1], out=cross)
    np.multiply(pe[1], po[0], out=part)
    cross -= part
    cross *= 2.0
    pe *= pe
    po *= po
    pe += po
    both = np.add(pe[0], pe[1], out=pe[0])
    count, envelope = len(images), lattice.envelope
    right, left = np.add(both, cross, out=po[0]), np.subtract(both, cross, out=po[1])
    np.multiply(right[:count, :, above], envelope[:, middle:], out=images[:, :, middle:])
    np.multiply(left[:count, :, below], envelope[:, :middle], out=images[:, :, :middle])
    images[broken[:count]] = np.nan


def _halves(values: Floating) -> tuple[Floating, Floating]:
    """Return the upper half of the last axis and the lower one mirrored; a middle entry is in both."""
    length = values.shape[-1]
    half = (length + 1) // 2
    return values[..., length - half :], values[..., half - 1 :: -1]


def _folded_waves(frequencies: Real, along: Real, dtype: DTypeLike) -> tuple[Floating, Floating]:
    """Return cosines and sines (K, half) at the upper half of symmetric places."""
    upper = along[len(along) // 2 :]
    cycles = np.outer(frequencies, upper)
    angle = 2.0 * np.pi * (cycles - np.rint(cycles))
    cosines = np.cos(angle)
    if len(along) % 2:
        cosines[:, 0] = 0.5  # folding counts the middle twice
    return cosines.astype(dtype), np.sin(angle).astype(dtype)


def _line(values: Real, rounding: float) -> tuple[NDArray[np.intp], Real] | None:
    """Return the number of each value on a line of even steps, and the line about its middle; none if off."""
    ordered = np.sort(values)
    steps = np.diff(ordered)
    steps = steps[steps > 1e3 * rounding]
    if not steps.size:
        return np.zeros(values.size, dtype=np.intp), np.zeros(1)
    span = float(np.ptp(values))
    count = round(span / float(steps.min()))
    if count >= _PLACES * values.size:
        return None
    pitch = span / count
    number = np.rint((values - values.min()) / pitch).astype(np.intp)
    if np.abs(values - values.min() - number * pitch).max() > rounding:
        return None
    return number, np.asarray((np.arange(count + 1) - 0.5 * count) * pitch, dtype=np.float64)
