"""Point spread functions by whichever of three engines is the cheapest for a pupil and an image.

- "fft": a zero-padded fast Fourier transform, which makes many pixels nobody asked for.
- "matrix": matrix products for just the pixels that are wanted (`wavequake.imaging.engines.matrix_fourier`).
- "segments": closed-form transforms of the segments' polygons (`wavequake.imaging.engines.segment_psf`),
  which sample nothing; instants whose slopes exceed what its series is good for are sampled and left to
  "matrix".
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.imaging.engines import matrix_fourier as matrix
from wavequake.imaging.engines.segment_basis import MOMENTS, SegmentBasis, segment_basis
from wavequake.imaging.engines.segment_figure import (
    SegmentFigure,
    figure_error,
    figure_psf,
    segment_figure,
    terms_of_motion,
)
from wavequake.imaging.engines.segment_lattice import SegmentLattice, lattice_psf, segment_lattice
from wavequake.imaging.engines.segment_psf import moments_needed, truncation_error
from wavequake.imaging.engines.segment_psf import psf as segments_psf
from wavequake.imaging.pupils.nyquist import samples_for, warn_of_coarse
from wavequake.imaging.pupils.outlines import Outline, blocked, segments
from wavequake.imaging.pupils.pupil_function import PupilGrid, pupil_function, sampled_pupil, single_patches
from wavequake.imaging.pupils.wavefront_phase import segment_phase
from wavequake.kernels.device.devices import NUMPY, Device
from wavequake.kernels.transforms.fourier import choose_fourier, fourier_2d

Real = NDArray[np.float64]

ENGINES = ("fft", "matrix", "segments")
# Measured on one thread of an AMD Zen 4 core: seconds per exponential, operations per second in products of
# matrices, and in Fourier transforms.
_WAVE = {"numpy": 25e-9, "opencl": 2e-9}
_PRODUCTS = {"numpy": 3e10, "opencl": 4e10}
_TRANSFORMS = {"scipy": 5e9, "opencl": 1e10}
# Seconds to fit polynomials to a bent segment.
_FIGURE = 1e-5
# Seconds to build one moment of one segment at one node.
_MOMENT = 2e-8
# Numbers in the padded pupils that are transformed at once: bounds the memory.
_PADDED = 1 << 22


@dataclass(frozen=True)
class SegmentedPupil:
    """A pupil of segments, simple polygons.

    Attributes
    ----------
    corners : ndarray, shape (S, V, 2)
        Projected corners in mm, counter-clockwise; a polygon with fewer than V corners repeats its last one.
    centers : ndarray, shape (S, 2)
        Points in mm to which the pistons belong and about which the slopes turn.
    diameter : float
        Length in mm that defines wavelength / diameter and encloses the pupil.
    obstructions : tuple of ndarray, shape (V, 2)
        Polygons in mm, counter-clockwise, that stand before the segments: vanes of a spider for
        example (`wavequake.imaging.pupils.outlines.vane`).
    figure_terms : int
        Noll terms j = 1..K on each segment; 3 for segments that move but do not bend. They are those of the
        circle about a segment's center that reaches the farthest corner of all segments.
    """

    corners: Real
    centers: Real
    diameter: float
    obstructions: tuple[Real, ...] = ()
    figure_terms: int = 3

    @property
    def reach(self) -> float:
        """Radius in mm of the circle of the segments' Noll terms."""
        return float(np.hypot(*np.moveaxis(self.corners - self.centers[:, None], -1, 0)).max())

    def outline(self) -> Outline:
        """Return where light passes: the segments, then what is taken from them."""
        found = segments(self.corners)
        for obstruction in self.obstructions:
            found = blocked(found, obstruction)
        return found


