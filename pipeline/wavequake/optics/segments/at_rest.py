"""A telescope at rest and with M2 turned a little: traced by the first process, and kept for the others."""

from dataclasses import make_dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wavequake.kernels.device.devices import choose_device
from wavequake.kernels.device.tiles import TILE
from wavequake.optics.derivatives.central import SIGNS
from wavequake.optics.segments.prepared import PreparedTrace, chief_rays, trace_states
from wavequake.optics.segments.states import rest
from wavequake.optics.segments.wavefront import analyse
from wavequake.optics.wavefronts.record import ARRAYS, Wavefront
from wavequake.tables import kept

Array = NDArray[np.float64]

STEP = 1e-6
"""By which M2 turns, rad."""


_Traced = make_dataclass("_Traced", [*ARRAYS, "status"], frozen=True)


def at_rest(
    prepared: PreparedTrace, known_by: tuple[str, ...], field: Array, terms: int, mirror_terms: int
) -> tuple[Wavefront, NDArray[np.int8]]:
    """Return the wavefront of a telescope, and the status (N,) of its rays at rest.

    It comes from NumPy whatever a study's device, so that it is the same on every worker.

    Parameters
    ----------
    prepared : PreparedTrace
    known_by : tuple of str
        Texts from which, with the wavelength and the field, follows all that is prepared.
    field : ndarray, shape (2,)
        In rad.
    terms, mirror_terms : int
        Of the figures of segments and of mirrors after M1.

    Returns
    -------
    Wavefront
        At rest, then for each of `SIGNS` with M2 turned by so many `STEP` about x and about y; at rest again.
    ndarray of int
    """

    def reference(*known_by: object) -> Any:
        return _traced(prepared, field, terms, mirror_terms)

    found = kept(_Traced, reference, *known_by, prepared.wavelength, field, terms, mirror_terms)
    return Wavefront(**{name: getattr(found, name) for name in ARRAYS}), found.status


def _traced(prepared: PreparedTrace, field: Array, terms: int, mirror_terms: int) -> Any:
    system = prepared.system
    still = rest(TILE, len(system.segments), len(system.surfaces), terms, mirror_terms)
    motion = still.surface_motion.copy()
    for place, axis in enumerate((3, 4)):
        motion[1 + place : 9 : 2, 0, axis] = SIGNS * STEP
    states = replace(still, surface_motion=motion, field=still.field + field)
    traced = trace_states(prepared, states, choose_device("numpy"))
    wavefront = analyse(prepared, traced, chief_rays(prepared, states))
    parts = {name: getattr(wavefront, name) for name in ARRAYS}
    return _Traced(**parts, status=np.asarray(traced.status[0, :, 0]))
