"""Which device runs the kernels: an OpenCL processor that computes right, or NumPy where there is none."""

import sys
from collections.abc import Callable
from functools import lru_cache
from platform import machine

import numpy as np

from wavequake.errors import UserError
from wavequake.kernels.device.opencl import (
    NUMPY,
    POCL,
    Device,
    in_one_line,
    list_devices,
    opencl_handle,
    require_device,
    seen,
)

__all__ = [
    "NUMPY",
    "POCL",
    "Device",
    "choose_device",
    "lens_test",
    "list_devices",
    "opencl_handle",
    "require_device",
    "self_test",
    "self_tests",
]

_POCL = (
    "install the CPU implementation PoCL with `pip install pocl-binary-distribution`, or "
    if sys.platform == "linux" and machine() == "x86_64"
    else "PoCL's wheel is for Linux on x86_64; take this system's OpenCL or conda-forge's pocl, or "
)
_NO_OPENCL = f"no OpenCL device was found: {_POCL}run without OpenCL, slower, with `campaign.device=numpy`"


# Of path lengths of tens of meters on a device and on NumPy, mm.
LARGEST_DIFFERENCE = 1e-9


def self_tests() -> list[tuple[Device, str]]:
    """Return every device with the result of its self test in words: a difference, or "unusable: reason"."""
    results = []
    for device in list_devices():
        try:
            difference = _tested(device, self_test, lens_test)
        except UserError as error:
            results.append((device, f"unusable: {error}"))
        else:
            results.append((device, f"{difference:.1e}"))
    return results + [(device, f"unusable: {reason}") for device, reason in seen()[1]]


def choose_device(request: str = "auto") -> Device:
    """Return the device that `request` names.

    Parameters
    ----------
    request : str
        "auto" (a GPU if there is one, else a CPU), "gpu", "cpu", "numpy", or a part of "PLATFORM: NAME" as
        `wavequake devices` lists them. Of several that fit, the one whose whole name is meant, else the first
        of the list; PoCL comes first.

    Raises
    ------
    UserError
        If there is no OpenCL device, or none that fits the request, PoCL has no linker to build kernels with,
        or the device fails or computes something else than NumPy (`self_test`, once per process).
    """
    if not isinstance(request, str):
        raise UserError(f"the device is {request!r}; it must be text, such as 'auto' or 'numpy'")
    if request == "numpy":
        return NUMPY
    devices = list_devices()[:-1]
    if not devices:
        raise UserError(_NO_OPENCL)
    if request == "auto":
        return _trusted(min(devices, key=lambda device: device.kind != "gpu"))
    if request in ("cpu", "gpu"):
        fitting = [device for device in devices if device.kind == request]
    else:
        wanted = request.strip().lower()
        fitting = [device for device in devices if wanted and wanted in device.label.lower()]
        fitting.sort(key=lambda device: wanted not in _names(device))
    if not fitting:
        labels = ", ".join(repr(device.label) for device in devices)
        raise UserError(
            f"no OpenCL device fits device={request!r}; use auto, cpu, gpu, numpy or part of one of: {labels}"
        )
    return _trusted(fitting[0])


def _names(device: Device) -> tuple[str, ...]:
    return device.name.lower(), device.platform.lower(), device.label.lower()


@lru_cache(maxsize=8)
def _trusted(device: Device) -> Device:
    """Return a device that is usable and has passed its self test in this process."""
    opencl_handle(device)  # says what a missing linker needs
    try:
        _tested(device, self_test)
    except UserError as error:
        raise UserError(
            f"the OpenCL device {device.label!r} is unusable: {error}; update its driver, or choose another "
            "device (`wavequake devices` lists them, campaign.device=numpy always works)"
        ) from error
    return device


def _tested(device: Device, *tests: Callable[[Device], float]) -> float:
    """Return the largest result of self tests of a device; raise UserError if one fails."""
    try:
        difference = float(np.max([test(device) for test in tests]))
    except (UserError, MemoryError):
        raise
    except Exception as error:
        raise UserError(in_one_line(error)) from error
    if not difference <= LARGEST_DIFFERENCE:
        raise UserError(
            f"it computes wrong numbers, {difference:.1e} mm off NumPy in its self test "
            f"(at most {LARGEST_DIFFERENCE:g} is allowed)"
        )
    return difference


def self_test(device: Device) -> float:
    """Trace a telescope on `device` and return the largest difference of path lengths to NumPy in mm.

    A healthy device stays below 1e-9 mm; NaN says that it loses rays which the twin does not.
    """
    from wavequake.kernels.device.example import two_mirrors
    from wavequake.kernels.trace.segmented import trace_segmented

    found, expected = (trace_segmented(**two_mirrors(), device=where).opd for where in (device, NUMPY))
    return float(np.abs(found - expected).max())


def lens_test(device: Device) -> float:
    """Do the same with a lens of aspheric and deformed surfaces.

    To build its kernel takes a second, and a command that traces a lens compares the first rays of that.
    """
    from wavequake.kernels.device.example import lens
    from wavequake.kernels.trace.sequential import trace_sequence

    found, expected = (trace_sequence(*lens(), where).path for where in (device, NUMPY))
    return float(np.abs(found - expected).max())
