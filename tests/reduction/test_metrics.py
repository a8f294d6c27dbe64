from dataclasses import replace

import numpy as np
import pytest

from wavequake.errors import UserError
from wavequake.mechanics.model import RayleighDamping
from wavequake.mechanics.vibration.eigen import eigenmodes
from wavequake.reduction.metrics import (
    acceleration,
    eps_mor,
    eps_of,
    frobenius,
    full_receptance,
    interface_modes,
    mac,
    modal_form,
    participation,
    pseudo_frequencies,
    receptance,
    relative_errors,
    residues,
    surface_modes,
)
from wavequake.reduction.reduce import reduce

FREQUENCIES = np.array([0.7, 33.0, 95.0, 210.0])


@pytest.fixture(scope="module")
def reduced(lattice):
    return reduce(lattice, "craigb24")


def solve(model, frequencies, rows=None):
    rows = model.inputs.T if rows is None else rows
    omega = 2 * np.pi * np.asarray(frequencies)
    return np.array(
        [
            rows
            @ np.linalg.solve(
                model.stiffness + 1j * w * model.damping_matrix - w**2 * model.mass, model.inputs
            )
            for w in omega
        ]
    )


def turned(model):
    """The same model in coordinates that are neither modal nor orthonormal."""
    turn = np.random.default_rng(3).normal(size=(model.order, model.order))
    matrices = {
        name: turn.T @ getattr(model, name) @ turn for name in ("mass", "stiffness", "damping_matrix")
    }
    symmetric = {name: (matrix + matrix.T) / 2 for name, matrix in matrices.items()}
    return replace(model, **symmetric, inputs=turn.T @ model.inputs, surface=model.surface @ turn)


def test_receptance_solves_the_equations_of_motion(reduced):
    wanted = solve(reduced, FREQUENCIES)
    assert receptance(reduced, FREQUENCIES) == pytest.approx(wanted, abs=1e-10 * np.abs(wanted).max())
    rows = solve(reduced, FREQUENCIES, reduced.surface)
    assert receptance(reduced, FREQUENCIES, reduced.surface) == pytest.approx(
        rows, abs=1e-10 * np.abs(rows).max()
    )


def test_coordinates_do_not_matter(reduced):
    other = turned(reduced)
    wanted = receptance(reduced, FREQUENCIES, reduced.surface)
    assert receptance(other, FREQUENCIES, other.surface) == pytest.approx(
        wanted, abs=1e-6 * np.abs(wanted).max()
    )
    assert pseudo_frequencies(other)[6:] == pytest.approx(pseudo_frequencies(reduced)[6:], rel=1e-7)
    assert np.diag(mac(surface_modes(other)[:, 6:], surface_modes(reduced)[:, 6:])) == pytest.approx(
        1, abs=1e-6
    )


def test_damping_that_couples_modes_is_solved(reduced):
    damping = reduced.damping_matrix.copy()
    damping[6, 7] = damping[7, 6] = 0.5 * damping[6, 6]
    coupled = replace(reduced, damping_matrix=damping)
    wanted = solve(coupled, FREQUENCIES)
    assert receptance(coupled, FREQUENCIES) == pytest.approx(wanted, abs=1e-10 * np.abs(wanted).max())
    assert eps_mor(wanted, receptance(reduced, FREQUENCIES)).max() > 1e-4


def test_acceleration_of_a_free_body_at_low_frequency_is_newtons(make_lattice):
    """Three equal forces through the center of mass would need symmetry; their sum on all nodes does not."""
    model = make_lattice(interfaces=range(18), damping=RayleighDamping(0.0, 1e-6))
    masses = model.mass.diagonal()[::3]
    moved = acceleration(reduce(model, "modal20"), 1e-3)[0]
    # Forces in proportion to the masses, a field of gravity, give all nodes the same acceleration.
    gravity = np.kron(masses, [0.0, 0.0, 1.0])
    assert moved @ gravity == pytest.approx(np.tile([0.0, 0.0, 1.0], 18), abs=1e-6)


def test_acceleration_is_the_second_derivative(reduced):
    assert acceleration(reduced, 10.0) == pytest.approx(-((20 * np.pi) ** 2) * receptance(reduced, 10.0))


def test_full_receptance_is_the_dense_solution(lattice, exact):
    seen = []
    assert full_receptance(lattice, FREQUENCIES, seen.append) == pytest.approx(
        exact(lattice, FREQUENCIES), rel=1e-6
    )
    assert seen == [1, 2, 3, 4]


def test_error_is_relative_in_the_frobenius_norm():
    reference = np.array([[[3.0, 0.0], [0.0, 4.0]]], dtype=complex)
    assert frobenius(reference) == pytest.approx([5.0])
    assert eps_mor(reference, reference + np.array([[0, 0.3j], [0.4, 0]])) == pytest.approx([0.1])


