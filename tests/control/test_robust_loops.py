"""Loops of a large plant with the controller of a small model: closed forms, Routh, peers, dense models."""

import warnings
from itertools import pairwise

import numpy as np
import pytest
import scipy.linalg
import scipy.signal
from scipy.integrate import quad
from scipy.special import comb, factorial

from wavequake.control.linear import LinearModel, linear_model
from wavequake.control.robustness.feedback import Loop, closed_matrix, closed_poles, lqg, refined_pole
from wavequake.control.robustness.margins import grid, margins, truncation_share
from wavequake.control.robustness.plant import (
    Plant,
    Truncated,
    in_units,
    linear,
    transfer,
    truncation_bound,
    whole_plant,
)
from wavequake.control.robustness.residual import (
    closed_covariance,
    closed_spectra,
    open_covariance,
    open_spectrum,
    shown_forces,
)
from wavequake.errors import UserError

ALPHA, BETA = 0.02, 2e-3


def chain(count=24, sensors=(5, 17), forces=(0, 11)):
    """A chain of masses between springs, one end at the wall: mass, damping, stiffness, inputs, outputs."""
    stiffness = 4.0 * (2 * np.eye(count) - np.eye(count, k=1) - np.eye(count, k=-1))
    stiffness[-1, -1] = 4.0
    mass = np.diag(1 + 0.3 * np.sin(np.arange(count)))
    unit = np.eye(count)
    return mass, ALPHA * mass + BETA * stiffness, stiffness, unit[:, list(forces)], unit[list(sensors)]


def modal(kept=None, **which):
    """The chain as a plant of some of its modes, with the flexibility of the others."""
    mass, _, stiffness, inputs, outputs = chain(**which)
    squared, shapes = scipy.linalg.eigh(stiffness, mass)
    b, c, rates = shapes.T @ inputs, outputs @ shapes, ALPHA + BETA * squared
    kept = len(squared) if kept is None else kept
    far = slice(kept, None)
    sizes = [
        np.linalg.eigvalsh((part / squared[far, None]).T @ part).max(initial=0.0)
        for part in (b[far], c.T[far])
    ]
    truncated = Truncated(squared[kept - 1], ALPHA, BETA, float(np.sqrt(sizes[0] * sizes[1])))
    static = (c[:, far] / squared[far]) @ b[far]
    return Plant(squared[:kept], rates[:kept], b[:kept], c[:, :kept], static, truncated)


def dense_response(s, **which):
    mass, damping, stiffness, inputs, outputs = chain(**which)
    return outputs @ np.linalg.solve(s * s * mass + s * damping + stiffness, inputs.astype(complex))


def first_modes(plant, count):
    return whole_plant(
        plant.squared[:count], plant.rates[:count], plant.inputs[:count], plant.outputs[:, :count]
    )


def test_truncation_bound_holds_wherever_nothing_grows_and_is_sharp_for_one_mode():
    rng = np.random.default_rng(3)
    s = np.concatenate(
        [1j * np.geomspace(1e-2, 60, 300), rng.uniform(0, 20, 200) + 1j * rng.uniform(-20, 20, 200)]
    )
    for kept in (4, 12, 23):
        plant = modal(kept)
        exact = np.array([dense_response(one) for one in s])
        off = np.linalg.norm(exact - transfer(plant, s), 2, axis=(1, 2))
        bound = truncation_bound(plant, s)
        assert (off <= bound * (1 + 1e-9) + 1e-14).all()
    # One truncated mode, said to begin where it is: below it the bound is the error.
    plant = modal(23, sensors=(5,), forces=(0,))
    last = scipy.linalg.eigh(*chain()[2::-2], eigvals_only=True)[-1]
    plant = Plant(*(getattr(plant, name) for name in ("squared", "rates", "inputs", "outputs", "static")),
                  Truncated(last, ALPHA, BETA, plant.truncated.flexibility))  # fmt: skip
    low = 1j * np.array([0.1, 0.5, 1.0])
    off = [
        abs(dense_response(one, sensors=(5,), forces=(0,)) - transfer(plant, np.array([one]))[0])[0, 0]
        for one in low
    ]
    np.testing.assert_allclose(truncation_bound(plant, low), off, rtol=1e-6, atol=1e-12)


