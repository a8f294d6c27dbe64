"""Try every image that this machine can build and run: size, instructions, and what is left of a blow."""

from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from wavequake.control.bench import Bench
from wavequake.control.regulator import ModalRegulator
from wavequake.control.sensor import SensorChain
from wavequake.control.stage import Stage
from wavequake.errors import UserError
from wavequake.firmware.build import build
from wavequake.firmware.devices import Codes, HostDevice
from wavequake.firmware.due import DueDevice
from wavequake.firmware.elf import flash_bytes
from wavequake.firmware.gains import VARIANTS, gains_of
from wavequake.firmware.loop import Blow, Residual, blow, residual
from wavequake.firmware.qemu import QemuDevice

# Flash with wait states costs up to about this many cycles per instruction: an assumption, not a measurement.
CYCLES_PER_INSTRUCTION = 3.0
COUNTED_STEPS = 300
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
        Whether its commands are those of the host bit by bit.
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
    bench: Bench,
    stage: Stage,
    regulator: ModalRegulator,
    chain: SensorChain,
    target: Path,
    friction: float = 0.3e-3,
) -> Iterator[Outcome]:
    """Build and run host library, Due and QEMU images in each arithmetic, on one blow.

    Raises
    ------
    UserError
        If the gains are out of range (says which), or there is no compiler for the host.
    """
    hit = blow(bench, chain, regulator.sample_time, duration=DURATION, friction=friction)
    for variant in VARIANTS:
        gains = gains_of(regulator, chain, variant)
        host = HostDevice(build("host", gains, target))
        left = residual(host, hit, stage, regulator, chain.reach)
        yield Outcome(f"host {variant}", left=left)
        host.reset()
        wanted = host.run(hit.adc, hit.trigger)
        for board in ("due", "qemu"):
            name = f"{board} {variant}"
            try:
                image = build(board, gains, target)
                with ExitStack() as stack:
                    if board == "due":
                        found = _due(DueDevice(image), hit)
                    else:
                        found = _qemu(stack.enter_context(QemuDevice(image)), hit)
            except UserError as error:
                if not _lacks_tool(error):
                    raise
                yield Outcome(name, skipped=str(error))
                continue
            codes, most = found
            clock = image.board.clock_hz
            yield Outcome(
                name,
                flash_bytes(image.path),
                most,
                most * CYCLES_PER_INSTRUCTION / clock if clock else None,
                left,
                bool(np.array_equal(codes, wanted)),
            )


def _lacks_tool(error: UserError) -> bool:
    return any(words in str(error) for words in ("No compiler", "needs unicorn", "needs qemu"))


def _due(device: DueDevice, hit: Blow) -> tuple[Codes, int]:
    device.count = True
    head = device.run(hit.adc[:COUNTED_STEPS], hit.trigger[:COUNTED_STEPS])
    device.count = False
    tail = device.run(hit.adc[COUNTED_STEPS:], hit.trigger[COUNTED_STEPS:])
    return np.concatenate([head, tail]), max(device.instructions)


def _qemu(device: QemuDevice, hit: Blow) -> tuple[Codes, int]:
    codes = device.run(hit.adc, hit.trigger)
    return codes, round(max(device.instructions))
