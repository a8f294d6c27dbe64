"""The whole chain in emulators: the sensor's edges, the Uno's image and words, the Due's image, the stage."""

import numpy as np
import pytest

from wavequake.control.bench import fitted_bench
from wavequake.control.experiment import Settings, design
from wavequake.control.loop import late_deviation, peak_to_peak, remaining_image, stage_motion
from wavequake.control.plant import swing
from wavequake.control.sensor import SensorChain, adc_codes, quadrature_counts
from wavequake.control.stage import Stage
from wavequake.errors import UserError
from wavequake.firmware.build import build
from wavequake.firmware.due import DueDevice
from wavequake.firmware.gains import gains_of
from wavequake.firmware.loop import positions_of
from wavequake.firmware.uno import GRAY, Uno

CHAIN, STAGE, DURATION = SensorChain(), Stage(), 3.0
# Pins change 16 000 times per s at most: above the fastest motion's 11 000 edges.
RATE = 16_000


def test_two_boards_in_a_row_steady_the_image(tmp_path):
    regulator = design(fitted_bench(), STAGE, Settings()).regulator
    gains = gains_of(regulator, CHAIN)
    try:
        uno = Uno(build("uno", gains, tmp_path))
        due = DueDevice(build("due", gains, tmp_path))
    except UserError as error:  # says which package is missing
        pytest.skip(str(error))
    free = swing([fitted_bench()], np.ones(1), friction=0.3e-3, duration=DURATION)
    fine = np.interp(np.arange(round(DURATION * RATE)) / RATE, free.time, free.measured[0])
    counts = quadrature_counts(CHAIN, fine)
    assert np.abs(np.diff(counts)).max() == 1  # the finest motion loses no edge here
    noise = np.random.default_rng(0).standard_normal(round(DURATION / 0.002))
    read, commands = [], []
    uno.play(np.zeros(200, np.uint8), RATE)
    for step, pins in enumerate(GRAY[counts % 4].reshape(-1, round(0.002 * RATE))):
        read.append(int(uno.words[-1]) >> 2 & 1023)
        (code,) = adc_codes(CHAIN, np.array(read[-1:]), noise[step : step + 1])
        commands.append(due.step(int(code), trigger=step == 0))
        uno.play(pins, RATE)
    # A word of this emulator takes up to 0.4 ms more, in which lens 4 moves by four codes.
    true = (fine[:: round(0.002 * RATE)] + CHAIN.reach) * 1023 / (2 * CHAIN.reach)
    assert np.abs(np.array(read) - true).max() < 5
    assert np.ptp(read) > 200
    moved = stage_motion(
        STAGE, positions_of(np.array([commands]), CHAIN.reach), 0.002, 0.0002, 1e-3, len(free.time)
    )[0]
    left = remaining_image(free.image[0], moved)
    assert peak_to_peak(left) < 0.05 * peak_to_peak(free.image[0])
    assert late_deviation(left, free.time) < 0.05 * late_deviation(free.image[0], free.time)
    assert due.resets == 0
    uno.close()
