"""From traced rays to wavefronts: OPD, Zernike coefficients, line of sight, Strehl ratio, segment phases.

`analyse` reduces the rays of a batch of instants to numbers, tile by tile at constant shapes, so that the
bits of an instant do not depend on its batch. The optics are in mm; the step to waves of the wavelength
happens here and nowhere else.

A lost ray is data: an instant that has one is fitted without it and says so in ``lost``.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wavequake.kernels.devices import Device
from wavequake.kernels.segmented import Traced
from wavequake.kernels.tiles import TILE, from_tiles
from wavequake.kernels.train import OK, vignetted
from wavequake.optics.fits import Fit, refit, segment_planes
from wavequake.optics.prepared import PreparedTrace, chief_rays, trace_states
from wavequake.optics.slopes import coefficients_of_tile
from wavequake.optics.states import SurfaceStates

Array = NDArray[np.float64]

_FOLD = 64  # rows of 16 instants that are reduced side by side


@dataclass(frozen=True)
class Wavefront:
    """The wavefront of a batch of instants.

    Attributes
    ----------
    zernike : ndarray, shape (batch, J)
        Annular Noll coefficients in waves, total (not relative to the reference configuration). The first
        one is NaN if they come from slopes.
    rms : ndarray, shape (batch,)
        Root of the sum of squares from j = 4 on (Störkle 2018, Eq. 3.40), waves.
    rms_raw : ndarray, shape (batch,)
        Weighted rms over the rays on glass, piston removed, waves.
    rms_flat, pv : ndarray, shape (batch,)
        Weighted rms and peak to valley over the rays on glass about the best-fit plane, waves.
    chief, los, centroid : ndarray, shape (batch, 2)
        Image point of the virtual chief ray; line of sight by Eq. 3.39 with annular tilt; weighted mean of
        the rays' image points (the true geometric centroid); mm.
    spot_rms : ndarray, shape (batch,)
        Weighted rms distance of the rays' image points from their centroid, mm.
    strehl : ndarray, shape (batch,)
        Squared modulus of the mean of exp(2 pi i OPD) about the best-fit plane: the intensity in the
        plane's direction.
    segment_phase : ndarray, shape (batch, S, 3)
        Of the OPD about the chief ray: piston at each segment's center in waves and slopes in x and y in
        waves/mm; NaN for a lost segment.
    lost : ndarray of int, shape (batch,)
        Number of lost rays; all numbers above are those of the remaining rays.
    vignetted : ndarray of int, shape (batch,)
        Those of them that pass by a mirror after M1, beyond its edge.
    lost_segments : ndarray of bool, shape (batch, S)
        Segments whose remaining rays do not determine a plane: mostly, that lost all their rays.
    """

    zernike: Array
    rms: Array
    rms_raw: Array
    rms_flat: Array
    pv: Array
    chief: Array
    los: Array
    centroid: Array
    spot_rms: Array
    strehl: Array
    segment_phase: Array
    lost: NDArray[np.int64]
    vignetted: NDArray[np.int64]
    lost_segments: NDArray[np.bool_]


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
        _analyse_tile(prepared, opd / prepared.wavelength, x, y, status == OK, center)
        for opd, x, y, status, center in zip(
            traced.opd, traced.x, traced.y, traced.status, chief, strict=True
        )
    ]
    zernike, rms, rms_raw, rms_flat, pv, shift, centroid, spot_rms, strehl, phase, lost, lost_segments = (
        np.concatenate(values) for values in zip(*parts, strict=True)
    )
    image_point = from_tiles(chief)[:, :2]
    passed_by = np.zeros(len(lost), dtype=np.int64)
    for tile in np.flatnonzero(lost.reshape(-1, TILE).any(axis=1)):
        gone = vignetted(prepared.train, traced.status[tile])
        passed_by[tile * TILE : (tile + 1) * TILE] = np.count_nonzero(gone, axis=0)
    factor = float(np.copysign(1.0 / np.sqrt(1.0 + prepared.obscuration**2), prepared.focal_length))
    return Wavefront(
        zernike=zernike,
        rms=rms,
        rms_raw=rms_raw,
        rms_flat=rms_flat,
        pv=pv,
        chief=image_point,
        los=los_eq339(image_point + shift, zernike, prepared.wavelength, prepared.numerical_aperture, factor),
        centroid=centroid,
        spot_rms=spot_rms,
        strehl=strehl,
        segment_phase=phase,
        lost=lost,
        vignetted=passed_by,
        lost_segments=lost_segments,
    )


def _analyse_tile(
    prepared: PreparedTrace, waves: Array, x: Array, y: Array, ok: NDArray[np.bool_], center: Array
) -> tuple[NDArray[Any], ...]:
    """Reduce one tile (N, 16) to arrays with its 16 instants first; lost rays count as nothing."""
    weight, segments = prepared.weight, len(prepared.system.segments)
    complete = bool(ok.all())
    if not complete:
        waves, x, y = (np.where(ok, values, 0.0) for values in (waves, x, y))
    incomplete = () if complete else np.flatnonzero(~ok.all(axis=0))

    def fitted(fit: Fit) -> Array:
        coefficients = fit.matrix @ waves
        for lane in incomplete:
            coefficients[:, lane] = refit(fit, ok[:, lane], waves[:, lane])
        return coefficients

    phase = (prepared.segment_fit @ waves).reshape(segments, 3, TILE)
    lost_segments = np.zeros((TILE, segments), dtype=np.bool_)
    remaining = np.ones(TILE)
    for lane in incomplete:
        kept = ok[:, lane]
        phase[..., lane], lost_segments[lane] = _refit_segments(prepared, kept, waves[:, lane])
        remaining[lane] = np.sum(weight[kept]) if kept.any() else np.nan
    shift = np.zeros((2, TILE))
    if prepared.sphere is not None:
        tilt = fitted(prepared.sphere)[1:3]
        waves = waves - prepared.sphere.basis[:, 1:3] @ tilt
        if not complete:
            waves = np.where(ok, waves, 0.0)
        shift = tilt * (prepared.wavelength / prepared.numerical_aperture)
    zernike, plane = fitted(prepared.zernike), fitted(prepared.plane)
    if prepared.slopes is not None:
        zernike = coefficients_of_tile(prepared.slopes, x - center[0], y - center[1], ok).T

    def mean(values: Array) -> Array:
        total: Array = weight @ (values if complete else values * ok)
        return total / remaining

    centroid = np.stack([mean(x), mean(y)], axis=1)
    axes = ((x, centroid[:, 0]), (y, centroid[:, 1]))
    angle = prepared.plane.basis @ (-2.0 * np.pi * plane)
    angle += 2.0 * np.pi * waves
    pv = _peak_to_valley(angle if complete else np.where(ok, angle, np.nan)) / (2.0 * np.pi)
    real = np.cos(angle)
    strehl = mean(real) ** 2
    rms_flat = np.sqrt(mean(np.square(angle, out=real))) / (2.0 * np.pi)
    strehl += mean(np.sin(angle, out=angle)) ** 2
    spread = [mean(np.square(np.subtract(x, middle, out=angle), out=angle)) for x, middle in axes]
    spot_rms = np.sqrt(spread[0] + spread[1])
    waves -= mean(waves)
    rms_raw = np.sqrt(mean(np.square(waves, out=waves)))
    rms = np.sqrt(np.sum(zernike[3:] ** 2, axis=0))
    lost = np.zeros(TILE, dtype=np.int64) if complete else np.count_nonzero(~ok, axis=0)
    phase = phase.transpose(2, 0, 1)
    return (
        *(zernike.T, rms, rms_raw, rms_flat, pv, shift.T, centroid, spot_rms),
        *(strehl, phase, lost, lost_segments),
    )


def _peak_to_valley(values: Array) -> Array:
    """Return the largest minus the smallest of values (N, 16), folded to long rows: 16 are slow to reduce."""
    whole = len(values) // _FOLD * _FOLD
    wide = values[:whole].reshape(-1, _FOLD * TILE)
    extremes = []
    for extreme, start in ((np.fmax, -np.inf), (np.fmin, np.inf)):
        folded = extreme.reduce(wide, axis=0, initial=start).reshape(_FOLD, TILE)
        rest = extreme.reduce(values[whole:], axis=0, initial=start)
        extremes.append(extreme(extreme.reduce(folded, axis=0), rest))
    return np.where(np.isfinite(extremes[0]), extremes[0] - extremes[1], np.nan)


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
