"""Launch kernels; OpenCL queues and programs are made when this process first uses them and then kept."""

import math
import mmap
import os
import re
import time
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from itertools import accumulate
from typing import Any, cast

import numpy as np
from numpy.typing import DTypeLike, NDArray

from wavequake.files import folder
from wavequake.kernels.device.launches import count_bytes, count_launch, device_seconds
from wavequake.kernels.device.opencl import POCL, Device, opencl_handle
from wavequake.kernels.device.pocl_processor import known_processor
from wavequake.kernels.device.pocl_source import for_pocl, has_wide_vectors
from wavequake.kernels.device.resident import Resident, exclusive, settled
from wavequake.prepared import count_preparation
from wavequake.tables import kept_by

# Rays, or groups of them, in a work-group. One size for all launches: PoCL compiles a kernel for each size.
_GROUP_RAYS = {"cpu": 125, "gpu": 8}
# Bytes: no implementation asks for more than its widest vector, sixteen doubles.
_ALIGNED = 128
# Arrays that are written together share memory up to so much, as taking it takes time; one keeps all alive.
_SHARED_BYTES = 1 << 20
# Of half a microsecond each.
_GLANCES = 1000
_YIELD = getattr(os, "sched_yield", lambda: None)


def launch(
    device: Device,
    name: str,
    constants: tuple[tuple[str, int], ...],
    size: tuple[int, int, int],
    inputs: Sequence[Any],
    outputs: Sequence[np.ndarray[Any, Any]],
    text: str | None = None,
    group: int | None = None,
) -> None:
    """Run a kernel and wait for its outputs.

    Parameters
    ----------
    device : Device
        An OpenCL device.
    name : str
        The kernel, found in ``kernels/NAME.cl``.
    constants : tuple of (str, int)
        Compile-time constants.
    size : tuple of int
        Lane groups, rays (or groups of them), tiles. Rays are padded to whole work-groups; the kernel must
        ignore those beyond.
    inputs : sequence
        The kernel's first arguments: NumPy scalars and arrays; an empty array or None becomes a null pointer.
    outputs : sequence of ndarray
        Its last arguments: contiguous arrays, which the kernel fills. A CPU works in the arrays' own memory;
        in another device stay those that `device_empty` makes.
    text : str, optional
        The kernel's source where it is generated; ``kernels/NAME.cl`` by default.
    group : int, optional
        Rays (or groups of them) in a work-group.

    Raises
    ------
    UserError
        If the device has not enough memory.
    """
    import pyopencl as cl

    if 0 in size:
        return
    lanes, rays, tiles = size
    group = group or _GROUP_RAYS[device.kind]
    arrays = [np.ascontiguousarray(item) if isinstance(item, np.ndarray) else item for item in inputs]
    # A kernel object holds one set of arguments, and does not keep their buffers alive.
    with exclusive(device), building():
        queue = _queue(device)
        arguments = [_input(queue, device, item) for item in arrays]
        results = [_output(queue, device, out) for out in outputs]
        kernel = _kernel(device, name, constants, text, scalar_types(arguments + results))
        kernel.set_args(*arguments, *results)
        padded = (lanes, -(-rays // group) * group, tiles)
        with finished(queue):
            event = cl.enqueue_nd_range_kernel(queue, kernel, padded, (lanes, group, 1))
            if padded[1:] == (group, 1):
                watch(queue, device, event)
            for out, result in zip(outputs, results, strict=True):
                _fetch(queue, device, out, result)
        count_launch(name, event)


@contextmanager
def finished(queue: Any) -> Iterator[None]:
    """Wait for what is queued within, also after Ctrl-C and alarms: kernels work in arrays that end then."""
    try:
        yield
    finally:
        queue.finish()


@contextmanager
def building() -> Iterator[None]:
    """Count what is done within as preparation if a kernel is built there, but for the time that it runs.

    PoCL compiles when it launches, before the event begins to run.
    """
    built, run, start = _kernel.cache_info().misses, device_seconds(), time.perf_counter()
    yield
    if _kernel.cache_info().misses > built:
        count_preparation(time.perf_counter() - start - (device_seconds() - run))


def watch(queue: Any, device: Device, event: Any) -> None:
    """Look half a millisecond whether short work is done: waking up on a processor takes up to 0.1 ms.

    Other threads that want this processor get it meanwhile.
    """
    import pyopencl as cl

    queue.flush()
    for _ in range(_GLANCES if device.kind == "cpu" else 0):
        if event.command_execution_status <= cl.command_execution_status.COMPLETE:  # below: it failed
            return
        _YIELD()


def aligned_empty(shape: tuple[int, ...], dtype: DTypeLike = np.float64) -> NDArray[Any]:
    """Return a new array at the start of a memory page: some implementations copy what lies elsewhere."""
    return aligned_empties(shape, [dtype])[0]


def aligned_empties(shape: tuple[int, ...], dtypes: Sequence[DTypeLike]) -> list[NDArray[Any]]:
    """Return new arrays of one shape, each at the start of a memory page; small ones share their memory."""
    types, count = [np.dtype(dtype) for dtype in dtypes], math.prod(shape)
    pages = [-(-count * dtype.itemsize // mmap.PAGESIZE) * mmap.PAGESIZE for dtype in types]
    if len(types) > 1 and sum(pages) > _SHARED_BYTES:
        return [aligned_empty(shape, dtype) for dtype in types]
    memory = np.empty(sum(pages) + mmap.PAGESIZE, np.uint8)
    first = -memory.__array_interface__["data"][0] % mmap.PAGESIZE
    starts = accumulate(pages[:-1], initial=first)
    return [np.ndarray(shape, dtype, memory, start) for dtype, start in zip(types, starts, strict=True)]


def device_empty(device: Device, shape: tuple[int, ...], dtype: DTypeLike = np.float64) -> NDArray[Any]:
    """Return a new array for launches to fill, which stays on a device that has memory of its own."""
    return device_empties(device, shape, [dtype])[0]


def device_empties(device: Device, shape: tuple[int, ...], dtypes: Sequence[DTypeLike]) -> list[NDArray[Any]]:
    """Return new arrays of one shape, which stay on a device that has memory of its own."""
    if device.kind == "cpu" or 0 in shape:
        return aligned_empties(shape, dtypes)
    return [cast(NDArray[Any], Resident(device, shape, dtype)) for dtype in dtypes]


def device_copy(device: Device, array: NDArray[Any]) -> NDArray[Any]:
    """Return an array for many launches to read, which stays on a device that has memory of its own."""
    import pyopencl as cl

    if device.kind == "cpu" or not array.size:
        return array
    kept = Resident(device, array.shape, array.dtype)
    with exclusive(device):
        queue = _queue(device)
        place = kept.place(queue, device)
        cl.enqueue_copy(queue, place, np.ascontiguousarray(array))
        count_bytes("to", array.nbytes)
    return cast(NDArray[Any], kept)


def _input(queue: Any, device: Device, item: Any) -> Any:
    """Return what the kernel takes for `item`: a scalar, a buffer, or None for an array without elements."""
    import pyopencl as cl

    if not isinstance(item, np.ndarray):
        item = settled(queue, device, item)
    if not isinstance(item, np.ndarray):
        return item
    if device.kind == "cpu" and device.platform != POCL and item.ctypes.data % _ALIGNED:
        given, item = item, aligned_empty(item.shape, item.dtype)  # Intel's copies at a tenth of the speed
        item[...] = given
    if not item.size:
        return None
    share = cl.mem_flags.USE_HOST_PTR
    if device.kind != "cpu":
        share = cl.mem_flags.COPY_HOST_PTR
        count_bytes("to", item.nbytes)
    return cl.Buffer(queue.context, cl.mem_flags.READ_ONLY | share, hostbuf=item)


def _output(queue: Any, device: Device, out: Any) -> Any:
    """Return the buffer that a kernel fills."""
    import pyopencl as cl

    if device.kind == "cpu":
        return cl.Buffer(queue.context, cl.mem_flags.WRITE_ONLY | cl.mem_flags.USE_HOST_PTR, hostbuf=out)
    out = settled(queue, device, out)
    if not isinstance(out, np.ndarray):
        return out
    return cl.Buffer(queue.context, cl.mem_flags.WRITE_ONLY, out.nbytes)


def _fetch(queue: Any, device: Device, out: Any, result: Any) -> None:
    """Queue what brings a result to its array; PoCL's processors write there, and waking them takes long."""
    import pyopencl as cl

    if device.kind != "cpu":
        out = settled(queue, device, out)
        if out is not result:  # else it stays
            cl.enqueue_copy(queue, out, result, is_blocking=False)
            count_bytes("from", out.nbytes)
    elif device.platform != POCL:
        mapped, _ = cl.enqueue_map_buffer(
            queue, result, cl.map_flags.READ, 0, out.shape, out.dtype, is_blocking=False
        )
        mapped.base.release(queue)


@lru_cache(maxsize=8)
def _context(device: Device) -> Any:
    """Return the device's context, which is kept: not every implementation's queues keep theirs alive."""
    import pyopencl as cl

    return cl.Context([opencl_handle(device)])


@lru_cache(maxsize=8)
def _queue(device: Device) -> Any:
    import pyopencl as cl

    return cl.CommandQueue(_context(device), properties=cl.command_queue_properties.PROFILING_ENABLE)


def scalar_types(arguments: Sequence[Any]) -> tuple[np.dtype[Any] | None, ...]:
    """Return the types of a kernel's arguments that are NumPy scalars, and None for buffers."""
    return tuple([one.dtype if isinstance(one, np.generic) else None for one in arguments])


@lru_cache(maxsize=256)
def _kernel(
    device: Device,
    name: str,
    constants: tuple[tuple[str, int], ...],
    text: str | None,
    types: tuple[np.dtype[Any] | None, ...],
) -> Any:
    """Build a kernel; binaries are kept on disk, so only the first process waits for the compiler.

    PyOpenCL that is told of the scalars' types sets arguments thirty times as fast.
    """
    import pyopencl as cl

    text = source(f"{name}.cl") if text is None else text
    try:
        kernel = cl.Kernel(_program(device, text, constants), name)
    except Exception:  # a cache holds what this driver does not take: another version's, or damaged
        kernel = cl.Kernel(_program(device, text, constants, anew=True), name)
    kernel.set_scalar_arg_dtypes(types)
    return kernel


@lru_cache(maxsize=64)
def _program(device: Device, text: str, constants: tuple[tuple[str, int], ...], anew: bool = False) -> Any:
    """Build a program once for all of its kernels; `anew` believes no cache."""
    import pyopencl as cl

    # -w: a CPU without 512-bit vectors warns of each function that takes lanes, though all are inlined.
    options = ["-cl-std=CL1.2", "-w", *(f"-D{key}={value}" for key, value in constants)]
    on_pocl = device.platform == POCL and device.kind == "cpu"
    text = for_pocl(text, has_wide_vectors()) if on_pocl else text
    with warnings.catch_warnings():  # compilers that have nothing to warn of say that all is well
        warnings.simplefilter("ignore", cl.CompilerWarning)
        if anew:  # the driver's own cache goes by source and options
            return cl.Program(_context(device), text).build([*options, "-DBUILT_ANEW"], cache_dir=False)
        return (_from_binary if on_pocl else _from_source)(device, text, options)


@dataclass(frozen=True)
class _Binary:
    """A program as PoCL writes it, with the kernels that are compiled by then."""

    content: NDArray[np.uint8]


def _from_binary(device: Device, text: str, options: list[str]) -> Any:
    """Build a program from the binary that an earlier process has kept: PoCL parses all of another.

    A fifth of the time; where its own cache lacks the kernels, they are put back there. Source, options,
    driver and processor decide all of it: other versions of this package take it, too.
    """
    import pyopencl as cl

    def binary() -> _Binary:
        program = _from_source(device, text, options)
        program.all_kernels()  # raises where the driver has taken damaged ones from its cache: not to be kept
        return _Binary(np.frombuffer(program.get_info(cl.program_info.BINARIES)[0], np.uint8))

    handle = opencl_handle(device)
    driver = handle.name, handle.version, handle.driver_version, known_processor()
    content = kept_by(_Binary, "program", (text, options, driver), binary).content.tobytes()
    return cl.Program(_context(device), [handle], [content]).build(options)


def _from_source(device: Device, text: str, options: list[str]) -> Any:
    import pyopencl as cl

    return cl.Program(_context(device), text).build(options)


def source(name: str) -> str:
    """Return a file of the kernels folder with its headers pasted in.

    Binaries on disk are found by the source's text: a changed header must change it.
    """
    text = (folder("kernels") / name).read_text(encoding="utf-8")
    return re.sub(r'^#include "(.+)"$', lambda match: source(match[1]), text, flags=re.MULTILINE)
