"""Margins of sampled loops by few directions and frequencies: those of all poles, at all factors."""

from dataclasses import replace

import numpy as np
import pytest

from wavequake.control.sampled import margins
from wavequake.control.sampled.channel import Timing, in_series, recoil, second_order
from wavequake.control.sampled.filters import integrator
from wavequake.control.sampled.margins import first_unstable, followed, graded_grid
from wavequake.control.sampled.regulator import model_of, shared_filter, whole
from wavequake.control.sampled.stability import (
    SampledLoop,
    _closed,
    _loop_gain,
    controller_model,
    parts_of,
    plant_model,
    sampled_margins,
)
from wavequake.control.sampled.stability import worst_pole as worst


def loop_of(seed, channels=3, modes=2, off=0.2):
    """Return a loop of some channels on resonances that answer them, stable or not."""
    rng = np.random.default_rng(seed)
    sees = np.eye(channels) + 0.2 * rng.standard_normal((channels, channels))
    through = np.linalg.inv(sees)
    if not off:  # the controller knows the mirror well, but for one direction
        sees = sees + 0.1 * np.outer(*rng.standard_normal((2, channels))) / channels
    structure = tuple(recoil(float(hertz), float(zeta)) for hertz, zeta in zip(
        rng.uniform(5, 200, modes), rng.uniform(0.002, 0.05, modes), strict=True
    ))  # fmt: skip
    drives, shown = 0.4 * rng.standard_normal((modes, channels)), rng.standard_normal((channels, modes))
    servo = in_series(second_order(300.0, 0.7), second_order(float(rng.uniform(20, 400)), 0.2))
    timing = Timing(1e-3, 1e-3, 1, 1e-3 * float(rng.uniform(0, 2)))
    regulator = shared_filter(through, integrator(float(rng.uniform(0.02, 0.3))))
    size = 1.0 if channels == 3 else 3.0 / channels
    return SampledLoop(timing, servo, sees, regulator, structure, size * drives, shown)


def poles(loop, factor=1.0):
    """Return all poles of the whole loop, channel by channel."""
    plant, own = plant_model(loop), controller_model(loop)
    c = factor * plant.c
    return np.linalg.eigvals(
        np.block([[plant.a - plant.b @ own.d @ c, -plant.b @ own.c], [own.b @ c, own.a]])
    )


def stable_loops(count=16, **keys):
    found = [loop_of(seed, **keys) for seed in range(count)]
    found = [loop for loop in found if abs(worst(loop).value) < 1.0]
    assert len(found) > count // 3
    return found


@pytest.mark.parametrize("keys", [{}, {"channels": 12, "off": 0.0}])
def test_turns_of_eigenvalues_say_what_poles_say_at_every_factor(monkeypatch, keys):
    judge, given = margins._is_unstable, []
    monkeypatch.setattr(
        margins, "_is_unstable", lambda loci, factor: given.append(loci) or judge(loci, factor)
    )
    both, known, changes = np.concatenate([margins._FACTORS[:90:5], 1 / margins._FACTORS[::15]]), 0, 0
    loops = stable_loops(5, **keys)
    for loop in loops:
        given.clear()
        sampled_margins(loop)
        said = [judge(given[0], factor) for factor in both]
        sizes = [np.abs(poles(loop, factor)).max() for factor in both]
        for one, size in zip(said, sizes, strict=True):
            assert one is None or one == (size > 1.0)
        known += sum(one is not None for one in said)
        changes += np.ptp(np.sign(np.array(sizes) - 1.0)) > 0
    assert changes == len(loops)
    assert known > 0.9 * len(loops) * len(both)


@pytest.mark.parametrize("keys", [{}, {"channels": 12, "off": 0.0}])
def test_margins_of_few_directions_and_frequencies_are_those_of_all(monkeypatch, keys):
    """The whole regulator is one that shares nothing: its loop is looked at channel by channel."""
    monkeypatch.setattr(margins, "_FACTORS", np.geomspace(1.0, 50.0, 40))
    loops = stable_loops(5, **keys)
    found = [sampled_margins(loop) for loop in loops]
    monkeypatch.setattr(margins, "_GRADED", margins._GRADED / 5)
    monkeypatch.setattr(margins, "_is_unstable", lambda loci, factor: None)
    for one, loop in zip(found, loops, strict=True):
        apart = replace(loop, regulator=whole(model_of(loop.regulator, loop.timing.period)))
        wanted = sampled_margins(apart)
        for name in ("gain_up", "gain_down", "phase", "delay", "last_omega"):
            assert getattr(one, name) == pytest.approx(getattr(wanted, name), rel=1e-8), name
        assert one.peak == pytest.approx(wanted.peak, rel=1e-10)


