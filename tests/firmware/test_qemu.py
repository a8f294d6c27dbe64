"""QEMU runs the same core: bits of the host, instructions counted exactly."""

import shutil

import numpy as np
import pytest

from wavequake.control.bench import fitted_bench
from wavequake.control.experiment import Settings, design
from wavequake.control.sensor import SensorChain
from wavequake.control.stage import Stage
from wavequake.errors import UserError
from wavequake.firmware.build import BOARDS, build, compiler_of
from wavequake.firmware.devices import HostDevice
from wavequake.firmware.gains import gains_of
from wavequake.firmware.loop import blow
from wavequake.firmware.qemu import QemuDevice

if shutil.which("qemu-system-arm") is None:
    pytest.skip("needs Debian's qemu-system-arm", allow_module_level=True)
try:
    compiler_of(BOARDS["qemu"])
except UserError as error:
    pytest.skip(str(error), allow_module_level=True)

CHAIN = SensorChain()
REGULATOR = design(fitted_bench(), Stage(), Settings()).regulator


@pytest.mark.parametrize(("variant", "budget"), [("float", 20_000), ("q31", 1000), ("q16", 1000)])
def test_commands_and_budget(tmp_path, variant, budget):
    """Bits of the host over more than 4000 steps; at 2 ms and 84 MHz there are 168 000 cycles for each."""
    hit = blow(fitted_bench(), CHAIN, REGULATOR.sample_time, duration=8.2)
    gains = gains_of(REGULATOR, CHAIN, variant)
    wanted = HostDevice(build("host", gains, tmp_path)).run(hit.adc, hit.trigger)
    with QemuDevice(build("qemu", gains, tmp_path)) as device:
        got = device.run(hit.adc, hit.trigger)
        assert len(device.instructions) == len(got) == len(hit.adc) >= 4000
    np.testing.assert_array_equal(got, wanted)
    assert len(np.unique(got)) > 500
    assert 100 < max(device.instructions) <= budget


def test_one_sample_at_a_time_is_the_same_run(tmp_path):
    hit = blow(fitted_bench(), CHAIN, REGULATOR.sample_time, duration=0.4)
    with QemuDevice(build("qemu", gains_of(REGULATOR, CHAIN), tmp_path)) as device:
        together = device.run(hit.adc, hit.trigger)
        device.reset()
        pairs = zip(hit.adc.tolist(), hit.trigger.tolist(), strict=True)
        assert [device.step(adc, trigger) for adc, trigger in pairs] == together.tolist()
        assert np.unique(together).size > 100
        assert device.run(hit.adc[:0], hit.trigger[:0]).size == 0


def test_a_dead_board_is_reported(tmp_path):
    with QemuDevice(build("qemu", gains_of(REGULATOR, CHAIN), tmp_path)) as device:
        device.close()
        with pytest.raises(UserError, match="does not answer"):
            device.step(2048, False)
