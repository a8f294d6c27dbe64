"""The regulator with a filter of one channel: nothing near costs less, without effort it is the predictor."""

import numpy as np
import pytest
from scipy.linalg import block_diag, solve_discrete_lyapunov

from wavequake.control.frames import controllers, residual
from wavequake.control.frames.disturbance import joined, line, sampled
from wavequake.control.linear import LinearModel
from wavequake.control.sampled.channel import RIGID, Timing, first_order, sampled_channel, second_order
from wavequake.control.sampled.filters import lqg, lqr
from wavequake.errors import UserError

T = 0.002
LINES = joined([line(12.0, 0.2, 3.0), line(30.0, 0.2, 2.0)])


def timing(latency, integration=1.0):
    return Timing(T, integration * T, 1, latency * T)


def cost(model, dynamics, latency, effort, noise=1.0):
    """Return the variances of the mean left and of changes of the command, weighted, by Lyapunov."""
    known, plant = sampled(LINES, T), sampled_channel(dynamics, timing(latency))
    n, m, k = len(plant.a), len(known.phi), len(model.a)
    # States: actuator, disturbance, controller, last command. Inputs: process noise, of mean and of sensor.
    whole = block_diag(plant.a, known.phi, model.a, np.zeros((1, 1)))
    row = np.concatenate([plant.c[0], known.row, np.zeros(k + 1)])
    command = np.concatenate([model.d[0, 0] * row[: n + m], model.c[0], [0.0]])
    whole[:n] += plant.b @ command[None]
    whole[n + m : n + m + k] += model.b @ row[None]
    whole[-1] = command
    into = np.zeros((len(whole), m + 2))
    into[n : n + m, :m] = np.eye(m)
    for column in (m, m + 1):
        into[:n, column] = plant.b[:, 0] * model.d[0, 0]
        into[n + m : n + m + k, column] = model.b[:, 0]
        into[-1, column] = model.d[0, 0]
    drive = np.zeros((m + 2, m + 2))
    drive[:m, :m], drive[:m, m], drive[m, :m] = known.q, known.s, known.s
    drive[m, m], drive[-1, -1] = known.r, noise**2
    assert np.abs(np.linalg.eigvals(whole)).max() < 1
    states = solve_discrete_lyapunov(whole, into @ drive @ into.T)
    change = command - np.eye(len(whole))[-1]
    moved = model.d[0, 0] ** 2 * (known.r + noise**2)
    return row @ states @ row + known.r + effort * (change @ states @ change + moved)


@pytest.mark.parametrize("latency", [0, 1, 2])
def test_without_effort_a_pure_delay_leaves_what_the_predictor_leaves(latency):
    known = sampled(LINES, T)
    found = cost(lqr(LINES, 1.0, 1e-9, RIGID, timing(latency)), RIGID, latency, 0.0)
    wanted = residual.residual(known, controllers.predictor(known, 1.0, latency + 1), 1.0)
    assert np.sqrt(found + known.within) == pytest.approx(wanted, rel=1e-6)


@pytest.mark.parametrize("dynamics", [first_order(40.0), second_order(60.0, 0.7)])
@pytest.mark.parametrize("latency", [0.0, 0.6, 1.0])
def test_a_slow_actuator_is_made_up_for(dynamics, latency):
    ours = lqr(LINES, 1.0, 1e-3, dynamics, timing(latency))
    other = lqg(LINES, 1.0, dynamics, timing(latency))
    assert cost(ours, dynamics, latency, 0.0) < 0.9 * cost(other, dynamics, latency, 0.0)


@pytest.mark.parametrize(("dynamics", "latency"), [(first_order(40.0), 0.6), (second_order(60.0, 0.3), 1.0)])
def test_no_controller_near_it_costs_less(dynamics, latency):
    effort = 0.05
    best = lqr(LINES, 1.0, effort, dynamics, timing(latency))
    least = cost(best, dynamics, latency, effort)
    random = np.random.default_rng(1)
    grown = []
    for _ in range(30):
        known = best.a, best.b, best.c, best.d
        parts = [part * (1 + 1e-3 * random.standard_normal(part.shape)) for part in known]
        grown.append(cost(LinearModel(*parts, T), dynamics, latency, effort) / least - 1)
    assert min(grown) > -1e-12
    assert max(grown) > 1e-6


def test_less_effort_leaves_less():
    left = [
        cost(lqr(LINES, 1.0, one, first_order(40.0), timing(1.0)), first_order(40.0), 1.0, 0.0)
        for one in (1, 0.1, 0.01)
    ]
    assert left[0] > left[1] > left[2]


def test_what_cannot_be_designed_is_said():
    with pytest.raises(UserError, match="averages over whole frames"):
        lqr(LINES, 1.0, 0.1, RIGID, timing(0.0, 0.5))
    with pytest.raises(UserError, match="needs a positive one"):
        lqr(LINES, 0.0, 0.1, RIGID, timing(0.0))
