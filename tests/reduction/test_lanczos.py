"""Modes by blocks against closed forms of chains and against dense algebra."""

import numpy as np
import pytest
import scipy.linalg
from scipy.sparse import csc_array, diags_array
from scipy.sparse.linalg import splu

from wavequake.reduction.lanczos import lowest_modes


def chain(order):
    """Return stiffness and mass of equal masses on a line of equal springs, both ends held."""
    stiffness = diags_array([-1.0, 2.0, -1.0], offsets=[-1, 0, 1], shape=(order, order)).tocsc()
    return stiffness, csc_array(diags_array(np.ones(order)))


@pytest.mark.parametrize("count", [10, 60, 240])
def test_modes_of_a_chain_are_those_of_its_closed_form(count):
    order = 1500
    stiffness, mass = chain(order)
    squared, shapes = lowest_modes(splu(stiffness).solve, mass, count)
    angles = np.arange(1, count + 1) * np.pi / (order + 1)
    np.testing.assert_allclose(squared, 4 * np.sin(angles / 2) ** 2, rtol=1e-9)
    exact = np.sqrt(2 / (order + 1)) * np.sin(np.outer(np.arange(1, order + 1), angles))
    overlap = np.abs(np.sum(exact * shapes, axis=0))
    np.testing.assert_allclose(overlap, 1.0, atol=1e-9)
    np.testing.assert_allclose(shapes.T @ (mass @ shapes), np.eye(count), atol=1e-12)


@pytest.mark.parametrize(("copies", "length"), [(6, 150), (20, 60), (40, 40)])
def test_equal_modes_are_all_found_or_said_to_be_missing(copies, length):
    """So many times the same chain; blocks have eight vectors."""
    stiffness = chain(length)[0]
    many = csc_array(scipy.linalg.block_diag(*[stiffness.toarray()] * copies))
    found = lowest_modes(splu(many).solve, csc_array(np.eye(copies * length)), 2 * copies + 20)
    assert found is not None or copies > 8
    if found is not None:
        squared, shapes = found
        angles = np.repeat(np.arange(1, 50), copies)[: len(squared)] * np.pi / (length + 1)
        np.testing.assert_allclose(squared, 4 * np.sin(angles / 2) ** 2, rtol=1e-9)
        np.testing.assert_allclose(many @ shapes, shapes * squared, atol=1e-10)


def test_a_mass_that_couples():
    rng = np.random.default_rng(3)
    stiffness, _ = chain(400)
    mass = diags_array([0.2, 1.0, 0.2], offsets=[-1, 0, 1], shape=(400, 400)).tocsc()
    mass += diags_array(rng.uniform(0, 3, 400))
    squared, shapes = lowest_modes(splu(stiffness).solve, csc_array(mass), 50)
    exact = scipy.linalg.eigh(stiffness.toarray(), mass.toarray(), subset_by_index=[0, 49])
    np.testing.assert_allclose(squared, exact[0], rtol=1e-9)
    np.testing.assert_allclose(np.abs(np.sum(exact[1] * (mass @ shapes), axis=0)), 1.0, atol=1e-8)


def test_too_few_masses_are_told():
    """Thirty masses have thirty modes."""
    stiffness, _ = chain(800)
    mass = csc_array(diags_array((np.arange(800) % 27 == 13).astype(float)))
    assert lowest_modes(splu(stiffness).solve, mass, 40) is None
