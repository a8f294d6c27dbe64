from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from wavequake.kernels.device.devices import NUMPY
from wavequake.kernels.device.tiles import TILE
from wavequake.optics.rays.pupils import PupilRays
from wavequake.optics.segments.catalog import telescope
from wavequake.optics.segments.prepared import chief_rays, prepare, trace_states
from wavequake.optics.segments.slopes import sphere_points
from wavequake.optics.segments.wavefront import analyse
from wavequake.optics.systems.kinematics import rest_states
from wavequake.optics.wavefronts.sphere_fit import fit_sphere, reference_fit


def cap(center, radius, sine, count=60, seed=0):
    """Points of an annular cap about the z axis before `center`, up to the aperture angle of this sine."""
    random = np.random.default_rng(seed)
    rho, theta = radius * sine * np.sqrt(random.uniform(0.1, 1, count)), random.uniform(0, 2 * np.pi, count)
    x, y = rho * np.cos(theta), rho * np.sin(theta)
    return center + np.stack([x, y, -np.sqrt(radius**2 - rho**2)], axis=1)


coordinates = st.floats(-1e3, 1e3)


@given(coordinates, coordinates, coordinates, st.floats(1, 1e5), st.floats(0.01, 0.95), st.integers(0, 99))
def test_a_sphere_is_found_again(x, y, z, radius, sine, seed):
    points = cap(np.array([x, y, z]), radius, sine, seed=seed)
    fitted = fit_sphere(points[None], np.random.default_rng(seed).uniform(1, 2, len(points)))
    # Rounding of the points moves the center along the axis by their sag's inverse.
    bound = 1e-13 * (radius + 1e3) / sine**2
    np.testing.assert_allclose(fitted.center, [[x, y, z]], rtol=0, atol=bound)
    np.testing.assert_allclose(fitted.radius, [radius], rtol=0, atol=bound)
    assert fitted.rms[0] < 1e-14 * (radius + 1e3)


@pytest.mark.parametrize("sine", [1 / 30, 0.5])
def test_noisy_points_against_scipy(sine):
    random = np.random.default_rng(3)
    points = cap(np.array([1.0, -2.0, 3.0]), 100.0, sine) + 1e-2 * sine * random.normal(size=(60, 3))
    weight = random.uniform(0.5, 2, 60)

    def residuals(unknown):
        return np.sqrt(weight) * (np.linalg.norm(points - unknown[:3], axis=1) - unknown[3])

    def jacobian(unknown):
        ray = unknown[:3] - points
        normal = ray / np.linalg.norm(ray, axis=1, keepdims=True)
        return np.sqrt(weight)[:, None] * np.concatenate([normal, -np.ones((60, 1))], axis=1)

    tight = {"xtol": 1e-15, "ftol": 1e-15, "gtol": 1e-15}
    truth = least_squares(residuals, [1, -2, 3, 100], jacobian, x_scale="jac", **tight).x
    fitted = fit_sphere(points[None], weight)
    np.testing.assert_allclose([*fitted.center[0], fitted.radius[0]], truth, rtol=1e-6)
    expected = np.sqrt(np.sum(residuals(truth) ** 2) / weight.sum())
    np.testing.assert_allclose(fitted.rms, expected, rtol=1e-9)


@given(coordinates, coordinates, coordinates, st.floats(0, 6), st.floats(0.1, 10))
def test_spheres_move_turn_and_grow_with_their_points(x, y, z, angle, scale):
    random = np.random.default_rng(6)
    points = cap(np.zeros(3), 10.0, 0.6) + 0.05 * random.normal(size=(60, 3))
    turn, shift = Rotation.from_euler("XYZ", [angle, 2 * angle, -angle]).as_matrix(), np.array([x, y, z])
    weight = random.uniform(1, 2, 60)
    both = fit_sphere(np.stack([points, scale * points @ turn.T + shift]), weight)
    np.testing.assert_allclose(both.center[1], scale * turn @ both.center[0] + shift, rtol=0, atol=1e-7)
    np.testing.assert_allclose(both.radius[1], scale * both.radius[0], rtol=1e-8)
    np.testing.assert_allclose(both.rms[1], scale * both.rms[0], rtol=1e-6)


def test_lost_points_are_left_out():
    points = cap(np.array([1.0, 2.0, 3.0]), 50.0, 0.3)
    spoiled = np.stack([points, points + 1.0])
    spoiled[0, ::3, 2] = np.nan
    weight = np.ones(len(points))
    fitted = fit_sphere(spoiled, weight)
    np.testing.assert_allclose(fitted.center, [[1, 2, 3], [2, 3, 4]], rtol=0, atol=1e-11)
    alone = fit_sphere(np.delete(points, np.s_[::3], axis=0)[None], np.delete(weight, np.s_[::3]))
    np.testing.assert_allclose(fitted.center[0], alone.center[0], rtol=0, atol=1e-11)


