"""The Arduino Due in the unicorn emulator: the image that is flashed, on mocked registers of the SAM3X8E.

What unicorn counts are instructions; cycles are those times a number that comes from no board.
"""

from importlib.util import find_spec
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.firmware.build import Image, check_hash
from wavequake.firmware.devices import ENABLED, TRIGGER, Codes, inputs_of
from wavequake.firmware.elf import segments_of

FLASH, FLASH_SIZE = 0x80000, 0x80000
MEMORY, MEMORY_SIZE = 0x20000000, 0x10000
PERIPHERALS, PERIPHERALS_SIZE = 0x40000000, 0x200000

# Offsets of registers from PERIPHERALS.
PMC_SR, PIOC_PDSR, PIOC_SODR, PIOC_CODR = 0xE0668, 0xE123C, 0xE1230, 0xE1234
TC0_CCR, TC0_SR, ADC_ISR, ADC_CDR7, DACC_CDR, WDT_CR = 0x80000, 0x80020, 0xC0030, 0xC006C, 0xC8020, 0xE1A50
ALL_READY = 0xFFFFFFFF
PIN_TRIGGER, PIN_SWITCH, PIN_MISSED = 1 << 1, 1 << 2, 1 << 3
WDT_MR, WATCHDOG_RESETS, WATCHDOG_RESTART = 0xE1A54, 1 << 13, 0xA5000001
WATCHDOG_HZ = 32768 / 128
# An image that has asked for a conversion so often waits until it ends.
MOST_POLLS = 1000
# An image that does not come back to its timer within this many instructions hangs.
PATIENCE = 5_000_000