@dataclass(frozen=True)
class PsfEngine:
    """A prepared engine for one pupil and one image.

    Attributes
    ----------
    name : str
        "fft", "matrix" or "segments".
    reason : str
        Why it was chosen.
    seconds : dict of str to float
        What each engine that can make the image is estimated to take for an instant.
    pupil : PupilGrid or SegmentedPupil
    grid : PupilGrid
        The sampled pupil.
    transform : MatrixFourier
    basis : SegmentBasis, SegmentFigure or SegmentLattice, optional
        The last where equal segments stand on a lattice, and have pistons alone or an OpenCL processor.
    tolerance : float
        Largest error that ending the series in segments' slopes may make, relative to the perfect peak.
    device : Device
    """

    name: str
    reason: str
    seconds: dict[str, float]
    pupil: PupilGrid | SegmentedPupil
    grid: PupilGrid
    transform: matrix.MatrixFourier
    basis: SegmentBasis | SegmentFigure | SegmentLattice | None
    tolerance: float
    device: Device


def prepare_psf(
    pupil: PupilGrid | SegmentedPupil,
    pixels: int,
    sampling: float,
    engine: str = "auto",
    device: Device = NUMPY,
    instants: int = 1000,
    corner_phase: float = 0.0,
    tolerance: float = 1e-4,
    samples: int = 512,
) -> PsfEngine:
    """Choose and prepare the engine that images a pupil.

    Parameters
    ----------
    pupil : PupilGrid or SegmentedPupil
    pixels : int
        An image has pixels x pixels points; [pixels // 2, pixels // 2] is the origin, rows are y.
    sampling : float
        Distance of the points in wavelengths / diameter.
    engine : {"auto", "fft", "matrix", "segments"}
        "auto" is the one with the smallest estimate.
    device : Device
        Where "fft" and "matrix" run.
    instants : int
        How many images will be made: they share the time of the preparation.
    corner_phase : float
        Largest phase in rad that slopes make between a segment's center and a corner; 0 for pistons alone,
        with which equal segments on a regular lattice are an order of magnitude faster.
    tolerance : float
        Largest error that ending the series in segments' slopes may make, relative to the perfect peak.
    samples : int
        Cells across a segmented pupil where it has to be sampled.

    Raises
    ------
    UserError
        If the engine cannot make the image, or the image or pupil is impossible.
    """
    grid = pupil
    if isinstance(pupil, SegmentedPupil):
        grid = sampled_pupil(pupil.outline(), samples, pupil.diameter)
    assert isinstance(grid, PupilGrid)
    transform = matrix.matrix_fourier(grid, pixels, sampling, device)
    moments, unable = _moments(pupil, corner_phase, tolerance)
    seconds = {"matrix": _matrix_seconds(grid, pixels, device)}
    padded = _padded_size(len(grid.axis), sampling)
    if padded:
        seconds["fft"] = _fft_seconds(grid, padded, device)
    lattice = None
    if moments:
        assert isinstance(pupil, SegmentedPupil)
        lattice = _lattice(pupil, pixels, sampling, moments, device)
        seconds["segments"] = (
            _lattice_seconds(lattice)
            if lattice
            else _segments_seconds(pupil, pixels, sampling, moments, max(instants, 1))
        )
    if engine not in ("auto", *ENGINES):
        raise UserError(f"the engine of an image is auto, {', '.join(ENGINES)}, not {engine!r}")
    if engine != "auto" and engine not in seconds:
        why = (
            unable if engine == "segments" else f"{len(grid.axis)} samples / {sampling:g} is no whole number"
        )
        raise UserError(f"the engine {engine!r} cannot make this image: {why}")
    name = min(seconds, key=lambda key: seconds[key]) if engine == "auto" else engine
    basis: SegmentBasis | SegmentFigure | SegmentLattice | None = None
    if name == "segments":
        assert isinstance(pupil, SegmentedPupil)
        basis = lattice or _segment_basis(pupil, pixels, sampling, moments)
    estimates = ", ".join(f"{key} {1e3 * value:.3g} ms" for key, value in sorted(seconds.items()))
    reason = "asked for" if engine != "auto" else f"the least of {estimates} per image"
    if engine == "auto" and unable:
        reason += f"; segments cannot: {unable}"
    return PsfEngine(name, reason, seconds, pupil, grid, transform, basis, tolerance, device)


