import itertools
from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg
from hypothesis import given, settings
from hypothesis import strategies as st
from truss import model, oscillator, truss

from wavequake.errors import UserError
from wavequake.mechanics.vibration.drive import Drive, Harmonic, Impulse, ramped_sine, sampled, values
from wavequake.mechanics.vibration.modal import modal_model
from wavequake.mechanics.vibration.response import displacements, propagate, respond

FORCES = np.zeros(9, dtype=bool)
ALL = np.ones(9, dtype=bool)


def by_expm(model, samples, step):
    """States (q, q') at every instant by the exponential of the augmented matrix, step by step."""
    n, p = model.inputs.shape
    system = np.zeros((2 * n + 2 * p, 2 * n + 2 * p))
    inverse = np.linalg.inv(model.mass)
    system[:n, n : 2 * n] = np.eye(n)
    system[n : 2 * n, :n] = -inverse @ model.stiffness
    system[n : 2 * n, n : 2 * n] = -inverse @ model.damping_matrix
    system[n : 2 * n, 2 * n : 2 * n + p] = inverse @ model.inputs
    system[2 * n : 2 * n + p, 2 * n + p :] = np.eye(p) / step
    power = scipy.linalg.expm(system * step)
    state, states = np.zeros(2 * n), [np.zeros(2 * n)]
    for before, after in itertools.pairwise(samples):
        state = power[: 2 * n] @ np.concatenate([state, before, after - before])
        states.append(state)
    return np.array(states)


def newmark(model, samples, step):
    """Average acceleration, the implicit integrator of finite-element programs; displacements (t, n)."""
    effective = model.mass + 0.5 * step * model.damping_matrix + 0.25 * step**2 * model.stiffness
    force = samples @ model.inputs.T
    q = v = np.zeros(len(model.mass))
    a = np.linalg.solve(model.mass, force[0])
    found = [q]
    for f in force[1:]:
        q_star, v_star = q + step * v + 0.25 * step**2 * a, v + 0.5 * step * a
        a = np.linalg.solve(effective, f - model.damping_matrix @ v_star - model.stiffness @ q_star)
        q, v = q_star + 0.25 * step**2 * a, v_star + 0.5 * step * a
        found.append(q)
    return np.array(found)


def one(omega, start=0.0, cosine=0.0, sine=1.0):
    return Drive(np.zeros(1, dtype=bool), (Harmonic(omega, start, np.array([cosine]), np.array([sine])),))


def close(found, expected, tolerance):
    np.testing.assert_allclose(found, expected, rtol=0, atol=tolerance * np.abs(expected).max())


@pytest.mark.parametrize("ratio", [0.0, 0.02, 0.7, 1.0, 3.0])
def test_sine_from_rest_matches_the_closed_form(ratio):
    natural, omega, time = 40.0, 55.0, np.linspace(0, 1.3, 500)
    modal = modal_model(oscillator(natural, ratio))
    found = respond(modal, [one(omega)], time)
    steady = 1 / (natural**2 - omega**2 + 2j * ratio * natural * omega)
    x0, v0 = -steady.imag, -(1j * omega * steady).imag
    roots = np.roots([1, 2 * ratio * natural, natural**2]).astype(complex)
    if ratio == 1.0:
        decay = np.exp(-natural * time) * (x0 + (v0 + natural * x0) * time)
    else:
        c = np.linalg.solve(np.array([[1, 1], roots]), [x0, v0])
        decay = (np.exp(np.outer(time, roots)) @ c).real
    close(found.coordinates[0, :, 0], (steady * np.exp(1j * omega * time)).imag + decay, 1e-12)


def test_resonance_without_damping_grows_linearly():
    omega, time = 31.0, np.linspace(0, 4, 800)
    found = respond(modal_model(oscillator(omega, 0.0)), [one(omega)], time)
    expected = (np.sin(omega * time) - omega * time * np.cos(omega * time)) / (2 * omega**2)
    close(found.coordinates[0, :, 0], expected, 1e-12)