class DueDevice:
    """The image of the Due, step by step.

    A step begins with a tick of the timer. After its command, the image looks once whether the next tick has
    come already, and then waits for it, which ends the step.

    Attributes
    ----------
    log : list of (int, int)
        What was written to registers before the first step: offset from 0x40000000, value.
    missed : bool
        Whether the pin "deadline missed" is up.
    was_missed : bool
        Whether it went up within the last step.
    instructions : list of int
        Of each step since `count` was set, from the timer's tick to the next look at it.
    count : bool
        Count instructions, which takes several times as long.
    late : bool
        Let the next step find that its deadline has passed.
    early : bool
        Let the trigger of the next step come before the timer's tick: the image begins the step by itself.
    restarted : bool
        Whether it started its timer anew within the last step.
    stuck : bool
        Let no conversion of the position's converter end: the image waits for it, its command stays, and the
        watchdog starts the board anew when its time is over.
    resets : int
        By the watchdog.
    """

    def __init__(self, image: Image) -> None:
        check_hash(image.path, image.gains)
        if find_spec("unicorn") is None:
            raise UserError("The emulated Due needs unicorn: pip install unicorn.")
        from unicorn import UC_ARCH_ARM, UC_MODE_MCLASS, UC_MODE_THUMB, Uc
        from unicorn.arm_const import UC_CPU_ARM_CORTEX_M3

        self._emulator = Uc(UC_ARCH_ARM, UC_MODE_THUMB | UC_MODE_MCLASS)
        self._emulator.ctl_set_cpu_model(UC_CPU_ARM_CORTEX_M3)
        self._emulator.mem_map(FLASH, FLASH_SIZE)
        self._emulator.mem_map(MEMORY, MEMORY_SIZE)
        self._emulator.mmio_map(PERIPHERALS, PERIPHERALS_SIZE, self._read, None, self._write, None)
        for segment in segments_of(image.path):
            self._emulator.mem_write(segment.address, segment.data)
        self._sizes: dict[tuple[int, int], int] = {}
        self._hook: Any = None
        self.instructions = list[int]()
        self._sample_time = image.gains.sample_time
        self.reset()

    @property
    def count(self) -> bool:
        """Whether instructions are counted."""
        return self._hook is not None

    @count.setter
    def count(self, wanted: bool) -> None:
        from unicorn import UC_HOOK_BLOCK

        if wanted and self._hook is None:
            self._hook = self._emulator.hook_add(UC_HOOK_BLOCK, self._count_block)
        elif not wanted and self._hook is not None:
            self._emulator.hook_del(self._hook)
            self._hook = None
        self._emulator.ctl_remove_cache(FLASH, FLASH + FLASH_SIZE)  # what was translated has the old hooks

    def reset(self) -> None:
        """Switch the board on and run to its first look at the timer."""
        self.late = self.early = self.stuck = False
        self.resets = 0
        self._start()

    def _start(self) -> None:
        from unicorn.arm_const import UC_ARM_REG_SP

        self.log: list[tuple[int, int]] = []
        self.missed = self.was_missed = False
        self._adc = self._pins = self._code = self._counted = 0
        self._watchdog: float | None = None
        self._unfed = 0.0
        self._begin(ticks=0, starting=True)
        stack, entry = np.frombuffer(bytes(self._emulator.mem_read(FLASH, 8)), dtype="<u4")
        self._emulator.reg_write(UC_ARM_REG_SP, int(stack))
        self._go(int(entry))

    def step(self, adc: int, trigger: bool, enabled: bool = True) -> int:
        """Run one sample; return the code of the command."""
        return self._step(adc, TRIGGER * bool(trigger) + ENABLED * bool(enabled))

    def run(self, adc: Codes, trigger: NDArray[np.bool_], enabled: NDArray[np.bool_] | None = None) -> Codes:
        """Run many samples, (k,); return the codes of the commands."""
        pairs = zip(adc.tolist(), inputs_of(trigger, enabled).tolist(), strict=True)
        return np.array([self._step(code, bits) for code, bits in pairs], np.uint16)

    def _step(self, adc: int, inputs: int) -> int:
        from unicorn.arm_const import UC_ARM_REG_PC

        self._adc = adc
        self._pins = (PIN_TRIGGER if inputs & TRIGGER else 0) | (PIN_SWITCH if inputs & ENABLED else 0)
        self._begin(ticks=0 if self.early else 1, starting=False)
        self.early = False
        self._go(self._emulator.reg_read(UC_ARM_REG_PC) | 1)
        self._unfed += self._sample_time
        if self._watchdog is not None and self._unfed > self._watchdog:
            self.resets += 1
            self._start()
        elif not (self._wrote or self.stuck):
            raise UserError("The image gave no command in a step; it is not the firmware of the Due.")
        if self.count:
            self.instructions.append(self._counted)
        return self._code

    def _begin(self, ticks: int, starting: bool) -> None:
        self._ticks, self._starting, self._counted = ticks, starting, 0
        self._wrote = self._looked = self._stopped = self.was_missed = self.restarted = False
        self._polls = 0

    def _go(self, address: int) -> None:
        from unicorn import UcError

        try:
            self._emulator.emu_start(address, 0, count=PATIENCE)
        except UcError as error:
            raise UserError(f"The image of the Due stopped: {error}.") from None
        if not self._stopped:
            raise UserError(
                f"The image of the Due did not come back to its timer in {PATIENCE} instructions."
            )

    def _read(self, _: Any, offset: int, __: int, ___: Any) -> int:
        if offset == TC0_SR:
            return self._timer()
        if offset == ADC_CDR7:
            return self._adc
        if offset == PIOC_PDSR:
            return self._pins
        if offset == ADC_ISR and self.stuck:
            self._polls += 1
            if self._polls > MOST_POLLS:
                self._stopped = True
                self._emulator.emu_stop()
            return 0
        return ALL_READY if offset in (PMC_SR, ADC_ISR) else 0

    def _timer(self) -> int:
        """Tick once per step; after it, the look for a missed deadline, then the wait that ends a step."""
        if self._ticks:
            self._ticks -= 1
            return 1 << 4
        if self._wrote and self.late:
            self.late = False
            return 1 << 4
        if self._starting or self._looked:
            self._stopped = True
            self._emulator.emu_stop()
        self._looked = self._wrote
        return 0

    def _write(self, _: Any, offset: int, __: int, value: int, ___: Any) -> None:
        if offset == WDT_MR and self._watchdog is None:  # the register can be written once
            self._watchdog = (value & 0xFFF) / WATCHDOG_HZ if value & WATCHDOG_RESETS else np.inf
        elif offset == WDT_CR and value == WATCHDOG_RESTART:
            self._unfed = 0.0
        if offset == DACC_CDR:
            self._code = value
        if self._starting:
            self.log.append((offset, value))
        elif offset == TC0_CCR:
            self.restarted = True
        elif offset == DACC_CDR:
            self._wrote, self._looked = True, False
        elif offset in (PIOC_SODR, PIOC_CODR) and value & PIN_MISSED:
            self.missed = offset == PIOC_SODR
            self.was_missed |= self.missed

    def _count_block(self, _: Any, address: int, size: int, __: Any) -> None:
        self._counted += self._instructions_of(address, size)

    def _instructions_of(self, address: int, size: int) -> int:
        """Return how many Thumb instructions a block has: those that begin with 0b11101 or more are long."""
        if (address, size) not in self._sizes:
            words = np.frombuffer(bytes(self._emulator.mem_read(address, size)), dtype="<u2")
            found = place = 0
            while place < len(words):
                place += 2 if words[place] >> 11 >= 0b11101 else 1
                found += 1
            self._sizes[address, size] = found
        return self._sizes[address, size]