def test_units_change_no_physics():
    plant = modal(10)
    other = in_units(plant, 0.1, 5.0, 1e-3)
    s = np.array([0.3j, 2 + 1j])
    np.testing.assert_allclose(transfer(other, s * 0.1), transfer(plant, s) * 5 / 1e-3, rtol=1e-12)
    np.testing.assert_allclose(
        truncation_bound(other, s * 0.1), truncation_bound(plant, s) * 5 / 1e-3, rtol=1e-9
    )


@pytest.mark.parametrize(("kappa", "limit"), [(1.0, 0.1000), (0.1, 1.0092), (0.02, 8.564)])
def test_one_mode_and_an_integrator_become_unstable_where_routh_says(kappa, limit):
    """(2 zeta w + c (1 - kappa)) (w^2 + 2 zeta w c (1 - kappa)) > c w^2 with the crossover c (Routh)."""
    omega, zeta = 2 * np.pi * 10, 0.005
    plant = Plant(*(np.array([one]) for one in (omega**2, 2 * zeta * omega)), np.array([[kappa * omega**2]]),
                  np.array([[1.0]]), np.array([[1.0 - kappa]]))  # fmt: skip
    d, rest = 2 * zeta * omega, 1 - kappa
    roots = np.roots([d * rest**2, rest * omega**2 + rest * d**2 - omega**2, d * omega**2]) if rest else [d]
    crossover = float(min(one.real for one in np.atleast_1d(roots) if one.real > 0))
    assert crossover / 2 / np.pi == pytest.approx(limit, rel=5e-4)
    for share in (0.999, 1.001):
        loop = Loop(plant, linear_model([[0.0]], [[1.0]], [[share * crossover]]))
        assert (closed_poles(loop)[0].real >= 0).sum() == (0 if share < 1 else 2)
    loop = Loop(plant, linear_model([[0.0]], [[1.0]], [[0.5 * crossover]]))
    found = margins(loop, grid(loop, closed_poles(loop)[0]))
    assert found.gain_up == pytest.approx(2.0, rel=1e-7)
    assert found.gain_down == 0.0


def sign_changes(polynomial):
    """How many roots grow, by the first column of Routh's array."""
    rows = [list(polynomial[::2]), list(polynomial[1::2])]
    rows[1] += [0.0] * (len(rows[0]) - len(rows[1]))
    while len(rows) < len(polynomial):
        above, below = rows[-2], rows[-1]
        factor = above[0] / below[0]
        rows.append([above[k + 1] - factor * below[k + 1] for k in range(len(below) - 1)] + [0.0])
    signs = np.sign([row[0] for row in rows])
    return int((signs[1:] != signs[:-1]).sum())


def test_a_second_mode_that_the_model_lacks_spills_over_as_routh_says():
    """Two masses, the force acts on that at the wall, the sensor sees the other; residues of two signs."""
    wall, between, damping = 1.0, 2.0, 4e-3
    stiffness = np.array([[wall + between, -between], [-between, between]])
    squared, shapes = np.linalg.eigh(stiffness)
    plant = whole_plant(squared, damping * squared, shapes.T @ [[1.0], [0.0]], [[0.0, 1.0]] @ shapes)
    spring, own, far = ([damping * one, one] for one in (between, wall + between, between))
    bottom = np.polysub(np.polymul([1, *own], [1, *far]), np.polymul(spring, spring))
    counts = []
    for effort in (1.0, 0.1, 1e-2, 1e-3):
        controller = lqg(first_modes(plant, 1), effort, effort)
        up, down = scipy.signal.ss2tf(controller.a, controller.b, controller.c, controller.d)
        wanted = sign_changes(np.polyadd(np.polymul(bottom, down), np.polymul(spring, up[0])))
        poles, worst = closed_poles(Loop(plant, controller))
        assert (poles.real > 0).sum() == wanted
        if wanted:
            assert worst.mode == 1  # the second one, from 0
            assert worst.value.imag == pytest.approx(np.sqrt(squared[1]), rel=0.2)
            assert worst.share > 0.5
        counts.append(wanted)
    assert counts[0] == 0
    assert counts[-1] == 2
    # Its own model promises stability at any effort.
    own_loop = Loop(first_modes(plant, 1), controller)
    assert (closed_poles(own_loop)[0].real < 0).all()


