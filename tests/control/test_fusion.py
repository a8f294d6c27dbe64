"""LQG of several sensors: the best linear prediction by conditioning of Gaussians, and LQG of one sensor."""

import numpy as np
import pytest
from scipy.linalg import block_diag

from wavequake.control.frames.disturbance import line
from wavequake.control.linear import frequency_response
from wavequake.control.sampled.channel import RIGID, Timing, acceleration, first_order, recoil
from wavequake.control.sampled.filters import lqg
from wavequake.control.sampled.fusion import Known, Seen, fused, plant_of
from wavequake.control.sampled.regulator import whole
from wavequake.control.sampled.run import Actuator, Eye, Loop, run, schedule
from wavequake.errors import UserError

HERTZ, ZETA, RMS = (6.0, 11.0), (0.03, 0.06), (2.0, 1.5)
PERIOD, LATE = 0.01, 0.013
# Both modes in two sensors of two and one readings; one channel.
SEES = (np.array([[1.0, 0.4], [0.2, -0.8]]), np.array([[0.5, 1.2]]))
NOISE, TARGET = (0.7, 0.3), np.array([[1.0, 0.6]])
POINTS, WEIGHTS = np.polynomial.legendre.leggauss(6)


def covariances(lags):
    """Return covariances of each mode at lags, in closed form, (lags, 2)."""
    found = []
    for hertz, zeta, rms in zip(HERTZ, ZETA, RMS, strict=True):
        w = 2 * np.pi * hertz
        wd, lag = w * np.sqrt(1 - zeta**2), np.abs(lags)
        found.append(rms**2 * np.exp(-zeta * w * lag) * (np.cos(wd * lag) + zeta * w / wd * np.sin(wd * lag)))
    return np.stack(found, axis=-1)


def of_means(begins, others):
    """Return covariances of means over periods that begin at given instants, by quadrature, (b, o, 2)."""
    at = 0.5 * PERIOD * (POINTS + 1)
    lags = (begins[:, None, None, None] + at[:, None]) - (others[None, :, None, None] + at)
    return np.einsum("bopqk,p,q->bok", covariances(lags), WEIGHTS / 2, WEIGHTS / 2)


def oscillators():
    parts = []
    for hertz, zeta, rms in zip(HERTZ, ZETA, RMS, strict=True):
        w = 2 * np.pi * hertz
        a = np.array([[0, w], [-w, -2 * zeta * w]])
        parts.append((a, np.array([[0.0], [rms * np.sqrt(4 * zeta * w)]])))
    a, g = block_diag(*(one for one, _ in parts)), block_diag(*(one for _, one in parts))
    # Positions of the modes among the states x, x' / w.
    return a, g, np.array([[1.0, 0, 0, 0], [0, 0, 1.0, 0]])


def test_it_is_the_best_prediction_of_all_readings():
    """Weights of past readings against conditional means; covariances are closed forms."""
    a, g, positions = oscillators()
    seen = [
        Seen(one @ positions, np.zeros((len(one), 1)), np.zeros((len(one), 0)), RIGID, noise)
        for one, noise in zip(SEES, NOISE, strict=True)
    ]
    timing = Timing(PERIOD, PERIOD, 1, LATE)
    found = fused(Known(a, g, TARGET @ positions), seen, RIGID, timing, (), np.zeros((0, 1)))
    count = 300
    weights, state = [found.d[0]], found.b
    for _ in range(count - 1):
        weights.append((found.c @ state)[0])
        state = found.a @ state
    weights = -np.array(weights).ravel()  # of readings 0, 1, ... periods ago

    begins = -PERIOD * np.arange(1.0, count + 1)
    sees, noise = np.vstack(SEES), np.array([NOISE[0], NOISE[0], NOISE[1]])
    within = of_means(begins, begins)
    k_yy = np.einsum("mk,bok,nk->bmon", sees, within, sees).reshape(3 * count, -1)
    k_yy += np.diag(np.tile(noise**2, count))
    ahead = of_means(np.array([LATE]), begins)[0]
    k_ty = np.einsum("k,bk,mk->bm", TARGET[0], ahead, sees).ravel()
    k_tt = float((TARGET[0] ** 2) @ of_means(np.array([0.0]), np.array([0.0]))[0, 0])
    best = k_tt - k_ty @ np.linalg.solve(k_yy, k_ty)
    reached = k_tt - 2 * weights @ k_ty + weights @ k_yy @ weights
    assert best < 0.3 * k_tt
    assert reached == pytest.approx(best, rel=1e-6)


@pytest.mark.parametrize("shows", [RIGID, first_order(40.0), acceleration(80.0, 0.7)])
def test_of_one_sensor_and_channel_it_is_lqg(shows):
    """Alone it holds no command back: with the actuator's lag and the sensor's."""
    expected, timing = line(9.0, 0.5, 2.0), Timing(PERIOD, PERIOD, 1, 0.004)
    noise, follows = 0.3 * (1e3 if shows.d > 1 else 1.0), first_order(60.0)
    one = Seen(expected.c[None], np.eye(1), np.zeros((1, 0)), shows, noise)
    known = Known(expected.a, expected.g, expected.c[None])
    found = fused(known, [one], follows, timing, (), np.zeros((0, 1)))
    wanted = lqg(expected, noise, follows, timing, shows)
    w = 2 * np.pi * np.array([0.1, 5.0, 9.0, 30.0, 49.0])
    np.testing.assert_allclose(frequency_response(found, w), frequency_response(wanted, w), rtol=1e-6)


