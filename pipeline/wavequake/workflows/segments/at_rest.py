"""What a telescope at rest does to the light of a study: its wavefront, and how M2 turns its direction."""

from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.kernels.device.devices import choose_device
from wavequake.kernels.device.tiles import TILE
from wavequake.kernels.trace.status import OK
from wavequake.optics.derivatives.central import SIGNS, checked_derivative
from wavequake.optics.segments.prepared import PreparedTrace, chief_rays, trace_states
from wavequake.optics.segments.states import rest
from wavequake.optics.segments.wavefront import Wavefront, analyse
from wavequake.optics.wavefronts.fits import tells_apart
from wavequake.tables import kept
from wavequake.workflows.segments.segment_study import SegmentStudy
from wavequake.workflows.segments.vignetting import Stopped, refuse_dark_segment, stopped_at_rest

Array = NDArray[np.float64]

_STEP = 1e-6  # rad


@dataclass(frozen=True)
class _Traced:
    """A wavefront without its device, and the status of each ray at rest (N,)."""

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
    status: NDArray[np.int8]


def at_rest(
    study: SegmentStudy, prepared: PreparedTrace, field: Array, terms: int, mirror_terms: int
) -> tuple[Wavefront, Stopped, Array]:
    """Measure the reference configuration, its lost light, and M2's rotations for 1 rad of line of sight.

    Without a mirror after M1 the rotations are zero. Both come from NumPy whatever the study's device, so
    that they are the same on every worker; the first process that traces keeps them on disk for the others.

    Parameters
    ----------
    study : SegmentStudy
    prepared : PreparedTrace
        What follows from the telescope, optics and wavefront of the study, at one field point and wavelength.
    field : ndarray, shape (2,)
        In rad.
    terms, mirror_terms : int
        Of the figures of segments and of mirrors after M1.

    Raises
    ------
    UserError
        If light of a segment does not arrive, or too little for the Zernike terms.
    """

    def reference(*known_by: object) -> _Traced:
        return _traced(prepared, field, terms, mirror_terms)

    sections = study.telescope, study.optics, study.wavefront
    texts = [section.model_dump_json() for section in sections]
    found = kept(_Traced, reference, *texts, prepared.wavelength, field, terms, mirror_terms)
    parts = {one.name: getattr(found, one.name) for one in fields(found) if one.name != "status"}
    wavefront, status = Wavefront(**parts), found.status
    refuse_dark_segment(prepared, status, wavefront.lost_segments[0])
    stopped = stopped_at_rest(prepared, status)
    if stopped.words() and not tells_apart(prepared.zernike, status == OK):
        raise UserError(
            f"{stopped.words()}; the others do not determine {prepared.zernike.basis.shape[1]} "
            "Zernike terms: take fewer wavefront.zernike_terms, or a larger semi_diameter_mm."
        )
    if not prepared.system.surfaces[0].reflects:
        return wavefront, stopped, np.zeros((2, 2))
    los = wavefront.los[1:9].reshape(4, 2, 2)
    per_tilt = checked_derivative(los, _STEP, "M2's tilt", "take other optics.rays").T
    return wavefront, stopped, np.asarray(np.linalg.inv(per_tilt / prepared.focal_length), dtype=np.float64)


def _traced(prepared: PreparedTrace, field: Array, terms: int, mirror_terms: int) -> _Traced:
    """Trace the telescope at rest and, for derivatives, with M2 turned by steps about x and y."""
    system = prepared.system
    still = rest(TILE, len(system.segments), len(system.surfaces), terms, mirror_terms)
    motion = still.surface_motion.copy()
    for place, axis in enumerate((3, 4)):
        motion[1 + place : 9 : 2, 0, axis] = SIGNS * _STEP
    states = replace(still, surface_motion=motion, field=still.field + field)
    traced = trace_states(prepared, states, choose_device("numpy"))
    wavefront = analyse(prepared, traced, chief_rays(prepared, states))
    parts = {one.name: getattr(wavefront, one.name) for one in fields(_Traced) if one.name != "status"}
    return _Traced(**parts, status=np.asarray(traced.status[0, :, 0]))