def test_points_that_determine_no_sphere_give_nan():
    sphere = cap(np.zeros(3), 10.0, 0.5, 12)
    plane = sphere * np.array([1, 1, 0.0])
    line, same = sphere * np.array([1.0, 0, 0]), np.ones((12, 3))
    few, none = sphere.copy(), np.full((12, 3), np.nan)
    few[3:] = np.nan
    fitted = fit_sphere(np.stack([sphere, plane, line, same, few, none]), np.ones(12))
    assert fitted.radius[0] == pytest.approx(10)
    for values in (fitted.radius, fitted.rms, fitted.center[:, 0]):
        np.testing.assert_array_equal(np.isnan(values), [False] + [True] * 5)
    assert np.isnan(fit_sphere(sphere[None, :3], np.ones(3)).radius).all()


@pytest.fixture(scope="module")
def thesis():
    system = telescope("tmt-thesis")
    inner, outer = system.annulus.inner, system.annulus.outer
    nodes, weights = np.polynomial.legendre.leggauss(16)
    r, theta = np.sqrt(inner**2 + (outer**2 - inner**2) * (nodes + 1) / 2), 2 * np.pi * np.arange(48) / 48
    x, y = np.outer(r, np.cos(theta)).ravel(), np.outer(r, np.sin(theta)).ravel()
    rays = PupilRays(x, y, np.repeat(weights / 96, 48), np.zeros(len(x), dtype=np.int64))
    return prepare(system, rays, 550e-6, 36)


@pytest.fixture(scope="module")
def disturbed(thesis):
    """Rays and chief rays of motions of M2: tilts of 1 to 10 urad with their coma, shifts and a focus."""
    states = rest_states(thesis.system, TILE)
    for instant, (dof, size) in enumerate([(3, 1e-6), (4, -1e-5), (0, 0.05), (1, -0.02), (2, 0.01)], start=1):
        states.surface_motion[instant, 2, dof] = size
    return trace_states(thesis, states, NUMPY), chief_rays(thesis, states)


def test_the_best_fit_sphere_looks_where_eq_339_does(thesis, disturbed):
    """Two ways to the direction of the wavefront: its tilt is in the image point now, the rest is unchanged.

    The tilt of the sphere is that of a sine, the polynomial's one that of the pupil: 1e-7 apart for the TMT.
    """
    by_chief = analyse(thesis, *disturbed)
    by_sphere = analyse(replace(thesis, sphere=reference_fit(thesis)), *disturbed)
    moved = np.abs(by_chief.los[:6]).max(axis=1)
    assert (moved[1:5] > 0.05).all()
    difference = np.abs(by_sphere.los - by_chief.los)[:6].max(axis=1)
    assert (difference < 2e-7 * moved + 1e-6).all()
    assert np.abs(by_chief.zernike[2, 1:3]).max() > 0.1
    assert np.abs(by_sphere.zernike[:6, 1:3]).max() < 1e-6 * np.abs(by_chief.zernike[:6, 1:3]).max()
    np.testing.assert_allclose(by_sphere.zernike[:6, 3:], by_chief.zernike[:6, 3:], rtol=0, atol=5e-7)
    np.testing.assert_allclose(by_sphere.strehl, by_chief.strehl, rtol=0, atol=1e-6)
    np.testing.assert_array_equal(by_sphere.segment_phase, by_chief.segment_phase)
    np.testing.assert_array_equal(by_sphere.chief, by_chief.chief)


def test_the_linear_fit_is_the_sphere_through_the_wavefronts_points(thesis, disturbed):
    """A point of the wavefront lies its OPD beyond the reference sphere along the ray, that is, inwards."""
    traced, chief = disturbed
    radius = thesis.train.sphere_radius
    across = sphere_points(thesis, rest_states(thesis.system, TILE))[2]
    sphere = np.column_stack([across, -np.sqrt(radius**2 - np.sum(across**2, axis=1))])
    points = sphere * (1.0 - traced.opd[0].T[..., None] / radius)
    centers = fit_sphere(points, thesis.weight).center[:, :2]
    with_sphere = replace(thesis, sphere=reference_fit(thesis))
    moved = analyse(with_sphere, traced, chief)
    rest_of_tilt = analyse(thesis, traced, chief).los - moved.chief
    assert np.abs(rest_of_tilt[2]).max() > 0.01
    # Rounding of coordinates of 46 m, over the sag: 1e-5 mm.
    np.testing.assert_allclose(centers, rest_of_tilt, rtol=0, atol=2e-5)


def test_lost_rays_do_not_pull_the_sphere(thesis, disturbed):
    traced, chief = disturbed
    with_sphere = replace(thesis, sphere=reference_fit(thesis))
    whole = analyse(with_sphere, traced, chief)
    holed = replace(traced, opd=traced.opd.copy(), status=traced.status.copy())
    holed.opd[0, ::5, 4], holed.status[0, ::5, 4] = np.nan, 1
    part = analyse(with_sphere, holed, chief)
    np.testing.assert_array_equal(np.delete(part.los, 4, 0), np.delete(whole.los, 4, 0))
    np.testing.assert_allclose(part.los[4], whole.los[4], rtol=0, atol=1e-3 * np.abs(whole.los[4]).max())
    assert part.los[4, 1] != whole.los[4, 1]
