"""Which device runs the kernels: an OpenCL processor, or NumPy where there is none.

A `Device` is a plain description that travels to worker processes; contexts and programs are made lazily in
the process that uses them (see `wavequake.kernels.device.program`): an OpenCL context does not survive a
fork.
"""

import sys
from dataclasses import dataclass, replace
from functools import lru_cache
from platform import machine
from typing import Any

import numpy as np

from wavequake.errors import UserError
from wavequake.kernels.device.linker import ensure_linker
from wavequake.kernels.device.pocl_cache import ensure_cache
from wavequake.kernels.device.pocl_processor import name_processor
from wavequake.kernels.device.threads import pin_each, running_threads
from wavequake.kernels.device.tiles import TILE

_POCL = (
    "install the CPU implementation PoCL with `pip install pocl-binary-distribution`, or "
    if sys.platform == "linux" and machine() == "x86_64"
    else "PoCL's wheel is for Linux on x86_64; take this system's OpenCL or conda-forge's pocl, or "
)
_NO_OPENCL = f"no OpenCL device was found: {_POCL}run without OpenCL, slower, with `campaign.device=numpy`"


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

# Of path lengths of tens of meters on a device and on NumPy, mm.
LARGEST_DIFFERENCE = 1e-9

NUMPY = Device("numpy", "numpy", "NumPy", TILE)


def require_device(device: Device) -> None:
    """Raise UserError unless it is a device."""
    if not isinstance(device, Device):
        raise UserError(f"the device is {device!r}; choose_device('auto') returns one")


@lru_cache(maxsize=1)
def _seen() -> tuple[tuple[tuple[Device, Any], ...], tuple[tuple[Device, str], ...]]:
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
            broken.append((Device("-", "-", name, 1), _words(error)))
    found.sort(key=lambda pair: pair[0].platform != POCL)
    places = {(device.name, device.platform) for device, _ in found}
    shared = [name for name, _ in places]
    return tuple(
        (replace(device, name=device.label) if shared.count(device.name) > 1 else device, handle)
        for device, handle in found  # stores keep the name alone, which must be enough to find it again
    ), tuple(broken)


def _found() -> tuple[tuple[Device, Any], ...]:
    return _seen()[0]


def _words(error: Exception) -> str:
    """Return an error in one line: what a driver says may be a compiler's whole log."""
    line = (str(error).strip() or type(error).__name__).splitlines()[0]
    return line if len(line) <= 160 else line[:157] + "..."


def list_devices() -> list[Device]:
    """Return the devices that can run the kernels; NumPy, which always can, is the last."""
    return [device for device, _ in _found()] + [NUMPY]


def self_tests() -> list[tuple[Device, str]]:
    """Return every device with the result of its self test in words: a difference, or "unusable: reason"."""
    results = []
    for device in list_devices():
        try:
            difference = _tested(device)
        except UserError as error:
            results.append((device, f"unusable: {error}"))
        else:
            results.append((device, f"{difference:.1e}"))
    return results + [(device, f"unusable: {reason}") for device, reason in _seen()[1]]


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
    devices = [device for device, _ in _found()]
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
        _tested(device)
    except UserError as error:
        raise UserError(
            f"the OpenCL device {device.label!r} is unusable: {error}; update its driver, or choose another "
            "device (`wavequake devices` lists them, campaign.device=numpy always works)"
        ) from error
    return device


def _tested(device: Device) -> float:
    """Return the result of a device's self test; raise UserError if it fails."""
    try:
        difference = self_test(device)
    except (UserError, MemoryError):
        raise
    except Exception as error:
        raise UserError(_words(error)) from error
    if not difference <= LARGEST_DIFFERENCE:
        raise UserError(
            f"it computes wrong numbers, {difference:.1e} mm off NumPy in its self test "
            f"(at most {LARGEST_DIFFERENCE:g} is allowed)"
        )
    return difference


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


def self_test(device: Device) -> float:
    """Trace a few rays on `device` and return the largest difference of path lengths to NumPy in mm.

    The traces are those of a segmented telescope and of a lens with aspheric and deformed surfaces. A healthy
    device stays below 1e-9 mm; NaN says that it loses rays which the twin does not.
    """
    from wavequake.kernels.device.example import lens, two_mirrors
    from wavequake.kernels.trace.segmented import trace_segmented
    from wavequake.kernels.trace.sequential import trace_sequence

    telescope, system = two_mirrors(), lens()
    apart = (
        [trace_segmented(**telescope, device=where).opd for where in (device, NUMPY)],
        [trace_sequence(*system, where).path for where in (device, NUMPY)],
    )
    return float(np.max([np.abs(found - expected).max() for found, expected in apart]))
