"""Strehl ratios of many instants from the phases of a pupil's patches, without an image."""

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.kernels.device.first_batch import Pick, compare_first, is_trusted
from wavequake.kernels.device.opencl import NUMPY, Device
from wavequake.kernels.device.program import source
from wavequake.kernels.device.steps import Step, run_steps, vector_width

Real = NDArray[np.float64]

# Instants in a work-group, and those of the NumPy twin at once.
_GROUP = 64
_BATCH = 256


def strehl_ratios(phase: Real, weight: Real, device: Device = NUMPY) -> Real:
    """Return the irradiance at the origin relative to that without phases: |Σ w exp(iφ)|² / (Σ w)².

    Parameters
    ----------
    phase : ndarray, shape (batch, m)
        2 pi OPD / wavelength of each patch of the pupil, rad; a segment is a patch if it does not tilt.
    weight : ndarray, shape (m,)
        Areas of the patches, or amplitudes times areas.
    device : Device
        Where to run.

    Returns
    -------
    ndarray, shape (batch,)
        NaN for an instant with a phase that is not a number.

    Raises
    ------
    UserError
        If the shapes do not fit, or the weights are not finite or sum to 0.
    """
    phase, weight = np.asarray(phase, dtype=np.float64), np.asarray(weight, dtype=np.float64)
    if weight.ndim != 1 or phase.ndim != 2 or phase.shape[1] != weight.size:
        raise UserError(
            f"{weight.size} patches need phases of shape (batch, {weight.size}), not {phase.shape}"
        )
    if not np.isfinite(weight).all() or weight.sum() == 0.0:
        raise UserError("the weights of a pupil's patches must be finite and not sum to 0")
    share = weight / weight.sum()
    ratios = np.empty(len(phase))
    if device.kind == "numpy":
        for first in range(0, len(phase), _BATCH):
            ratios[first : first + _BATCH] = _ratios_numpy(phase[first : first + _BATCH], share)
        return ratios
    width = vector_width(device, np.dtype(np.float64), long=True)
    while width > weight.size:
        width //= 2
    # The last group of lanes ends with the last patch: what is in the group before it has no weight again.
    whole = weight.size // width * width
    rest = weight.size - whole
    last = np.concatenate([np.zeros(width - rest), share[whole:]]) if rest else np.empty(0)
    constants = (("W", width), ("SINGLE", 0), ("PATCHES", weight.size))
    arguments = (np.int32(len(phase)), "phase", "weight", "ratio")
    step = Step(_text(), "strehl", constants, (1, len(phase), 1), (1, _GROUP, 1), arguments)
    if len(phase):
        inputs = {"phase": phase, "weight": np.concatenate([share[:whole], last])}
        run_steps(device, [step], inputs, {"ratio": ratios}, {})
        if not is_trusted(device, ("strehl", constants)):
            _compare(device, ("strehl", constants), phase, share, ratios)
    return ratios


def _ratios_numpy(phase: Real, share: Real) -> Real:
    waves = np.exp(1j * phase)
    field = (waves[:, None, :] @ share[:, None])[:, 0, 0]  # bits do not depend on the batch
    return np.asarray(field.real**2 + field.imag**2)


def _compare(device: Device, program: Any, phase: Real, share: Real, ratios: Real) -> None:
    """Compare amplitudes with NumPy; their errors do not depend on the ratios."""
    some = np.arange(0, len(phase), -(-len(phase) // _BATCH))
    known = some[np.isfinite(phase[some]).all(axis=1)]
    if not known.size:
        return
    light = float(np.abs(share).sum())

    def twin(pick: Pick) -> list[Real]:
        return [np.sqrt(_ratios_numpy(phase[known[pick]], share)) / light]

    found = np.sqrt(np.maximum(ratios[known], 0.0)) / light
    compare_first(device, program, [found], twin, float(np.abs(phase[known]).max()), "instants")


@lru_cache(maxsize=1)
def _text() -> str:
    return source("strehl.cl")