@pytest.mark.parametrize("coupled", [False, True], ids=["proportional damping", "damping couples modes"])
def test_errors_by_inner_products_are_those_of_the_matrices(lattice, coupled):
    """Large ones, and those of the reference itself, where the products cancel."""
    frequencies, random = np.linspace(20.0, 400.0, 60), np.random.default_rng(6)
    whole = reduce(lattice, "craigb48")
    if coupled:
        damping = whole.damping_matrix.copy()
        damping[6, 7] = damping[7, 6] = 0.5 * damping[6, 6]
        whole = replace(whole, damping_matrix=damping)
    outputs = random.standard_normal((40, len(whole.surface)))
    reference = residues(whole, frequencies, outputs @ whole.surface)
    largest = []
    for variant in (reduce(lattice, "craigb24"), turned(reduce(lattice, "craigb36")), whole):
        rows = outputs @ variant.surface
        transfer = receptance(variant, frequencies, rows)
        norm, error = eps_of(reference, variant, frequencies, rows)
        exact = eps_mor(reference.transfer, transfer)
        np.testing.assert_allclose(norm, frobenius(transfer), rtol=1e-12)
        np.testing.assert_allclose(error, exact, rtol=1e-6, atol=1e-13)
        largest.append(exact.max())
    assert largest[0] > 1e-3 > largest[-1]


def test_errors_of_many_variants_are_in_order(lattice, exact):
    wanted = exact(lattice, FREQUENCIES)
    errors = relative_errors(
        wanted, [reduce(lattice, f"craigb{order}") for order in (12, 24, 54)], FREQUENCIES
    )
    assert errors.shape == (3, 4)
    assert (errors[2] < 1e-6).all()
    assert (errors[0] > errors[1]).all()


def test_mac_is_one_for_multiples_and_zero_for_orthogonal_shapes():
    shapes = np.array([[1.0, 0.0], [0.0, 2.0], [1.0, 0.0]])
    assert mac(shapes, -3.0 * shapes) == pytest.approx(np.eye(2))
    assert mac(shapes, np.zeros((3, 1))) == pytest.approx(np.zeros((2, 1)))


def test_mac_in_the_mass_norm_knows_the_modes_of_the_full_model(lattice):
    shapes = eigenmodes(lattice, 12)[1]
    assert mac(shapes[:, 6:], shapes[:, 6:], lattice.mass) == pytest.approx(np.eye(6), abs=1e-9)
    kept = reduce(lattice, "modal12")
    assert np.diag(mac(surface_modes(kept), lattice.surface @ shapes))[6:] == pytest.approx(1, abs=1e-6)


def test_participation_gives_the_residues(reduced):
    shapes = participation(reduced)
    assert shapes.shape == (24, 9)
    assert interface_modes(reduced) == pytest.approx(shapes.T)
    near = modal_form(reduced)
    light = replace(reduced, damping_matrix=1e-6 * np.eye(24))
    omega = np.sqrt(near.squared[6])
    peak = receptance(light, omega / (2 * np.pi))[0] * (1j * omega * 1e-6)
    assert peak == pytest.approx(np.outer(shapes[6], shapes[6]), abs=1e-6 * np.abs(shapes[6]).max() ** 2)


@pytest.mark.parametrize("frequencies", [[-1.0], [np.nan], [np.inf], [], [[1.0]]])
def test_bad_frequencies_are_refused(reduced, frequencies):
    with pytest.raises(UserError, match="Frequencies must be finite"):
        receptance(reduced, frequencies)


def test_a_free_body_has_no_static_response(reduced):
    with pytest.raises(UserError, match="is free to move"):
        receptance(reduced, [0.0, 1.0])


def test_a_singular_mass_is_refused(reduced):
    with pytest.raises(UserError, match="mass matrix of craigb24 is singular"):
        receptance(replace(reduced, mass=np.diag([0.0] + [1.0] * 23)), 1.0)


def test_different_frequencies_cannot_be_compared(reduced):
    with pytest.raises(UserError, match="cannot be compared"):
        eps_mor(receptance(reduced, [1.0, 2.0]), receptance(reduced, [1.0]))
    with pytest.raises(UserError, match="cannot be compared"):
        mac(np.ones((3, 1)), np.ones((4, 1)))


def test_damping_sweeps_need_no_new_basis(make_lattice, exact):
    """Proportional damping changes the damping matrix alone."""
    model = make_lattice(damping=RayleighDamping(0.0, 1e-3))
    wanted = exact(model, FREQUENCIES)
    assert receptance(reduce(model, "craigb54"), FREQUENCIES) == pytest.approx(
        wanted, abs=1e-8 * np.abs(wanted).max()
    )
