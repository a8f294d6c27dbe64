"""From surface states to wavefronts: OPD, Zernike coefficients, line of sight, Strehl ratio, segment phases.

`prepare` collects what does not change from instant to instant, `trace_states` traces a batch of instants,
and `analyse` reduces the rays to numbers, tile by tile at constant shapes, so that the bits of an instant
do not depend on its batch. The optics are in mm; the step to waves of the wavelength happens here and
nowhere else.

A lost ray is data: an instant that has one is fitted without it and says so in ``lost``.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from wavequake.errors import UserError
from wavequake.kernels.devices import Device
from wavequake.kernels.segmented import SegmentedTrain, Traced, trace_chief, trace_segmented
from wavequake.kernels.tiles import TILE, from_tiles
from wavequake.kernels.train import OK
from wavequake.optics.fits import Fit, refit, segment_planes, weighted_fit, well_determined
from wavequake.optics.kinematics import field_directions, segment_poses, surface_poses
from wavequake.optics.pupils import PupilRays
from wavequake.optics.segmented_telescope import SegmentedTelescope, first_order
from wavequake.optics.segments import candidates, half_planes
from wavequake.optics.states import SurfaceStates, rest
from wavequake.optics.zernike import annular_zernike, circular_zernike_xy, noll_to_nm

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PreparedTrace:
    """What a telescope, its rays and a wavelength determine once for all instants; lengths in mm.

    Attributes
    ----------
    system : SegmentedTelescope
    rays : PupilRays
        The N rays that meet glass in the reference configuration.
    wavelength : float
    train : SegmentedTrain
    candidates : ndarray of int32, shape (N, C)
        Segments that a ray may meet while motions stay below `margin`.
    margin : float
    weight : ndarray, shape (N,)
        Share of the pupil that each ray stands for; the sum is 1.
    zernike : Fit
        Of the annular Noll Zernike polynomials.
    plane : Fit
        Of piston, x and y over the outer pupil radius.
    segment_fit : csr_matrix, shape (3 S, N)
        Values to piston at the center, slope in x and slope in y (1/mm) of each segment.
    figure_matrix : ndarray, shape (S, M, terms)
        From Noll coefficients (heights along the segment's normal, to the sky) to coefficients of the
        kernel's monomials (heights along z, with the light); M = 0 without a figure.
    obscuration, numerical_aperture, focal_length : float
    chief : ndarray, shape (2,)
        Image point of the virtual chief ray in the reference configuration.
    """

    system: SegmentedTelescope
    rays: PupilRays
    wavelength: float
    train: SegmentedTrain
    candidates: NDArray[np.int32]
    margin: float
    weight: Array
    zernike: Fit
    plane: Fit
    segment_fit: csr_matrix
    figure_matrix: Array
    obscuration: float
    numerical_aperture: float
    focal_length: float
    chief: Array


@dataclass(frozen=True)
class Wavefront:
    """The wavefront of a batch of instants.

    Attributes
    ----------
    zernike : ndarray, shape (batch, J)
        Annular Noll coefficients in waves, total (not relative to the reference configuration).
    rms : ndarray, shape (batch,)
        Root of the sum of squares from j = 4 on (Störkle 2018, Eq. 3.40), waves.
    rms_raw : ndarray, shape (batch,)
        Weighted rms over the rays on glass, piston removed, waves.
    chief, los, centroid : ndarray, shape (batch, 2)
        Image point of the virtual chief ray; line of sight by Eq. 3.39 with annular tilt; weighted mean of
        the rays' image points (the true geometric centroid); mm.
    strehl : ndarray, shape (batch,)
        Squared modulus of the mean of exp(2 pi i OPD) about the best-fit plane: the intensity in the
        plane's direction.
    segment_phase : ndarray, shape (batch, S, 3)
        Piston at each segment's center in waves and slopes in x and y in waves/mm; NaN for a lost segment.
    lost : ndarray of int, shape (batch,)
        Number of lost rays; all numbers above are those of the remaining rays.
    lost_segments : ndarray of bool, shape (batch, S)
        Segments whose remaining rays do not determine a plane: mostly, that lost all their rays.
    """

    zernike: Array
    rms: Array
    rms_raw: Array
    chief: Array
    los: Array
    centroid: Array
    strehl: Array
    segment_phase: Array
    lost: NDArray[np.int64]
    lost_segments: NDArray[np.bool_]


def prepare(
    system: SegmentedTelescope,
    rays: PupilRays,
    wavelength: float,
    terms: int,
    figure_terms: int = 0,
    margin: float = 5.0,
) -> PreparedTrace:
    """Collect what does not change from instant to instant.

    Parameters
    ----------
    system : SegmentedTelescope
    rays : PupilRays
        Those that meet no segment are left out.
    wavelength : float
        In mm.
    terms : int
        Number of annular Noll Zernike polynomials, at least 3.
    figure_terms : int
        Number of circular Noll Zernike polynomials of each segment's figure.
    margin : float
        How far (mm) a ray may wander across M1 before its candidate segments are searched anew.

    Raises
    ------
    UserError
        If the wavelength is not positive, no ray meets glass, or the rays determine not all Zernike terms
        or not the tilt of every segment.
    """
    if not (np.isfinite(wavelength) and wavelength > 0.0):
        raise UserError(f"the wavelength is {wavelength} mm, it must be a positive number")
    if terms < 3:
        raise UserError(f"{terms} Zernike terms were asked for, the line of sight needs at least 3")
    used = (rays.segment >= 0) & (rays.weight > 0.0)
    if not used.any():
        raise UserError(
            f"none of the {len(rays.x)} rays meets a segment of {system.name}, so there is no wavefront"
        )
    rays = PupilRays(rays.x[used], rays.y[used], rays.weight[used], rays.segment[used])
    weight = rays.weight / np.sum(rays.weight)
    x, y = rays.x / system.pupil_outer, rays.y / system.pupil_outer
    obscuration = system.pupil_inner / system.pupil_outer
    optics = first_order(system)
    degree = noll_to_nm(figure_terms)[0] if figure_terms else -1
    train = _train(system, degree, optics.exit_pupil_distance)
    rows, solved = segment_planes(rays.x, rays.y, weight, rays.segment, system.segments.centers[:, :2])
    if not solved.all():
        name = system.segments.names[int(np.argmin(solved))]
        raise UserError(
            f"segment {name} has too few rays for its tilt (at least 3 not in a line); raise optics.rays."
        )
    places = np.add.outer(np.arange(3), 3 * rays.segment).ravel(), np.tile(np.arange(len(x)), 3)
    still = rest(TILE, len(system.segments), len(system.surfaces))
    at_rest = surface_poses(system, still.surface_motion)
    return PreparedTrace(
        system=system,
        rays=rays,
        wavelength=wavelength,
        train=train,
        candidates=candidates(system.segments, rays.x, rays.y, margin),
        margin=margin,
        weight=weight,
        zernike=well_determined(weighted_fit(annular_zernike(x, y, terms, obscuration), weight)),
        plane=weighted_fit(np.stack([np.ones_like(x), x, y], axis=1), weight),
        segment_fit=csr_matrix((rows.ravel(), places), shape=(3 * len(system.segments), len(x))),
        figure_matrix=circular_zernike_xy(degree, figure_terms) / -system.segments.axes[:, 2, 2, None, None],
        obscuration=obscuration,
        numerical_aperture=optics.numerical_aperture,
        focal_length=optics.focal_length,
        chief=trace_chief(train, at_rest, field_directions(still.field), system.stop_z)[0, :2, 0],
    )


def _train(system: SegmentedTelescope, figure_degree: int, sphere_radius: float) -> SegmentedTrain:
    """Pack the parts of a system that do not move."""
    segments = system.segments
    along = segments.axes[:, :2, 0]  # the local x axis, projected
    along = along / np.linalg.norm(along, axis=1, keepdims=True) / _radii(system)[:, None]
    return SegmentedTrain(
        primary_curvature=1.0 / system.primary_radius,
        primary_conic=system.primary_conic,
        edges=half_planes(segments),
        figure_frames=np.concatenate([segments.centers[:, :2], along], axis=1),
        figure_degree=figure_degree,
        surface_curvatures=np.array([1.0 / surface.radius for surface in system.surfaces]),
        surface_conics=np.array([surface.conic for surface in system.surfaces]),
        sphere_radius=sphere_radius,
    )


def _radii(system: SegmentedTelescope) -> Array:
    """Return the radius of each segment's circumscribed circle; a mirror without corners fills the pupil."""
    segments = system.segments
    if segments.corners.shape[1] == 0:
        return np.full(len(segments), system.pupil_outer)
    radii: Array = np.linalg.norm(segments.corners - segments.centers[:, None, :2], axis=2).max(axis=1)
    return radii


def chief_rays(prepared: PreparedTrace, states: SurfaceStates) -> Array:
    """Return the virtual chief ray of every instant, shape (T, 3, 16), mm.

    It has image x, y and the path length to the reference sphere, and is traced through the undisturbed
    parent of M1 and the displaced surfaces after it.
    """
    poses = surface_poses(prepared.system, states.surface_motion)
    return trace_chief(prepared.train, poses, field_directions(states.field), prepared.system.stop_z)


def trace_states(prepared: PreparedTrace, states: SurfaceStates, device: Device) -> Traced:
    """Trace all rays at all instants in one launch.

    Parameters
    ----------
    prepared : PreparedTrace
    states : SurfaceStates
        The batch is a whole number of tiles; NaN motions lose the rays that they concern.
    device : Device

    Raises
    ------
    UserError
        If the states do not fit the telescope.
    """
    system = prepared.system
    shape = (len(states), *prepared.figure_matrix.shape[::2])
    if states.segment_figure.shape != shape:
        raise UserError(
            f"the segment figures have the shape {states.segment_figure.shape}, it must be {shape}"
        )
    figure = None
    if prepared.figure_matrix.size:
        lanes_last = states.segment_figure.reshape(-1, TILE, *shape[1:]).transpose(0, 2, 3, 1)
        figure = np.matmul(prepared.figure_matrix, lanes_last)
    wander = _wander(system, states)
    chosen = prepared.candidates
    if wander > prepared.margin:
        chosen = candidates(system.segments, prepared.rays.x, prepared.rays.y, wander)
    return trace_segmented(
        prepared.train,
        prepared.rays.x,
        prepared.rays.y,
        system.stop_z,
        chosen,
        segment_poses(system.segments, states.segment_motion),
        figure,
        surface_poses(system, states.surface_motion),
        field_directions(states.field),
        chief_rays(prepared, states),
        device,
    )


def _wander(system: SegmentedTelescope, states: SurfaceStates) -> float:
    """Return a bound (mm) of how far rays wander across segments by the motions and the field angles."""
    motion, angle = np.abs(states.segment_motion), np.abs(states.field)
    for magnitudes in (motion, angle):
        magnitudes[~np.isfinite(magnitudes)] = 0.0  # such rays are lost anyhow
    largest = motion.max(axis=0).max(axis=0)  # twice: instants first is five times as fast as both at once
    steepest = np.sqrt(2.0) * np.tan(angle.max())
    radius = _radii(system).max()
    depth = np.abs(system.segments.centers[:, 2] - system.stop_z).max() + radius
    return float(np.sum(largest[:3]) + np.sum(largest[3:]) * radius + steepest * depth)


def los_eq339(
    chief: Array, zernike: Array, wavelength: float, numerical_aperture: float, factor: float = 1.0
) -> Array:
    """Return the line of sight from the chief ray and the fitted tilt (Störkle 2018, Eq. 3.39).

    It is the direction of the best-fit plane, not the centroid: coma moves the centroid, too.

    Parameters
    ----------
    chief : ndarray, shape (batch, 2)
        Image point of the chief ray, mm.
    zernike : ndarray, shape (batch, J)
        Noll coefficients in waves, of which j = 2 and 3 are used.
    wavelength : float
        In mm.
    numerical_aperture : float
        Of the pupil whose outer radius normalizes the polynomials.
    factor : float
        1 as printed, right for circular polynomials; 1 / sqrt(1 + eps^2) for annular ones of obscuration
        eps, whose tilt is steeper by this factor. Negative if the focal length is: the pupil is upside down.

    Returns
    -------
    ndarray, shape (batch, 2)
        Image coordinates in mm.
    """
    return chief - (2.0 * wavelength / numerical_aperture * factor) * zernike[:, 1:3]


def analyse(prepared: PreparedTrace, traced: Traced, chief: Array) -> Wavefront:
    """Reduce traced rays to the numbers of the wavefront.

    Parameters
    ----------
    prepared : PreparedTrace
    traced : Traced
        Of T tiles of 16 instants.
    chief : ndarray, shape (T, 3, 16)
        From `chief_rays`.

    Returns
    -------
    Wavefront
        With batch = 16 T.
    """
    parts = [
        _analyse_tile(prepared, opd / prepared.wavelength, x, y, status == OK)
        for opd, x, y, status in zip(traced.opd, traced.x, traced.y, traced.status, strict=True)
    ]
    zernike, rms, rms_raw, centroid, strehl, phase, lost, lost_segments = (
        np.concatenate(values) for values in zip(*parts, strict=True)
    )
    image_point = from_tiles(chief)[:, :2]
    factor = float(np.copysign(1.0 / np.sqrt(1.0 + prepared.obscuration**2), prepared.focal_length))
    return Wavefront(
        zernike=zernike,
        rms=rms,
        rms_raw=rms_raw,
        chief=image_point,
        los=los_eq339(image_point, zernike, prepared.wavelength, prepared.numerical_aperture, factor),
        centroid=centroid,
        strehl=strehl,
        segment_phase=phase,
        lost=lost,
        lost_segments=lost_segments,
    )


def _analyse_tile(
    prepared: PreparedTrace, waves: Array, x: Array, y: Array, ok: NDArray[np.bool_]
) -> tuple[NDArray[Any], ...]:
    """Reduce one tile (N, 16) to arrays with its 16 instants first; lost rays count as nothing."""
    weight, segments = prepared.weight, len(prepared.system.segments)
    complete = bool(ok.all())
    if not complete:
        waves, x, y = (np.where(ok, values, 0.0) for values in (waves, x, y))
    zernike, plane = prepared.zernike.matrix @ waves, prepared.plane.matrix @ waves
    phase = (prepared.segment_fit @ waves).reshape(segments, 3, TILE)
    lost_segments = np.zeros((TILE, segments), dtype=np.bool_)
    remaining = np.ones(TILE)
    for lane in () if complete else np.flatnonzero(~ok.all(axis=0)):
        kept, values = ok[:, lane], waves[:, lane]
        zernike[:, lane], plane[:, lane] = (
            refit(fit, kept, values) for fit in (prepared.zernike, prepared.plane)
        )
        phase[..., lane], lost_segments[lane] = _refit_segments(prepared, kept, values)
        remaining[lane] = np.sum(weight[kept]) if kept.any() else np.nan

    def mean(values: Array) -> Array:
        total: Array = weight @ (values if complete else values * ok)
        return total / remaining

    centroid = np.stack([mean(x), mean(y)], axis=1)
    angle = prepared.plane.basis @ (-2.0 * np.pi * plane)
    angle += 2.0 * np.pi * waves
    strehl = mean(np.cos(angle)) ** 2 + mean(np.sin(angle, out=angle)) ** 2
    waves -= mean(waves)
    rms_raw = np.sqrt(mean(np.square(waves, out=waves)))
    rms = np.sqrt(np.sum(zernike[3:] ** 2, axis=0))
    lost = np.count_nonzero(~ok, axis=0)
    return zernike.T, rms, rms_raw, centroid, strehl, phase.transpose(2, 0, 1), lost, lost_segments


def _refit_segments(
    prepared: PreparedTrace, kept: NDArray[np.bool_], values: Array
) -> tuple[Array, NDArray[np.bool_]]:
    """Return the segment phases (S, 3) of one instant without its lost rays, and the lost segments (S,)."""
    rays, centers = prepared.rays, prepared.system.segments.centers[:, :2]
    rows, solved = segment_planes(rays.x, rays.y, prepared.weight * kept, rays.segment, centers)
    parts = [np.bincount(rays.segment, row * values, len(centers)) for row in rows]
    return np.where(solved[:, None], np.stack(parts, axis=1), np.nan), ~solved


def measure(prepared: PreparedTrace, states: SurfaceStates, device: Device) -> Wavefront:
    """Trace a batch of instants and reduce it to its wavefronts: `trace_states`, then `analyse`."""
    return analyse(prepared, trace_states(prepared, states, device), chief_rays(prepared, states))
