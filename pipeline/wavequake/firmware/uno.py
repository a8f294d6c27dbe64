"""The Arduino Uno in simavr, which knows the cycles of its instructions."""

import ctypes
import shutil
import subprocess
import tempfile
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.files import folder
from wavequake.firmware.build import Image, check_hash
from wavequake.firmware.devices import ENABLED, TRIGGER, Codes, inputs_of
from wavequake.firmware.elf import segments_of

CLOCK_HZ = 16_000_000
# States of A and B, forward: bits 1 and 0.
GRAY = np.array([0b00, 0b10, 0b11, 0b01], np.uint8)
_MOST_WORDS = 200_000


@lru_cache(maxsize=1)
def _library() -> ctypes.CDLL:
    """Compile the emulator's harness against the simavr of this machine, and load it.

    Raises
    ------
    UserError
        If it is not installed; names the packages.
    """
    needed = "The emulated Uno needs simavr: install Debian's libsimavr-dev and libelf-dev, and a C compiler."
    if shutil.which("cc") is None:
        raise UserError(needed)
    with tempfile.TemporaryDirectory(prefix="wavequake-simavr-") as place:
        path = Path(place) / "simavr.so"
        source = folder("firmware") / "emulators" / "simavr.c"
        words = ["cc", "-O2", "-shared", "-fPIC", str(source), "-o", str(path), "-lsimavr", "-lelf"]
        if subprocess.run(words, capture_output=True, check=False).returncode:
            raise UserError(needed)
        library = ctypes.CDLL(str(path))
    library.uno_open.restype = ctypes.c_void_p
    return library


class Uno:
    """An image for the ATmega328P with the sensor's pins and the converter's SPI.

    Attributes
    ----------
    words : ndarray of uint16
        That the converter got.
    longest : int
        Cycles of the longest interrupt.
    """

    def __init__(self, image: Image) -> None:
        check_hash(image.path, image.gains)
        self._simavr = _library()
        segments = segments_of(image.path)
        code = bytearray(max(one.address + len(one.data) for one in segments))
        for one in segments:
            code[one.address : one.address + len(one.data)] = one.data
        self._words = np.zeros(_MOST_WORDS, np.uint16)
        given = (ctypes.c_uint8 * len(code)).from_buffer(code)
        self._board = ctypes.c_void_p(
            self._simavr.uno_open(given, len(code), _pointer(self._words), len(self._words))
        )

    def close(self) -> None:
        """End the emulator."""
        self._simavr.uno_close(self._board)

    @property
    def words(self) -> NDArray[np.uint16]:
        """Words that the converter got, the last 200 000 at most."""
        return self._words[: self._simavr.uno_words(self._board)]

    @property
    def longest(self) -> int:
        """Cycles of the longest interrupt so far, entry and exit included."""
        return int(self._simavr.uno_longest(self._board))

    def run(self, cycles: int) -> None:
        """Let time go by; UserError if the image crashes."""
        if self._simavr.uno_run(self._board, ctypes.c_uint32(cycles)):
            raise UserError("The image of the Uno crashed.")

    def play(self, pins: NDArray[np.uint8], edges_per_second: float) -> None:
        """Set the sensor's pins, one state (k,) after the other, evenly; UserError if the image crashes."""
        pins = np.ascontiguousarray(pins, np.uint8)
        cycles = ctypes.c_uint32(round(CLOCK_HZ / edges_per_second))
        if self._simavr.uno_play(self._board, _pointer(pins), ctypes.c_uint32(len(pins)), cycles):
            raise UserError("The image of the Uno crashed.")

    def settled(self) -> int:
        """Return the last word, when the board has had time to send it."""
        self.run(CLOCK_HZ // 500)
        return int(self.words[-1])


class UnoDevice:
    """The regulator on an ATmega328P, in lock step: the image of the board "simavr".

    Attributes
    ----------
    cycles, instructions : list of int
        Of each step: its own cycles, and its instructions with those that take over inputs.
    """

    def __init__(self, image: Image) -> None:
        if image.board.name != "simavr":
            raise UserError(
                f"{image.path} is an image of the board {image.board.name!r}; that of 'simavr' runs steps."
            )
        self._image = image
        self._uno = Uno(image)
        self._start()

    def _start(self) -> None:
        self.cycles, self.instructions = list[int](), list[int]()
        self._uno.run(CLOCK_HZ // 1000)

    def close(self) -> None:
        """End the emulator."""
        self._uno.close()

    def reset(self) -> None:
        """Start the board anew."""
        self._uno.close()
        self._uno = Uno(self._image)
        self._start()

    def step(self, adc: int, trigger: bool, enabled: bool = True) -> int:
        """Run one sample; return the code of the command."""
        return self._step(adc, TRIGGER * bool(trigger) + ENABLED * bool(enabled))

    def run(self, adc: Codes, trigger: NDArray[np.bool_], enabled: NDArray[np.bool_] | None = None) -> Codes:
        """Run many samples, (k,); return the codes of the commands."""
        pairs = zip(adc.tolist(), inputs_of(trigger, enabled).tolist(), strict=True)
        return np.array([self._step(code, bits) for code, bits in pairs], np.uint16)

    def _step(self, adc: int, inputs: int) -> int:
        command, cycles, instructions = ctypes.c_uint16(), ctypes.c_uint16(), ctypes.c_uint32()
        found = (ctypes.byref(one) for one in (command, cycles, instructions))
        given = (ctypes.c_uint16(adc), ctypes.c_uint8(inputs))
        if self._uno._simavr.uno_step(self._uno._board, *given, *found):
            raise UserError("The board in simavr does not answer; its image is not the firmware.")
        self.cycles.append(cycles.value)
        self.instructions.append(instructions.value)
        return command.value


def _pointer(array: NDArray[np.generic]) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)
