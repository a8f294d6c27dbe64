"""The Uno's image in simavr: every edge of the sensor is counted, and words of the converter are right."""

import ctypes
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from wavequake.control.bench import fitted_bench
from wavequake.control.experiment import Settings, design
from wavequake.control.sensor import SensorChain, dac_codes
from wavequake.control.stage import Stage
from wavequake.files import folder
from wavequake.firmware.build import BOARDS, COMMON, build, write_header
from wavequake.firmware.devices import HostDevice
from wavequake.firmware.gains import gains_of

if not shutil.which("avr-gcc"):
    pytest.skip("needs Debian's gcc-avr and avr-libc", allow_module_level=True)
if not shutil.which("cc") or not Path("/usr/include/simavr/sim_avr.h").exists():
    pytest.skip("needs Debian's libsimavr-dev and libelf-dev, and a C compiler", allow_module_level=True)

CHAIN = SensorChain()
CLOCK = 16_000_000
GRAY = np.array([0b00, 0b10, 0b11, 0b01], np.uint8)


@pytest.fixture(scope="module")
def simavr(tmp_path_factory):
    path = tmp_path_factory.mktemp("simavr") / "shim.so"
    source = Path(__file__).with_name("simavr_shim.c")
    subprocess.run(["cc", "-O2", "-shared", "-fPIC", source, "-o", path, "-lsimavr", "-lelf"], check=True)
    library = ctypes.CDLL(str(path))
    library.uno_open.restype = ctypes.c_void_p
    return library


@pytest.fixture(scope="module")
def image(tmp_path_factory):
    regulator = design(fitted_bench(), Stage(), Settings()).regulator
    return build("uno", gains_of(regulator, CHAIN), tmp_path_factory.mktemp("uno")).path


class Uno:
    def __init__(self, library, image):
        self.simulator, self._words = library, np.zeros(200_000, np.uint16)
        pointer = ctypes.c_void_p(self._words.ctypes.data)
        self.board = ctypes.c_void_p(library.uno_open(str(image).encode(), pointer, len(self._words)))
        self.play(np.zeros(1, np.uint8), 100)

    def play(self, pins, edges_per_second):
        pins = np.ascontiguousarray(pins, np.uint8)
        cycles = round(CLOCK / edges_per_second)
        pointer = ctypes.c_void_p(pins.ctypes.data)
        assert self.simulator.uno_play(self.board, pointer, len(pins), cycles) == 0

    def settled(self):
        """Return the last word, when the board has had time to send the last count."""
        assert self.simulator.uno_run(self.board, CLOCK // 500) == 0
        return self.words[-1]

    @property
    def words(self):
        return self._words[: self.simulator.uno_words(self.board)]

    @property
    def longest(self):
        return self.simulator.uno_longest(self.board)


def word(count):
    return 0x3000 | int(dac_codes(CHAIN, np.array([count]))[0]) << 2


@pytest.mark.parametrize("rate", [2_400, 20_000, 100_000])
@pytest.mark.parametrize("direction", [1, -1])
def test_every_edge_counts_in_both_directions(simavr, image, rate, direction):
    uno = Uno(simavr, image)
    uno.play(GRAY[(direction * np.arange(1, 401)) % 4], rate)
    assert uno.settled() == word(400 * direction)


def test_every_edge_counts_under_reversals(simavr, image):
    rng = np.random.default_rng(0)
    uno = Uno(simavr, image)
    position = np.cumsum(rng.choice([-1, 1], 3000))
    uno.play(GRAY[position % 4], 20_000)
    assert uno.settled() == word(position[-1])
    # Every word on the way is that of a position that was there, none is torn.
    there = {word(count) for count in range(min(0, position.min()), position.max() + 1)}
    assert len(uno.words) > 500
    assert set(uno.words.tolist()) <= there


def test_the_interrupt_leaves_most_of_the_time_at_20_000_edges_per_second(simavr, image):
    uno = Uno(simavr, image)
    uno.play(GRAY[np.arange(1, 401) % 4], 20_000)
    assert 20 < uno.longest < 0.25 * CLOCK / 20_000


def test_the_16_bit_regulator_fits_the_uno_and_has_the_bits_of_the_host(simavr, tmp_path):
    regulator = design(fitted_bench(), Stage(), Settings()).regulator
    gains = gains_of(regulator, CHAIN, "q16")
    path = tmp_path / "step.elf"
    core = folder("firmware") / "core"
    subprocess.run(
        [*BOARDS["uno"].gcc, *COMMON, f"-I{write_header(gains, tmp_path)}", f"-I{core}", core / "control.c",
         Path(__file__).with_name("uno_step.c"), "-o", path],
        check=True,
    )  # fmt: skip
    uno = Uno(simavr, path)
    assert simavr.uno_run(uno.board, 2 * CLOCK) == 0
    codes, cycles = uno.words[0::2][:1000], uno.words[1::2][:1000]
    noise, adc = 1, []
    for _ in range(1000):
        noise = (noise * 25173 + 13849) % 65536
        adc.append(1536 + (noise >> 6))
    trigger = np.arange(1000) % 256 == 0
    host = HostDevice(build("host", gains, tmp_path))
    np.testing.assert_array_equal(codes, host.run(np.array(adc, np.uint16), trigger))
    assert np.ptp(codes.astype(int)) > 1000
    # The sample time is 2 ms, and the decoder's interrupt wants its share.
    assert cycles.max() / CLOCK < 0.75 * regulator.sample_time
