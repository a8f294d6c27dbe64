"""Try every image that this machine can build and run: size, instructions, and what is left of a blow."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from wavequake.control.regulator import ModalRegulator
from wavequake.control.sensor import SensorChain
from wavequake.control.stage import Stage
from wavequake.errors import UserError
from wavequake.firmware.build import Image, build
from wavequake.firmware.devices import Codes, HostDevice
from wavequake.firmware.due import DueDevice
from wavequake.firmware.elf import flash_bytes
from wavequake.firmware.gains import VARIANTS, gains_of
from wavequake.firmware.loop import Blow, Residual, residual
from wavequake.firmware.qemu import QemuDevice
from wavequake.firmware.uno import CLOCK_HZ, GRAY, Uno, UnoDevice

# Flash with wait states costs up to about this many cycles per instruction: an assumption, not a measurement.
CYCLES_PER_INSTRUCTION = 3.0
COUNTED_STEPS = 300
EDGES_PER_SECOND = 20_000
DURATION = 4.0


@dataclass(frozen=True)
class Outcome:
    """What a trial found of an image.

    Attributes
    ----------
    image : str
    flash : int, optional
        Bytes.
    instructions : int, optional
        Most in a step.
    seconds : float, optional
        Of the longest step at the board's clock.
    left : Residual, optional
    same : bool, optional
        Whether its commands (of the decoder: its words) are those of the host bit by bit.
    skipped : str
        Why it was not run: names the package that is missing.
    """

    image: str
    flash: int | None = None
    instructions: int | None = None
    seconds: float | None = None
    left: Residual | None = None
    same: bool | None = None
    skipped: str = ""


def trials(
    hit: Blow, stage: Stage | None, regulator: ModalRegulator, chain: SensorChain, target: Path
) -> Iterator[Outcome]:
    """Build and run host library, Due and QEMU images in each arithmetic on one blow, and the Uno's images.

    Without a stage, nothing is said of what is left of the blow: the regulator is not made for it.

    Images of "due" and "uno" are those that are flashed; those of "qemu" and "simavr" run the same regulator
    on the same kinds of processor.

    An arithmetic that cannot hold the gains is skipped and says which one.

    Raises
    ------
    UserError
        If a gain is not finite, or there is no compiler for the host.
    """
    for variant in VARIANTS:
        try:
            gains = gains_of(regulator, chain, variant)
        except UserError as error:
            if variant == "float":
                raise
            yield Outcome(f"all {variant}", skipped=str(error))
            continue
        host = HostDevice(build("host", gains, target))
        left = None if stage is None else residual(host, hit, stage, regulator, chain.reach)
        yield Outcome(f"host {variant}", left=left)
        host.reset()
        wanted = host.run(hit.adc, hit.trigger)
        # 16 bits are those for which an 8-bit processor is fast enough.
        for board in ("due", "qemu", "simavr")[: 3 if variant == "q16" else 2]:
            name = f"{board} {variant}"
            try:
                image = build(board, gains, target)
                codes, most, seconds = _RUNS[board](image, hit)
            except UserError as error:
                if not _lacks_tool(error):
                    raise
                yield Outcome(name, skipped=str(error))
                continue
            same = bool(np.array_equal(codes, wanted))
            yield Outcome(name, flash_bytes(image.path), most, seconds, left, same)
    try:
        yield _decoder(host, build("uno", gains, target))
    except UserError as error:
        if not _lacks_tool(error):
            raise
        yield Outcome("uno decoder", skipped=str(error))


def _lacks_tool(error: UserError) -> bool:
    return any(
        words in str(error) for words in ("No compiler", "needs unicorn", "needs qemu", "needs simavr")
    )


# Commands, most instructions in a step, and the time of the longest one where the emulator tells it.
Run = tuple[Codes, int, float | None]


def _due(image: Image, hit: Blow) -> Run:
    device = DueDevice(image)
    device.count = True
    head = device.run(hit.adc[:COUNTED_STEPS], hit.trigger[:COUNTED_STEPS])
    device.count = False
    tail = device.run(hit.adc[COUNTED_STEPS:], hit.trigger[COUNTED_STEPS:])
    most = max(device.instructions)
    return np.concatenate([head, tail]), most, most * CYCLES_PER_INSTRUCTION / image.board.clock_hz


def _qemu(image: Image, hit: Blow) -> Run:
    with QemuDevice(image) as device:
        codes = device.run(hit.adc, hit.trigger)
        return codes, round(max(device.instructions)), None


def _simavr(image: Image, hit: Blow) -> Run:
    device = UnoDevice(image)
    try:
        codes = device.run(hit.adc, hit.trigger)
        return codes, max(device.instructions), max(device.cycles) / image.board.clock_hz
    finally:
        device.close()


_RUNS: dict[str, Callable[[Image, Blow], Run]] = {"due": _due, "qemu": _qemu, "simavr": _simavr}


def _decoder(host: HostDevice, image: Image) -> Outcome:
    """Move the sensor forward and back at 20 000 edges per second; each rest must show the host's word."""
    uno, position, same = Uno(image), 0, True
    try:
        uno.play(GRAY[:1], 100)
        for path in (400, -700, 300, -1):
            steps = position + np.sign(path) * np.arange(1, abs(path) + 1)
            position = int(steps[-1])
            word = host.decoder_codes(np.array([position], np.int16))[1][0]
            uno.play(GRAY[steps % 4], EDGES_PER_SECOND)
            same &= uno.settled() == word
        return Outcome("uno decoder", flash_bytes(image.path), None, uno.longest / CLOCK_HZ, None, bool(same))
    finally:
        uno.close()
