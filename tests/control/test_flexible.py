"""Modes on a structure, against closed forms, full state spaces and simulation by hand."""

import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.optimize import brentq

from wavequake.control.linear import LinearModel
from wavequake.control.sampled.channel import RIGID, Timing, in_series, sampled_channel, second_order
from wavequake.control.sampled.flexible import (
    FlexibleLoop,
    Structure,
    closed_matrix,
    flexible_controller,
    flexible_plant,
    mixed,
    mixed_is_stable,
    poles,
    reduced,
    response,
)
from wavequake.errors import UserError

FRAME = 0.02


def one_mode(gain, share=1.0, hertz=10.0, zeta=0.005, latency=0.0, integration=1e-6, frame=FRAME):
    structure = Structure(np.array([hertz]), np.array([zeta]), np.array([share]), np.ones((1, 1)))
    timing = Timing(frame, integration * frame, 1, latency * frame)
    return FlexibleLoop(timing, RIGID, np.array([gain]), 0.0, structure)


def largest(loop):
    return np.abs(poles(reduced(loop))).max()


def limit(make):
    gains = np.geomspace(1e-4, 2, 400)
    first = next(one for one in gains if largest(make(one)) > 1)
    return brentq(lambda gain: largest(make(gain)) - 1, first / 1.03, first)


@pytest.mark.parametrize(
    ("rate", "frames", "hertz"), [(50, 1, 0.298), (50, 2, 3.80), (200, 1, 0.1048), (200, 2, 0.1225)]
)
def test_a_mode_that_is_all_of_the_response_is_stable_up_to_the_sampled_limit(rate, frames, hertz):
    # A point is read where its frame ends; that of the closed form, where it begins.
    found = limit(lambda gain: one_mode(gain, latency=float(frames), frame=1 / rate)) * rate / (2 * np.pi)
    assert found == pytest.approx(hertz, rel=3e-3)


@pytest.mark.parametrize(("share", "hertz"), [(1.0, 0.1000), (0.1, 1.0092), (0.02, 8.564)])
def test_a_fast_loop_has_the_limit_of_the_continuous_one(share, hertz):
    # Continuous integrator: (2 zeta w + wc (1 - k)) (w^2 + 2 zeta w wc (1 - k)) > wc w^2.
    rate = 40_000.0
    w, zeta = 2 * np.pi * 10, 0.005

    def excess(wc):
        left = (2 * zeta * w + wc * (1 - share)) * (w**2 + 2 * zeta * w * wc * (1 - share))
        return left - wc * w**2

    expected = brentq(excess, 1e-3, 60) / (2 * np.pi)
    assert expected == pytest.approx(hertz, rel=1e-3)
    gain = 2 * np.pi * hertz / rate
    assert largest(one_mode(0.98 * gain, share, frame=1 / rate)) < 1
    assert largest(one_mode(1.02 * gain, share, frame=1 / rate)) > 1


@pytest.fixture
def mirror():
    random = np.random.default_rng(3)
    shapes = np.linalg.qr(random.standard_normal((9, 3)))[0]
    structure = Structure(
        np.array([4.0, 8.0, 13.0]), np.array([0.01, 0.02, 0.01]), np.array([0.2, 0.3, 0.1]), shapes
    )
    gains = np.array([0.02, 0.02, 0.02, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1])
    timing = Timing(FRAME, FRAME, 1, 1.3 * FRAME)
    return FlexibleLoop(timing, second_order(20.0, 0.5), gains, 0.001, structure)


