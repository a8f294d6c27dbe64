"""Gains of well-posed problems in SI units, whose numbers spread over tens of orders of magnitude."""

import warnings

import numpy as np
import pytest
import scipy.linalg

from wavequake.control.gains import (
    kalman_bucy_gain,
    kalman_gain,
    placed_observer,
    placed_regulator,
    regulator_gain,
)
from wavequake.control.linear import linear_model, zero_order_hold
from wavequake.errors import UserError
from wavequake.mechanics.mirrors.models import circular_mirror
from wavequake.reduction.reduce import reduce

# Frequencies from a rigid motion to 160 kHz, drives and weights of some units: decoupled, so in closed form.
OMEGA = np.array([0.0, 3.0, 2e2, 4e4, 1e6])
DRIVE = np.array([1e-3, 40.0, 1e-5, 2.0, 7e4])
WEIGHT = np.array([1e4, 1e-6, 1e16, 1e9, 1e3])
COST = np.array([1e-8, 1e-4, 1e2, 1e-12, 1e-3])


def oscillators(omega, drive):
    count = len(omega)
    a = np.zeros((2 * count, 2 * count))
    a[:count, count:], a[count:, :count] = np.eye(count), -np.diag(omega**2)
    b = np.vstack([np.zeros((count, count)), np.diag(drive)])
    return linear_model(a, b, np.hstack([np.eye(count), np.zeros((count, count))]))


@pytest.fixture(scope="module", params=["craigb18", "rubin18"])
def mirror(request):
    """The free mirror: nine forces, nine displacements."""
    body = reduce(circular_mirror(), request.param)
    zeros, count = np.zeros((body.order, body.order)), body.order
    a = np.block([[zeros, np.eye(count)], [-body.stiffness, -body.damping_matrix]])
    inputs = np.vstack([np.zeros((count, 9)), body.inputs])
    return body.name, linear_model(a, inputs, np.hstack([body.inputs.T, np.zeros((9, count))]))


@pytest.fixture(autouse=True)
def no_warnings():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


def test_decoupled_oscillators_are_regulated_as_closed_forms_say():
    """(p^2 + w^2)^2 + q b^2 / r has the stable factor p^2 + k2 b p + w^2 + k1 b."""
    gain = regulator_gain(oscillators(OMEGA, DRIVE), np.append(WEIGHT, np.zeros(5)), COST)
    added = WEIGHT * DRIVE**2 / COST
    stiffer = added / (np.sqrt(OMEGA**4 + added) + OMEGA**2)
    np.testing.assert_allclose(np.diag(gain[:, :5]), stiffer / DRIVE, rtol=1e-8)
    np.testing.assert_allclose(np.diag(gain[:, 5:]), np.sqrt(2.0 * stiffer) / DRIVE, rtol=1e-8)


def test_decoupled_random_walks_are_filtered_as_closed_forms_say():
    """P = M + q and M = P r / (P + r) give the gain P / (P + r)."""
    noise, error = np.array([1e-20, 1e-9, 3.0, 1e8]), np.array([1e-22, 1e-3, 1e-12, 1e14])
    sizes = np.array([1e-9, 1e3, 1.0, 1e-4])
    gain = kalman_gain(np.eye(4), np.diag(sizes), noise, error)
    q, r = noise * sizes**2, error
    ahead = (q + np.sqrt(q**2 + 4.0 * q * r)) / 2.0
    np.testing.assert_allclose(np.diag(gain), ahead / (ahead + r) / sizes, rtol=1e-8)


