"""What the Zernike polynomials leave of a vibrating mirror's figure, as a grid that is traced with them.

It is linear in the coordinates of a reduced model: the grids of unit coordinates, and what these do to the
light, are made once per model and multiplied with the coordinates over time.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from wavequake.kernels.device.devices import Device
from wavequake.kernels.trace.sequence import Moving
from wavequake.mechanics.model import ReducedModel
from wavequake.mechanics.vibration.response import Response, displacements
from wavequake.optics.derivatives.central import SIGNS, central, checked_derivative
from wavequake.optics.shapes.basis import spline_coefficients
from wavequake.optics.shapes.fit import (
    coefficients,
    heights,
    relative_residual,
    residual,
    residual_grid,
)
from wavequake.optics.shapes.motion_fit import MotionFit
from wavequake.optics.shapes.shapes import GridDeformation
from wavequake.optics.systems.kinematics import rest_states
from wavequake.optics.wavefronts.fits import fit_instants
from wavequake.optics.wavefronts.wavefront import incoming_light, line_of_sight, trace_light
from wavequake.workflows.mirrors.optics import NM_PER_MM, Optics, displacements_mm, with_deformation

Array = NDArray[np.float64]

# Step of the central differences of a grid, mm.
_STEP = 1e-5
# Instants whose nodes are displaced at a time.
_INSTANTS = 1024


@dataclass(frozen=True)
class Left:
    """What the polynomials leave under unit coordinates of a reduced model with r of them.

    Attributes
    ----------
    heights : ndarray, shape (r, p)
        At the optical nodes, mm.
    missed, whole : ndarray, shape (r, r)
        Products of what is left, and of all heights, averaged over the surface, mm^2.
    """

    heights: Array
    missed: Array
    whole: Array

    def share(self, coordinates: Array) -> float:
        """Return the largest rms that is left over time, as a share of the largest rms deformation."""
        missed, whole = (float(rms_of(part, coordinates).max()) for part in (self.missed, self.whole))
        return missed / whole if whole > 0.0 else 0.0


@dataclass(frozen=True)
class Residual:
    """What is left as grids, and what they do to the light, each per unit coordinate.

    Attributes
    ----------
    splines : ndarray, shape (r, rows + 2, columns + 2)
        Coefficients of the splines through the heights of each grid, mm: linear, so that those of an instant
        are sums of these.
    aberrations : ndarray, shape (2 + J, r)
        Line of sight in mm, Noll coefficients in nm.
    rough, whole : ndarray, shape (r, r)
        Products of the wavefronts of the grids without their Zernike part, and without their plane, averaged
        over the rays, nm^2.
    """

    splines: Array
    aberrations: Array
    rough: Array
    whole: Array

    def at(self, coordinates: Array) -> Array:
        """Return the splines under coordinates (T, r), (T, rows + 2, columns + 2)."""
        found = coordinates @ self.splines.reshape(len(self.splines), -1)
        return found.reshape(len(coordinates), *self.splines.shape[1:])


def rms_of(products: Array, coordinates: Array) -> Array:
    """Return the rms over time (T,) of what has these products, under coordinates (T, r)."""
    square = np.sum((coordinates @ products) * coordinates, axis=1)
    return np.asarray(np.sqrt(np.maximum(square, 0.0)))


def coordinates_of(response: Response) -> Array:
    """Return the coordinates of the reduced model over time, (T, r), of the first case."""
    moved: Array = displacements(response, np.eye(len(response.modes)))[0]
    return moved


def left_by(optics: Optics, model: ReducedModel) -> Left:
    """Return what the polynomials leave of each coordinate of a model."""
    fit = optics.surface
    above = heights(fit, displacements_mm(model.surface.T))
    left = residual(fit, above, coefficients(fit, above))
    return Left(left, (left * fit.weights) @ left.T, (above * fit.weights) @ above.T)


def missed_over_time(motion: MotionFit, coordinates: Array) -> Array:
    """Return the share of each instant's deformation that the polynomials miss, from all nodes, (T,)."""
    shapes = motion.shapes.reshape(len(motion.shapes), -1)
    found = []
    for start in range(0, len(coordinates), _INSTANTS):
        moved = (coordinates[start : start + _INSTANTS] @ shapes).reshape(-1, *motion.shapes.shape[1:])
        above = heights(motion.fit, moved, linear=False)
        found.append(relative_residual(motion.fit, above, coefficients(motion.fit, above)))
    return np.concatenate(found)


def grid_of(optics: Optics) -> GridDeformation:
    """Return a grid over the mirror, twice as fine as the optical nodes lie on average."""
    area = np.pi * optics.radius**2 * (1.0 - optics.obscuration**2)
    apart = np.sqrt(area / len(optics.surface.nodes)) / 2.0
    count = int(np.ceil(2.0 * optics.radius / apart)) + 3
    spacing = 2.0 * optics.radius / (count - 3)
    return GridDeformation(count, count, spacing, spacing)


def deformed_light(optics: Optics, figures: Array, splines: Array | None) -> Moving:
    """Return what moves under figures (T, J) and splines (T, rows + 2, columns + 2) of the rest, mm."""
    rest = rest_states(optics.prepared.system, len(figures))
    states = replace(rest, deformations=(figures, *rest.deformations[1:]))
    light = incoming_light(optics.prepared, states)
    return light if splines is None else replace(light, grids=(splines, *light.grids[1:]))


def residual_of(optics: Optics, left: Left, device: Device) -> Residual:
    """Interpolate what is left on grids, and trace each of them up and down (Störkle 2018, Eq. 4.22)."""
    grid = grid_of(optics)
    heights = residual_grid(optics.surface, left.heights, grid)
    largest = np.abs(heights).max(axis=(1, 2))
    scale = np.divide(_STEP, largest, out=np.zeros_like(largest), where=largest > 0.0)
    splines, prepared = spline_coefficients(heights), with_deformation(optics, grid)
    steps = scale[:, None, None] * splines
    figures = np.zeros((len(SIGNS) * len(steps), optics.terms))
    light = deformed_light(optics, figures, np.concatenate([sign * steps for sign in SIGNS]))
    opd, _, chief = trace_light(prepared, light, device)
    remedy = "it is too fast for its number of rays or terms"
    opd, chief = (values.reshape(len(SIGNS), len(steps), -1) for values in (opd, chief))
    opd = checked_derivative(opd, _STEP, "the mirror's residual", remedy) * largest[:, None]
    chief = central(chief, _STEP) * largest[:, None]  # it may hardly move at all
    zernike = fit_instants(prepared.fit, opd, device)
    to_nm = prepared.wavelength * NM_PER_MM
    root = np.sqrt(prepared.fit.weight / prepared.fit.weight.sum())
    rough, whole = (
        to_nm * root * (opd - zernike[:, :terms] @ prepared.fit.basis[:, :terms].T)
        for terms in (optics.terms, 3)
    )
    aberrations = np.hstack([line_of_sight(prepared, chief, zernike), to_nm * zernike]).T
    return Residual(splines, aberrations, rough @ rough.T, whole @ whole.T)
