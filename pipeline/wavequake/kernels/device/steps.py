"""Run several kernels one after the other on buffers that stay on the device."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from wavequake.kernels.device.launches import count_launch
from wavequake.kernels.device.opencl import POCL, Device, opencl_handle
from wavequake.kernels.device.pocl_source import has_wide_vectors
from wavequake.kernels.device.program import (
    _fetch,
    _input,
    _kernel,
    _output,
    _queue,
    building,
    finished,
    scalar_types,
    watch,
)
from wavequake.kernels.device.resident import exclusive

# Scratch memory is kept for the next call, unless it is more than this: (device, name) to buffer.
_SCRATCH: dict[tuple[Device, str], Any] = {}
_KEPT_BYTES = 1 << 28


@dataclass(frozen=True)
class Step:
    """One launch of a kernel of some source text with compile-time constants.

    ``size`` and ``group`` are those of OpenCL; ``arguments`` are NumPy scalars and names of buffers.
    """

    text: str
    kernel: str
    constants: tuple[tuple[str, int], ...]
    size: tuple[int, int, int]
    group: tuple[int, int, int]
    arguments: tuple[Any, ...]


def run_steps(
    device: Device,
    steps: Sequence[Step],
    inputs: Mapping[str, Any],
    outputs: Mapping[str, np.ndarray[Any, Any]],
    scratch: Mapping[str, int],
) -> None:
    """Run kernels in order and wait for their outputs.

    Parameters
    ----------
    device : Device
        An OpenCL device.
    steps : sequence of Step
        A size is rounded up to whole groups; kernels must ignore what lies beyond.
    inputs : mapping of name to ndarray
        What kernels read.
    outputs : mapping of name to contiguous ndarray
        What kernels write; a CPU works in the arrays' own memory, in another device stay those that
        `device_empty` makes.
    scratch : mapping of name to int
        Sizes in bytes of buffers that stay on the device; their memory is used again by later calls.

    Raises
    ------
    UserError
        If the device has not enough memory.
    """
    import pyopencl as cl

    arrays = {
        name: np.ascontiguousarray(array) if isinstance(array, np.ndarray) else array
        for name, array in inputs.items()
    }
    with exclusive(device), building():
        queue = _queue(device)
        buffers = {name: _input(queue, device, array) for name, array in arrays.items()}
        buffers |= {name: _output(queue, device, array) for name, array in outputs.items()}
        buffers |= {name: _scratch(queue, device, name, size) for name, size in scratch.items()}
        events = []
        with finished(queue):
            for step in steps:
                kernel = _kernel(device, step.kernel, step.constants, step.text, scalar_types(step.arguments))
                kernel.set_args(*(buffers[a] if isinstance(a, str) else a for a in step.arguments))
                size = tuple(-(-n // g) * g for n, g in zip(step.size, step.group, strict=True))
                events.append(cl.enqueue_nd_range_kernel(queue, kernel, size, step.group))
            if events:
                watch(queue, device, events[-1])
            for name, out in outputs.items():
                _fetch(queue, device, out, buffers[name])
        for step, event in zip(steps, events, strict=True):
            count_launch(step.kernel, event)


def vector_width(device: Device, dtype: np.dtype[Any], long: bool = False) -> int:
    """Return how many real numbers the device calculates with at once: on a GPU 1.

    AMD's processors to Zen 4 calculate with 256 bits at a time; `long` kernels, which run out of registers,
    gain by 512 where there are such.
    """
    if device.kind == "gpu":
        return 1
    own = int(opencl_handle(device).native_vector_width_double) * (8 // dtype.itemsize)
    wide = long and device.platform == POCL and has_wide_vectors()
    return max(1, min(own, 32 // dtype.itemsize) if "AMD" in device.name and not wide else own)


def _scratch(queue: Any, device: Device, name: str, size: int) -> Any:
    import pyopencl as cl

    kept = _SCRATCH.get((device, name))
    if kept is None or kept.size < size:
        kept = cl.Buffer(queue.context, cl.mem_flags.READ_WRITE, max(size, 64))
        if size <= _KEPT_BYTES:
            _SCRATCH[device, name] = kept
    return kept