@pytest.mark.filterwarnings("ignore::DeprecationWarning:control")  # the peer's own, of NumPy 2.5
@pytest.mark.parametrize("effort", [0.2, 0.08])
def test_margins_of_one_channel_are_those_of_python_control(effort):
    control = pytest.importorskip("control", reason="needs python-control: pip install control")
    # Small enough for the polynomials in which the peer looks for crossings.
    plant = modal(count=4, sensors=(2,), forces=(0,))
    controller = lqg(first_modes(plant, 2), effort, effort)
    loop = Loop(plant, controller)
    poles, _ = closed_poles(loop)
    peer = control.ss(*(getattr(linear(plant), name) for name in "abcd")) * control.ss(
        controller.a, controller.b, controller.c, controller.d
    )
    theirs = control.poles(control.feedback(peer, 1))
    np.testing.assert_allclose(np.sort(poles.real), np.sort(theirs.real), atol=1e-9)
    assert (poles.real < 0).all()
    found = margins(loop, grid(loop, poles))
    gains, phases, *_ = control.stability_margins(peer, returnall=True)
    gains, phases = np.asarray(gains), np.asarray(phases)
    assert found.gain_up == pytest.approx(gains[gains > 1].min(), rel=1e-6)
    assert np.degrees(found.phase) == pytest.approx(np.abs(phases).min(), rel=1e-6)


def loop_of_two(effort=0.1, kept=8):
    plant = modal()
    return Loop(plant, lqg(first_modes(plant, kept), effort, effort))


def sensitivity_model(loop):
    """State space of (I + G H)^-1 from its definition, e = d - G H e."""
    plant, own = linear(loop.plant), loop.controller
    count = len(plant.c)
    return LinearModel(
        closed_matrix(loop),
        np.vstack([np.zeros((len(plant.a), count)), own.b]),
        np.hstack([plant.c, -plant.d @ own.c]),
        np.eye(count),
    )


@pytest.mark.parametrize(("effort", "kept"), [(1.0, 8), (0.1, 14)])
def test_sensitivity_peak_is_the_norm_by_hamiltonians(effort, kept):
    """A level is reached at a frequency if and only if a Hamiltonian has an imaginary eigenvalue (Boyd)."""
    loop = loop_of_two(effort, kept)
    poles, _ = closed_poles(loop)
    assert (poles.real < 0).all()
    peak = margins(loop, grid(loop, poles)).peak
    s = sensitivity_model(loop)

    def reached(gamma):
        r = s.d.T @ s.d - gamma**2 * np.eye(2)
        inner = s.a - s.b @ np.linalg.solve(r, s.d.T @ s.c)
        corner = -s.b @ np.linalg.solve(r, s.b.T)
        left = -s.c.T @ (np.eye(2) - s.d @ np.linalg.solve(r, s.d.T)) @ s.c
        values = np.linalg.eigvals(np.block([[inner, corner], [left, -inner.T]]))
        return bool((np.abs(values.real) < 1e-7 * np.abs(values)).any())

    assert reached(peak * (1 - 1e-5))
    assert not reached(peak * (1 + 1e-5))


def test_sensitivity_peak_is_that_of_slycot():
    control = pytest.importorskip("control", reason="needs python-control: pip install control")
    pytest.importorskip("slycot", reason="needs slycot: pip install slycot")
    loop = loop_of_two(0.1, 14)
    found = margins(loop, grid(loop, closed_poles(loop)[0]))
    s = sensitivity_model(loop)
    norm, omega = control.linfnorm(control.ss(s.a, s.b, s.c, s.d), tol=1e-10)
    assert found.peak == pytest.approx(norm, rel=1e-8)
    assert found.peak_omega == pytest.approx(omega, rel=1e-4)


