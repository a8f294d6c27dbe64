"""The kernel against a trace in 80-bit numbers that shares no code with it: unit directions, explicit sag."""

import math
from functools import cache

import numpy as np
import pytest

from wavequake.kernels.device.devices import NUMPY, list_devices
from wavequake.kernels.trace.ring import ring_order
from wavequake.kernels.trace.sequence import Element, Moving, Rays, Ring, Sequence
from wavequake.kernels.trace.sequential import trace_sequence

ALL = [NUMPY, *(device for device in list_devices() if device.kind != "numpy")]
LONG = np.longdouble
M1, K1 = -60e3, -1.00095348
M2, K2 = -6227.68, -1.31822813


def zernike_figure(degree, rms):
    """Random circular Zernike polynomials of all orders up to `degree`, from n = 2 on, by (n, m)."""
    random = np.random.default_rng(degree)
    orders = [(n, m) for n in range(2, degree + 1) for m in range(n % 2, n + 1, 2)]
    return {(n, sign * m): rms * random.normal() for n, m in orders for sign in ((1, -1) if m else (1,))}


def as_monomials(figure, degree):
    """The figure as monomials with coefficients of 80 bits, whose sums keep 10 digits at degree 30."""
    total = np.zeros((degree + 1, degree + 1), LONG)
    for (n, signed), rms in figure.items():
        m = abs(signed)
        weight = LONG(rms) * np.sqrt(LONG((n + 1) * (2 if m else 1)))
        for k in range((n - m) // 2 + 1):
            radial = (-1) ** k * math.comb(n - k, k) * math.comb(n - 2 * k, (n - m) // 2 - k)
            q = (n - m) // 2 - k
            # rho^(2q) (x + i y)^m, of whose second factor cosines take the even powers of y
            for a in range(q + 1):
                for b in range(1 if signed < 0 else 0, m + 1, 2):
                    factor = radial * (-1) ** (b // 2) * math.comb(m, b) * math.comb(q, a)
                    total[2 * a + m - b, 2 * (q - a) + b] += weight * LONG(factor)
    return np.array([[total[s - j, j] for s in range(degree + 1) for j in range(s + 1)]])


def long_trace(position, direction, coefficients, degree, fold, image):
    """Trace to the image plane through M1 with its figure, M2 and a fold, all in numbers of 80 bits."""
    p, d = position.astype(LONG), direction.astype(LONG)
    d = d / np.sqrt((d * d).sum(axis=0))
    opl = np.zeros(p.shape[1], LONG)
    powers = [(s - j, j) for s in range(degree + 1) for j in range(s + 1)]
    scale = LONG(15000)

    def figure(x, y):
        of_u, of_v = ([LONG(1) + 0 * t] for t in (x, y))
        for _ in range(degree):
            of_u.append(of_u[-1] * (x / scale))
            of_v.append(of_v[-1] * (y / scale))
        value, along_x, along_y = LONG(0) * x, LONG(0) * x, LONG(0) * x
        for c, (i, j) in zip(coefficients[0].astype(LONG), powers, strict=True):
            value = value + c * of_u[i] * of_v[j]
            if i:
                along_x = along_x + c * i * of_u[i - 1] * of_v[j] / scale
            if j:
                along_y = along_y + c * j * of_u[i] * of_v[j - 1] / scale
        return value, along_x, along_y

    def bare(x, y):
        return LONG(0) * x, LONG(0) * x, LONG(0) * x

    for vertex, radius, conic, extra in ((0.0, M1, K1, figure), (-27093.75, M2, K2, bare)):
        p = p - np.array([[0], [0], [vertex]], LONG)
        c, k = 1 / LONG(radius), LONG(conic)
        way = -p[2] / d[2]
        for _ in range(12):
            x, y, z = p + way * d
            square = x * x + y * y
            edge = np.sqrt(1 - (1 + k) * c * c * square)
            more, more_x, more_y = extra(x, y)
            slope_x, slope_y = c * x / edge + more_x, c * y / edge + more_y
            step = (z - c * square / (1 + edge) - more) / (d[2] - slope_x * d[0] - slope_y * d[1])
            way = way - step
        assert np.abs(step).max() < 1e-13
        p, opl = p + way * d, opl + way
        normal = np.stack([-slope_x, -slope_y, np.ones_like(x)])
        d = d - 2 * (normal * d).sum(axis=0) / (normal * normal).sum(axis=0) * normal
        p = p + np.array([[0], [0], [vertex]], LONG)
    for plane in (fold, image):
        origin, normal = np.array(plane[0], LONG)[:, None], np.array(plane[1], LONG)[:, None]
        way = ((origin - p) * normal).sum(axis=0) / (normal * d).sum(axis=0)
        p, opl = p + way * d, opl + way
        if plane is fold:
            d = d - 2 * (normal * d).sum(axis=0) / (normal * normal).sum(axis=0) * normal
    return p - np.array(image[0], LONG)[:, None], opl


@cache
def telescope(degree, count=400):
    """Arguments of `trace_sequence` for a thirty-meter telescope, and what the long trace finds."""
    figure = zernike_figure(degree, 2e-5)
    monomials = as_monomials(figure, degree)
    basis, coefficients = "monomial", monomials.astype(float)
    if degree > 20:
        basis, coefficients = Ring(), np.array([[figure.get(order, 0.0) for order in ring_order(degree)]])
    i = np.arange(count) + 0.5
    r, phi = np.sqrt(3e3**2 + (15e3**2 - 3e3**2) * i / count), i * math.pi * (3 - math.sqrt(5))
    position = np.stack([r * np.cos(phi), r * np.sin(phi), np.full(count, -1e4)])
    direction = np.array([1e-4, -5e-5, math.sqrt(1 - 1e-8 - 2.5e-9)])
    rays = Rays(position, np.broadcast_to(direction[:, None], (3, count)), np.zeros(count))

    # The fold's axes are (1, 0, -1) and (1, 0, 1) times sqrt(1/2); light leaves it towards -x.
    half = math.sqrt(0.5)
    turn = np.array([[half, 0, -half], [0, 1, 0], [half, 0, half]])
    axes = np.array([[0, 0, 1], [0, 1, 0], [-1.0, 0, 0]])
    poses = np.array([[
        [*np.eye(3).ravel(), 0, 0, 0],
        [*np.eye(3).ravel(), 0, 0, 27093.75],
        [*turn.ravel(), *(-turn @ np.array([0, 0, 23593.75]))],
        [*(axes @ turn.T).ravel(), *(-axes @ np.array([-20000.0, 0, 0]))],
    ]])  # fmt: skip
    mirror = Element(
        1 / M1,
        K1,
        "reflect",
        deformation_degree=degree,
        deformation_radius=15e3,
        deformation_basis=basis,
    )
    elements = (mirror, Element(1 / M2, K2, "reflect"), Element(action="reflect"), Element())
    moving = Moving(poses, (coefficients, None, None, None))
    fold, image = ([0, 0, -3500.0], [half, 0, half]), ([-20000.0, 0, -3500.0], [-1.0, 0, 0])
    place, path = long_trace(position, rays.direction, monomials, degree, fold, image)
    return (Sequence(elements), rays, moving), (axes[0] @ place, axes[1] @ place, path)


@pytest.mark.parametrize("device", ALL, ids=lambda device: device.kind)
@pytest.mark.parametrize("degree", [6, 13, 30])
def test_a_deformed_telescope_agrees_with_80_bit_numbers(degree, device):
    """28, 105 or 496 terms of 20 nm rms: position to 2e-12 m, path to 3e-13 m."""
    arguments, (x, y, path) = telescope(degree)
    traced = trace_sequence(*arguments, device)
    assert arguments[2].deformations[0].shape == (1, {6: 28, 13: 105, 30: 496}[degree])
    assert (traced.status == 0).all()
    assert np.abs(traced.x[0] - x).max() < 2e-9
    assert np.abs(traced.y[0] - y).max() < 2e-9
    assert np.abs(traced.path[0] - path).max() < 3e-10
