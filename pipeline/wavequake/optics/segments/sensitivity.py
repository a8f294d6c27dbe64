"""Kinematic-optical sensitivities: how wavefront and line of sight follow small motions and figures.

One column of the matrix C_a of Störkle 2018, Eq. 4.21 per degree of freedom, by central differences of full
ray traces (section 4.4.1; Eq. 4.24 is M2's tilt columns, Eq. 4.26 the columns of a figure). A pair of
instants of a batch is one column, so that the matrices of hundreds of segments are a few launches.

Every column is computed with two steps. Where the two disagree, neither is a derivative: a ray crossed an
edge, rounding is too large, or the motion acts nonlinearly.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.kernels.device.devices import Device
from wavequake.kernels.device.tiles import TILE, padded
from wavequake.optics.segments.kinematics import carried_segments
from wavequake.optics.segments.prepared import PreparedTrace, chief_rays, trace_states
from wavequake.optics.segments.states import SurfaceStates, rest
from wavequake.optics.segments.wavefront import analyse, measure

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
# Writes into states at instants (K,) how far (K,) elements (K,) move in their degrees of freedom (K,).
_Move = Callable[[SurfaceStates, Indices, Indices, Indices, Array], None]

DOFS = ("dx", "dy", "dz", "rx", "ry", "rz")
TOLERANCE = 1e-5

_FAINT = 1e-4  # of a tilt or shift of the whole pupil: where all derivatives are smaller, this is their scale
_LAUNCH_TILES = 32  # about 40 MB per output array at 9000 rays
_LAUNCH_NUMBERS = 2**24  # and no more motions, poses and figures of segments than this


@dataclass(frozen=True)
class Steps:
    """Half widths of the central differences: of translations in mm, rotations in rad, figures in mm."""

    translation: float = 1e-3
    rotation: float = 1e-6
    figure: float = 1e-5


@dataclass(frozen=True)
class SensitivityMatrix:
    """Derivatives with respect to E elements (surfaces or segments) of D degrees of freedom each.

    Attributes
    ----------
    elements : tuple of str, length E
    dofs : tuple of str, length D
        dx ... rz, or Z1, Z2, ... for a figure's circular Noll Zernike terms.
    steps : ndarray, shape (D,)
        Half width of the central differences, mm or rad.
    zernike : ndarray, shape (E, D, J)
        Of the annular Noll coefficients, waves per mm or rad.
    los : ndarray, shape (E, D, 2)
        Of the line of sight (Störkle 2018, Eq. 3.39, annular tilt / sqrt(1 + eps^2)), mm per mm or rad in the
        axes of the image plane, which is the detector: if it moves, the image moves against it.
    centroid : ndarray, shape (E, D, 2)
        Of the rays' geometric centroid, mm per mm or rad.
    rms_raw : ndarray, shape (E, D)
        Rms over the rays of the derivative of the OPD, piston removed, waves per mm or rad.
    disagreement : ndarray, shape (E, D)
        Between the derivatives with this step and the double one, relative to the largest derivative of the
        same quantity with respect to any element and degree of freedom of the same unit (or to 1e-4 of what
        a shift or tilt of the whole pupil does, if that is more); inf if the motion loses rays.
    tolerance : float
        The largest disagreement of a valid column.
    """

    elements: tuple[str, ...]
    dofs: tuple[str, ...]
    steps: Array
    zernike: Array
    los: Array
    centroid: Array
    rms_raw: Array
    disagreement: Array
    tolerance: float

    @property
    def agrees(self) -> bool:
        """Whether two steps agree in all columns."""
        return bool(np.all(self.disagreement <= self.tolerance))

    @property
    def worst(self) -> tuple[str, str, float]:
        """Element, degree of freedom and size of the largest disagreement between two steps."""
        element, dof = np.unravel_index(np.argmax(self.disagreement), self.disagreement.shape)
        return self.elements[element], self.dofs[dof], float(self.disagreement[element, dof])


@dataclass(frozen=True)
class Sensitivities:
    """The matrices of a telescope: M1 as one rigid body, surfaces after it, its segments, figures of both."""

    primary: SensitivityMatrix
    surfaces: SensitivityMatrix
    segments: SensitivityMatrix
    figures: SensitivityMatrix | None
    mirrors: SensitivityMatrix | None

    @property
    def all_surfaces(self) -> SensitivityMatrix:
        """M1 as one rigid body and the surfaces after it."""
        both = (self.primary, self.surfaces)
        joined: dict[str, Any] = {
            name: np.concatenate([getattr(one, name) for one in both])
            for name in ("zernike", "los", "centroid", "rms_raw", "disagreement")
        }
        return replace(self.surfaces, elements=self.primary.elements + self.surfaces.elements, **joined)


def sensitivities(
    prepared: PreparedTrace,
    device: Device,
    field: Array | None = None,
    steps: Steps | None = None,
    tolerance: float = TOLERANCE,
) -> Sensitivities:
    """Return the kinematic-optical sensitivities about the reference configuration.

    Surfaces move about their vertices in the axes of the optics frame, M1 with all its segments, too;
    segments by themselves about their centers in their local frames (see `SurfaceStates`). Nothing is
    inverted here; rows of piston and tilt never should be.

    Parameters
    ----------
    prepared : PreparedTrace
        Its numbers of figure terms are those of the figures' matrices.
    device : Device
    field : ndarray, shape (2,), optional
        Field point, rad; the axis by default.
    steps : Steps, optional
    tolerance : float
        See `SensitivityMatrix.disagreement`; whether it is kept is said by `SensitivityMatrix.agrees`.

    Raises
    ------
    UserError
        If a step is not a positive number, or all rays are lost at rest.
    """
    steps = steps or Steps()
    for name, step in vars(steps).items():
        if not (np.isfinite(step) and step > 0.0):
            raise UserError(f"the step of a {name} is {step}, it must be a positive number")
    at = np.zeros(2) if field is None else field
    still = _rest(prepared, TILE)
    terms, mirror_terms = prepared.figure_matrix.shape[2], prepared.mirror_matrix.shape[1]
    lost = int(measure(prepared, replace(still, field=still.field + at), device).lost[0])
    if lost == len(prepared.rays.x):
        raise UserError(f"no ray of {prepared.system.name} reaches the image at rest; check the field point")
    rigid = np.repeat([steps.translation, steps.rotation], 3)
    surface_names = tuple(surface.name for surface in prepared.system.surfaces)
    segment_names = tuple(prepared.system.segments.names)
    figure_names = tuple(f"Z{j}" for j in range(1, max(terms, mirror_terms) + 1))

    def matrix(
        move: _Move, elements: Sequence[str], dofs: tuple[str, ...], sizes: Array
    ) -> SensitivityMatrix:
        fine, wide = (
            _derivatives(prepared, device, move, len(elements), factor * sizes, at, lost) for factor in (1, 2)
        )
        return SensitivityMatrix(
            elements=tuple(elements),
            dofs=dofs,
            steps=sizes,
            zernike=fine.zernike,
            los=fine.los,
            centroid=fine.centroid,
            rms_raw=fine.rms_raw,
            disagreement=_disagreement(prepared, fine, wide, dofs),
            tolerance=tolerance,
        )

    return Sensitivities(
        primary=matrix(_together(prepared), ("M1",), DOFS, rigid),
        surfaces=matrix(_one_by_one("surface_motion"), surface_names, DOFS, rigid),
        segments=matrix(_one_by_one("segment_motion"), segment_names, DOFS, rigid),
        figures=matrix(
            _one_by_one("segment_figure"), segment_names, figure_names[:terms], np.full(terms, steps.figure)
        )
        if terms
        else None,
        mirrors=matrix(
            _one_by_one("mirror_figure"),
            surface_names[:-1],
            figure_names[:mirror_terms],
            np.full(mirror_terms, steps.figure),
        )
        if mirror_terms and len(surface_names) > 1
        else None,
    )


def _rest(prepared: PreparedTrace, batch: int) -> SurfaceStates:
    segments, _, terms = prepared.figure_matrix.shape
    return rest(batch, segments, len(prepared.system.surfaces), terms, prepared.mirror_matrix.shape[1])


def _one_by_one(name: str) -> _Move:
    """Return how entries (element, dof) of an array of `SurfaceStates` move by themselves."""

    def move(states: SurfaceStates, instant: Indices, element: Indices, dof: Indices, size: Array) -> None:
        getattr(states, name)[instant, element, dof] = size

    return move


def _together(prepared: PreparedTrace) -> _Move:
    """Return how all segments move as one rigid body.

    Along the derivative of their motions: what is of second order has no part in a central difference.
    """
    carried = carried_segments(prepared.system.segments)

    def move(states: SurfaceStates, instant: Indices, element: Indices, dof: Indices, size: Array) -> None:
        states.segment_motion[instant] = size[:, None, None] * carried[dof]

    return move


class _Derivatives(NamedTuple):
    """Of E elements by D degrees of freedom, (E, D, ...); a column is intact if its motions lose no rays."""

    zernike: Array
    los: Array
    centroid: Array
    rms_raw: Array
    intact: NDArray[np.bool_]


def _derivatives(
    prepared: PreparedTrace,
    device: Device,
    move: _Move,
    elements: int,
    sizes: Array,
    field: Array,
    lost: int,
) -> _Derivatives:
    """Return central differences of half widths `sizes` (D,); `lost` is how many rays are lost at rest."""
    (segments, _, terms), dofs = prepared.figure_matrix.shape, len(sizes)
    tiles = min(max(_LAUNCH_NUMBERS // (TILE * segments * (terms + 20)), 1), _LAUNCH_TILES)
    pairs = tiles * TILE // 2
    parts = []
    for first in range(0, elements * dofs, pairs):
        element, dof = np.divmod(np.arange(first, min(first + pairs, elements * dofs)), dofs)
        plus = 2 * np.arange(len(element))
        states = _rest(prepared, padded(2 * len(element)))
        states.field[:] = field
        move(states, plus, element, dof, sizes[dof])
        move(states, plus + 1, element, dof, -sizes[dof])
        parts.append([values[: len(element)] for values in _pair_differences(prepared, device, states, lost)])
    zernike, los, centroid, rms_raw, intact = (np.concatenate(part) for part in zip(*parts, strict=True))
    shape, widths = (elements, dofs), 2.0 * sizes
    return _Derivatives(
        zernike.reshape(*shape, -1) / widths[:, None],
        los.reshape(*shape, 2) / widths[:, None],
        centroid.reshape(*shape, 2) / widths[:, None],
        rms_raw.reshape(shape) / widths,
        intact.reshape(shape),
    )


def _pair_differences(
    prepared: PreparedTrace, device: Device, states: SurfaceStates, lost: int
) -> tuple[NDArray[Any], ...]:
    """Trace a batch of pairs of instants: differences of Zernikes, LOS and centroid, their rms, intact."""
    traced = trace_states(prepared, states, device)
    wavefront = analyse(prepared, traced, chief_rays(prepared, states), device)
    change = [tile[:, 0::2] - tile[:, 1::2] for tile in traced.opd]
    rms = np.concatenate([_weighted_rms(prepared.weight, one) for one in change]) / prepared.wavelength
    intact = (wavefront.lost[0::2] == lost) & (wavefront.lost[1::2] == lost)
    zernike, los, centroid = (
        values[0::2] - values[1::2] for values in (wavefront.zernike, wavefront.los, wavefront.centroid)
    )
    return zernike, los, centroid, rms, intact


def _weighted_rms(weight: Array, values: Array) -> Array:
    """Return the rms (K,) of values (N, K) about their means; rays that are NaN do not count."""
    kept = np.isfinite(values)
    shares = weight[:, None] * kept
    total = np.maximum(shares.sum(axis=0), np.finfo(float).tiny)
    values = np.where(kept, values, 0.0)
    values = values - np.sum(shares * values, axis=0) / total
    rms: Array = np.sqrt(np.sum(shares * values**2, axis=0) / total)
    return rms


def _disagreement(
    prepared: PreparedTrace, fine: _Derivatives, wide: _Derivatives, dofs: tuple[str, ...]
) -> Array:
    """Return the relative differences (E, D) between two results of `_derivatives`; inf where rays are lost.

    Columns of one unit share a scale: a mirror's turn about its own axis, which changes nothing, is as
    accurate as its tilts.
    """
    turns = np.array([name in DOFS[3:] for name in dofs])
    # A tilt of the pupil by one unit, and the image's answer to it.
    radius, image = (
        np.where(turns, length, 1.0) for length in (prepared.system.pupil_outer, prepared.focal_length)
    )
    waves, millimeters = (_FAINT * np.abs(size) for size in (radius / prepared.wavelength, image))
    worst = np.zeros(fine.intact.shape)
    for one, other, faint in (
        (fine.zernike, wide.zernike, waves),
        (fine.los, wide.los, millimeters),
        (fine.centroid, wide.centroid, millimeters),
    ):
        difference = np.abs(one - other).max(axis=2)
        size = np.abs(one).max(axis=(0, 2))
        largest = np.where(turns, size[turns].max(initial=0.0), size[~turns].max(initial=0.0))
        worst = np.maximum(worst, difference / np.maximum(largest, faint))
    return np.where(fine.intact & wide.intact & np.isfinite(worst), worst, np.inf)
