import numpy as np
import pytest
import scipy.integrate
import scipy.linalg
from hypothesis import given
from hypothesis import strategies as st

from wavequake.errors import UserError
from wavequake.mechanics.model import RayleighDamping
from wavequake.reduction.methods.balanced import oscillators, position_gramian
from wavequake.reduction.metrics import receptance
from wavequake.reduction.names import Variant
from wavequake.reduction.reduce import reduce
from wavequake.reduction.structure import structure


def lyapunov(squared, dampings, inputs):
    """Controllability Gramian of the first-order form, position block."""
    count = len(squared)
    state = np.block([[np.zeros((count, count)), np.eye(count)], [-np.diag(squared), -np.diag(dampings)]])
    drive = np.vstack([np.zeros_like(inputs), inputs])
    return scipy.linalg.solve_continuous_lyapunov(state, -drive @ drive.T)[:count, :count]


def quadrature(squared, dampings, inputs, low, high):
    def integrand(frequency):
        omega = 2 * np.pi * frequency
        states = inputs / (squared - omega**2 + 1j * omega * dampings)[:, None]
        # The mirror image doubles the real part; d omega / 2 pi = d frequency.
        return 2 * (states @ states.conj().T).real

    return scipy.integrate.quad_vec(integrand, low, high, epsrel=1e-10, limit=2000)[0]


@st.composite
def systems(draw):
    count = draw(st.integers(1, 5))
    random = np.random.default_rng(draw(st.integers(0, 10**6)))
    omega = np.sort(2 * np.pi * random.uniform(1.0, 10.0, count))
    # From light to above critical damping.
    return omega**2, omega * random.uniform(0.02, 3.0, count), random.normal(size=(count, 2))


@given(systems())
def test_infinite_gramian_solves_the_lyapunov_equation(system):
    wanted = lyapunov(*system)
    assert position_gramian(*system, ()) == pytest.approx(wanted, abs=1e-9 * np.abs(wanted).max())


@given(systems(), st.floats(0.0, 5.0), st.floats(0.5, 10.0))
def test_band_gramian_is_the_integral_over_the_band(system, low, width):
    wanted = quadrature(*system, low, low + width)
    gramian = position_gramian(*system, ((low, low + width, 1.0),))
    assert gramian == pytest.approx(wanted, abs=1e-7 * np.abs(wanted).max())


@given(systems())
def test_weighted_bands_add_up_to_all_frequencies(system):
    bands = ((0.0, 3.0, 1.0), (3.0, 1e9, 1.0))
    wanted = position_gramian(*system, ())
    assert position_gramian(*system, bands) == pytest.approx(wanted, abs=1e-6 * np.abs(wanted).max())
    doubled = position_gramian(*system, ((0.0, 3.0, 2.0),))
    assert doubled == pytest.approx(2 * position_gramian(*system, bands[:1]), rel=1e-12)


def test_critical_damping_is_no_exception():
    squared, inputs = np.array([25.0, 900.0]), np.array([[1.0], [2.0]])
    dampings = 2 * np.sqrt(squared)
    wanted = quadrature(squared, dampings, inputs, 0.0, 4.0)
    assert position_gramian(squared, dampings, inputs, ((0.0, 4.0, 1.0),)) == pytest.approx(wanted, rel=1e-5)


def test_lost_energy_of_the_impulse_response_is_the_tail_of_the_gramian(lattice):
    """Of all subspaces of its size, that of bt leaves out the least energy: the sum of the tail."""
    system = oscillators(structure(lattice))
    values, vectors = np.linalg.eigh(lyapunov(*system))
    reduced = reduce(lattice, "bt18")
    kept = vectors[:, ::-1][:, :12]
    squared = np.linalg.eigvalsh((kept.T * system[0]) @ kept)
    assert np.diag(reduced.stiffness)[6:] == pytest.approx(squared, rel=1e-6)
    lost = np.trace(lyapunov(*system)) - np.trace(kept.T @ lyapunov(*system) @ kept)
    assert lost == pytest.approx(values[:-12].sum(), rel=1e-6)


def test_gramians_agree_with_pymor():
    """Position controllability against velocity observability: one matrix for symmetric systems."""
    pytest.importorskip("pymor")
    from pymor.models.iosys import SecondOrderModel

    random = np.random.default_rng(2)
    omega = np.sort(random.uniform(1.0, 10.0, 12))
    squared, dampings, inputs = omega**2, 0.05 * omega, random.normal(size=(12, 3))
    peer = SecondOrderModel.from_matrices(
        np.eye(12), np.diag(dampings), np.diag(squared), inputs, Cp=inputs.T
    )
    gramian = position_gramian(squared, dampings, inputs, ())
    assert gramian == pytest.approx(peer.gramian("pc_dense"), abs=1e-10)
    assert gramian == pytest.approx(peer.gramian("vo_dense"), abs=1e-10)


def test_a_band_is_served_better_than_all_frequencies(lattice, exact):
    frequencies = np.linspace(5.0, 100.0, 20)
    wanted = exact(lattice, frequencies)
    errors = [
        np.abs(receptance(reduce(lattice, name), frequencies) - wanted).max()
        for name in ("bt18", "flbt18(0-100)")
    ]
    assert errors[1] < 0.1 * errors[0]


def test_weights_move_accuracy_between_bands(lattice, exact):
    """Two bands and one order: each band is served better where it weighs a million times the other."""
    bands, favors = ((20.0, 110.0), (150.0, 240.0)), ((1e6, 1.0), (1.0, 1e6))
    variants = [
        Variant("fwbt", 20, bands=tuple((*band, weight) for band, weight in zip(bands, weights, strict=True)))
        for weights in favors
    ]
    errors = np.zeros((2, 2))
    for row, band in enumerate(bands):
        frequencies = np.linspace(*band, 60)
        wanted = exact(lattice, frequencies)
        for column, variant in enumerate(variants):
            found = receptance(reduce(lattice, variant), frequencies)
            errors[row, column] = np.linalg.norm(found - wanted) / np.linalg.norm(wanted)
    assert errors[0, 0] < 0.01 * errors[0, 1]
    assert errors[1, 1] < 0.2 * errors[1, 0]


@pytest.mark.parametrize("name", ["bt20", "flbt20(0-100)", "irka20", "pod20"])
def test_undamped_modes_are_refused(make_lattice, name):
    with pytest.raises(UserError, match="need positive damping"):
        reduce(make_lattice(damping=RayleighDamping(0.0, 0.0)), name)
