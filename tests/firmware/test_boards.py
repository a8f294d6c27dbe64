"""Watchdog, deadline, switch and trigger on the emulated boards, in closed form or against the host."""

from contextlib import ExitStack, closing

import numpy as np
import pytest

from wavequake.control.bench import fitted_bench
from wavequake.control.experiment import Settings, design
from wavequake.control.sensor import SensorChain
from wavequake.control.stage import Stage
from wavequake.errors import UserError
from wavequake.firmware.build import build
from wavequake.firmware.devices import HostDevice
from wavequake.firmware.due import DACC_CDR, DueDevice
from wavequake.firmware.gains import gains_of
from wavequake.firmware.qemu import QemuDevice
from wavequake.firmware.uno import UnoDevice

CHAIN = SensorChain()
DESIGNS = {step: design(fitted_bench(), Stage(), Settings(modal_step=step)) for step in (0.002, 0.1)}
REGULATOR = DESIGNS[0.002].regulator
MIDDLE = 2048


def gains(variant="q31", step=0.002):
    return gains_of(DESIGNS[step].regulator, CHAIN, variant)


def due(folder, variant="q31", step=0.002):
    try:
        return DueDevice(build("due", gains(variant, step), folder))
    except UserError as error:
        pytest.skip(str(error))


@pytest.fixture(params=["host", "due", "qemu", "simavr"])
def device(request, tmp_path):
    given = gains("q16")
    with ExitStack() as stack:
        try:
            image = build(request.param, given, tmp_path)
            if request.param == "qemu":
                made = stack.enter_context(QemuDevice(image))
            elif request.param == "simavr":
                made = stack.enter_context(closing(UnoDevice(image)))
            else:
                made = HostDevice(image) if request.param == "host" else DueDevice(image)
        except UserError as error:  # says which package is missing
            pytest.skip(str(error))
        yield made


def test_a_board_whose_converter_hangs_is_started_anew_by_its_watchdog(tmp_path):
    """The command stays until a quarter of a second has gone by, then the board begins as if switched on."""
    board = due(tmp_path)
    swing = (2048 + 600 * np.sin(0.08 * np.arange(200))).astype(np.uint16)
    fresh = board.run(swing, np.arange(200) == 0)
    board.reset()
    before = board.run(swing, np.arange(200) == 0)
    np.testing.assert_array_equal(before, fresh)
    board.stuck = True
    held = [board.step(2048, False) for _ in range(125)]
    assert set(held) == {int(before[-1])}
    assert before[-1] != MIDDLE
    assert board.resets == 0
    # Fed in the last good step; 65 ticks of 1/256 s, 253.9 ms, are over in the 127th step from there on.
    assert board.step(2048, False) == MIDDLE
    assert board.resets == 1
    assert (DACC_CDR, MIDDLE) in board.log
    board.stuck = False
    np.testing.assert_array_equal(board.run(swing, np.arange(200) == 0), fresh)
    assert board.resets == 1


def test_a_short_hang_costs_a_deadline_but_no_reset(tmp_path):
    board = due(tmp_path)
    board.step(2048, False)
    board.stuck = True
    for _ in range(20):
        board.step(2048, False)
    board.stuck = False
    board.step(2048, False)
    assert board.was_missed
    board.step(2048, False)
    assert not board.was_missed
    assert board.resets == 0


@pytest.mark.parametrize(("variant", "step"), [("q31", 0.002), ("float", 0.1)])
def test_the_watchdog_waits_for_three_steps_and_is_fed_by_each(tmp_path, variant, step):
    board = due(tmp_path, variant, step)
    (mode,) = [value for offset, value in board.log if offset == 0xE1A54]
    assert mode >> 13 & 1  # resets the board
    assert mode & 1 << 15 == 0  # is not switched off
    assert mode >> 16 & 0xFFF >= mode & 0xFFF  # may be fed at any time
    assert max(3 * step, 0.2) < (mode & 0xFFF) / 256 < 3 * step + 0.3
    board.run(np.full(200, 2048, np.uint16), np.zeros(200, bool))
    assert board.resets == 0


def test_every_deadline_missed_shows_at_the_pin(tmp_path):
    board = due(tmp_path)
    rng = np.random.default_rng(0)
    late = rng.random(200) < 0.3
    seen = []
    for one in late:
        board.late = bool(one)
        board.step(2048, False)
        seen.append(board.was_missed)
    np.testing.assert_array_equal(seen, late)


def test_the_switch_takes_the_command_away_and_gives_it_back(device):
    rng = np.random.default_rng(1)
    adc = (2048 + 500 * np.sin(0.1 * np.arange(300)) + rng.integers(-5, 6, 300)).astype(np.uint16)
    trigger, on = np.arange(300) == 0, np.ones(300, bool)
    on[100:200] = False
    always = device.run(adc, trigger)
    device.reset()
    switched = device.run(adc, trigger, on)
    assert (switched[~on] == MIDDLE).all()
    assert (always[~on] != MIDDLE).any()
    np.testing.assert_array_equal(switched[on], always[on])  # the observer went on


def test_a_blow_counts_at_its_edge_and_arms_itself_again(device):
    rest = np.full(400, 2048, np.uint16)

    def commands(*spans):
        trigger = np.zeros(400, bool)
        for first, last in spans:
            trigger[first:last] = True
        device.reset()
        return device.run(rest, trigger)

    once = commands((0, 1))
    assert np.ptp(once.astype(int)) > 20
    np.testing.assert_array_equal(commands((0, 400)), once)  # held
    np.testing.assert_array_equal(commands((0, 1), (3, 4)), once)  # bounces within the blow
    again = commands((0, 1), (200, 201))
    np.testing.assert_array_equal(again[:200], once[:200])
    # The observer is linear but for rounding: the second blow is the first one, 200 steps later.
    second = again[200:].astype(int) - once[200:]
    assert np.abs(second - (once[:200].astype(int) - MIDDLE)).max() <= 2
