"""QEMU's Cortex-M3 board in lock step by its serial port; it counts instructions exactly."""

import shutil
import socket
import subprocess
import tempfile
from pathlib import Path
from types import TracebackType

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.firmware.build import Image, check_hash
from wavequake.firmware.devices import ENABLED, TRIGGER, Codes, inputs_of

# Under -icount shift=7 an instruction takes 128 ns; the board's SysTick counts 25 MHz.
SHIFT = 7
TICKS_PER_INSTRUCTION = 25e6 * 2**SHIFT * 1e-9
ANSWER_S = 20.0


class QemuDevice:
    """The image for QEMU's board mps2-an385; a context manager that ends the emulator.

    Attributes
    ----------
    instructions : list of float
        Of each step.
    """

    def __init__(self, image: Image) -> None:
        check_hash(image.path, image.gains)
        if shutil.which("qemu-system-arm") is None:
            raise UserError(
                "The emulated board needs qemu-system-arm: install Debian's package of that name."
            )
        self._image = image
        self._start()

    def __enter__(self) -> "QemuDevice":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _start(self) -> None:
        self.instructions: list[float] = []
        with tempfile.TemporaryDirectory() as folder, socket.socket(socket.AF_UNIX) as listener:
            path = Path(folder) / "uart"
            listener.bind(str(path))
            listener.listen(1)
            listener.settimeout(ANSWER_S)
            self._process = subprocess.Popen(
                ["qemu-system-arm", "-M", "mps2-an385", "-kernel", str(self._image.path), "-display", "none",
                 "-monitor", "none", "-icount", f"shift={SHIFT}", "-serial", f"unix:{path}"],
                stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
            )  # fmt: skip
            try:
                self._line, _ = listener.accept()
            except TimeoutError:
                self._process.kill()
                self._process.wait()
                raise UserError("qemu-system-arm did not start the board mps2-an385.") from None
        self._line.settimeout(ANSWER_S)

    def close(self) -> None:
        """End the emulator."""
        self._line.close()
        self._process.kill()
        self._process.wait()

    def reset(self) -> None:
        """Start the board anew."""
        self.close()
        self._start()

    def step(self, adc: int, trigger: bool, enabled: bool = True) -> int:
        """Run one sample; return the code of the command."""
        return self._step(adc, TRIGGER * bool(trigger) + ENABLED * bool(enabled))

    def run(self, adc: Codes, trigger: NDArray[np.bool_], enabled: NDArray[np.bool_] | None = None) -> Codes:
        """Run many samples, (k,); return the codes of the commands."""
        pairs = zip(adc.tolist(), inputs_of(trigger, enabled).tolist(), strict=True)
        return np.array([self._step(code, bits) for code, bits in pairs], np.uint16)

    def _step(self, adc: int, inputs: int) -> int:
        answer = b""
        try:
            self._line.sendall(bytes([adc & 0xFF, adc >> 8, inputs]))
            while len(answer) < 5:
                received = self._line.recv(5 - len(answer))
                if not received:
                    raise ConnectionResetError
                answer += received
        except (TimeoutError, OSError):
            raise UserError("The board in QEMU does not answer; its image is not the firmware.") from None
        self.instructions.append(int.from_bytes(answer[2:], "little") / TICKS_PER_INSTRUCTION)
        return int.from_bytes(answer[:2], "little")
