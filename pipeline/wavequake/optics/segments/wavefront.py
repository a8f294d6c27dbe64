"""From traced rays to wavefronts: OPD, Zernike coefficients, line of sight, Strehl ratio, segment phases.

`analyse` reduces the rays of a batch of instants to numbers, tile by tile at constant shapes, so that the
bits of an instant do not depend on its batch. The optics are in mm; the step to waves of the wavelength
happens here and nowhere else.

A lost ray is data: an instant that has one is fitted without it and says so in ``lost``.
"""

import numpy as np
from numpy.typing import NDArray

from wavequake.kernels.device.devices import NUMPY, Device
from wavequake.kernels.device.resident import device_of
from wavequake.kernels.device.tiles import TILE, from_tiles
from wavequake.kernels.sums.ray_sums import tile_moments
from wavequake.kernels.trace.segmented import Traced
from wavequake.kernels.trace.status import OK
from wavequake.kernels.trace.train import vignetted
from wavequake.optics.segments.prepared import PreparedTrace, chief_rays, trace_states
from wavequake.optics.segments.slopes import wavefront_from_slopes
from wavequake.optics.systems.system import States
from wavequake.optics.wavefronts.fits import fit_tile, segment_planes
from wavequake.optics.wavefronts.record import Wavefront

Array = NDArray[np.float64]

_TILES = 16  # that are reduced at a time: their waves take memory beside the traced rays


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


def analyse(prepared: PreparedTrace, traced: Traced, chief: Array, device: Device = NUMPY) -> Wavefront:
    """Reduce traced rays to the numbers of the wavefront.

    Parameters
    ----------
    prepared : PreparedTrace
    traced : Traced
        Of T tiles of 16 instants.
    chief : ndarray, shape (T, 3, 16)
        From `chief_rays`.
    device : Device
        Where to take the sums over rays that are not fits.

    Returns
    -------
    Wavefront
        With batch = 16 T.
    """
    fits, sums = [], []
    slopes = prepared.plane.basis[:, 1:3].T
    status, stays = np.asarray(traced.status), device_of(traced.x) is not None
    step, lost = len(status) if stays else _TILES, status != OK
    some_lost = bool(lost.any())
    for first in range(0, len(status), step):
        tiles = slice(first, first + step)
        waves = traced.opd[tiles] / prepared.wavelength
        if some_lost:
            waves[lost[tiles]] = np.nan
            found = [_fit_tile(prepared, *tile) for tile in zip(waves, ~lost[tiles], strict=True)]
        else:
            found = [_fit_tile(prepared, tile) for tile in waves]
        planes = np.stack([tile[-1] for tile in found])
        x, y = (values if stays else values[tiles] for values in (traced.x, traced.y))  # a part would come
        sums.append(vars(tile_moments(waves, x, y, prepared.weight, slopes, planes, device)))
        fits += found
    zernike, phase, lost_segments, shift = (np.concatenate([tile[k] for tile in fits]) for k in range(4))
    moments = {name: np.concatenate([part[name] for part in sums]) for name in sums[0]}
    if prepared.slopes is not None:
        zernike = wavefront_from_slopes(prepared.slopes, traced, chief)
    image_point = from_tiles(chief)[:, :2]
    lost_rays, passed_by = (np.zeros(len(status) * TILE, dtype=np.int64) for _ in range(2))
    if some_lost:
        lost_rays[:] = np.count_nonzero(lost, axis=1).ravel()
    for tile in np.flatnonzero(lost_rays.reshape(-1, TILE).any(axis=1)):
        gone = vignetted(prepared.train, status[tile])
        passed_by[tile * TILE : (tile + 1) * TILE] = np.count_nonzero(gone, axis=0)
    scale = prepared.wavelength, prepared.numerical_aperture, prepared.tilt_factor
    return Wavefront(
        zernike=zernike,
        rms_raw=moments["rms_raw"],
        rms_flat=moments["rms_flat"],
        pv=moments["pv"],
        chief=image_point,
        los=los_eq339(image_point + shift, zernike, *scale),
        centroid=moments["centroid"],
        spot_rms=moments["spot_rms"],
        strehl=moments["strehl"],
        segment_phase=phase,
        lost=lost_rays,
        vignetted=passed_by,
        lost_segments=lost_segments,
        device=device,
    )


def _fit_tile(
    prepared: PreparedTrace, waves: Array, ok: NDArray[np.bool_] | None = None
) -> tuple[Array, Array, NDArray[np.bool_], Array, Array]:
    """Fit one tile (N, 16) of rays of which some are `ok`, or all; the fitted sphere's tilt is taken out.

    Return Zernike coefficients, phases of segments, lost segments and shift of the sphere's center with the
    16 instants first, and the plane's slopes (2, 16).
    """
    segments = len(prepared.system.segments)
    known = waves if ok is None else np.where(ok, waves, 0.0)
    phase = (prepared.segment_fit @ known).reshape(segments, 3, TILE)
    lost_segments = np.zeros((TILE, segments), dtype=np.bool_)
    if ok is not None:
        for lane in np.flatnonzero(~ok.all(axis=0)):
            phase[..., lane], lost_segments[lane] = _refit_segments(prepared, ok[:, lane], known[:, lane])
    shift = np.zeros((2, TILE))
    if prepared.sphere is not None:
        tilt = fit_tile(prepared.sphere, waves, ok)[1:3]
        waves -= prepared.sphere.basis[:, 1:3] @ tilt
        shift = tilt * (prepared.wavelength / prepared.numerical_aperture)
    zernike, plane = (fit_tile(fit, waves, ok) for fit in (prepared.fit, prepared.plane))
    return zernike.T, phase.transpose(2, 0, 1), lost_segments, shift.T, plane[1:3]


def _refit_segments(
    prepared: PreparedTrace, kept: NDArray[np.bool_], values: Array
) -> tuple[Array, NDArray[np.bool_]]:
    """Return the segment phases (S, 3) of one instant without its lost rays, and the lost segments (S,)."""
    rays, centers = prepared.rays, prepared.system.segments.centers[:, :2]
    rows, solved = segment_planes(rays.x, rays.y, prepared.weight * kept, rays.segment, centers)
    parts = [np.bincount(rays.segment, row * values, len(centers)) for row in rows]
    return np.where(solved[:, None], np.stack(parts, axis=1), np.nan), ~solved


def measure(prepared: PreparedTrace, states: States, device: Device) -> Wavefront:
    """Trace a batch of instants and reduce it to its wavefronts: `trace_states`, then `analyse`."""
    return analyse(prepared, trace_states(prepared, states, device), chief_rays(prepared, states), device)
