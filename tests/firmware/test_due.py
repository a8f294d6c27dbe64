"""The Due's own image in the emulator: bits, instructions, clock, watchdog, deadline pin."""

import shutil
from dataclasses import replace
from importlib.util import find_spec

import numpy as np
import pytest

from wavequake.control.bench import fitted_bench
from wavequake.control.experiment import Settings, design
from wavequake.control.sensor import SensorChain
from wavequake.control.stage import Stage
from wavequake.errors import UserError
from wavequake.firmware.build import build
from wavequake.firmware.devices import HostDevice
from wavequake.firmware.due import DACC_CDR, WDT_CR, DueDevice
from wavequake.firmware.elf import flash_bytes
from wavequake.firmware.gains import VARIANTS, gains_of
from wavequake.firmware.loop import blow, residual

COMPILERS = [
    name
    for name, found in (("gcc", shutil.which("arm-none-eabi-gcc")), ("zig", find_spec("ziglang")))
    if found
]
if not COMPILERS:
    pytest.skip("needs ziglang (extra firmware) or Debian's gcc-arm-none-eabi", allow_module_level=True)
pytest.importorskip("unicorn", reason="needs unicorn (extra firmware)")

BENCH, STAGE, CHAIN = fitted_bench(), Stage(), SensorChain()
REGULATOR = design(BENCH, STAGE, Settings()).regulator
STEPS = 4101


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("due")


@pytest.fixture(scope="module")
def hit():
    found = blow(BENCH, CHAIN, REGULATOR.sample_time, duration=8.2)
    assert len(found.adc) == STEPS
    return found


@pytest.fixture(scope="module")
def device(folder):
    return DueDevice(build("due", gains_of(REGULATOR, CHAIN), folder, prefer=COMPILERS[0]))


