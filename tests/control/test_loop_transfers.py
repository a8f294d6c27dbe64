"""Responses, eigenvalues and poles of loops of large plants, against the straightforward ways."""

import numpy as np
import pytest

from wavequake.control.gains import regulator_gain
from wavequake.control.linear import LinearModel, linear_model
from wavequake.control.modes import grows, modes
from wavequake.control.robustness import margins
from wavequake.control.robustness.feedback import Loop, closed_matrix, lqg, vector_of
from wavequake.control.robustness.plant import whole_plant
from wavequake.errors import UserError


def loop_of(count=20, kept=8, effort=0.3):
    """Return a loop of random lightly damped modes, two forces and two sensors beside each other."""
    random = np.random.default_rng(4)
    hertz = np.sort(random.uniform(0.5, 8.0, count))
    shapes = random.standard_normal((count, 2))
    plant = whole_plant(hertz**2, 0.02 + 2e-3 * hertz**2, shapes, shapes.T)
    model = whole_plant(plant.squared[:kept], plant.rates[:kept], shapes[:kept], shapes[:kept].T)
    return Loop(plant, lqg(model, effort, effort))


def test_a_transfer_by_back_substitution_is_that_of_solves_one_by_one():
    loop = loop_of()
    s, own = 1j * np.geomspace(1e-2, 30.0, 300), loop.controller
    wanted = np.array([own.c @ np.linalg.solve(one * np.eye(len(own.a)) - own.a, own.b) for one in s])
    sizes = np.abs(wanted).max(axis=(1, 2), keepdims=True)
    assert np.abs((margins.controller_transfer(loop, s) - wanted) / sizes).max() < 1e-12
    alone = [margins.controller_transfer(loop, s[k : k + 1])[0] for k in range(len(s))]
    assert np.abs((alone - wanted) / sizes).max() < 1e-12


def in_long_double(a, b):
    """Solve by elimination with pivots, 64 bits of mantissa."""
    a, b = a.astype(np.clongdouble), b.astype(np.clongdouble)
    for k in range(len(a)):
        pivot = k + int(np.abs(a[k:, k]).argmax())
        a[[k, pivot]], b[[k, pivot]] = a[[pivot, k]], b[[pivot, k]]
        share = (a[k + 1 :, k] / a[k, k])[:, None]
        a[k + 1 :] -= share * a[k]
        b[k + 1 :] -= share * b[k]
    found = np.zeros_like(b)
    for k in reversed(range(len(a))):
        found[k] = (b[k] - a[k, k + 1 :] @ found[k + 1 :]) / a[k, k]
    return found


def test_a_transfer_beside_a_narrow_pole_is_as_good_as_by_a_solution():
    """Refined: without, ten times and more as far off as what LAPACK's solution with A is."""
    own = modes_of(np.array([1.0, 1.0000001, 3.0, 40.0]) ** 2, 2e-4)
    loop = Loop(whole_plant(np.ones(1), np.ones(1), np.ones((1, 2)), np.ones((2, 1))), own)
    for at in (1.0, 3.0, 40.0):
        s = np.array([1j * at])
        shifted = s[0] * np.eye(len(own.a)) - own.a
        exact = own.c @ in_long_double(shifted, own.b)
        found = margins.controller_transfer(loop, s)[0]
        both = margins.controller_transfer(loop, np.repeat(s, 3))[1]
        plain = own.c @ np.linalg.solve(shifted, own.b)
        size, floor = np.abs(exact).max(), np.abs(plain - exact).max()
        for one in (found, both):
            assert np.abs(one - exact).max() <= max(10 * floor, 1e-13 * size)


def modes_of(squared, zeta):
    """Return a controller of modes that are seen and driven twice, mixed but for its zeros."""
    random, n = np.random.default_rng(6), len(squared)
    a = np.block([[np.zeros((n, n)), np.eye(n)], [-np.diag(squared), -np.diag(2 * zeta * np.sqrt(squared))]])
    a[n:, :n] += 1e-4 * random.standard_normal((n, n))
    b = np.vstack([np.zeros((n, 2)), random.standard_normal((n, 2))])
    return LinearModel(a, b, np.hstack([random.standard_normal((2, n)), np.zeros((2, n))]), np.zeros((2, 2)))


def test_eigenvalues_follow_their_predecessors_one_by_one():
    """Where two want the same one, the first takes it; against choosing one by one everywhere."""
    random = np.random.default_rng(0)
    values = np.cumsum(0.3 * random.standard_normal((400, 4, 2)) @ [1, 1j], axis=0) + np.arange(4)
    values = random.permuted(values, axis=1)
    wanted = values.copy()
    for place in range(1, len(values)):
        left = list(values[place])
        for column in range(4):
            near = min(left, key=lambda one, at=wanted[place - 1, column]: abs(one - at))
            left.remove(near)
            wanted[place, column] = near
    np.testing.assert_array_equal(margins._sorted(values), wanted)


def test_a_vector_of_a_known_eigenvalue_is_that_of_the_decomposition():
    matrix = closed_matrix(loop_of())
    values, vectors = np.linalg.eig(matrix)
    for place in (0, 10, len(values) - 1):
        found = vector_of(matrix, complex(values[place]))
        wanted = vectors[:, place] / vectors[np.abs(found).argmax(), place]
        np.testing.assert_allclose(found / found[np.abs(found).argmax()], wanted, atol=1e-9)


def test_modes_that_are_not_asked_for_change_nothing_of_the_others():
    random = np.random.default_rng(1)
    model = linear_model(
        random.standard_normal((7, 7)), random.standard_normal((7, 1)), random.standard_normal((1, 7))
    )
    some = modes(model, only=grows)
    assert 0 < len(some) < len(modes(model))
    assert some == tuple(one for one in modes(model) if not one.stable)


def test_what_grows_and_is_not_driven_is_still_found():
    model = linear_model(np.diag([0.5, -1.0]), [[0.0], [1.0]], [[1.0, 1.0]])
    with pytest.raises(UserError, match="does not drive mode 1"):
        regulator_gain(model, np.eye(2), 1.0)
