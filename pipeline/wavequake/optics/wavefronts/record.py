"""What the rays of a wavefront come to: one record for segmented telescopes and any other system."""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from wavequake.kernels.device.devices import NUMPY, Device

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Wavefront:
    """The wavefronts of T instants.

    Attributes
    ----------
    zernike : ndarray, shape (T, J)
        Annular Noll coefficients in waves, total (not relative to the reference configuration). The first
        one is NaN if they come from slopes.
    rms_raw : ndarray, shape (T,)
        Weighted rms over the rays that arrive, piston removed, waves.
    rms_flat, pv : ndarray, shape (T,)
        Weighted rms and peak to valley over these rays about the best-fit plane, waves.
    chief, los, centroid : ndarray, shape (T, 2)
        Image point of the (virtual) chief ray; line of sight by Störkle 2018, Eq. 3.39 with annular tilt:
        that of the best-fit plane; weighted mean of the rays' image points (the true geometric centroid);
        mm in the frame of the image.
    spot_rms : ndarray, shape (T,)
        Weighted rms distance of the rays' image points from their centroid, mm.
    strehl : ndarray, shape (T,)
        Squared modulus of the mean of exp(2 pi i OPD) about the best-fit plane, weighted by the amplitude:
        the intensity in the plane's direction, relative to that of a perfect wavefront.
    lost : ndarray of int, shape (T,)
        Number of lost rays; all numbers above are those of the remaining rays.
    vignetted : ndarray of int, shape (T,)
        Those of them that an edge or opening stops: of a segmented telescope, one of a mirror after M1.
    segment_phase : ndarray, shape (T, S, 3)
        Of the OPD about the chief ray: piston at each segment's center in waves and slopes in x and y in
        waves/mm; NaN for a lost segment. Empty for optics without segments.
    lost_segments : ndarray of bool, shape (T, S)
        Segments whose remaining rays do not determine a plane: mostly, that lost all their rays.
    device : Device
        Where it was measured, and where images of it are made.
    """

    zernike: Array
    rms_raw: Array
    rms_flat: Array
    pv: Array
    chief: Array
    los: Array
    centroid: Array
    spot_rms: Array
    strehl: Array
    lost: NDArray[np.int64]
    vignetted: NDArray[np.int64]
    segment_phase: Array = field(default_factory=lambda: np.zeros((0, 0, 3)))
    lost_segments: NDArray[np.bool_] = field(default_factory=lambda: np.zeros((0, 0), dtype=np.bool_))
    device: Device = NUMPY

    @cached_property
    def rms(self) -> Array:
        """Root of the sum of squares from j = 4 on, waves, shape (T,) (Störkle 2018, Eq. 3.40)."""
        return np.asarray(np.sqrt(np.sum(self.zernike[:, 3:] ** 2, axis=1)), dtype=np.float64)


ARRAYS = tuple(one.name for one in fields(Wavefront) if one.name != "device")
"""Names of what a wavefront holds of each instant."""


def joined(parts: Sequence[Wavefront]) -> Wavefront:
    """Return the wavefronts of parts of a case, measured on one device, one after the other."""
    if len(parts) == 1:
        return parts[0]
    arrays = {name: np.concatenate([getattr(one, name) for one in parts]) for name in ARRAYS}
    return Wavefront(**arrays, device=parts[0].device)