def test_gain_and_delay_of_all_channels_are_where_poles_cross():
    loop = loop_of_two(0.1, 14)
    found = margins(loop, grid(loop, closed_poles(loop)[0]))
    own = loop.controller

    def growth(factor):
        changed = LinearModel(own.a, own.b, factor * own.c, own.d)
        return closed_poles(Loop(loop.plant, changed))[1].value.real

    assert growth(found.gain_up * (1 - 1e-6)) < 0 < growth(found.gain_up * (1 + 1e-6))
    factors = np.geomspace(1e-3, found.gain_up * 0.999, 60)
    assert max(growth(one) for one in factors[factors > found.gain_down * 1.001]) < 0
    # The delay as an all-pass of high order in every channel: the Padé approximant [4/4] of exp(-s delay).
    order = np.arange(4, -1, -1)
    terms = comb(4, order) * factorial(8 - order) / factorial(8)
    top, bottom = (np.poly1d(terms * (sign * found.delay) ** order) for sign in (-1.0, 1.0))
    for share in (0.98, 1.02):
        scaled = [np.poly1d(one.c * share ** np.arange(one.order, -1, -1)) for one in (top, bottom)]
        late = LinearModel(*scipy.signal.tf2ss(scaled[0].c, scaled[1].c))
        a, b, c, d = (np.kron(np.eye(2), one) for one in (late.a, late.b, late.c, late.d))
        joint = LinearModel(
            np.block([[own.a, np.zeros((len(own.a), len(a)))], [b @ own.c, a]]),
            np.vstack([own.b, np.zeros((len(a), 2))]),
            np.hstack([d @ own.c, c]),
            np.zeros((2, 2)),
        )
        assert (closed_poles(Loop(loop.plant, joint))[1].value.real > 0) == (share > 1)


def test_poles_of_a_truncated_plant_are_counted_by_its_certificate_and_refined_by_the_exact_response():
    agreed = set()
    for effort in (1.0, 0.13, 0.11):
        whole = modal()
        controller = lqg(first_modes(whole, 5), effort, effort)
        exact, _ = closed_poles(Loop(whole, controller))
        for kept in (6, 10, 16, 20, 23):
            loop = Loop(modal(kept), controller)
            poles, worst = closed_poles(loop)
            if truncation_share(loop, grid(loop, poles)) < 1:
                assert (poles.real >= 0).sum() == (exact.real >= 0).sum()
                agreed.add((effort, kept, int((exact.real >= 0).sum())))
        if worst.value.real > 0:

            def response(s):
                step = 1e-5
                slope = (dense_response(s + step) - dense_response(s - step)) / (2 * step)
                return dense_response(s), slope

            found = refined_pole(worst.value, response, controller)
            assert np.abs(exact - found).min() < 1e-9 * abs(found)
    assert len(agreed) >= 4
    assert {unstable for _, _, unstable in agreed} == {0, 2, 4}


def test_certificate_is_above_1_where_a_mode_that_is_left_out_grows():
    plant = modal(sensors=(5,), forces=(0,))
    controller = lqg(first_modes(plant, 3), 1e-3, 1e-3)
    cut = Loop(modal(3, sensors=(5,), forces=(0,)), controller)
    poles, _ = closed_poles(cut)
    assert (closed_poles(Loop(plant, controller))[0].real >= 0).sum() != (poles.real >= 0).sum()
    assert truncation_share(cut, grid(cut, poles)) > 1