@pytest.mark.parametrize("compiler", COMPILERS)
@pytest.mark.parametrize("variant", VARIANTS)
def test_commands_are_those_of_the_host_bit_by_bit(folder, hit, compiler, variant):
    """A step in floats, for which the processor has no unit, takes several times as long."""
    steps = STEPS // 4 if variant == "float" else STEPS
    adc, trigger = hit.adc[:steps], hit.trigger[:steps]
    assert trigger[: steps // 4].any()
    gains = gains_of(REGULATOR, CHAIN, variant)
    wanted = HostDevice(build("host", gains, folder)).run(adc, trigger)
    due = DueDevice(build("due", gains, folder / compiler, prefer=compiler))
    np.testing.assert_array_equal(due.run(adc, trigger), wanted)


@pytest.mark.parametrize("variant", ["q31", "q16"])
def test_what_the_board_leaves_meets_the_target(folder, hit, variant):
    due = DueDevice(build("due", gains_of(REGULATOR, CHAIN, variant), folder, prefer=COMPILERS[0]))
    left = residual(due, hit, STAGE, REGULATOR, CHAIN.reach)
    assert max(left.range, left.deviation) < 5


@pytest.mark.parametrize("compiler", COMPILERS)
@pytest.mark.parametrize("variant", VARIANTS)
def test_states_that_saturate_agree_with_the_host(folder, compiler, variant):
    """Blows of nearly full scale, one after the other, drive states to their limits, which no swing does."""
    full = 4 * CHAIN.reach
    strong = replace(REGULATOR, start=0.9 * full / np.abs(REGULATOR.start).max() * REGULATOR.start)
    gains = gains_of(strong, CHAIN, variant)
    trigger = np.arange(400) % 10 == 0
    adc = np.where(np.arange(400) // 40 % 2, 4095, 0).astype(np.uint16)
    wanted = HostDevice(build("host", gains, folder)).run(adc, trigger)
    due = DueDevice(build("due", gains, folder / compiler, prefer=compiler))
    np.testing.assert_array_equal(due.run(adc, trigger), wanted)
    assert np.ptp(wanted.astype(int)) == 4095


def test_peripherals_are_clocked_and_wired_as_the_board_is(device):
    """SAM3X data sheet: identifiers 13 PIOC, 27 TC0, 37 ADC, 38 DACC; A0 is channel 7; at most 20 MHz."""
    device.reset()
    written = dict(device.log)  # the last value of each
    assert written[0xE0610] == 1 << 13 | 1 << 27
    assert written[0xE0700] == 1 << (37 - 32) | 1 << (38 - 32)
    assert written[0xC0010] == 1 << 7
    prescaler = written[0xC0004] >> 8 & 0xFF
    assert 1e6 <= 84e6 / (2 * (prescaler + 1)) <= 20e6
    assert written[0xC0004] & 0b11111 == 0  # software trigger, 12 bits, awake
    assert written[0xC8010] == 1 << 0  # DAC0
    assert written[0xC8004] & 0b110001 == 0  # half words, no hardware trigger, awake
    assert written[0xC8004] >> 16 & 3 == 0  # user's channel 0
    assert written[0xE1210] == 1 << 3  # of pins 33 to 35 (PC1 to PC3), the last one is an output
    assert written[0xE1214] == 1 << 1 | 1 << 2
    assert written[0x80004] & 0b111 == 0  # half the master clock
    assert written[0x80004] >> 13 & 0b111 == 0b110  # wave mode, up to RC


@pytest.mark.parametrize("compiler", COMPILERS)
def test_a_step_in_q31_stays_within_its_budget(folder, hit, compiler):
    """1000 instructions, converters and pins included: at 2 ms there are 168 000 cycles."""
    image = build("due", gains_of(REGULATOR, CHAIN), folder / compiler, prefer=compiler)
    due = DueDevice(image)
    due.run(hit.adc[:300], hit.trigger[:300])
    assert not due.instructions
    due.count = True
    due.run(hit.adc[:300], hit.trigger[:300])
    assert len(due.instructions) == 300
    assert 100 < max(due.instructions) <= 1000
    assert flash_bytes(image.path) < 4096


@pytest.mark.parametrize("variant", VARIANTS)
def test_full_scale_inputs_agree_with_the_host(folder, variant):
    rng = np.random.default_rng(1)
    adc = rng.choice(np.array([0, 4095, 2048], np.uint16), 200)
    trigger, enabled = rng.random(200) < 0.2, rng.random(200) < 0.8
    gains = gains_of(REGULATOR, CHAIN, variant)
    wanted = HostDevice(build("host", gains, folder)).run(adc, trigger, enabled)
    due = DueDevice(build("due", gains, folder, prefer=COMPILERS[-1]))
    np.testing.assert_array_equal(due.run(adc, trigger, enabled), wanted)


def test_the_clock_is_brought_up_in_order(device):
    device.reset()
    log = device.log
    registers = [offset for offset, _ in log]
    # Watchdog first, then wait states before the clock is raised (84 MHz needs four).
    assert registers[0] == 0xE1A54
    assert log[1:3] == [(0xE0A00, 0x400), (0xE0C00, 0x400)]
    (pll,) = [value for offset, value in log if offset == 0xE0628]
    crystal = 12e6
    assert crystal * ((pll >> 16 & 0x7FF) + 1) / (pll & 0xFF) / 2 == 84e6
    masters = [value for offset, value in log if offset == 0xE0630]
    assert masters == [0x11, 0x12]  # by 2 before the PLL is chosen
    (period,) = [value for offset, value in log if offset == 0x8001C]
    assert period / 42e6 == pytest.approx(REGULATOR.sample_time, rel=1e-12)
    assert log[-1] == (DACC_CDR, 2048)
    assert WDT_CR not in registers


def test_a_missed_deadline_raises_the_pin_and_the_next_step_in_time_clears_it(device):
    device.reset()
    device.step(2048, False)
    assert not device.missed
    device.late = True
    device.step(2048, False)
    assert device.was_missed
    assert not device.missed
    device.step(2048, False)
    assert not device.was_missed


def test_a_trigger_between_ticks_begins_a_step(device, monkeypatch):
    """The blow is seen at once, and commands are those of a blow at a tick."""
    adc = np.full(30, 2100, np.uint16)
    device.reset()
    wanted = device.run(adc, np.arange(30) == 4)
    device.reset()
    found = []
    for k, code in enumerate(adc.tolist()):
        device.early = k == 4
        found.append(device.step(code, k == 4))
        assert device.restarted == (k == 4)
        assert not device.was_missed
    np.testing.assert_array_equal(found, wanted)
    monkeypatch.setattr("wavequake.firmware.due.PATIENCE", 20_000)
    device.early = True  # the trigger has not come, nor has the tick
    with pytest.raises(UserError, match="did not come back to its timer"):
        device.step(2048, False)
    device.reset()


def test_a_trigger_that_does_not_count_begins_no_step(device, monkeypatch):
    """Not while a blow is being added, and not while the pin has been up since."""
    monkeypatch.setattr("wavequake.firmware.due.PATIENCE", 20_000)
    for trigger in (np.array([True, False]), np.ones(40, dtype=bool)):
        device.reset()
        device.run(np.full(len(trigger), 2048, np.uint16), trigger)
        device.early = True
        with pytest.raises(UserError, match="did not come back to its timer"):
            device.step(2048, True)
    device.reset()


def test_an_image_of_other_gains_is_refused(folder):
    image = build("due", gains_of(REGULATOR, CHAIN), folder, prefer=COMPILERS[0])
    other = gains_of(replace(REGULATOR, gain=REGULATOR.gain * 1.01), CHAIN)
    with pytest.raises(UserError, match=f"gains {image.gains.digest}, but the design has {other.digest}"):
        DueDevice(replace(image, gains=other))


def test_a_foreign_file_is_refused(tmp_path, folder):
    image = build("due", gains_of(REGULATOR, CHAIN), folder, prefer=COMPILERS[0])
    (tmp_path / "foreign.elf").write_bytes(b"\x7fELF" + bytes(100))
    with pytest.raises(UserError, match="carries no hash"):
        DueDevice(replace(image, path=tmp_path / "foreign.elf"))