def point_spread(engine: PsfEngine, wavefront: Real, check: bool = True) -> Real:
    """Return point spread functions, whose unit is the peak of the perfect one.

    Parameters
    ----------
    engine : PsfEngine
    wavefront : ndarray
        For a `PupilGrid` phases (batch, m) in rad at its patches; for a `SegmentedPupil` (batch, S, K):
        pistons in waves, slopes along x and y in waves per mm, and Noll terms j = 4..K in waves. An instant
        that is not a number gives an image of NaN.
    check : bool
        Whether to warn if a sampled pupil is too coarse for the phase, which takes a fraction of the image.

    Returns
    -------
    ndarray, shape (batch, pixels, pixels)

    Raises
    ------
    UserError
        If the wavefront has the wrong shape.
    """
    pupil = engine.pupil
    if not isinstance(pupil, SegmentedPupil):
        return _sampled(engine, wavefront, check)
    motion = np.asarray(wavefront, dtype=np.float64)
    shape = (len(pupil.centers), pupil.figure_terms)
    if motion.ndim != 3 or motion.shape[1:] != shape:
        raise UserError(
            f"{shape[0]} segments of {shape[1]} terms need motions of shape (batch, {shape[0]}, {shape[1]}), "
            f"not {motion.shape}"
        )
    pixels = len(engine.transform.axis)
    images = np.empty((len(motion), pixels, pixels))
    steep = np.ones(len(motion), dtype=bool)
    if isinstance(engine.basis, SegmentFigure):
        terms = terms_of_motion(motion, engine.basis.basis.slope_scale)
        steep = figure_error(engine.basis, terms) > engine.tolerance
        images[~steep] = figure_psf(engine.basis, terms[~steep], engine.tolerance).reshape(-1, pixels, pixels)
    elif isinstance(engine.basis, SegmentLattice):
        steep = np.asarray(truncation_error(engine.basis, motion)[-1] > engine.tolerance)
        images[~steep] = lattice_psf(engine.basis, motion[~steep])
    elif engine.basis is not None:
        steep = np.asarray(truncation_error(engine.basis, motion)[-1] > engine.tolerance)
        exact = segments_psf(engine.basis, motion[~steep], engine.tolerance)
        images[~steep] = exact.reshape(-1, pixels, pixels)
    chosen = np.flatnonzero(steep)
    for first in range(0, chosen.size, 16):  # phases of a sampled pupil are large
        part = chosen[first : first + 16]
        phase = segment_phase(engine.grid, pupil.centers, motion[part], 0.5 * pupil.diameter, pupil.reach)
        images[part] = _sampled(engine, phase, check)
    return images


def _sampled(engine: PsfEngine, phase: Real, check: bool) -> Real:
    grid, transform = engine.grid, engine.transform
    if check and phase.ndim == 2 and phase.shape[1] == grid.cells.size:
        field = 2.0 * float(np.abs(transform.axis).max())
        warn_of_coarse(len(grid.axis), samples_for(grid, phase, field), field, 4)
    return _fft_psf(engine, phase) if engine.name == "fft" else matrix.psf(transform, phase)


