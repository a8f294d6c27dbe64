"""The derivatives behind the modal model, by a few ray traces in which all segments move at once.

A ray meets one segment, so that the derivatives of its optical path difference (OPD) with respect to the
motions of that segment say all there is: one step of all segments in one degree of freedom gives the
derivatives with respect to each of them.
"""

from contextlib import suppress

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from wavequake.errors import UserError
from wavequake.kernels.device.devices import Device
from wavequake.kernels.device.tiles import TILE, from_tiles, padded
from wavequake.kernels.trace.status import OK
from wavequake.optics.derivatives.central import central, checked_derivative
from wavequake.optics.segments.modal import COMMON, RIGID, ModalModel, layout_of
from wavequake.optics.segments.prepared import PreparedTrace, chief_rays, directions, trace_states
from wavequake.optics.segments.telescope import M2
from wavequake.optics.segments.wavefront import los_eq339
from wavequake.optics.shapes.concave import signed_distance
from wavequake.optics.shapes.polygons import concave
from wavequake.optics.systems.kinematics import rest_states
from wavequake.optics.systems.system import States

Array = NDArray[np.float64]

# Half widths of the central differences, mm or rad: rounding of the OPD and the third derivative both stay
# below 1e-8 of what the motion does.
_TRANSLATION, _ROTATION, _FIGURE = 0.02, 3e-6, 1e-4
# Steps are so much shorter where lenses bend the light too much. What turns do beyond a tilt of the wavefront
# may be little: the scale is at least that share of a tilt of the whole pupil.
_SHORTER, _FAINT = (1.0, 0.25, 0.0625), 1e-2
_LAUNCH_TILES = 16


def modal_model(prepared: PreparedTrace, device: Device, dofs: tuple[int, ...]) -> ModalModel:
    """Trace the derivatives of the OPD with respect to the motions that the caller means to use.

    Parameters
    ----------
    prepared : PreparedTrace
        With coefficients from path lengths about the chief ray (no `slopes`, no `sphere`).
    device : Device
    dofs : tuple of int
        See `ModalModel`.

    Raises
    ------
    UserError
        If the wavefront is not fitted as the model needs it, or a ray is lost at rest or within a step.
    """
    if prepared.slopes is not None or prepared.sphere is not None:
        raise UserError("The modal model needs coefficients from path lengths about the chief ray.")
    *shorter, last = (factor * _steps(dofs) for factor in _SHORTER)
    for steps in shorter:
        with suppress(UserError):
            return _modal_model(prepared, device, dofs, steps)
    return _modal_model(prepared, device, dofs, last)


def _modal_model(prepared: PreparedTrace, device: Device, dofs: tuple[int, ...], steps: Array) -> ModalModel:
    singles, pairs = _stencils(len(steps))
    opd, x, y, chief = (
        np.concatenate(part, axis=-1) for part in _traced(prepared, device, dofs, singles * steps)
    )
    still, remedy = opd[:, 0], "take other optics.rays, or optics.light = 'traced'"
    twice = 2.0 * singles[1:] * steps
    far = np.concatenate(_traced(prepared, device, dofs, twice, whole=False)[0], axis=-1)
    fourfold = np.stack([opd[:, 1::2], opd[:, 2::2], far[:, 0::2], far[:, 1::2]])
    turns = np.array([3 <= dof < RIGID for dof in dofs] + [True] * COMMON)
    least = np.where(turns, _FAINT * prepared.system.annulus.outer / prepared.wavelength, 0.0)
    slope = checked_derivative(fourfold, steps, "the path lengths", remedy, 0, turns, least)
    slope_x, slope_y = (central(np.stack([one[:, 1::2], one[:, 2::2]]), steps) for one in (x, y))
    chief_slope = central(np.stack([chief[:, 1::2], chief[:, 2::2]]), steps).T
    curvature = np.zeros((len(steps), len(steps)))
    bend = (opd[:, 1::2] + opd[:, 2::2] - 2.0 * still[:, None]) / steps**2
    curvature[np.diag_indices(len(steps))] = _rms(prepared.weight, bend)
    first, second = np.triu_indices(len(steps), 1)
    twist = np.concatenate(
        [
            _rms(prepared.weight, part[:, 0::4] + part[:, 1::4] - part[:, 2::4] - part[:, 3::4])
            for part, *_ in zip(*_traced(prepared, device, dofs, pairs * steps), strict=True)
        ]
        if len(pairs)
        else [np.zeros(0)]
    )
    curvature[first, second] = curvature[second, first] = twist / (4.0 * steps[first] * steps[second])
    return _assembled(prepared, dofs, still, (slope, slope_x, slope_y, chief_slope), curvature)


