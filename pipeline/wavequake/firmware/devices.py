"""Boards that run the firmware: one protocol, whatever the emulator."""

import _ctypes
import ctypes
import os
import shutil
import tempfile
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.firmware.build import Image, check_hash

Codes = NDArray[np.uint16]

ENABLED, TRIGGER = 1, 2


class Device(Protocol):
    """A control unit that runs the firmware: codes of converters in, codes of converters out."""

    def reset(self) -> None:
        """Start anew, all that was measured forgotten."""

    def step(self, adc: int, trigger: bool, enabled: bool = True) -> int:
        """Run one sample; return the code of the command."""

    def run(self, adc: Codes, trigger: NDArray[np.bool_], enabled: NDArray[np.bool_] | None = None) -> Codes:
        """Run many samples, (k,); return the codes of the commands."""


def inputs_of(
    trigger: NDArray[np.bool_], enabled: NDArray[np.bool_] | None
) -> np.ndarray[tuple[int], np.dtype[np.uint8]]:
    """Return the bits that boards read beside the converter."""
    on = np.ones_like(trigger) if enabled is None else enabled
    return (TRIGGER * trigger.astype(np.uint8) + ENABLED * on.astype(np.uint8)).astype(np.uint8)


class HostDevice:
    """The core as a shared library in this process; the fast reference."""

    def __init__(self, image: Image) -> None:
        check_hash(image.path, image.gains)
        # A copy, because a file that is loaded already is not looked at again: it may hold an older design.
        with tempfile.TemporaryDirectory(prefix="wavequake-", ignore_cleanup_errors=True) as place:
            try:
                self._library = ctypes.CDLL(shutil.copy(image.path, place))
            except OSError as error:
                raise UserError(f"{image.path} cannot be loaded: {error}.") from None
        self._state = ctypes.create_string_buffer(self._library.wq_host_size() + 16)
        self.reset()

    def close(self) -> None:
        """Unload the library; a process cannot hold thousands of them. The device is of no use afterwards."""
        if os.name == "posix":
            _ctypes.dlclose(self._library._handle)  # type: ignore[attr-defined,unused-ignore]
        del self._library

    def reset(self) -> None:
        """Forget all that was measured."""
        self._library.wq_host_reset(self._state)

    def step(self, adc: int, trigger: bool, enabled: bool = True) -> int:
        """Run one sample; return the code of the command."""
        return int(self.run(np.array([adc], np.uint16), np.array([trigger]), np.array([enabled]))[0])

    def run(self, adc: Codes, trigger: NDArray[np.bool_], enabled: NDArray[np.bool_] | None = None) -> Codes:
        """Run many samples, (k,); return the codes of the commands."""
        adc = np.ascontiguousarray(adc, dtype=np.uint16)
        inputs, codes = inputs_of(trigger, enabled), np.empty(len(adc), np.uint16)
        self._library.wq_host_run(
            self._state, _pointer(adc), _pointer(inputs), _pointer(codes), ctypes.c_uint32(len(adc))
        )
        return codes

    def quadrature(self, pins: NDArray[np.uint8]) -> tuple[NDArray[np.int16], int]:
        """Return the decoder's counts after each state of its pins, and the number of illegal transitions."""
        pins = np.ascontiguousarray(pins, dtype=np.uint8)
        counts = np.empty(len(pins), np.int16)
        illegal = self._library.wq_host_quadrature(
            _pointer(pins), _pointer(counts), ctypes.c_uint32(len(pins))
        )
        return counts, int(illegal)

    def decoder_codes(self, counts: NDArray[np.int16]) -> tuple[Codes, Codes]:
        """Return codes and words of the decoding board's converter for counts."""
        counts = np.ascontiguousarray(counts, dtype=np.int16)
        codes, words = np.empty(len(counts), np.uint16), np.empty(len(counts), np.uint16)
        self._library.wq_host_codes(
            _pointer(counts), _pointer(codes), _pointer(words), ctypes.c_uint32(len(counts))
        )
        return codes, words


def _pointer(array: NDArray[np.generic]) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)