def _fft_psf(engine: PsfEngine, phase: Real) -> Real:
    grid, transform = engine.grid, engine.transform
    matrix.check_phase(transform, phase)
    pixels, samples = len(transform.axis), len(grid.axis)
    padded = _padded_size(samples, float(transform.axis[1] - transform.axis[0]) if pixels > 1 else 1.0)
    wanted = (np.arange(pixels) - pixels // 2) % padded
    images = np.empty((len(phase), pixels, pixels))
    each = max(1, _PADDED // padded**2)
    for first in range(0, len(phase), each):
        part = phase[first : first + each]
        field = np.zeros((len(part), padded, padded), dtype=np.complex128)
        field[:, :samples, :samples] = pupil_function(grid, part)
        image = fourier_2d(field, device=engine.device)[:, wanted[:, None], wanted]
        images[first : first + each] = (image.real**2 + image.imag**2) / transform.peak
    return images


def _padded_size(samples: int, sampling: float) -> int:
    """Return the size of the padded transform that has the sampling, or 0 if there is none."""
    size = samples / sampling
    whole = round(size)
    return whole if whole >= samples and abs(size - whole) < 1e-9 * size else 0


def _moments(pupil: PupilGrid | SegmentedPupil, corner_phase: float, tolerance: float) -> tuple[int, str]:
    """Return the moments that the segment basis needs, or 0 and why it cannot be used."""
    if not isinstance(pupil, SegmentedPupil):
        return 0, "the pupil is no sum of segments"
    if pupil.figure_terms > 3:
        return MOMENTS[-1], ""  # whether they suffice is seen at each instant
    try:
        return moments_needed(corner_phase, tolerance), ""
    except UserError as error:
        return 0, str(error)


def _matrix_seconds(grid: PupilGrid, pixels: int, device: Device) -> float:
    n, kind = len(grid.axis), "numpy" if device.kind == "numpy" else "opencl"
    share = 1.0 if kind == "numpy" else 0.25  # folded by parity
    operations = 8.0 * share * (n * n * pixels + n * pixels * pixels)
    # Cells that hold several patches are put together by NumPy.
    wave = _WAVE[kind] if single_patches(grid) else 2.0 * _WAVE["numpy"]
    return grid.cells.size * wave + operations / _PRODUCTS[kind]


def _fft_seconds(grid: PupilGrid, padded: int, device: Device) -> float:
    engine = choose_fourier((1, padded, padded), np.complex128, device).engine
    operations = 5.0 * padded**2 * np.log2(float(padded) ** 2)
    return float(grid.cells.size * _WAVE["numpy"] + operations / _TRANSFORMS[engine])


def _segments_seconds(
    pupil: SegmentedPupil, pixels: int, sampling: float, moments: int, instants: int
) -> float:
    nodes = 1.1 * pixels * sampling + 18.0
    columns = moments * len(pupil.centers)
    operations = 4.0 * nodes**2 * columns + 4.0 * pixels * nodes * (nodes + pixels)
    fits = _FIGURE * len(pupil.centers) if pupil.figure_terms > 3 else 0.0
    return fits + operations / _PRODUCTS["numpy"] + _MOMENT * columns * nodes**2 / instants


def _lattice(
    pupil: SegmentedPupil, pixels: int, sampling: float, moments: int, device: Device
) -> SegmentLattice | None:
    """Return the lattice that equal segments stand on, if they do."""
    if pupil.obstructions or pupil.figure_terms > 3 or pixels < 2:
        return None
    place = pupil.corners, pupil.centers, pixels, sampling, pupil.diameter
    return segment_lattice(*place, device=device, moments=moments)


def _lattice_seconds(lattice: SegmentLattice) -> float:
    pixels, (columns, rows) = lattice.pixels, lattice.shape
    operations = 2.0 * pixels * columns * (rows + pixels)  # folded by parity
    if lattice.kernel:
        operations *= MOMENTS[lattice.kernel.degree // 2]
        return 1e-8 * lattice.places.size + 6e-10 * pixels**2 + operations / _PRODUCTS["opencl"]
    return 5e-8 * lattice.places.size + 1e-8 * pixels**2 + operations / _PRODUCTS["numpy"]


def _segment_basis(
    pupil: SegmentedPupil, pixels: int, sampling: float, moments: int
) -> SegmentBasis | SegmentFigure:
    count, outline = len(pupil.corners), pupil.outline()
    shadows = Outline(outline.corners[count:], outline.sign[count:], outline.piece[count:])
    place = pupil.corners, pupil.centers, pixels, sampling, pupil.diameter
    if pupil.figure_terms > 3:
        return segment_figure(*place, pupil.figure_terms, moments, np.complex128, shadows)
    return segment_basis(*place, moments, np.complex128, shadows)