def _steps(dofs: tuple[int, ...]) -> Array:
    rigid = [_TRANSLATION] * 3 + [_ROTATION] * 3
    local = [rigid[dof] if dof < RIGID else _FIGURE for dof in dofs]
    return np.array(local + [_ROTATION] * COMMON)


def _stencils(count: int) -> tuple[Array, Array]:
    """Return signs of steps: at rest, then + and - of each motion; and ++, --, +-, -+ of each pair of two."""
    singles = np.zeros((1 + 2 * count, count))
    singles[1::2], singles[2::2] = np.eye(count), -np.eye(count)
    first, second = np.triu_indices(count, 1)
    pairs = np.zeros((len(first), 4, count))
    for case, (one, other) in enumerate([(1, 1), (-1, -1), (1, -1), (-1, 1)]):
        pairs[np.arange(len(first)), case, first] = one
        pairs[np.arange(len(first)), case, second] = other
    return singles, pairs.reshape(-1, count)


def _traced(
    prepared: PreparedTrace,
    device: Device,
    dofs: tuple[int, ...],
    moved: Array,
    whole: bool = True,
) -> tuple[list[Array], list[Array], list[Array], list[Array]]:
    """Trace all segments moving at once by motions (n, D + 4); lists of launches of what light does.

    That is the OPD in waves, x, y (N, m) and chief (2, m). A lost ray is an error, or NaN where not the
    `whole` light is needed.
    """
    parts: tuple[list[Array], list[Array], list[Array], list[Array]] = ([], [], [], [])
    for begin in range(0, len(moved), _LAUNCH_TILES * TILE):
        motions = moved[begin : begin + _LAUNCH_TILES * TILE]
        states = _states(prepared, dofs, motions)
        traced = trace_states(prepared, states, device)
        count = len(motions)
        lost = from_tiles((traced.status != OK).astype(float))[:count] > 0.0
        if whole and lost.any():
            raise UserError(
                f"{int(lost.any(axis=0).sum())} rays are lost at rest or within {_TRANSLATION} mm of it, so "
                "that there are no derivatives: take other optics.rays, or optics.light = 'traced'."
            )
        opd, x, y = (from_tiles(values)[:count].T for values in (traced.opd, traced.x, traced.y))
        parts[0].append(opd / prepared.wavelength)
        parts[1].append(x)
        parts[2].append(y)
        parts[3].append(from_tiles(chief_rays(prepared, states))[:count, :2].T)
    return parts


def _states(prepared: PreparedTrace, dofs: tuple[int, ...], motions: Array) -> States:
    count = len(motions)
    states = rest_states(prepared.system, padded(count))
    for column, dof in enumerate(dofs):
        if dof < RIGID:
            states.segment_motion[:count, :, dof] = motions[:, column, None]
        else:
            states.segment_figure[:count, :, dof - RIGID] = motions[:, column, None]
    states.surface_motion[:count, M2, 3:5] = motions[:, len(dofs) : len(dofs) + 2]
    states.line_of_sight[:count] = motions[:, len(dofs) + 2 :]
    return states


def _rms(weight: Array, values: Array) -> Array:
    return np.asarray(np.sqrt(weight @ values**2), dtype=np.float64)


