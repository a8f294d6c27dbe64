"""A telescope at rest, and moved a little: traced by the first process, and kept for the others."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, fields, make_dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wavequake.kernels.device.devices import choose_device
from wavequake.kernels.device.tiles import TILE
from wavequake.optics.derivatives.central import SIGNS
from wavequake.optics.segments.prepared import PreparedTrace, chief_rays, trace_states
from wavequake.optics.segments.telescope import M2
from wavequake.optics.segments.wavefront import analyse
from wavequake.optics.systems.kinematics import rest_states
from wavequake.optics.systems.system import States
from wavequake.optics.wavefronts.record import ARRAYS, Wavefront
from wavequake.tables import kept

STEP = 1e-6
"""By which M2 turns, rad."""


_Traced = make_dataclass("_Traced", [*ARRAYS, "status"], frozen=True)


def at_rest(prepared: PreparedTrace, known_by: tuple[str, ...]) -> tuple[Wavefront, NDArray[np.int8]]:
    """Return the wavefront of a telescope, and the status (N,) of its rays at rest.

    It comes from NumPy whatever a study's device, so that it is the same on every worker.

    Parameters
    ----------
    prepared : PreparedTrace
    known_by : tuple of str
        Texts from which, with the wavelength and the field, follows all that is prepared.

    Returns
    -------
    Wavefront
        At rest, then for each of `SIGNS` with M2 turned by so many `STEP` about x and about y; at rest again.
    ndarray of int
    """

    def reference(*known_by: object) -> Any:
        return _traced(prepared)

    terms = prepared.figure_matrix.shape[2], prepared.mirror_matrix.shape[1]
    found = kept(_Traced, reference, *known_by, prepared.wavelength, prepared.point, *terms)
    return Wavefront(**{name: getattr(found, name) for name in ARRAYS}), found.status


def _traced(prepared: PreparedTrace) -> Any:
    states = rest_states(prepared.system, TILE)
    for place, axis in enumerate((3, 4)):
        states.surface_motion[1 + place : 9 : 2, M2, axis] = SIGNS * STEP
    traced = trace_states(prepared, states, choose_device("numpy"))
    wavefront = analyse(prepared, traced, chief_rays(prepared, states))
    parts = {name: getattr(wavefront, name) for name in ARRAYS}
    return _Traced(**parts, status=np.asarray(traced.status[0, :, 0]))


@dataclass(frozen=True)
class _Seen:
    los: NDArray[np.float64]
    zernike: NDArray[np.float64]


def traced_once(
    prepared: PreparedTrace, states: States, known_by: tuple[str, ...]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return line of sight (T, 2), mm, and Noll coefficients (T, J), waves, of T instants.

    As `at_rest` they come from NumPy, and are kept: by the texts from which all that is prepared follows, by
    what the rays meet, and by the states.
    """

    def sight(*known_by: object) -> _Seen:
        found = trace_states(prepared, states, choose_device("numpy"))
        wavefront = analyse(prepared, found, chief_rays(prepared, states))
        return _Seen(wavefront.los, wavefront.zernike)

    rays = prepared.rays.x, prepared.rays.y, prepared.weight, prepared.fit.basis
    parts = [getattr(one, name.name) for one in (prepared.train, states) for name in fields(one)]
    found = kept(_Seen, sight, *known_by, prepared.wavelength, prepared.point, *rays, *_one_by_one(parts))
    return found.los, found.zernike


def _one_by_one(items: Iterable[object]) -> Iterator[object]:
    """Yield items, and those of tuples among them alone: words for arrays within tuples are shortened."""
    for one in items:
        yield from one if isinstance(one, tuple) else (one,)
