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
AHEAD = 64


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
        inputs = TRIGGER * bool(trigger) + ENABLED * bool(enabled)
        return int(self._run(np.array([[adc & 0xFF, adc >> 8, inputs]]))[0])

    def run(self, adc: Codes, trigger: NDArray[np.bool_], enabled: NDArray[np.bool_] | None = None) -> Codes:
        """Run many samples, (k,); return the codes of the commands."""
        samples = np.stack([adc & 0xFF, adc >> 8, inputs_of(trigger, enabled)], axis=1)
        # Samples wait in the line until the board reads them: fewer turns between the two processes.
        turns = [self._run(samples[first : first + AHEAD]) for first in range(0, len(samples), AHEAD)]
        return np.concatenate([np.zeros(0, np.uint16), *turns])

    def _run(self, samples: NDArray[np.integer]) -> Codes:
        """Send samples (k, 3) as bytes, receive 5 bytes for each: the command, and ticks that it took."""
        answer = b""
        try:
            self._line.sendall(samples.astype(np.uint8).tobytes())
            while len(answer) < 5 * len(samples):
                received = self._line.recv(5 * len(samples) - len(answer))
                if not received:
                    raise ConnectionResetError
                answer += received
        except (TimeoutError, OSError):
            raise UserError("The board in QEMU does not answer; its image is not the firmware.") from None
        numbers = np.frombuffer(answer, np.uint8).reshape(-1, 5).astype(np.int64)
        ticks = numbers[:, 2:] @ (1 << np.array([0, 8, 16]))
        self.instructions += (ticks / TICKS_PER_INSTRUCTION).tolist()
        return (numbers[:, 0] + 256 * numbers[:, 1]).astype(np.uint16)
