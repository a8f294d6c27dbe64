"""What a device is, which devices OpenCL shows, and their handles in this process.

A `Device` is a plain description that travels to worker processes; contexts and programs are made lazily in
the process that uses them (see `wavequake.kernels.device.program`): an OpenCL context does not survive a
fork.
"""

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

from wavequake.errors import UserError
from wavequake.kernels.device.linker import ensure_linker
from wavequake.kernels.device.pocl_cache import ensure_cache
from wavequake.kernels.device.pocl_processor import name_processor
from wavequake.kernels.device.threads import pin_each, running_threads
from wavequake.kernels.device.tiles import TILE


@dataclass(frozen=True)
class Device:
    """A place where kernels run.

    ``kind`` is "cpu", "gpu" or "numpy"; ``vector_width`` counts the instants that one work-item traces: a
    whole tile on a CPU, one on a GPU.
    """

    name: str
    kind: str
    platform: str
    vector_width: int

    @property
    def label(self) -> str:
        """Platform and name, which tells devices of the same name apart."""
        return self.name if self.name.startswith(f"{self.platform}: ") else f"{self.platform}: {self.name}"


POCL = "Portable Computing Language"

NUMPY = Device("numpy", "numpy", "NumPy", TILE)


def require_device(device: Device) -> None:
    """Raise UserError unless it is a device."""
    if not isinstance(device, Device):
        raise UserError(f"the device is {device!r}; choose_device('auto') returns one")


@lru_cache(maxsize=1)
def seen() -> tuple[tuple[tuple[Device, Any], ...], tuple[tuple[Device, str], ...]]:
    """Return every OpenCL device with float64 and its pyopencl handle, and what of OpenCL is broken and why.

    PoCL comes before other implementations for CPUs, so that results do not depend on what else is installed.
    """
    try:
        import pyopencl as cl

        ensure_cache()
        platforms = cl.get_platforms()
    except Exception:  # no loader or no platform: both mean that there is no OpenCL
        return (), ()
    found, broken = [], []
    for platform in platforms:
        name = "unnamed"
        try:
            name = platform.name.strip()
            before = running_threads()
            handles = platform.get_devices()
            if name == POCL:
                pin_each(running_threads() - before)
            for handle in handles:
                if name == POCL:
                    name_processor(handle)
                if handle.double_fp_config and handle.available:
                    gpu = bool(handle.type & cl.device_type.GPU)
                    kind, width = ("gpu", 1) if gpu else ("cpu", TILE)
                    found.append((Device(handle.name.strip(), kind, name, width), handle))
        except Exception as error:  # a broken driver must not hide the others
            broken.append((Device("-", "-", name, 1), in_one_line(error)))
    found.sort(key=lambda pair: pair[0].platform != POCL)
    places = {(device.name, device.platform) for device, _ in found}
    shared = [name for name, _ in places]
    return tuple(
        (replace(device, name=device.label) if shared.count(device.name) > 1 else device, handle)
        for device, handle in found  # stores keep the name alone, which must be enough to find it again
    ), tuple(broken)


def _found() -> tuple[tuple[Device, Any], ...]:
    return seen()[0]


def list_devices() -> list[Device]:
    """Return the devices that can run the kernels; NumPy, which always can, is the last."""
    return [device for device, _ in _found()] + [NUMPY]


def in_one_line(error: Exception) -> str:
    """Return an error in one line: what a driver says may be a compiler's whole log."""
    line = (str(error).strip() or type(error).__name__).splitlines()[0]
    return line if len(line) <= 160 else line[:157] + "..."


@lru_cache(maxsize=8)
def opencl_handle(device: Device) -> Any:
    """Return the pyopencl device that `device` describes.

    Raises
    ------
    UserError
        If this process does not see it, or PoCL has no linker to build kernels with.
    """
    for found, handle in _found():
        if (found.name, found.platform) == (device.name, device.platform):
            if device.platform == POCL:
                ensure_linker()
            return handle
    raise UserError(f"the OpenCL device {device.label!r} is not visible in this process")