def test_what_is_left_is_the_integral_over_frequency():
    loop, noise = loop_of_two(1.0, 8), 1.0
    covariance, forces = closed_covariance(loop, noise)
    shape = np.random.default_rng(1).normal(size=len(loop.plant.squared))
    plant, own = loop.plant, loop.controller

    def density(omega, what):
        s = 1j * omega
        moved = plant.inputs / (plant.squared + s * (plant.rates + s))[:, None]
        g = plant.outputs @ moved
        h = own.c @ np.linalg.solve(s * np.eye(len(own.a)) - own.a, own.b)
        answer = np.linalg.inv(np.eye(2) + h @ g)  # of forces at the inputs
        if what == "shape":
            rows = shape @ moved @ np.hstack([answer, -answer @ h * np.sqrt(noise)])
            return float(np.sum(np.abs(rows) ** 2))
        return float(np.sum(np.abs(answer @ h @ np.hstack([g, np.sqrt(noise) * np.eye(2)])) ** 2))

    edges = np.concatenate([[0.0], np.sort(np.abs(closed_poles(loop)[0].imag)), [20.0, 200.0, 5e3, np.inf]])
    edges = np.unique(np.round(edges, 6))
    for what, exact in (("shape", shape @ covariance @ shape), ("force", np.trace(forces))):
        total = sum(quad(density, *ends, args=(what,), epsrel=1e-9, limit=200)[0] for ends in pairwise(edges))
        assert total / np.pi == pytest.approx(exact, rel=1e-5)


def test_spectra_of_a_form_add_up_to_its_covariance():
    loop, noise = loop_of_two(1.0, 8), 0.7
    count = len(loop.plant.squared)
    shape = np.random.default_rng(1).normal(size=(count, count))
    gram = shape @ shape.T
    omega = grid(loop, closed_poles(loop)[0])
    omega = np.unique(np.concatenate([omega, (omega[1:] + omega[:-1]) / 2]))
    forces = shown_forces(loop.plant, gram, omega)
    for spectrum, exact in (
        (sum(closed_spectra(loop, forces, noise, omega)), np.sum(gram * closed_covariance(loop, noise)[0])),
        (closed_spectra(loop, forces, noise, omega)[0], np.sum(gram * closed_covariance(loop, 1e-30)[0])),
        (open_spectrum(forces), np.sum(gram * open_covariance(loop.plant))),
    ):
        assert np.trapezoid(spectrum, omega / (2 * np.pi)) == pytest.approx(exact, rel=5e-4)


def test_without_a_controller_the_closed_form_is_lyapunovs():
    plant = modal(9)
    model = linear(plant)
    whole = scipy.linalg.solve_continuous_lyapunov(model.a, -model.b @ model.b.T)
    np.testing.assert_allclose(open_covariance(plant), whole[:9, :9], rtol=1e-8, atol=1e-10)


def test_designs_that_cannot_be_made_say_why():
    plant = first_modes(modal(), 4)
    with pytest.raises(UserError, match=r"The effort of a controller is -1.0; it must be positive"):
        lqg(plant, -1.0, 1.0)
    with pytest.raises(UserError, match=r"The noise of a controller is 0.0"):
        lqg(plant, 1.0, 0.0)
    blind = whole_plant(plant.squared, plant.rates, plant.inputs, 0 * plant.outputs)
    with pytest.raises(UserError, match=r"No sensor sees any mode of the model"):
        lqg(blind, 1.0, 1.0)
    # A free mode that no force drives never comes to rest.
    free = whole_plant(
        np.array([0.0, 4.0]), np.array([0.0, 0.1]), np.array([[0.0], [1.0]]), np.array([[1.0, 1.0]])
    )
    with pytest.raises(UserError, match=r"(Riccati|does not drive)"):
        lqg(free, 1.0, 1.0)
    loop = loop_of_two()
    with pytest.raises(UserError, match=r"No pole of the full model was found near"):
        refined_pole(1e3 + 0j, lambda s: (np.zeros((2, 2)), np.zeros((2, 2))), loop.controller)


def test_a_refinement_that_runs_away_ends_in_a_sentence_and_without_warnings():
    """1 + 1e-300 / (s (s + 1)) is so flat that the first step leads beyond all numbers."""
    flat = linear_model([[-1.0]], [[1.0]], [[1e-300]])

    def plant(s):
        assert np.isfinite(s)
        return np.array([[1 / s]]), np.array([[-1 / s**2]])

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(UserError, match="No pole of the full model was found near"):
            refined_pole(1.0 + 1j, plant, flat)