def _assembled(
    prepared: PreparedTrace,
    dofs: tuple[int, ...],
    still: Array,
    slopes: tuple[Array, Array, Array, Array],
    curvature: Array,
) -> ModalModel:
    """Reduce fields over the rays (N, D + 4) to sums over each segment; over all rays for what is common."""
    opd, x, y, chief = slopes
    weight, local = prepared.weight, len(dofs)
    segments, terms = len(prepared.system.segments), len(prepared.fit.matrix)
    of_segment = csr_matrix(
        (np.ones(len(weight)), (prepared.rays.segment, np.arange(len(weight)))), shape=(segments, len(weight))
    )
    places = layout_of(terms)
    common = opd[:, local:]
    functionals = np.zeros((len(weight), places.width))  # of the OPD
    functionals[:, places.zernike] = prepared.fit.matrix.T
    functionals[:, places.mean] = weight
    functionals[:, places.plane] = prepared.plane.matrix.T
    functionals[:, places.static] = weight * still
    functionals[:, places.cross] = weight[:, None] * common
    columns = np.empty((local * segments + COMMON, places.width))
    for column in range(local + COMMON):
        rows = slice(column * segments, (column + 1) * segments) if column < local else slice(None)
        summed = of_segment @ (functionals * opd[:, column, None])
        image = of_segment @ (weight[:, None] * np.stack([x[:, column], y[:, column]], axis=1))
        if column < local:
            columns[rows] = summed
            columns[rows, places.centroid] = image
        else:
            row = local * segments + column - local
            columns[row] = summed.sum(axis=0)
            columns[row, places.centroid] = image.sum(axis=0)
    toward = np.zeros((len(columns), 2))
    toward[local * segments :] = chief[local:]
    columns[:, places.los] = los_eq339(
        toward, columns, prepared.wavelength, prepared.numerical_aperture, prepared.tilt_factor
    )
    # The common motions' own products are in `common`, not in what their columns add to the cross terms.
    columns[local * segments :, places.cross] = 0.0
    square = np.zeros((local, local, segments))
    for i in range(local):
        for j in range(i, local):
            square[i, j] = of_segment @ (weight * opd[:, i] * opd[:, j]) * (1.0 if i == j else 2.0)
    at_rest = still @ functionals
    at_rest[places.static] = 0.0
    at_rest[places.cross] = 0.0
    return ModalModel(
        dofs=dofs,
        terms=terms,
        rest=at_rest,
        columns=columns,
        square=square,
        common=common.T @ (weight[:, None] * common),
        rest_square=float(weight @ still**2),
        plane_normal=prepared.plane.normal,
        curvature=curvature,
        clearance=_clearance(prepared),
        radius=_largest_radius(prepared),
    )


def _clearance(prepared: PreparedTrace) -> float:
    """Return the distance (mm) of the ray nearest to the edge of its segment; infinite without edges."""
    system, rays = prepared.system, prepared.rays
    corners = system.segments.corners
    if corners.shape[1] == 0:
        return np.inf
    curvature, conic = prepared.train.primary_curvature, system.primary.shape.conic
    square = rays.x**2 + rays.y**2
    sag = curvature * square / (1.0 + np.sqrt(1.0 - (1.0 + conic) * curvature**2 * square))
    direction = directions(prepared, rest_states(system, TILE))[0, :, 0]
    x, y = (
        place + part / direction[2] * (sag - system.stop_z)
        for place, part in zip((rays.x, rays.y), direction, strict=False)
    )
    if concave(corners).any():
        return float(-signed_distance(corners[rays.segment], x, y).max())
    edges = prepared.train.edges[rays.segment]
    inside = edges[..., 2] - edges[..., 0] * x[:, None] - edges[..., 1] * y[:, None]
    return float(inside.min())


def _largest_radius(prepared: PreparedTrace) -> float:
    segments = prepared.system.segments
    if segments.corners.shape[1] == 0:
        return prepared.system.annulus.outer
    return float(np.linalg.norm(segments.corners - segments.centers[:, None, :2], axis=2).max())
