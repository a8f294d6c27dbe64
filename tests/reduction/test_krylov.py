import math

import numpy as np
import pytest

from wavequake.errors import UserError
from wavequake.mechanics.model import RayleighDamping
from wavequake.mechanics.vibration.eigen import eigenmodes
from wavequake.reduction.metrics import eps_mor, pseudo_frequencies, receptance
from wavequake.reduction.reduce import reduce


def derivatives(mass, stiffness, inputs, sigma, count):
    """Derivatives of B^T (K - sigma M)^-1 B with respect to sigma, by the resolvent's own rule."""
    solution = np.linalg.solve(stiffness - sigma * mass, inputs.astype(complex))
    result = [inputs.T @ solution]
    for order in range(1, count):
        solution = np.linalg.solve(stiffness - sigma * mass, mass @ solution)
        result.append(math.factorial(order) * (inputs.T @ solution))
    return np.array(result)


def full_and_reduced(model, name, point, count):
    sigma = -((2 * np.pi * (point.imag + 1j * point.real)) ** 2)
    small = reduce(model, name)
    matrices = (a.toarray() for a in (model.mass, model.stiffness, model.inputs))
    return (
        derivatives(*matrices, sigma, count),
        derivatives(small.mass, small.stiffness, small.inputs, sigma, count),
    )


@pytest.mark.parametrize(
    ("name", "points"),
    [
        ("krylov(90*2)", [90]),
        ("krylov(60*1,150*1)", [60, 150]),
        ("krylov(50j*2)", [50j]),
        ("krylov(90+30j*1)", [90 + 30j]),
    ],
)
def test_moments_match_at_the_expansion_points(lattice, name, points):
    """m blocks match 2 m derivatives with respect to s^2, and not one more."""
    matched = 2 * int(name.rstrip(")")[-1])
    for point in map(complex, points):
        full, small = full_and_reduced(lattice, name, point, matched + 1)
        errors = np.linalg.norm(full - small, axis=(1, 2)) / np.linalg.norm(full, axis=(1, 2))
        assert errors[:matched].max() < 1e-10
        assert errors[matched] > 1e-7


def test_chosen_moments_set_the_order(lattice):
    reduced = reduce(lattice, "krylov(60*1,150*2)")
    assert reduced.order == 6 + 9 * 3
    assert reduced.name == "krylov33(60*1,150*2)"
    assert reduce(lattice, reduced.name).order == 33


def test_points_share_the_order_in_turn(lattice, exact):
    """Twelve directions at two points: the first point has a whole block, the second three directions."""
    full, small = full_and_reduced(lattice, "krylov18(60,150)", 60 + 0j, 2)
    assert np.abs(full - small).max(axis=(1, 2)) == pytest.approx(0, abs=1e-8 * np.abs(full[1]).max())
    error = eps_mor(exact(lattice, [150.0]), receptance(reduce(lattice, "krylov18(60,150)"), [150.0]))
    assert 1e-8 < error < 1


@pytest.mark.parametrize("shape", [(3, 3, 2), (8, 8, 4)], ids=["dense", "sparse"])
def test_a_point_on_an_eigenfrequency_is_moved_by_a_millihertz(make_lattice, exact, shape):
    model = make_lattice(shape)
    resonance = eigenmodes(model, 8)[0][6]
    on, beside = (reduce(model, f"krylov({f!r}*3)") for f in (float(resonance), float(resonance) + 1e-3))
    frequencies = np.array([0.95, 0.99, 1.01, 1.05]) * resonance
    reference = exact(model, frequencies)
    assert eps_mor(reference, receptance(on, frequencies)).max() < 1e-4
    assert pseudo_frequencies(on)[6] == pytest.approx(resonance, rel=1e-7)
    assert pseudo_frequencies(on) == pytest.approx(pseudo_frequencies(beside), rel=1e-4)


def test_damping_does_not_spoil_the_match(make_lattice, exact):
    """The basis is undamped; three block moments hide that up to the fourth power of the loss."""
    model = make_lattice(damping=RayleighDamping(0.0, 5e-6))
    error = eps_mor(exact(model, [90.0]), receptance(reduce(model, "krylov(90*3)"), [90.0]))
    assert error < 1e-9


@pytest.mark.parametrize("frequency", [40.0, 90.0])
def test_a_complex_point_matches_the_damped_transfer_function(lattice, frequency):
    """Rayleigh damping shifts K by sigma M, sigma = (s^2 + a s) / (1 + b s): s0 = sqrt(sigma) is exact.

    Two block moments match four derivatives with respect to s, too.
    """
    alpha, beta = lattice.damping.mass, lattice.damping.stiffness
    s = 2j * np.pi * frequency
    shift = np.sqrt((s**2 + alpha * s) / (1 + beta * s))
    point = complex(shift.imag, shift.real) / (2 * np.pi)
    assert point.imag > 0
    small = reduce(lattice, f"krylov({point.real!r}+{point.imag!r}j*2)")
    full = [a.toarray() for a in (lattice.mass, lattice.damping_matrix, lattice.stiffness, lattice.inputs)]
    own = [small.mass, small.damping_matrix, small.stiffness, small.inputs]
    found = [damped_derivatives(*matrices, s) for matrices in (full, own)]
    for wanted, got in zip(*found, strict=True):
        assert np.linalg.norm(got - wanted) < 1e-10 * np.linalg.norm(wanted)


def damped_derivatives(mass, damping, stiffness, inputs, s):
    """Derivatives 0 to 3 of B^T (s^2 M + s D + K)^-1 B with respect to s, by differentiating the product."""
    dynamic, slope, bend = s**2 * mass + s * damping + stiffness, 2 * s * mass + damping, 2 * mass
    terms = [np.linalg.solve(dynamic, inputs.astype(complex))]
    terms.append(-np.linalg.solve(dynamic, slope @ terms[0]))
    terms.append(-np.linalg.solve(dynamic, 2 * slope @ terms[1] + bend @ terms[0]))
    terms.append(-np.linalg.solve(dynamic, 3 * slope @ terms[2] + 3 * bend @ terms[1]))
    return [inputs.T @ term for term in terms]


def test_exhausted_points_are_named(supported_lattice):
    with pytest.raises(UserError, match="give only 9 independent directions"):
        reduce(supported_lattice, "krylov20(90*1)")
