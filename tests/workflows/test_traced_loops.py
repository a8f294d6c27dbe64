"""Loops whose sensors see traced light: what they read does not depend on the linear light at all."""

from dataclasses import replace

import numpy as np
import pytest
from small_loops import small

from wavequake.kernels.device.devices import choose_device
from wavequake.workflows.loops.telescope_bench import bench_of
from wavequake.workflows.loops.telescope_light import drawn, seen_of
from wavequake.workflows.loops.telescope_loop import positions_of

NUMPY = choose_device("numpy")
NAMES = ("rigid/60/0.5", "elastic/60/0.5", "body/60/0.5")


@pytest.fixture(scope="module")
def prepared():
    """Two cases, what is seen of them, and a study whose sensors are traced beside the linear one."""
    bench = bench_of(small(**{"disturbance.history.instants": 20}))
    draws = [drawn(bench.study, bench.optics, 0, realization) for realization in range(2)]
    seen = [seen_of(bench.study, bench.optics, case) for case in draws]
    look = bench.study.look.model_copy(update={"sensors": "traced"})
    traced = replace(bench, study=bench.study.model_copy(update={"look": look}))
    return bench, traced, draws, seen


def named(bench, name):
    return next(one for one in bench.controllers if one.name == name)


@pytest.mark.parametrize("name", NAMES)
def test_small_motions_give_what_linear_light_gives(prepared, name):
    """Light is linear to 1e-5 of motions of a few hundred nm."""
    bench, traced, draws, seen = prepared
    linear = positions_of(bench, named(bench, name), 0, draws, seen, NUMPY)[0]
    found = positions_of(traced, named(bench, name), 0, draws, seen, NUMPY)[0]
    scale = np.abs(linear[0]).max()
    difference = max(np.abs(a - b).max() for a, b in zip(linear, found, strict=True))
    assert 0.0 < difference < 1e-3 * scale


@pytest.mark.parametrize("name", NAMES)
def test_a_wrong_linear_light_changes_nothing(prepared, name):
    """Sensitivities and what is seen are 10 % too small: the linear loop errs, the traced one cannot know."""
    bench, traced, draws, seen = prepared
    right = named(bench, name)
    loops = tuple(replace(loop, sees=0.9 * loop.sees) for loop in right.loops)
    wrong = replace(right, sight=0.9 * right.sight, loops=loops)
    dimmed = [0.9 * values for values in seen]
    for study, apart in ((traced, False), (bench, True)):
        expected = positions_of(study, right, 0, draws, seen, NUMPY)[0]
        found = positions_of(study, wrong, 0, draws, dimmed, NUMPY)[0]
        largest = np.abs(expected[0]).max()
        difference = np.abs(expected[0] - found[0]).max()
        assert (difference > 0.01 * largest) if apart else (difference < 1e-9 * largest)


def test_a_case_has_the_same_bits_alone(prepared):
    _, traced, draws, seen = prepared
    one = named(traced, "elastic/60/0.5")
    both = positions_of(traced, one, 0, draws, seen, NUMPY)[0]
    alone = positions_of(traced, one, 0, draws[1:], seen[1:], NUMPY)[0]
    np.testing.assert_array_equal(both[1], alone[0])


def test_a_loop_that_grows_diverges(prepared):
    """Rays that motion loses make a reading that is none, not one of zero."""
    _, traced, draws, seen = prepared
    right = named(traced, "rigid/60/0.5")
    (loop,) = right.loops
    strong = replace(loop.regulator, decoupling=-400.0 * loop.regulator.decoupling)
    wrong = replace(right, loops=(replace(loop, regulator=strong),))
    _, _, diverged = positions_of(traced, wrong, 0, draws, seen, NUMPY)
    assert diverged.all()
