import numpy as np
import pytest

from wavequake.errors import UserError
from wavequake.mechanics.model import ReducedModel
from wavequake.mechanics.vibration.damping import with_modal_damping


def coupled(rigid=0, order=5):
    """Random mass; stiffness with some rigid modes."""
    random = np.random.default_rng(4)
    root = random.normal(size=(order, order))
    factor = random.normal(size=(order, order - rigid))
    return ReducedModel(
        name="example5",
        method="example",
        mass=root @ root.T + np.eye(order),
        stiffness=1e4 * factor @ factor.T,
        damping_matrix=np.zeros((order, order)),
        inputs=np.zeros((order, 9)),
        surface=np.zeros((3, order)),
        nodes=np.zeros((3, 3)),
        interfaces=np.arange(3),
        surface_nodes=np.arange(1),
        surface_weights=np.ones(1),
        seconds=0.0,
    )


def poles(model):
    """Eigenvalues of the state matrix with positive imaginary part, by size."""
    inverse = np.linalg.inv(model.mass)
    size = model.order
    state = np.block(
        [
            [np.zeros((size, size)), np.eye(size)],
            [-inverse @ model.stiffness, -inverse @ model.damping_matrix],
        ]
    )
    values = np.linalg.eigvals(state)
    return np.array(sorted(values[values.imag > 1e-3], key=abs))


@pytest.mark.parametrize("ratios", [0.02, [0.01, 0.0, 0.05, 0.3, 0.002]], ids=["one", "each"])
def test_every_pole_has_its_ratio(ratios):
    found = poles(with_modal_damping(coupled(), ratios))
    np.testing.assert_allclose(-found.real / np.abs(found), np.broadcast_to(ratios, 5), rtol=0, atol=1e-10)
    np.testing.assert_allclose(np.abs(found), np.abs(poles(coupled())), rtol=1e-10)


def test_rigid_modes_are_not_damped():
    model = with_modal_damping(coupled(rigid=2), 0.05)
    assert np.linalg.matrix_rank(model.damping_matrix) == 3
    free = np.linalg.svd(model.stiffness)[2][-2:].T
    np.testing.assert_allclose(
        model.damping_matrix @ free, 0, rtol=0, atol=1e-9 * np.abs(model.damping_matrix).max()
    )


@pytest.mark.parametrize("ratios", [-0.01, np.nan, [0.01, 0.01, 0.01, 0.01, np.inf]])
def test_impossible_ratios_are_refused(ratios):
    with pytest.raises(UserError, match="damping ratios of example5 must be finite and not negative"):
        with_modal_damping(coupled(), ratios)


def test_a_wrong_number_of_ratios_is_refused():
    with pytest.raises(
        UserError, match="2 damping ratios are given for example5; give one, or one for each of its 5"
    ):
        with_modal_damping(coupled(), [0.01, 0.02])
