"""The Uno in simavr: every edge of the sensor counts, words are right, the regulator fits."""

import numpy as np
import pytest

from wavequake.control.bench import fitted_bench
from wavequake.control.experiment import Settings, design
from wavequake.control.sensor import SensorChain, dac_codes
from wavequake.control.stage import Stage
from wavequake.errors import UserError
from wavequake.firmware import uno as simavr
from wavequake.firmware.build import BOARDS, build, compiler_of
from wavequake.firmware.devices import HostDevice
from wavequake.firmware.gains import gains_of
from wavequake.firmware.loop import blow, residual
from wavequake.firmware.uno import CLOCK_HZ, GRAY, Uno, UnoDevice

try:
    compiler_of(BOARDS["uno"])
    simavr._library()
except UserError as error:  # says which package is missing
    pytest.skip(str(error), allow_module_level=True)

CHAIN = SensorChain()
REGULATOR = design(fitted_bench(), Stage(), Settings()).regulator


@pytest.fixture(scope="module")
def image(tmp_path_factory):
    return build("uno", gains_of(REGULATOR, CHAIN), tmp_path_factory.mktemp("uno"))


@pytest.fixture
def uno(image):
    board = Uno(image)
    board.play(np.zeros(1, np.uint8), 100)
    yield board
    board.close()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("step")


@pytest.fixture(scope="module")
def device(folder):
    board = UnoDevice(build("simavr", gains_of(REGULATOR, CHAIN, "q16"), folder))
    yield board
    board.close()


@pytest.fixture(scope="module")
def host(folder):
    return HostDevice(build("host", gains_of(REGULATOR, CHAIN, "q16"), folder))


def word(count):
    return 0x3000 | int(dac_codes(CHAIN, np.array([count]))[0]) << 2


@pytest.mark.parametrize("rate", [2_400, 20_000, 100_000])
@pytest.mark.parametrize("direction", [1, -1])
def test_every_edge_counts_in_both_directions(uno, rate, direction):
    uno.play(GRAY[(direction * np.arange(1, 401)) % 4], rate)
    assert uno.settled() == word(400 * direction)


def test_every_edge_counts_under_reversals(uno):
    rng = np.random.default_rng(0)
    position = np.cumsum(rng.choice([-1, 1], 3000))
    uno.play(GRAY[position % 4], 20_000)
    assert uno.settled() == word(position[-1])
    # Every word on the way is that of a position that was there, none is torn.
    there = {word(count) for count in range(min(0, position.min()), position.max() + 1)}
    assert len(uno.words) > 500
    assert set(uno.words.tolist()) <= there


def test_the_interrupt_leaves_most_of_the_time_at_20_000_edges_per_second(uno):
    uno.play(GRAY[np.arange(1, 401) % 4], 20_000)
    assert 20 < uno.longest < 0.25 * CLOCK_HZ / 20_000


def test_the_16_bit_regulator_has_the_bits_of_the_host_on_a_blow(device, host):
    """4101 steps, as on the other boards; the sample time is 2 ms, and the decoder wants its share."""
    hit = blow(fitted_bench(), CHAIN, REGULATOR.sample_time, duration=8.2)
    host.reset()
    device.reset()
    np.testing.assert_array_equal(device.run(hit.adc, hit.trigger), host.run(hit.adc, hit.trigger))
    assert len(device.cycles) == len(hit.adc) > 4000
    assert 2000 < max(device.cycles) < 0.7e-3 * CLOCK_HZ
    # An instruction of this processor takes one to four cycles.
    cycles, instructions = np.array(device.cycles), np.array(device.instructions)
    assert (instructions < cycles).all()
    assert (4 * instructions > cycles).all()


def test_what_is_left_meets_the_target(device):
    hit = blow(fitted_bench(), CHAIN, REGULATOR.sample_time, duration=2.0)
    left = residual(device, hit, Stage(), REGULATOR, CHAIN.reach)
    assert max(left.range, left.deviation) < 5


def test_full_scale_inputs_agree_with_the_host(device, host):
    """Products of bytes in assembly at the limits of their operands: states saturate either way."""
    rng = np.random.default_rng(1)
    square = np.where(np.arange(800) // 40 % 2, 4095, 0)
    adc = np.where(rng.random(800) < 0.2, rng.choice([0, 4095, 2048], 800), square).astype(np.uint16)
    trigger, enabled = rng.random(800) < 0.2, rng.random(800) < 0.8
    host.reset()
    device.reset()
    wanted = host.run(adc, trigger, enabled)
    np.testing.assert_array_equal(device.run(adc, trigger, enabled), wanted)
    assert np.ptp(wanted.astype(int)) == 4095


def test_an_image_of_another_board_is_refused(image):
    with pytest.raises(UserError, match="image of the board 'uno'"):
        UnoDevice(image)


def test_a_machine_without_simavr_is_told_what_to_install(monkeypatch, tmp_path, image):
    simavr._library.cache_clear()
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(UserError, match="libsimavr-dev and libelf-dev"):
        Uno(image)