def test_a_core_has_all_poles_and_eigenvalues_and_half_the_states():
    loop = loop_of(3, channels=12, modes=2, off=0.0)
    parts = parts_of(loop)
    core = parts.core()
    assert (len(parts.inner), len(core.sees), core.value) == (6, 3, 1.0)
    closed = _closed(loop, parts)
    wanted, found = poles(loop, 1.3), np.concatenate(closed.poles(1.3))
    assert len(closed.step(1.0)) < 0.3 * len(wanted)
    # The actuator before a mode, which nothing shows apart from that of its channel, has its own poles.
    twice = np.linalg.eigvals(loop.channels()[0].a)
    slow = wanted[np.abs(wanted) > 0.05]
    assert np.abs(slow[:, None] - np.append(found, twice)).min(axis=1).max() < 1e-9
    assert np.abs(found[np.abs(found) > 0.05][:, None] - wanted).min(axis=1).max() < 1e-9
    hertz = np.array([3.0, 40.0, 400.0])
    own, plant = (responses(of(loop), hertz) for of in (controller_model, plant_model))
    for h, g, values in zip(own, plant, _loop_gain(loop, parts).loci(hertz), strict=True):
        assert (
            np.abs(np.linalg.eigvals(h @ g)[:, None] - values).min(axis=1).max()
            < 1e-10 * np.abs(values).max()
        )


def responses(model, hertz):
    z = np.exp(2j * np.pi * hertz * model.sample_time)
    return [model.c @ np.linalg.solve(one * np.eye(len(model.a)) - model.a, model.b) + model.d for one in z]


def test_what_grows_is_named_by_the_channel_that_moves_most():
    loop = loop_of(5, channels=12, modes=2, off=0.0)
    factor = 1.5 * sampled_margins(loop).gain_up if abs(worst(loop).value) < 1 else 1.0
    found = worst(loop, factor)
    plant, own = plant_model(loop), controller_model(loop)
    c = factor * plant.c
    step = np.block([[plant.a - plant.b @ own.d @ c, -plant.b @ own.c], [own.b @ c, own.a]])
    values, vectors = np.linalg.eig(step)
    state = vectors[:, np.abs(values).argmax()]
    commands = np.abs(own.d @ c @ state[: len(plant.a)] + own.c @ state[len(plant.a) :])
    shares = found.channels / found.channels.max()
    np.testing.assert_allclose(shares, commands / commands.max(), atol=1e-6)


def test_turns_that_are_too_wide_are_left_to_poles():
    loci = np.array([[-0.5 + 0.01j], [-0.5 - 0.01j]])
    assert margins._is_unstable(loci, 2.0) is None
    assert margins._is_unstable(loci, 1.01) is False


def test_what_is_said_wrongly_of_a_factor_is_found_out():
    """Said to be stable beyond its limit of 1.3, or unstable before it."""

    def radius(factor):
        return 0.5 + 0.5 * factor / 1.3

    for judge in (lambda factor: factor > 2.0, lambda factor: True, lambda factor: None):
        assert first_unstable(radius, margins._FACTORS, np.inf, judge) == pytest.approx(1.3, rel=1e-9)


@pytest.mark.parametrize("factors", [margins._FACTORS, 1 / margins._FACTORS])
@pytest.mark.parametrize("known", [None, True])
def test_a_loop_that_grows_from_the_start_has_no_margin(factors, known):
    """As one does whose poles are counted for rounding, above 1 by a little."""
    assert first_unstable(lambda factor: 1.0 + 2e-9, factors, np.inf, lambda factor: known) == 1.0


def test_a_graded_grid_is_close_where_poles_are():
    pole = np.exp(-0.02 + 2j * np.pi * 0.1)
    hertz = graded_grid(np.array([pole, pole.conj(), 1.0 + 0j, 0.0]), 1e-3)
    assert hertz[-1] == 500.0
    near = np.abs(1j * hertz - np.log(pole) / (2e-3 * np.pi))
    steps = np.diff(hertz)
    assert steps.max() <= 5.0
    assert (steps <= 0.05 * near[:-1] * (1 + 1e-9)).all()
    assert len(hertz) < 700


def test_eigenvalues_are_followed_through_any_order():
    along = np.linspace(0.0, 1.0, 50)[:, None] * np.exp(1j * np.array([0.1, 1.0, 2.0])) + np.array(
        [1, 2j, -1]
    )
    mixed = np.random.default_rng(0).permuted(along, axis=1)
    np.testing.assert_array_equal(np.sort_complex(followed(mixed)[0]), np.sort_complex(along[0]))
    assert np.abs(np.diff(followed(mixed), axis=0)).max() < 0.03