def test_free_mass_follows_the_integrals_of_its_force():
    omega, time = 7.0, np.linspace(0, 3, 301)
    found = respond(modal_model(oscillator(0.0, 0.0)), [one(omega)], time)
    assert found.coordinates.shape[2] == 0
    close(found.rigid[0, :, 0], time / omega - np.sin(omega * time) / omega**2, 1e-12)


def test_impulse_is_a_jump_of_velocity():
    natural, ratio, at, time = 30.0, 0.1, 0.123456, np.linspace(0, 1, 400)
    drive = Drive(np.zeros(1, dtype=bool), impulses=(Impulse(at, np.array([2.0])),))
    found = respond(modal_model(oscillator(natural, ratio, mass=4.0)), [drive], time)
    damped, late = natural * np.sqrt(1 - ratio**2), np.maximum(time - at, 0)
    expected = 2.0 / (4.0 * damped) * np.exp(-ratio * natural * late) * np.sin(damped * late)
    close(displacements(found, np.eye(1))[0, :, 0], expected, 1e-12)


def test_harmonic_may_start_between_two_instants():
    natural, ratio, omega, start, time = 30.0, 0.05, 50.0, 0.101234, np.linspace(0, 1, 200)
    shifted = respond(modal_model(oscillator(natural, ratio)), [one(omega, start)], time)
    phase, after = omega * start, time > start
    for instant, value in zip(time[after][::20], shifted.coordinates[0, after, 0][::20], strict=True):
        drive = one(omega, 0.0, np.sin(phase), np.cos(phase))
        alone = respond(modal_model(oscillator(natural, ratio)), [drive], np.array([0, instant - start]))
        assert value == pytest.approx(alone.coordinates[0, -1, 0], rel=1e-10, abs=1e-14)
    assert (shifted.coordinates[0, ~after] == 0).all()


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    damping=st.sampled_from([0.0, 1e-6, 2e-4, 1e-2]),
    local=st.sampled_from([0.0, 300.0]),
    instants=st.sampled_from([2, 3, 50, 101]),
)
def test_sampled_input_matches_the_matrix_exponential(seed, damping, local, instants):
    """Free, under- and overdamped modes, with and without a damper that couples them all."""
    extra = np.zeros((18, 18))
    extra[:2, :2] = local * np.array([[1, -1], [-1, 1]])
    body = truss(damping=damping, extra=extra)
    random, time = np.random.default_rng(seed), 1e-3 * np.arange(instants)
    samples = random.standard_normal((instants, 9))
    found = respond(modal_model(body), [Drive(FORCES, samples=samples)], time)
    close(displacements(found, np.eye(18))[0], by_expm(body, samples, 1e-3)[:, :18], 1e-10)


def test_a_hundred_modes_over_two_thousand_steps_match_the_matrix_exponential():
    """A mirror's spectrum: 54 modes up to some 20 kHz, 6 of them free, 0.1 ms steps."""
    random = np.random.default_rng(3)
    squared = np.concatenate([np.zeros(6), (2 * np.pi * np.geomspace(100, 2e4, 102)) ** 2])
    body = model(np.eye(108), np.diag(5e-6 * squared), np.diag(squared), random.standard_normal((108, 9)))
    samples = random.standard_normal((2000, 9))
    found = respond(modal_model(body), [Drive(FORCES, samples=samples)], 1e-4 * np.arange(2000))
    expected = by_expm(body, samples, 1e-4)[:, :108]
    close(displacements(found, np.eye(108))[0], expected, 1e-10)
    elastic = displacements(replace(found, rigid=0 * found.rigid), np.eye(108))[0]
    close(elastic[:, 6:], expected[:, 6:], 1e-10)