@pytest.mark.parametrize("cost", [1e-6, 1e-10, 1e-12, 1e-14])
def test_a_free_mirror_is_regulated_alike_in_all_units(mirror, cost):
    """Micrometers, periods and millinewtons instead of meters and newtons; two slowest poles are known."""
    name, model = mirror
    gain = regulator_gain(model, model.c.T @ model.c, cost)
    units = np.repeat([1e-6, 1e-6 * 630.0], model.a.shape[0] // 2)
    own = linear_model(
        model.a * units / units[:, None], model.b * 1e-3 / units[:, None], model.c * units / 1e-6
    )
    again = regulator_gain(own, own.c.T @ own.c, cost * 1e-6 / 1e-12) * 1e-3 / units
    np.testing.assert_allclose(again, gain, rtol=0, atol=1e-7 * np.abs(gain).max())
    poles = np.linalg.eigvals(model.a - model.b @ gain)
    slowest = {("craigb18", 1e-10): -3.752, ("rubin18", 1e-12): -23.26}.get((name, cost))
    if slowest:
        assert poles.real.max() == pytest.approx(slowest, rel=2e-4)
    assert poles.real.max() < 0.0


def test_a_free_mirror_is_filtered_in_si(mirror):
    """The filter is the regulator of the transposed model; the sampled one tends to it with small steps."""
    _, model = mirror
    gain = kalman_bucy_gain(model, 1e-2, 1e-14, model.b)
    turned = linear_model(model.a.T, model.c.T, model.b.T)
    dual = regulator_gain(turned, 1e-2 * model.b @ model.b.T, 1e-14).T
    np.testing.assert_allclose(gain, dual, rtol=0, atol=1e-9 * np.abs(dual).max())
    step = 1e-7
    sampled = zero_order_hold(model, step)
    found = kalman_gain(sampled.a, model.c, step * 1e-2 * model.b @ model.b.T, 1e-14 / step) / step
    np.testing.assert_allclose(found, gain, rtol=0, atol=1e-2 * np.abs(gain).max())


def test_poles_are_placed_to_a_millionth():
    open_loop = np.linalg.eigvals(oscillators(OMEGA[1:4], DRIVE[1:4]).a)
    wanted = np.sort_complex(open_loop - 0.1 * np.abs(open_loop))
    plant = oscillators(OMEGA[1:4], DRIVE[1:4])
    for closed in (
        plant.a - plant.b @ placed_regulator(plant, wanted),
        plant.a - placed_observer(plant, wanted) @ plant.c,
    ):
        np.testing.assert_allclose(np.sort_complex(np.linalg.eigvals(closed)), wanted, rtol=1e-6)


def test_poles_that_rounding_cannot_place_are_refused():
    one = oscillators(np.linspace(10.0, 12.0, 9), np.ones(9))
    single = linear_model(one.a, one.b.sum(axis=1, keepdims=True), one.c)
    with pytest.raises(UserError, match=r"cannot be placed: rounding leaves them off by"):
        placed_regulator(single, -np.linspace(1e3, 1e4, 18))


def test_weights_are_symmetric_but_for_rounding():
    model = oscillators(OMEGA[1:3], DRIVE[1:3])
    rows = np.random.default_rng(5).normal(size=(6, 4)) * [1e9, 1.0, 1e-3, 1e4]
    weight = rows.T @ rows
    rounded = weight * (1.0 + 1e-14 * np.triu(np.random.default_rng(6).normal(size=(4, 4))))
    wanted = regulator_gain(model, weight, 1.0)
    np.testing.assert_allclose(regulator_gain(model, rounded, 1.0), wanted, rtol=1e-6, atol=0)
    with pytest.raises(UserError, match="symmetric"):
        regulator_gain(model, 1e-12 * (np.eye(4) + np.eye(4, k=1)), 1.0)
    with pytest.raises(UserError, match="R must be positive definite"):
        regulator_gain(model, 1.0, 1e-30 * np.ones((2, 2)))


def test_a_mode_that_neither_decays_nor_is_weighted_is_named():
    # Undamped modes of 3 and 200 rad/s; the second costs nothing, and noise does not shake it.
    model = oscillators(np.array([3.0, 200.0]), np.ones(2))
    q = np.diag([1.0, 0.0, 1.0, 0.0])
    with pytest.raises(
        UserError, match=r"mode 2 \(200 rad/s, 31\.8 Hz\) neither decays nor is weighted; give"
    ):
        regulator_gain(model, q, 1.0)
    with pytest.raises(UserError, match=r"mode 2 \(200 rad/s, 31\.8 Hz\) neither decays nor is shaken; give"):
        kalman_bucy_gain(model, q, 1.0)


def test_a_sampled_mode_that_is_not_seen_is_named_by_its_turns():
    # Two that turn by 0.1 and 0.3 of a turn per sample and never decay; the measurement sees the first alone.
    turns = 2 * np.pi * np.array([0.1, 0.3])
    a = scipy.linalg.block_diag(*([[np.cos(w), np.sin(w)], [-np.sin(w), np.cos(w)]] for w in turns))
    with pytest.raises(
        UserError, match=r"does not see the mode of 0\.3 turns per sample \(eigenvalue of size 1\)"
    ):
        kalman_gain(a, np.array([[1.0, 0.0, 0.0, 0.0]]), 1.0, 1.0)
