"""Which device runs the kernels: an OpenCL processor, or NumPy where there is none.

A `Device` is a plain description that travels to worker processes; contexts and programs are made lazily in
the process that uses them (see `wavequake.kernels.program`): an OpenCL context does not survive a fork.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from wavequake.errors import UserError
from wavequake.kernels.linker import ensure_linker
from wavequake.kernels.tiles import TILE

_NO_OPENCL = (
    "no OpenCL device was found: install the CPU implementation PoCL with "
    "`pip install pocl-binary-distribution`, or run without OpenCL with `campaign.device=numpy`"
)


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


# Of path lengths of tens of meters on a device and on NumPy, mm.
LARGEST_DIFFERENCE = 1e-9

NUMPY = Device("numpy", "numpy", "NumPy", TILE)


@lru_cache(maxsize=1)
def _found() -> tuple[tuple[Device, Any], ...]:
    """Return every OpenCL device with float64, with its pyopencl handle; empty without OpenCL."""
    try:
        import pyopencl as cl

        platforms = cl.get_platforms()
    except Exception:  # no loader, no platform, or a broken driver: all mean that there is no OpenCL
        return ()
    found = []
    for platform in platforms:
        for handle in platform.get_devices():
            if handle.double_fp_config and handle.available:
                gpu = bool(handle.type & cl.device_type.GPU)
                device = Device(
                    handle.name.strip(), "gpu" if gpu else "cpu", platform.name.strip(), 1 if gpu else TILE
                )
                found.append((device, handle))
    return tuple(found)


def list_devices() -> list[Device]:
    """Return the devices that can run the kernels; NumPy, which always can, is the last."""
    return [device for device, _ in _found()] + [NUMPY]


def choose_device(request: str = "auto") -> Device:
    """Return the device that `request` names.

    Parameters
    ----------
    request : str
        "auto" (a GPU if there is one, else a CPU), "gpu", "cpu", "numpy", or a part of a device's name.

    Raises
    ------
    UserError
        If there is no OpenCL device, or none that fits the request, PoCL has no linker to build kernels with,
        or the device computes something else than NumPy (`self_test`, once per process).
    """
    if request == "numpy":
        return NUMPY
    devices = [device for device, _ in _found()]
    if not devices:
        raise UserError(_NO_OPENCL)
    if request == "auto":
        return _trusted(min(devices, key=lambda device: device.kind != "gpu"))
    if request in ("cpu", "gpu"):
        fitting = [device for device in devices if device.kind == request]
    else:
        fitting = [device for device in devices if request and request.lower() in device.name.lower()]
    if not fitting:
        names = ", ".join(repr(device.name) for device in devices)
        raise UserError(
            f"no OpenCL device fits device={request!r}; use auto, cpu, gpu, numpy or part of one of: {names}"
        )
    return _trusted(fitting[0])


@lru_cache(maxsize=8)
def _trusted(device: Device) -> Device:
    """Return a device that is usable and has passed its self test in this process."""
    _usable(device)
    difference = self_test(device)
    if not difference <= LARGEST_DIFFERENCE:
        raise UserError(
            f"the OpenCL device {device.name!r} ({device.platform}) computes wrong numbers: in its self test "
            f"it is {difference:.1e} mm off NumPy, at most {LARGEST_DIFFERENCE:g} is allowed; update its "
            "driver, or choose another device (campaign.device=numpy always works)"
        )
    return device


def _usable(device: Device) -> Device:
    if device.platform == "Portable Computing Language":
        ensure_linker()
    return device


def opencl_handle(device: Device) -> Any:
    """Return the pyopencl device that `device` describes.

    Raises
    ------
    UserError
        If this process does not see it, or PoCL has no linker to build kernels with.
    """
    for found, handle in _found():
        if (found.name, found.platform) == (device.name, device.platform):
            _usable(device)
            return handle
    raise UserError(f"the OpenCL device {device.name!r} ({device.platform}) is not visible in this process")


def self_test(device: Device) -> float:
    """Trace a few rays on `device` and return the largest difference of path lengths to NumPy in mm.

    The traces are those of a segmented telescope and of a lens with aspheric and deformed surfaces. A healthy
    device stays below 1e-9 mm; NaN says that it loses rays which the twin does not.
    """
    from wavequake.kernels.example import lens, two_mirrors
    from wavequake.kernels.segmented import trace_segmented
    from wavequake.kernels.sequential import trace_sequence

    telescope, system = two_mirrors(), lens()
    apart = (
        [trace_segmented(**telescope, device=where).opd for where in (device, NUMPY)],
        [trace_sequence(*system, where).path for where in (device, NUMPY)],
    )
    return float(np.max([np.abs(found - expected).max() for found, expected in apart]))