def test_it_knows_how_the_structure_answers():
    """The separation principle: poles are those of the filter and of the plant, in a loop as well."""
    expected, timing = line(9.0, 0.5, 2.0), Timing(PERIOD, PERIOD, 1, 0.004)
    mode, drives = recoil(14.0, 0.01), np.array([[0.4]])
    one = Seen(expected.c[None], np.eye(1), np.ones((1, 1)), RIGID, 0.3)
    known = Known(expected.a, expected.g, expected.c[None])
    found = fused(known, [one], RIGID, timing, [mode], drives)
    plant = plant_of([one], RIGID, timing, [mode], drives)
    closed = np.block(
        [[plant.a + plant.b @ found.d @ plant.c, plant.b @ found.c], [found.b @ plant.c, found.a]]
    )
    poles = np.abs(np.linalg.eigvals(closed))
    assert poles.max() < 1 - 1e-4
    assert np.abs(np.linalg.eigvals(plant.a)).max() == pytest.approx(poles.max(), rel=1e-7)


@pytest.mark.parametrize(
    ("integration", "noise", "words"), [(0.5, 0.3, "average over whole frames"), (1.0, 0.0, "positive noise")]
)
def test_what_cannot_be_designed_is_said(integration, noise, words):
    expected = line(9.0, 0.5, 2.0)
    one = Seen(expected.c[None], np.eye(1), np.zeros((1, 0)), RIGID, noise)
    known = Known(expected.a, expected.g, expected.c[None])
    with pytest.raises(UserError, match=words):
        fused(known, [one], RIGID, Timing(PERIOD, integration * PERIOD, 1, 0.0), (), np.zeros((0, 1)))


def test_a_run_with_two_sensors_is_that_of_the_models_by_periods():
    """Events with a lagging sensor and a quick one, against one matrix per period."""
    expected, timing = line(9.0, 0.5, 2.0), Timing(PERIOD, PERIOD, 1, 0.0)
    mode, drives = recoil(14.0, 0.05), np.array([[0.4]])
    slow, fast = first_order(40.0), RIGID
    seen = [
        Seen(expected.c[None], np.eye(1), np.ones((1, 1)), slow, 0.3),
        Seen(0.5 * expected.c[None], np.array([[0.7]]), np.array([[0.2]]), fast, 0.2),
    ]
    known = Known(expected.a, expected.g, expected.c[None])
    own = fused(known, seen, RIGID, timing, [mode], drives)
    plant = plant_of(seen, RIGID, timing, [mode], drives)
    read = np.random.default_rng(5).standard_normal((30, 2, 1))
    free = Actuator(RIGID, np.array([np.inf]), np.inf, np.array([np.nan]))
    further = (Eye(np.array([[0.7, 0.2]]), 0.0, fast),)
    loop = Loop(timing, whole(own), free, np.ones((1, 2)), 0.0, slow, drives, further)
    looks = (np.arange(1, 31) + 0.5) * PERIOD
    got = run([loop], schedule([timing], looks), [read], 30, [mode]).positions[:, 0, 0]
    z, x, commands = np.zeros(len(plant.a)), np.zeros(len(own.a)), []
    for one in read[..., 0]:
        y = plant.c @ z + one
        commands.append(own.c @ x + own.d @ y)
        x, z = own.a @ x + own.b @ y, plant.a @ z + plant.b @ commands[-1]
    np.testing.assert_allclose(got, np.ravel(commands), rtol=1e-9, atol=1e-12)


def test_a_reading_that_sees_nothing_changes_nothing():
    """Its own weight is zero, whatever its electronics; the others are those without it."""
    a, g, positions = oscillators()
    rows = [one @ positions for one in SEES] + [np.zeros((1, 4))]
    shows = (RIGID, RIGID, acceleration(50.0, 0.7))
    seen = [
        Seen(one, np.zeros((len(one), 1)), np.zeros((len(one), 0)), how, noise)
        for one, how, noise in zip(rows, shows, (*NOISE, 0.2), strict=True)
    ]
    timing = Timing(PERIOD, PERIOD, 1, LATE)
    less, more = (
        fused(Known(a, g, TARGET @ positions), some, RIGID, timing, (), np.zeros((0, 1)))
        for some in (seen[:2], seen)
    )
    hertz = np.array([1.0, 6.0, 30.0])
    found, wanted = (frequency_response(one, 2 * np.pi * hertz) for one in (more, less))
    np.testing.assert_allclose(found[..., :3], wanted, atol=1e-9 * np.abs(wanted).max())
    np.testing.assert_allclose(found[..., 3], 0.0, atol=1e-12 * np.abs(wanted).max())
