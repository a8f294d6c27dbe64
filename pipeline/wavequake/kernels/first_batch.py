"""The first batch of every program against its NumPy twin.

Programs are generated per system, so a device that passed its self test may still err in one of them. Errors
of compilers and processors are gross; a few rays tell.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.kernels.devices import Device

Array = NDArray[np.float64]
Pick = NDArray[np.intp]

_RAYS = 16
# Of the longest length on the way. Rounding stays a thousand times below, but for rays that graze a surface.
_TOLERANCE = 1e-11
_GRAZING = 0.25
_TRUSTED: set[tuple[Device, Any]] = set()


def is_trusted(device: Device, program: Any) -> bool:
    """Return whether a program of a device was compared before."""
    return (device, program) in _TRUSTED


def compare_first(
    device: Device,
    program: Any,
    found: Sequence[Array],
    twin: Callable[[Pick], Sequence[Array]],
    length: float = 0.0,
    kind: str = "rays",
    tolerance: float = _TOLERANCE,
) -> None:
    """Compare some rays of a program's batch with NumPy; from then on it is trusted in this process.

    Parameters
    ----------
    device : Device
    program : hashable
        What tells the program from others of the device.
    found : sequence of ndarray, shape (N, ...)
        What the device computed for N rays at one instant or more; NaN where a ray is lost.
    twin : callable
        Returns the same for rays of given numbers.
    length : float
        Of the way of the light, mm, where it is more than the largest of the numbers.
    kind : str
        What there are N of, if not rays.
    tolerance : float
        Of the largest number or length; single precision needs more than the default.

    Raises
    ------
    UserError
        If more rays differ than can graze a surface or meet an edge.
    """
    count = len(found[0]) if found else 0
    if not count:
        return
    pick = np.unique(np.linspace(0, count - 1, _RAYS).astype(np.intp))
    one, other = (np.stack(list(values)) for values in ([array[pick] for array in found], twin(pick)))
    arrives = np.isfinite(other).all(axis=0)
    if not arrives.any():
        return  # nothing to compare yet
    both = arrives & np.isfinite(one).all(axis=0)
    allowed = tolerance * max(length, 1.0, float(np.abs(other[:, arrives]).max()))
    apart = np.abs(np.where(both, one - other, 0.0)).max(axis=0)
    wrong = int(np.count_nonzero(apart > allowed))
    lost = int(np.count_nonzero(arrives & ~both))  # few: where light meets the edge of an opening
    if wrong > _GRAZING * np.count_nonzero(both) or (arrives.sum() >= 8 and 2 * lost > arrives.sum()):
        unit = " mm" if kind == "rays" else ""
        raise UserError(
            f"the OpenCL device {device.label!r} computes wrong numbers: of {arrives.sum()} {kind} of the "
            f"first batch {wrong} differ from those of NumPy, by up to {apart.max():.1e}{unit}, and {lost} "
            "are lost; update its driver, or choose another device (campaign.device=numpy always works)"
        )
    _TRUSTED.add((device, program))
