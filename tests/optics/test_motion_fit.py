"""Fits of motions that are sums of shapes, against the fit of all nodes displaced at every instant."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from wavequake.errors import UserError
from wavequake.optics.rays.pupils import sunflower
from wavequake.optics.shapes import motion_fit as module
from wavequake.optics.shapes.fit import apply, coefficients, surface_fit
from wavequake.optics.shapes.motion_fit import figures, motion_fit
from wavequake.optics.shapes.shapes import Conic, EvenAsphere

RADIUS, TERMS, INSTANTS = 500.0, 21, 400
PARABOLA = Conic(-3400.0, -1.0)
NODES = sunflower(0.0, 1.0, 600)
XY = RADIUS * np.column_stack([NODES.x, NODES.y])


def fit_of(shape=PARABOLA):
    return surface_fit(XY, np.ones(len(XY)), TERMS, RADIUS, 0.0, shape)


def smooth_shapes(count):
    """Displacements of order one that a plate of some thickness has: across the axis by its slopes."""
    x, y = XY.T / RADIUS
    found = []
    for n in range(count):
        i, j = n % 4, n // 4
        slopes = [i * x ** max(i - 1, 0) * y**j, j * x**i * y ** max(j - 1, 0)]
        found.append(np.stack([0.02 * slopes[0], 0.02 * slopes[1], x**i * y**j], axis=1))
    return np.array(found)


def amplitudes(count, size, seed=1):
    """Sums of few oscillations, mm."""
    rng = np.random.default_rng(seed)
    time = np.linspace(0.0, 1.0, INSTANTS)[:, None]
    waves = np.sin(2 * np.pi * time * np.arange(1, 4)) @ rng.standard_normal((3, count))
    return size * waves


def displaced(fit, shapes, sizes):
    """Heights in closed form, fitted; the sag of the displaced nodes less that at rest rounds by 1e-14 mm."""
    curvature, (x, y) = 1.0 / fit.shape.radius, XY.T
    u_x, u_y, u_z = np.moveaxis(np.tensordot(sizes, shapes, axes=1), 2, 0)
    above = u_z - curvature * (x * u_x + y * u_y + (u_x**2 + u_y**2) / 2.0)
    return coefficients(fit, above)


@pytest.fixture
def not_node_by_node(monkeypatch):
    """See that the quick way is the one that is tested."""

    def refuse(*_):
        raise AssertionError("the nodes were displaced")

    monkeypatch.setattr(module, "_node_by_node", refuse)


@pytest.mark.usefixtures("not_node_by_node")
@pytest.mark.parametrize("size", [1e-6, 1e-2, 1.0, 30.0])
@pytest.mark.parametrize("shape", [PARABOLA, Conic(900.0, -1.0), Conic()])
def test_the_nodes_need_not_be_displaced(shape, size):
    """To 1e-10 of the largest figure, also where squares make percents of it."""
    fit, shapes, sizes = fit_of(shape), smooth_shapes(12), amplitudes(12, size)
    truth = displaced(fit, shapes, sizes)
    found = figures(motion_fit(fit, shapes), sizes)
    np.testing.assert_allclose(found, truth, rtol=0, atol=1e-10 * np.abs(truth).max())


@pytest.mark.usefixtures("not_node_by_node")
def test_the_sag_at_displaced_nodes_is_meant():
    fit, shapes, sizes = fit_of(), smooth_shapes(12), amplitudes(12, 1.0)
    truth = apply(fit, np.tensordot(sizes, shapes, axes=1), linear=False)
    found = figures(motion_fit(fit, shapes), sizes)
    np.testing.assert_allclose(found, truth, rtol=0, atol=1e-10 * np.abs(truth).max())


@pytest.mark.usefixtures("not_node_by_node")
def test_squares_matter_and_are_found():
    """A shift by d across the axis of a parabola: tilt c d x, and piston c d^2 / 2 in closed form."""
    fit, distance = fit_of(), 20.0
    shift = np.zeros((1, len(XY), 3))
    shift[0, :, 0] = 1.0
    found = figures(motion_fit(fit, shift), distance * np.ones((INSTANTS, 1)))
    curvature = 1.0 / PARABOLA.radius
    expected = np.zeros(TERMS)
    # Noll: Z1 = 1, Z2 = 2 rho cos(theta).
    expected[:2] = -curvature * distance**2 / 2.0, -curvature * distance * RADIUS / 2.0
    np.testing.assert_allclose(found, np.tile(expected, (INSTANTS, 1)), rtol=0, atol=1e-11 * abs(expected[1]))


@pytest.mark.usefixtures("not_node_by_node")
def test_a_motion_across_the_axis_alone_is_all_squares():
    """About the axis nothing is linear: the height is -c/2 (angle rho)^2, piston and defocus."""
    fit, angle = fit_of(), 0.01
    turn = np.zeros((1, len(XY), 3))
    turn[0, :, 0], turn[0, :, 1] = -XY[:, 1], XY[:, 0]
    found = figures(motion_fit(fit, turn), angle * np.ones((INSTANTS, 1)))[0]
    # rho^2 = Z1 / 2 + Z4 / (2 sqrt(3)) on the unit circle.
    height = -0.5 / PARABOLA.radius * (angle * RADIUS) ** 2
    expected = np.zeros(TERMS)
    expected[[0, 3]] = height / 2.0, height / (2.0 * np.sqrt(3.0))
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-10 * abs(height))


@given(
    seed=st.integers(0, 10_000),
    count=st.integers(1, 30),
    size=st.sampled_from([1e-5, 1e-2, 1.0]),
    instants=st.sampled_from([1, 7, 300]),
)
def test_any_shapes_and_amplitudes(seed, count, size, instants):
    rng = np.random.default_rng(seed)
    fit, shapes = FIT, rng.standard_normal((count, len(XY), 3))
    shapes *= 10.0 ** rng.uniform(-6, 2, count)[:, None, None]
    sizes = size * rng.standard_normal((instants, count)) * 10.0 ** rng.uniform(-6, 2, count)
    truth = displaced(fit, shapes, sizes)
    found = figures(motion_fit(fit, shapes), sizes)
    np.testing.assert_allclose(found, truth, rtol=0, atol=1e-10 * np.abs(truth).max())


FIT = fit_of()


@pytest.mark.parametrize("shape", [Conic(-3400.0, 0.0), EvenAsphere(-3400.0, -1.0, (0.0, 1e-12))])
def test_other_surfaces_displace_the_nodes(shape):
    fit, shapes, sizes = fit_of(shape), smooth_shapes(6), amplitudes(6, 1.0)
    found = figures(motion_fit(fit, shapes), sizes)
    truth = apply(fit, np.tensordot(sizes, shapes, axes=1), linear=False)
    np.testing.assert_allclose(found, truth, rtol=0, atol=1e-12 * np.abs(found).max())
    # The paraboloid that touches it is not the same.
    touching = figures(motion_fit(fit_of(), shapes), sizes)
    assert np.abs(touching - found).max() > 1e-7 * np.abs(found).max()


def test_too_many_patterns_displace_the_nodes(monkeypatch):
    seen = []
    plain = module._node_by_node
    monkeypatch.setattr(module, "_node_by_node", lambda *args: seen.append(1) or plain(*args))
    rng = np.random.default_rng(3)
    shapes, sizes = rng.standard_normal((40, len(XY), 3)), rng.standard_normal((INSTANTS, 40))
    figures(motion_fit(FIT, shapes), sizes)
    assert seen
    del seen[:]
    figures(motion_fit(FIT, shapes), 1e-11 * sizes)  # squares that nobody sees need no patterns
    assert not seen


def test_rest_stays_at_rest():
    assert not figures(motion_fit(FIT, smooth_shapes(3)), np.zeros((5, 3))).any()


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_motion_that_is_not_finite(bad):
    motion = motion_fit(FIT, smooth_shapes(3))
    with pytest.raises(UserError, match="amplitude of a surface's motion is not finite"):
        figures(motion, np.array([[0.0, bad, 0.0]]))
    with pytest.raises(UserError, match="not finite"):
        motion_fit(FIT, np.full((2, len(XY), 3), bad))
