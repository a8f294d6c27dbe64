"""The first batch of every program against its NumPy twin.

Programs are generated per system, so a device that passed its self test may still err in one of them. Errors
of compilers and processors are gross; a few rays tell.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.kernels.device.opencl import Device
from wavequake.prepared import preparing

Array = NDArray[np.float64]
Pick = NDArray[np.intp]

_RAYS = 16
# Of the longest length on the way. Rounding stays a thousand times below, but for rays that graze a surface.
_TOLERANCE = 1e-11
_AT_EDGES = 0.25
# A traced ray may err by ten times what poses that are off by so much, relatively, do to it: rounding stays a
# thousand times below. One that may err by a hundred tolerances tells nothing, nor do a few others.
_SHAKEN, _SHARE_OF_SHAKEN = 1e-12, 10.0
_BLURRED = 100.0
_FEW = 8
COPIES = 5
# An error may sit in one lane of a vector: many rays are compared, and one in so many may err nevertheless.
_SAMPLES, _LEAST_RAYS = 64, 8
_CHANCE = 32
_TRUSTED: set[tuple[Device, Any]] = set()


def is_trusted(device: Device, program: Any) -> bool:
    """Return whether a program of a device was compared before."""
    return (device, program) in _TRUSTED


@preparing()
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
        If more of them differ than can be at an edge.
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
    lost = int(np.count_nonzero(arrives & ~both))
    if wrong > _AT_EDGES * np.count_nonzero(both) or (arrives.sum() >= 8 and 2 * lost > arrives.sum()):
        raise _refusal(device, int(arrives.sum()), kind, wrong, float(apart.max()), lost)
    _TRUSTED.add((device, program))


@np.errstate(invalid="ignore")
def shaken(poses: Array, length: float) -> Array:
    """Return poses (L, 12, ...) as they are, then off by 1e-12 in several ways, (COPIES, L, 12, ...).

    Each goes both ways: a ray at an edge is lost in one of them.
    """
    entries = np.array([_SHAKEN] * 9 + [_SHAKEN * max(length, 1.0)] * 3)
    random = np.random.default_rng(0).uniform(-1.0, 1.0, (COPIES // 2, *poses.shape))
    noise = random * entries.reshape(12, *(1,) * (poses.ndim - 2))
    return np.concatenate([poses[None], poses + noise, poses - noise])


@preparing()
def compare_rays(
    device: Device,
    program: Any,
    found: Sequence[Array],
    twin: Callable[[Pick], Sequence[Array]],
    length: float,
) -> None:
    """Compare some rays of a program's batch with NumPy, as `compare_first`, and each by its own tolerance.

    Where light goes far beyond the system or grazes surfaces, as at an asphere that folds over, rounding
    grows out of bounds, on every device: `shaken` poses tell for which rays.

    Parameters
    ----------
    device : Device
    program : hashable
        What tells the program from others of the device.
    found : sequence of ndarray, shape (N, ...)
        What the device computed for N rays; NaN where a ray is lost.
    twin : callable
        Returns the same for rays of given numbers, by `shaken` poses: (COPIES, numbers, ...).
    length : float
        Largest length of the system, mm.

    Raises
    ------
    UserError
        If rays differ by more than rounding explains.
    """
    count = len(found[0]) if found else 0
    if not count:
        return
    most = max(_LEAST_RAYS, _SAMPLES * count // found[0].size)
    pick = np.arange(0, count, -(-count // most) | 1)  # an odd step meets all lanes of vectors alike
    one, copies = np.stack([array[pick] for array in found]), np.stack(list(twin(pick)), axis=1)
    other, size = copies[0], np.maximum(np.abs(copies[0]).max(axis=0), max(length, 1.0))
    with np.errstate(invalid="ignore"):
        blur = _SHARE_OF_SHAKEN * np.abs(copies[1:] - other).max(axis=(0, 1))  # NaN where one copy is lost
        apart = np.abs(one - other).max(axis=0)
        known = blur <= _BLURRED * _TOLERANCE * max(length, 1.0)
        wrong, lost = known & (apart > _TOLERANCE * size + blur), known & ~np.isfinite(apart)
    rays, arriving = int(known.sum()), int(np.isfinite(other).all(axis=0).sum())
    if rays < max(1, min(_FEW, arriving)):
        return  # nothing to compare yet
    # Where an iteration wanders for many rays, or finds nothing, it may do so for some of the others.
    may_err = max(rays // _CHANCE, min(arriving - rays, rays // 3))
    may_end = max(may_err, min(known.size - rays, rays // 10))
    off, gone = int(wrong.sum()), int(lost.sum())
    if off > may_err or (gone > may_end and rays >= _FEW):
        raise _refusal(device, rays, "rays", off, float(apart[wrong].max(initial=0.0)), gone)
    _TRUSTED.add((device, program))


def _refusal(device: Device, count: int, kind: str, wrong: int, largest: float, lost: int) -> UserError:
    unit = " mm" if kind == "rays" else ""
    return UserError(
        f"the OpenCL device {device.label!r} computes wrong numbers: of {count} {kind} of the first batch "
        f"{wrong} differ from those of NumPy, by up to {largest:.1e}{unit}, and {lost} are lost; update its "
        "driver, or choose another device (campaign.device=numpy always works)"
    )
