"""Arrays in a device's own memory: launches fill and read them there, and NumPy fetches what it asks for."""

import math
import threading
from collections.abc import Callable, Iterator
from itertools import count, pairwise
from typing import Any, cast
from weakref import WeakValueDictionary

import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin
from numpy.typing import DTypeLike, NDArray

from wavequake.errors import UserError
from wavequake.kernels.device.launches import count_bytes
from wavequake.kernels.device.opencl import Device, opencl_handle

# Of all arrays that stay on devices. The largest trace and the wavefronts made of it take four fifths.
_KEPT_BYTES = 1 << 29
_KEPT: WeakValueDictionary[int, "Resident"] = WeakValueDictionary()  # by when they were used, latest last
_TURNS = count()
_LOCK = threading.RLock()
_NO_MEMORY = (
    "MEM_OBJECT_ALLOCATION_FAILURE",
    "OUT_OF_RESOURCES",
    "OUT_OF_HOST_MEMORY",
    "INVALID_BUFFER_SIZE",
)


class Resident(NDArrayOperatorsMixin):
    """An array that a device holds until NumPy asks for it; from then on the host does.

    It stands wherever an array does: functions of NumPy, operators and methods fetch it, once. Its numbers
    are in one place at a time, from where launches take them, so that what is written on the host counts.
    Some of its rows (``array[3]``, ``array[2:5]``, ``array[rows]``) come alone and leave the others there.
    Of those that stay, the ones that were used longest ago come to the host before all take too much memory.
    """

    def __init__(self, device: Device, shape: tuple[int, ...], dtype: DTypeLike = np.float64) -> None:
        self.device, self.shape, self.dtype = device, shape, np.dtype(dtype)
        self.ndim, self.size = len(shape), math.prod(shape)
        self.nbytes = self.size * self.dtype.itemsize
        self._place: Any = None  # the device's buffer or the host's array
        self._queue: Any = None
        self._turn = -1

    def place(self, queue: Any, device: Device) -> Any:
        """Return what a launch reads or fills: memory of the device, taken at first, or the host's array."""
        import pyopencl as cl

        if device != self.device:
            return self.numpy()
        with exclusive(self.device):
            if self._place is None:
                # Some drivers take any size, and fail when it is first used.
                if self.nbytes > opencl_handle(self.device).global_mem_size:
                    raise _no_memory(self.device, "INVALID_BUFFER_SIZE")
                _make_room(self.nbytes)
                self._place = cl.Buffer(queue.context, cl.mem_flags.READ_WRITE, self.nbytes)
                self._queue = queue
            if not isinstance(self._place, np.ndarray):
                _KEPT.pop(self._turn, None)
                self._turn = next(_TURNS)
                _KEPT[self._turn] = self
            return self._place

    @property
    def stays(self) -> bool:
        """Whether the device has the numbers still."""
        return not (self._place is None or isinstance(self._place, np.ndarray))

    def numpy(self) -> NDArray[Any]:
        """Return the array, which the host has from now on; it may be written."""
        with exclusive(self.device):
            if not isinstance(self._place, np.ndarray):
                array = np.empty(self.shape, self.dtype)
                if self._place is not None:
                    self._copy(array, 0)
                    self._queue.finish()
                    _KEPT.pop(self._turn, None)
                self._place = array
            return cast(NDArray[Any], self._place)

    def _copy(self, array: NDArray[Any], row: int) -> None:
        """Queue what brings the rows from `row` on to an array."""
        import pyopencl as cl

        start = row * (self.nbytes // max(1, self.shape[0]))
        cl.enqueue_copy(self._queue, array, self._place, src_offset=start, is_blocking=False)
        count_bytes("from", array.nbytes)

    def __getitem__(self, key: Any) -> Any:
        shown = isinstance(key, int | np.integer | slice)  # by NumPy, whose numbers can be written there
        with exclusive(self.device):
            if self.stays and (shown or (isinstance(key, np.ndarray) and key.ndim == 1)):
                rows = np.arange(self.shape[0])[key]
                if rows.size < self.shape[0] or not isinstance(key, slice):
                    found = self._rows(np.atleast_1d(rows))
                    found.flags.writeable = not shown
                    return found if rows.ndim else found[0]
            return self.numpy()[key]

    def _rows(self, rows: NDArray[np.intp]) -> NDArray[Any]:
        """Return some rows; those that follow each other are copied at once."""
        found = np.empty((len(rows), *self.shape[1:]), self.dtype)
        edges = [0, *(np.flatnonzero(np.diff(rows) != 1) + 1).tolist(), len(rows)]
        for first, last in pairwise(edges):
            if first < last:
                self._copy(found[first:last], int(rows[first]))
        self._queue.finish()
        return found

    def __setitem__(self, key: Any, value: Any) -> None:
        self.numpy()[key] = value

    def __len__(self) -> int:
        return len(self.numpy()) if not self.shape else self.shape[0]

    def __iter__(self) -> Iterator[Any]:
        return iter(self.numpy())

    def __array__(self, dtype: DTypeLike | None = None, copy: bool | None = None) -> NDArray[Any]:
        return np.array(self.numpy(), dtype, copy=copy)

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Any, **more: Any) -> Any:
        if "out" in more:
            more["out"] = tuple(map(_on_host, more["out"]))
        return getattr(ufunc, method)(*map(_on_host, inputs), **more)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(f"Resident has no attribute {name!r}")
        return getattr(self.numpy(), name)

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        return np.asarray, (self.numpy(),)

    def __repr__(self) -> str:
        return repr(self.numpy())


def floats_for(device: Device, values: Any) -> NDArray[np.float64]:
    """Return what a launch on the device takes: an array of floating-point numbers, or one that is there."""
    if isinstance(values, Resident) and values.device == device and values.dtype == np.float64:
        return cast(NDArray[np.float64], values)
    return np.asarray(values, dtype=np.float64)


def device_of(values: Any) -> Device | None:
    """Return the device that holds an array, or None if the host does."""
    return values.device if isinstance(values, Resident) and values.stays else None


def settled(queue: Any, device: Device, item: Any) -> Any:
    """Return `Resident.place` of what may stay on the device, and anything else as it is."""
    return item.place(queue, device) if isinstance(item, Resident) else item


class exclusive:  # noqa: N801 - used as a context
    """Work with a device alone of all threads.

    Raises
    ------
    UserError
        Instead of an error of OpenCL which says that there is not enough memory.
    """

    def __init__(self, device: Device) -> None:
        self._device = device

    def __enter__(self) -> None:
        _LOCK.acquire()

    def __exit__(self, kind: Any, error: BaseException | None, trace: Any) -> None:
        _LOCK.release()
        if error is None:
            return
        import pyopencl as cl

        code = getattr(error, "code", None) if isinstance(error, cl.Error) else None
        for name in _NO_MEMORY:
            if code == getattr(cl.status_code, name):
                raise _no_memory(self._device, name) from error


def _no_memory(device: Device, name: str) -> UserError:
    return UserError(
        f"the OpenCL device {device.label!r} has not enough memory left ({name}); end other programs that "
        "use it, take fewer rays, or choose another (campaign.device=cpu)"
    )


def _on_host(item: Any) -> Any:
    return item.numpy() if isinstance(item, Resident) else item


def _make_room(size: int) -> None:
    """Bring arrays to the host, those that were used longest ago first, until there is room for more."""
    kept = sorted(_KEPT.items())
    held = sum(array.nbytes for _, array in kept)
    for _, array in kept:
        if held + size <= _KEPT_BYTES:
            return
        array.numpy()
        held -= array.nbytes
