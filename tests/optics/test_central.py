"""Central differences with a checked step, against closed forms."""

import numpy as np
import pytest

from wavequake.errors import UserError
from wavequake.optics.derivatives.central import (
    SIGNS,
    TOLERANCE,
    Differences,
    checked_derivative,
    sensitivity_matrix,
)


def test_the_error_of_a_central_difference_is_of_second_order():
    """sin: (sin(x + h) - sin(x - h)) / (2 h) = cos(x) sin(h) / h exactly."""
    x = np.linspace(0.1, 1.0, 5)
    for step in (1e-2, 1e-3):
        values = np.sin(x + step * SIGNS[:, None])
        if step**2 / 2.0 > TOLERANCE:
            with pytest.raises(
                UserError, match=r"the derivatives of a sine differ by .* between two steps; go on"
            ):
                checked_derivative(values, step, "a sine", "go on")
            continue
        found = checked_derivative(values, step, "a sine", "go on")
        np.testing.assert_allclose(found, np.cos(x) * np.sin(step) / step, rtol=1e-12)


def test_a_jump_is_no_derivative_and_a_missing_value_no_error():
    line = 3.0 * 1e-3 * SIGNS[:, None] * [1.0, 2.0]
    with pytest.raises(UserError, match="differ by"):
        checked_derivative(line + (SIGNS[:, None] > 1.5) * 1e-6, 1e-3, "a step", "go on")
    line[2, 1] = np.nan
    np.testing.assert_allclose(checked_derivative(line, 1e-3, "a line", "go on"), [3.0, 6.0], rtol=1e-14)


def test_derivatives_of_one_unit_share_a_scale():
    """Rounding of what does not move is measured by what does."""
    noise = 1e-9 * np.array([1.0, -1.0, -1.0, 1.0])
    values = np.stack([SIGNS, noise, 1e-3 * SIGNS], axis=1)[:, None]
    with pytest.raises(UserError, match="differ by"):
        checked_derivative(values, 1.0, "both", "go on", axis=0)
    checked_derivative(values, 1.0, "both", "go on", axis=0, units=np.array([0, 0, 1]))
    with pytest.raises(UserError, match="differ by"):
        checked_derivative(values, 1.0, "both", "go on", axis=0, units=np.array([0, 1, 2]))


@pytest.mark.parametrize("at_once", [1, 4, 100])
def test_a_matrix_is_that_of_a_known_function_however_it_is_cut(at_once):
    """A cube in the motion adds h^2, and four times that with twice the step, over the largest column."""
    elements, dofs, sizes = ("A", "B", "C"), ("dx", "rx"), np.array([1e-2, 1e-4])

    def pairs(element, dof, size):
        assert len(element) <= at_once
        slope = 1.0 + element + 10.0 * dof
        cube = 5.0 * size**3 * (element == 1)
        both = np.stack([slope * size + cube, 2.0 * slope * size], axis=1) * 2.0
        return Differences(both, both, both, np.abs(both[:, 0]), element != 2)

    found = sensitivity_matrix(pairs, at_once, elements, dofs, sizes, (np.zeros(2), np.zeros(2)))
    slope = 1.0 + np.arange(3)[:, None] + 10.0 * np.arange(2)
    cube = np.zeros((3, 2))
    cube[1] = 5.0 * sizes**2
    np.testing.assert_allclose(found.zernike[..., 0], slope + cube, rtol=1e-13)
    np.testing.assert_allclose(found.los[..., 1], 2.0 * slope, rtol=1e-13)
    assert np.isinf(found.disagreement[2]).all()
    np.testing.assert_allclose(found.disagreement[1], 3.0 * cube[1] / (2.0 * slope[2]), rtol=1e-6)
    assert found.worst[0] == "C"
    assert not found.agrees
