"""Wavefronts of traced rays, made where their paths are: on the host by NumPy, or on a device.

What comes of rays that stay on a device stays there, too, see `wavequake.kernels.device.resident`.
"""

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wavequake.kernels.device.first_batch import Pick, compare_first, is_trusted
from wavequake.kernels.device.opencl import Device
from wavequake.kernels.device.program import device_empty, source
from wavequake.kernels.device.resident import device_of
from wavequake.kernels.device.steps import Step, run_steps

Array = NDArray[np.float64]

# Work-items of a group.
_GROUP = 64


def path_differences(path: Array, chief: Array, wavelength: float) -> Array:
    """Return by how many waves the paths (T, N) of rays are shorter than those (T,) of chief rays."""
    device = device_of(path)
    if device is None:
        return np.asarray((chief[:, None] - path) / wavelength)
    waves, arguments = device_empty(device, path.shape), {"path": path, "chief": chief}

    def twin(pick: Pick) -> Array:
        return path_differences(path[pick], chief[pick], wavelength)

    _run(device, "opd", path.shape, arguments | {"wavelength": np.float64(wavelength)}, waves, twin)
    return waves


def without_planes(waves: Array, slopes: Array, planes: Array) -> Array:
    """Return wavefronts (T, N) less two functions (2, N) at the rays, as much of each as in planes (T, 2)."""
    device = device_of(waves)
    if device is None:
        return np.asarray(waves - planes[:, :1] * slopes[0] - planes[:, 1:] * slopes[1])
    rest, arguments = device_empty(device, waves.shape), {"waves": waves, "slopes": slopes, "planes": planes}

    def twin(pick: Pick) -> Array:
        return without_planes(waves[pick], slopes, planes[pick])

    _run(device, "without_planes", waves.shape, arguments, rest, twin)
    return rest


def count_status(status: NDArray[np.int8], wanted: int) -> NDArray[np.int64]:
    """Return how many rays have a status at each instant, (T,) of (T, N)."""
    device = device_of(status)
    if device is None:
        return np.asarray(np.count_nonzero(status == wanted, axis=1), dtype=np.int64)
    counts, arguments = np.empty(len(status), np.int32), {"status": status, "wanted": np.int32(wanted)}

    def twin(pick: Pick) -> Array:
        return count_status(status[pick], wanted).astype(np.float64)

    _run(device, "count_status", status.shape, arguments, counts, twin)
    return counts.astype(np.int64)


def _run(
    device: Device,
    kernel: str,
    shape: tuple[int, ...],
    arguments: dict[str, Any],
    out: NDArray[Any],
    twin: Callable[[Pick], Array],
) -> None:
    """Fill `out` from arrays of instants and rays; the first batch is compared with NumPy."""
    instants, rays = shape
    inputs = {name: value for name, value in arguments.items() if not isinstance(value, np.generic)}
    given = (name if name in inputs else value for name, value in arguments.items())
    size = (rays if len(out.shape) > 1 else _GROUP, instants, 1)  # a group sums what it shares
    constants, numbers = (("GROUP", _GROUP),), (np.int32(rays), *given, "out")
    run_steps(
        device, [Step(_text(), kernel, constants, size, (_GROUP, 1, 1), numbers)], inputs, {"out": out}, {}
    )
    if not is_trusted(device, kernel):
        compare_first(device, kernel, [out], lambda pick: [twin(pick)], kind="numbers")


@lru_cache(maxsize=1)
def _text() -> str:
    return source("opd.cl")