def whole(loop, interaction):
    """Return the step of all modes, each with an actuator and each structure mode with one of its own."""
    rigid = sampled_channel(loop.dynamics, loop.timing)
    s = loop.structure
    through = [
        sampled_channel(in_series(loop.dynamics, second_order(f, z)), loop.timing)
        for f, z in zip(s.hertz, s.zeta, strict=True)
    ]
    m = len(loop.gains)
    a = block_diag(*[rigid.a] * m, *(one.a for one in through))
    b = np.vstack(
        [
            block_diag(*[rigid.b] * m),
            *(np.outer(one.b, row) for one, row in zip(through, s.shapes.T, strict=True)),
        ]
    )
    left = np.eye(m) - s.shapes @ np.diag(s.shares) @ s.shapes.T
    c = np.hstack(
        [
            left @ block_diag(*[rigid.c] * m),
            *(
                share * np.outer(row, one.c)
                for one, row, share in zip(through, s.shapes.T, s.shares, strict=True)
            ),
        ]
    )
    keep = (1 - loop.leak) * np.eye(m)
    g = np.diag(loop.gains)
    return closed_matrix(
        LinearModel(a, b, interaction @ c, np.zeros((m, m))), LinearModel(keep, np.eye(m), keep @ g, g)
    )


def test_few_directions_have_the_poles_and_the_response_of_all_modes(mirror):
    every = np.linalg.eigvals(whole(mirror, np.eye(9)))
    few = poles(reduced(mirror))
    few = few[np.abs(few) > 0.5]  # delays make many equal poles near 0, which rounding spreads
    assert max(np.abs(every - one).min() for one in few) < 1e-9
    assert max(np.abs(few - one).min() for one in every[np.abs(every) > 0.5]) < 1e-9
    found = reduced(mirror)
    at = response(found, np.array([3.0]))
    full = response(
        type(found)(mirror, np.eye(9), found.gains, found.groups), np.array([3.0])
    ).sensitivity[0]  # fmt: skip
    np.testing.assert_allclose(
        found.basis @ at.sensitivity[0] @ found.basis.T @ mirror.structure.shapes,
        full @ mirror.structure.shapes,
        rtol=1e-10,
    )


def test_without_errors_the_determinant_and_the_poles_agree_on_the_limit(mirror):
    found = mixed(mirror, np.eye(9))
    for factor in np.geomspace(0.2, 20, 25):
        scaled = FlexibleLoop(mirror.timing, mirror.dynamics, factor * mirror.gains, 0.001, mirror.structure)
        assert mixed_is_stable(found, factor) == (largest(scaled) < 1)


def test_with_errors_the_determinant_counts_as_all_poles_do(mirror):
    random = np.random.default_rng(5)
    outcomes = set()
    for _ in range(40):
        interaction = np.eye(9) + 0.3 * random.standard_normal((9, 9))
        factor = float(random.uniform(0.3, 6.0))
        scaled = FlexibleLoop(mirror.timing, mirror.dynamics, factor * mirror.gains, 0.001, mirror.structure)
        stable = np.abs(np.linalg.eigvals(whole(scaled, interaction))).max() < 1
        assert mixed_is_stable(mixed(mirror, interaction), factor) == stable
        outcomes.add(bool(stable))
    assert len(outcomes) == 2


def test_the_controller_is_that_of_the_poles(mirror):
    found = reduced(mirror)
    own, plant = flexible_controller(found.loop), flexible_plant(found.loop)
    z = np.exp(2j * np.pi * 3.0 * FRAME)
    h = own.c @ np.linalg.solve(z * np.eye(len(own.a)) - own.a, own.b) + own.d
    p = plant.c @ np.linalg.solve(z * np.eye(len(plant.a)) - plant.a, plant.b)
    np.testing.assert_allclose(p @ h, response(found, np.array([3.0])).gain[0] * 1.0, rtol=1e-9, atol=1e-12)


def test_shares_of_more_than_the_whole_response_are_refused():
    shapes = np.ones((1, 2))
    structure = Structure(np.array([4.0, 5.0]), np.array([0.01, 0.01]), np.array([0.6, 0.6]), shapes)
    with pytest.raises(UserError, match=r"1\.2 of the static response"):
        FlexibleLoop(Timing(0.02, 0.02, 1, 0.0), RIGID, np.ones(1), 0.0, structure)
