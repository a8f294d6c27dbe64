from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import eigh
from scipy.sparse import csc_array, diags_array, eye_array

from wavequake.errors import UserError
from wavequake.mechanics.mirrors.material import Material
from wavequake.mechanics.mirrors.models import CircularMirror, circular_mirror, on_springs
from wavequake.mechanics.model import FiniteElementModel, RayleighDamping, check_model
from wavequake.mechanics.vibration.eigen import (
    eigenmodes,
    elastic_flexibility,
    mass_normalized_rigid_modes,
)

SMALL = CircularMirror(core=1, rings=2)


def chain(count, stiffness=4e4, mass=0.25, held=False):
    """Equal masses on the x axis, joined by equal springs and free at both ends, or held at both ends."""
    matrix = diags_array(
        [np.full(count - 1, -1.0), np.r_[1.0, np.full(count - 2, 2.0), 1.0], np.full(count - 1, -1.0)],
        offsets=[-1, 0, 1],
    ).tolil()
    if held:
        matrix[0, 0] = matrix[count - 1, count - 1] = 2.0
    ends = np.array([0, count - 1])
    return FiniteElementModel(
        name="chain",
        mass=csc_array(mass * eye_array(count)),
        stiffness=csc_array(stiffness * matrix),
        damping=RayleighDamping(),
        nodes=np.column_stack([np.arange(count), np.zeros(count), np.zeros(count)]).astype(float),
        dof_node=np.arange(count),
        dof_direction=np.zeros(count, dtype=np.int64),
        interfaces=ends,
        surface_nodes=ends,
        surface_weights=np.array([0.5, 0.5]),
    )


@pytest.mark.parametrize("count", [5, 60, 400], ids=["five", "dense", "sparse"])
@pytest.mark.parametrize("held", [False, True], ids=["free", "held"])
def test_chain_has_its_closed_form(count, held):
    model = chain(count, held=held)
    wanted = min(count, 20)
    frequencies, modes = eigenmodes(model, wanted)
    index = np.arange(wanted)
    angle = (index + 1) * np.pi / (2 * (count + 1)) if held else index * np.pi / (2 * count)
    np.testing.assert_allclose(frequencies, np.sqrt(4e4 / 0.25) / np.pi * np.sin(angle), rtol=1e-9)
    np.testing.assert_allclose(modes.T @ (model.mass @ modes), np.eye(wanted), rtol=0, atol=1e-10)
    if not held:
        assert frequencies[0] == 0
        np.testing.assert_allclose(modes[:, 0], modes[0, 0], rtol=1e-12)


def test_sparse_and_dense_solutions_agree():
    model = circular_mirror(SMALL)
    frequencies, _ = eigenmodes(model, 40)
    squares = eigh(
        model.stiffness.toarray(), model.mass.toarray(), eigvals_only=True, subset_by_index=(6, 39)
    )
    np.testing.assert_allclose(frequencies[6:], np.sqrt(squares) / (2 * np.pi), rtol=1e-9)
    many, _ = eigenmodes(model, 300)
    np.testing.assert_allclose(many[:40], frequencies, rtol=1e-9)


def test_modes_diagonalize_mass_and_stiffness():
    model = circular_mirror(SMALL)
    frequencies, modes = eigenmodes(model, 40)
    squares = (2 * np.pi * frequencies) ** 2
    np.testing.assert_allclose(modes.T @ (model.mass @ modes), np.eye(40), rtol=0, atol=1e-12)
    np.testing.assert_allclose(
        modes.T @ (model.stiffness @ modes), np.diag(squares), rtol=1e-10, atol=1e-10 * squares[-1]
    )


def test_rigid_modes_are_exact_and_come_first():
    model = circular_mirror(SMALL)
    frequencies, modes = eigenmodes(model, 8)
    assert (frequencies[:6] == 0).all()
    assert (frequencies[6:] > 1).all()
    shapes = modes.reshape(-1, 3, 8)
    np.testing.assert_allclose(shapes[:, :, :3], np.broadcast_to(shapes[0, :, :3], shapes[:, :, :3].shape))
    # Distances do not change under any of them.
    arms, turns = model.nodes - model.nodes[7], shapes[:, :, :6] - shapes[7, :, :6]
    assert np.abs(np.einsum("kd,kdm->km", arms, turns)).max() < 1e-14


def test_rigid_modes_survive_a_file_of_ten_digits():
    model = circular_mirror(SMALL)
    rounded = model.stiffness.copy()
    rounded.data = np.array([float(f"{value:.9e}") for value in rounded.data])
    frequencies, _ = eigenmodes(replace(model, stiffness=rounded), 10)
    assert (frequencies[:6] == 0).all()
    squares = eigh(rounded.toarray(), model.mass.toarray(), eigvals_only=True, subset_by_index=(6, 9))
    np.testing.assert_allclose(frequencies[6:], np.sqrt(squares) / (2 * np.pi), rtol=1e-6)


def test_fewer_modes_than_rigid_ones():
    frequencies, modes = eigenmodes(circular_mirror(SMALL), 4)
    assert modes.shape[1] == 4
    assert (frequencies == 0).all()


def test_every_run_gives_the_same_bits():
    first, second = (eigenmodes(circular_mirror(SMALL), 20) for _ in range(2))
    np.testing.assert_array_equal(first[0], second[0])
    np.testing.assert_array_equal(first[1], second[1])


