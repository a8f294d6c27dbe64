"""Gain margins of sampled loops: passing over factors at which no pole can cross changes none of them."""

import numpy as np
import pytest

from wavequake.control.sampled import margins
from wavequake.control.sampled.channel import Timing, in_series, recoil, second_order
from wavequake.control.sampled.filters import integrator
from wavequake.control.sampled.regulator import shared_filter
from wavequake.control.sampled.stability import SampledLoop, sampled_margins, worst_pole


def loop_of(seed):
    """Return a loop of three channels on two resonances that answer them, stable or not."""
    rng = np.random.default_rng(seed)
    sees = np.eye(3) + 0.2 * rng.standard_normal((3, 3))
    modes = tuple(recoil(float(hertz), float(zeta)) for hertz, zeta in zip(
        rng.uniform(5, 200, 2), rng.uniform(0.002, 0.05, 2), strict=True
    ))  # fmt: skip
    drives, shown = 0.4 * rng.standard_normal((2, 3)), rng.standard_normal((3, 2))
    servo = in_series(second_order(300.0, 0.7), second_order(float(rng.uniform(20, 400)), 0.2))
    timing = Timing(1e-3, 1e-3, 1, 1e-3 * float(rng.uniform(0, 2)))
    regulator = shared_filter(np.linalg.inv(sees), integrator(float(rng.uniform(0.02, 0.3))))
    return SampledLoop(timing, servo, sees, regulator, modes, drives, shown)


def test_passing_over_factors_changes_no_margin(monkeypatch):
    loops = [loop for loop in map(loop_of, range(16)) if abs(worst_pole(loop).value) < 1.0]
    assert len(loops) > 4
    choose, given = margins._worth_trying, []
    monkeypatch.setattr(margins, "_worth_trying", lambda *asked: given.append(asked) or choose(*asked))
    found = [sampled_margins(loop) for loop in loops]
    monkeypatch.setattr(margins, "_worth_trying", lambda loci, factors: factors)
    for one, loop in zip(found, loops, strict=True):
        whole = sampled_margins(loop)
        assert one.gain_up == pytest.approx(whole.gain_up, rel=1e-9)
        assert one.gain_down == pytest.approx(whole.gain_down, rel=1e-9)
    # No factor is passed over beside which stability changes, at the first margin or behind it.
    monkeypatch.undo()
    changes = 0
    for number, (loci, factors) in enumerate(given):
        tried = np.isin(factors, margins._worth_trying(loci, factors))
        loop = loops[number // 2]
        stable = np.array([abs(worst_pole(loop, factor).value) < 1.0 for factor in factors])
        at = np.flatnonzero(stable[1:] != stable[:-1])
        changes += len(at)
        assert tried[at].all()
        assert tried[at + 1].all()
    assert changes >= len(loops)


def test_a_short_range_of_unstable_gains_is_not_passed_over():
    """Unstable from 1.3 to 1.4, and from 50 on: eigenvalues cross the negative axis at -1 over these."""
    crossings = -1.0 / np.array([1.3, 1.4, 50.0])
    turns = np.exp(1j * np.radians([-30.0, 30.0]))
    loci = (crossings[:, None] * turns).reshape(-1, 1)

    def radius(factor):
        return 1.0 + np.tanh(min(factor - 1.3, 1.4 - factor) if factor < 7.0 else factor - 50.0)

    tried = margins._worth_trying(loci, margins._FACTORS)
    assert len(tried) < 0.4 * len(margins._FACTORS)
    assert margins.first_unstable(radius, tried, np.inf) == pytest.approx(1.3, rel=1e-6)