def test_ramped_sine_is_the_sine_times_its_ramp():
    omega, ramp, time = 2 * np.pi * 100, 0.0123, np.linspace(0, 0.05, 700)
    drive = Drive(np.zeros(1, dtype=bool), ramped_sine(omega, np.array([3.0]), ramp))
    swing = np.sin(0.5 * np.pi * np.minimum(time / ramp, 1)) ** 2
    np.testing.assert_allclose(
        values(drive, time)[:, 0], 3 * swing * np.sin(omega * time), rtol=0, atol=1e-12
    )


@pytest.mark.parametrize("prescribed", [FORCES, ALL])
@pytest.mark.parametrize("ramp", [0.0, 0.0052, 0.004])
def test_harmonics_are_the_limit_of_their_samples(prescribed, ramp):
    """A first-order hold converges to the exact harmonic with order 2."""
    body = truss()
    modal = modal_model(body, prescribed)
    pattern = np.zeros(9)
    pattern[2::3] = 1.0
    drive = Drive(prescribed, ramped_sine(2 * np.pi * 100, pattern, ramp))
    errors = []
    for count in (201, 401, 801):
        time = np.linspace(0, 0.02, count)
        exact = displacements(respond(modal, [drive], time), body.surface)[0]
        held = displacements(respond(modal, [sampled(drive, time)], time), body.surface)[0]
        errors.append(np.abs(held - exact).max() / np.abs(exact).max())
    np.testing.assert_allclose(np.log2(np.array(errors[:-1]) / errors[1:]), 2.0, rtol=0, atol=0.1)
    assert errors[-1] < 1e-4


def test_newmark_converges_to_the_exact_response_with_order_two():
    body = truss(damping=2e-5)
    modal, errors = modal_model(body), []
    pattern = np.zeros(9)
    pattern[[2, 4, 6]] = [1.0, -0.5, 0.3]
    drive = Drive(FORCES, ramped_sine(2 * np.pi * 60, pattern, 0.005))
    for count in (801, 1601, 3201):
        time = np.linspace(0, 0.02, count)
        exact = displacements(respond(modal, [drive], time), np.eye(18))[0]
        approximate = newmark(body, values(drive, time), time[1])
        errors.append(np.abs(approximate - exact).max() / np.abs(exact).max())
    np.testing.assert_allclose(np.log2(np.array(errors[:-1]) / errors[1:]), 2.0, rtol=0, atol=0.1)


def test_energy_after_an_impulse_is_kept_without_damping_and_falls_with_it():
    time = np.linspace(0, 0.2, 500)
    momentum = np.random.default_rng(1).standard_normal(9)
    drive = Drive(FORCES, impulses=(Impulse(0.0, momentum),))
    for damping, kept in ((0.0, True), (1e-5, False)):
        body = truss(damping=damping)
        modal = modal_model(body)
        position, rate = propagate(modal, drive, time)
        energy = 0.5 * np.sum(rate**2 + modal.squared[:, None] * position**2, axis=0)
        whole = 0.5 * momentum @ body.inputs.T @ np.linalg.solve(body.mass, body.inputs @ momentum)
        assert energy[0] == pytest.approx(whole, rel=1e-12)
        if kept:
            np.testing.assert_allclose(energy, whole, rtol=1e-11)
        else:
            assert (np.diff(energy) < 0).all()


def test_undamped_modes_gain_no_energy_however_fast_they_are():
    """Each of 10,000 steps rounds: 1e-16 of the energy, also of modes that turn 4000 times per step."""
    body, drive = truss(damping=0.0), Drive(FORCES, impulses=(Impulse(0.0, np.linspace(-1.0, 2.0, 9)),))
    modal = modal_model(body)
    for factor in (1.0, 1e2, 1e4):
        fast = replace(modal, squared=factor**2 * modal.squared)
        position, rate = propagate(fast, drive, 1e-4 * np.arange(10_001))
        energy = rate**2 + fast.squared[:, None] * position**2
        np.testing.assert_allclose(energy[6:].sum(axis=0), energy[6:, 0].sum(), rtol=3e-12)