@settings(max_examples=6, deadline=None)
@given(st.floats(1e-3, 1e3), st.floats(1e-3, 1e3), st.floats(0.1, 10.0))
def test_frequencies_scale_with_modulus_density_and_size(young, density, size):
    base = Material(70e9, 0.33, 2700.0)
    scaled = Material(70e9 * young, 0.33, 2700.0 * density)
    one, _ = eigenmodes(circular_mirror(replace(SMALL, material=base)), 9)
    lengths = {"diameter": size, "thickness": 0.02 * size, "focal_length": 1.7 * size}
    other, _ = eigenmodes(
        circular_mirror(replace(SMALL, material=scaled, mount_radius=0.333 * size, **lengths)), 9
    )
    np.testing.assert_allclose(other, one * np.sqrt(young / density) / size, rtol=1e-8)


def test_soft_springs_carry_a_rigid_body():
    """Three equal springs: the piston has the frequency of a point mass, the elastic modes hardly change."""
    model = circular_mirror(SMALL)
    held = on_springs(model, (1e3, 1e3, 1e3))
    total = model.mass.sum() / 3
    frequencies, _ = eigenmodes(held, 7)
    assert mass_normalized_rigid_modes(held).shape[1] == 0
    free, _ = eigenmodes(model, 7)
    piston = np.sqrt(3 * 1e3 / total) / (2 * np.pi)
    # The body bends a little: an effect of the square of the ratio of frequencies.
    assert np.abs(frequencies / piston - 1).min() < (piston / free[6]) ** 2
    assert frequencies[6] == pytest.approx(free[6], rel=(piston / free[6]) ** 2)


def test_springs_along_one_axis_leave_three_rigid_modes():
    held = on_springs(circular_mirror(SMALL), (0.0, 0.0, 1e6))
    frequencies, modes = eigenmodes(held, 10)
    assert (frequencies == 0).sum() == 3
    assert frequencies[3] > 1
    np.testing.assert_allclose(modes.T @ (held.mass @ modes), np.eye(10), rtol=0, atol=1e-9)


def test_flexibility_solves_for_balanced_forces():
    model = circular_mirror(SMALL)
    rigid = mass_normalized_rigid_modes(model)
    forces = np.random.default_rng(3).normal(size=(model.order, 4))
    displacements = elastic_flexibility(model, rigid)(forces)
    balanced = forces - model.mass @ rigid @ (rigid.T @ forces)
    np.testing.assert_allclose(model.stiffness @ displacements, balanced, rtol=0, atol=1e-7)
    np.testing.assert_allclose(rigid.T @ (model.mass @ displacements), 0, rtol=0, atol=1e-18)


@pytest.mark.parametrize("count", [0, 244])
def test_a_number_of_modes_that_the_model_does_not_have_is_refused(count):
    model = circular_mirror(CircularMirror(core=1, rings=1, mount_radius=0.5))
    with pytest.raises(UserError, match=f"{count} modes of circular mirror are wanted; it has 243"):
        eigenmodes(model, count)


def test_a_loose_part_is_refused():
    model = circular_mirror(SMALL)
    stiffness = model.stiffness.tolil()
    stiffness[30, :] = 0
    stiffness[:, 30] = 0
    with pytest.raises(UserError, match="singular"):
        eigenmodes(replace(model, stiffness=csc_array(stiffness)), 8)


def test_an_indefinite_stiffness_is_refused():
    model = chain(40, held=True)
    with pytest.raises(UserError, match="not positive semi-definite"):
        eigenmodes(replace(model, stiffness=csc_array(model.stiffness - 1e3 * eye_array(40))), 8)


def test_a_motion_without_mass_is_no_mode():
    model = chain(5)
    model = replace(model, mass=csc_array(np.diag([1.0, 0.0, 1.0, 1.0, 1.0])))
    assert len(eigenmodes(model, 4)[0]) == 4
    with pytest.raises(UserError, match="4 elastic modes of chain are wanted; only 3 have a mass"):
        eigenmodes(model, 5)


@pytest.mark.parametrize("coefficients", [(-1e-3, 0.0), (0.0, -5e-6), (np.nan, 0.0), (0.0, np.inf)])
def test_impossible_damping_is_refused(coefficients):
    with pytest.raises(UserError, match="Rayleigh damping"):
        RayleighDamping(*coefficients)


def test_interfaces_on_a_line_are_refused():
    with pytest.raises(UserError, match="the 2 interface nodes of the model chain lie on a line"):
        check_model(chain(5))
    with pytest.raises(UserError, match="the 4 interface nodes"):
        check_model(replace(chain(5), interfaces=np.arange(4)))


def test_impossible_surfaces_are_refused():
    model = circular_mirror(SMALL)
    none = np.zeros(0, dtype=np.int64)
    with pytest.raises(UserError, match="optical surface of the model circular mirror is empty"):
        check_model(replace(model, surface_nodes=none, surface_weights=np.zeros(0)))
    with pytest.raises(UserError, match="one positive weight"):
        check_model(replace(model, surface_weights=-model.surface_weights))
    with pytest.raises(UserError, match="one positive weight"):
        check_model(replace(model, surface_weights=model.surface_weights[1:]))


def test_missing_coordinates_are_refused():
    model = circular_mirror(SMALL)
    nodes = model.nodes.copy()
    nodes[5, 1] = np.nan
    with pytest.raises(UserError, match="node 5 of the model circular mirror"):
        check_model(replace(model, nodes=nodes))
