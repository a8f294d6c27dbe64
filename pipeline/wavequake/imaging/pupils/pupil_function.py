"""The pupil function of an aperture on a grid (Störkle 2018, Eq. 3.68 and 3.69).

A cell on a rim holds the mean of the complex amplitude over it, not of the optical path, which would cost
0.2 % of the peak: its amplitude is the share of it that is lit, its phase that at the center of its light. A
cell in which several pieces of a wavefront meet holds the sum over the pieces.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.imaging.pupils.coverage import coverage
from wavequake.imaging.pupils.outlines import Outline, annulus

Real = NDArray[np.float64]


@dataclass(frozen=True)
class PupilGrid:
    """A pupil sampled on n x n cells, in units of its outer radius.

    A patch is what one piece of the wavefront lights of one cell.

    Attributes
    ----------
    axis : ndarray, shape (n,)
        Middles of the cells, symmetric about 0, in both directions.
    amplitude : ndarray, shape (n, n)
        Mean amplitude of each cell (rows are y): between 0 and 1 on the rims.
    x, y : ndarray, shape (m,)
        Where the light of each patch is centered: there a phase is to be evaluated.
    cells : ndarray of int, shape (m,)
        Index of the patches' cells in the flat grid.
    light : ndarray, shape (m,)
        What each patch adds to the amplitude of its cell.
    piece : ndarray of int, shape (m,)
        Which piece of the wavefront (segment) a patch belongs to.
    """

    axis: Real
    amplitude: Real
    x: Real
    y: Real
    cells: NDArray[np.intp]
    light: Real
    piece: NDArray[np.intp]


def annular_pupil(samples: int, obscuration: float = 0.0) -> PupilGrid:
    """Sample a circular or annular pupil.

    Parameters
    ----------
    samples : int
        Cells across the diameter.
    obscuration : float
        Inner radius over outer radius.

    Raises
    ------
    UserError
        If there are fewer than 8 samples, or the obscuration is not in [0, 1).
    """
    if not 0.0 <= obscuration < 1.0:
        raise UserError(f"the obscuration is {obscuration:g}; it must lie in 0 <= obscuration < 1")
    return sampled_pupil(annulus(1.0, obscuration), samples, 2.0)


def sampled_pupil(outline: Outline, samples: int, diameter: float) -> PupilGrid:
    """Sample an outline, whose origin is the grid's middle.

    Parameters
    ----------
    outline : Outline
        Corners in any unit.
    samples : int
        Cells across the diameter.
    diameter : float
        In the outline's unit; it encloses the outline.

    Raises
    ------
    UserError
        If there are fewer than 8 samples, the diameter is impossible or too small, or no light passes.
    """
    if samples < 8:
        raise UserError(f"the pupil has {samples} samples across; it needs at least 8")
    if not (np.isfinite(diameter) and diameter > 0.0):
        raise UserError(f"the diameter of the pupil must be above 0 and finite, not {diameter}")
    corners = (outline.corners / diameter + 0.5) * samples
    patches = coverage(Outline(corners, outline.sign, outline.piece), samples)
    if not patches.share.size:
        raise UserError("no light passes the pupil: everything is blocked")
    amplitude: Real = np.bincount(patches.cells, patches.share, samples * samples).astype(np.float64)
    return PupilGrid(
        axis=(2.0 * np.arange(samples) + 1.0) / samples - 1.0,
        amplitude=amplitude.reshape(samples, samples),
        x=2.0 * patches.x / samples - 1.0,
        y=2.0 * patches.y / samples - 1.0,
        cells=patches.cells,
        light=patches.share,
        piece=patches.piece,
    )


def apodized(grid: PupilGrid, transmission: Real) -> PupilGrid:
    """Weaken the amplitude of each patch by a factor (m,).

    Raises
    ------
    UserError
        If there is not one finite factor of at least 0 for each patch, or all are 0.
    """
    if transmission.shape != grid.light.shape:
        raise UserError(
            f"a pupil of {grid.light.size} patches needs as many factors, not {transmission.shape}"
        )
    if not (np.isfinite(transmission).all() and (transmission >= 0.0).all()):
        raise UserError("the amplitude that a pupil transmits must be finite and at least 0")
    if not transmission.any():
        raise UserError("no light passes the pupil: every factor is 0")
    light = grid.light * transmission
    amplitude: Real = np.bincount(grid.cells, light, grid.amplitude.size).astype(np.float64)
    return replace(grid, light=light, amplitude=amplitude.reshape(grid.amplitude.shape))


def pupil_function(grid: PupilGrid, phase: Real) -> NDArray[np.complex128]:
    """Return the complex amplitude (batch, n, n) for phases (batch, m) in rad at the grid's patches."""
    return pupil_field(grid, np.exp(1j * phase))


def pupil_field(grid: PupilGrid, amplitude: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Return the complex amplitude (batch, n, n) of what is `amplitude` (batch, m) at the grid's patches.

    Weakened by the grid's own light; 1 everywhere is the perfect pupil.
    """
    batch, samples = len(amplitude), len(grid.axis)
    field = np.zeros((batch, samples * samples), dtype=np.complex128)
    patches = grid.light * amplitude
    if single_patches(grid):
        field[:, grid.cells] = patches
    else:
        for instant, values in zip(field, patches, strict=True):
            np.add.at(instant, grid.cells, values)
    return field.reshape(batch, samples, samples)


def single_patches(grid: PupilGrid) -> bool:
    """Return whether it is plain that no cell holds several patches, so that a cell has one phase."""
    return bool((np.diff(grid.cells) > 0).all())