def test_free_body_gains_the_momentum_of_its_impulse():
    body = truss()
    drive = Drive(FORCES, impulses=(Impulse(0.0, np.tile([0.0, 0.0, 2.0], 3)),))
    time = np.linspace(0, 0.1, 300)
    found = displacements(respond(modal_model(body), [drive], time), np.eye(18))[0]
    weight = np.diag(body.mass)[2::3]
    np.testing.assert_allclose(found[:, 2::3] @ weight, 6.0 * time, rtol=1e-9, atol=1e-12)


def test_a_case_has_the_same_bits_alone_and_in_a_batch():
    body, time = truss(), 1e-4 * np.arange(300)
    modal, random = modal_model(body, ALL), np.random.default_rng(5)
    drives = [
        Drive(ALL, ramped_sine(2 * np.pi * f, random.standard_normal(9), ramp))
        for f, ramp in ((100.0, 0.0), (300.0, 0.003), (100.0, 0.01))
    ] + [Drive(ALL, samples=random.standard_normal((300, 9)))]
    together = displacements(respond(modal, drives, time), body.surface)
    for case, drive in enumerate(drives):
        assert (displacements(respond(modal, [drive], time), body.surface)[0] == together[case]).all()


def test_python_control_gives_the_same_response():
    control = pytest.importorskip("control")
    body = truss(damping=1e-4)
    samples = np.random.default_rng(2).standard_normal((200, 9))
    time = 1e-4 * np.arange(200)
    inverse = np.linalg.inv(body.mass)
    a = np.block(
        [[np.zeros((18, 18)), np.eye(18)], [-inverse @ body.stiffness, -inverse @ body.damping_matrix]]
    )
    b = np.vstack([np.zeros((18, 9)), inverse @ body.inputs])
    system = control.ss(a, b, np.eye(18, 36), np.zeros((18, 9)))
    other = control.forced_response(system, time, samples.T).outputs
    found = respond(modal_model(body), [Drive(FORCES, samples=samples)], time)
    close(displacements(found, np.eye(18))[0], other.T, 1e-9)


@pytest.mark.parametrize(
    ("time", "match"),
    [
        (np.array([0.0, 0.1, 0.3]), "evenly spaced"),
        (np.array([0.1, 0.2, 0.3]), "begin at 0"),
        (np.array([0.0, -0.1, -0.2]), "positive"),
        (np.zeros(3), "positive"),
        (np.zeros(1), "two finite"),
        (np.array([0.0, np.nan]), "two finite"),
    ],
)
def test_bad_instants_are_refused(time, match):
    with pytest.raises(UserError, match=match):
        respond(modal_model(oscillator(1.0, 0.0)), [one(1.0)], time)


def test_bad_drives_are_refused():
    modal, time = modal_model(truss(), ALL), np.linspace(0, 1, 10)
    zero = np.zeros(9)
    bad = {
        "prescribes other": Drive(FORCES),
        "do not fit": Drive(ALL, samples=np.zeros((9, 9))),
        "not finite": Drive(ALL, samples=np.full((10, 9), np.inf)),
        "frequency": Drive(ALL, (Harmonic(-1.0, 0.0, zero, zero),)),
        "instant": Drive(ALL, impulses=(Impulse(-1.0, zero),)),
        "is a force": Drive(ALL, impulses=(Impulse(0.0, zero + 1.0),)),
    }
    for match, drive in bad.items():
        with pytest.raises(UserError, match=match):
            respond(modal, [drive], time)
    with pytest.raises(UserError, match="at least one drive"):
        respond(modal, [], time)


def test_a_sinusoid_above_half_the_sampling_frequency_is_not_sampled():
    with pytest.raises(UserError, match=r"cannot be sampled every 0\.01 s"):
        sampled(one(2 * np.pi * 51), np.linspace(0, 1, 101))
