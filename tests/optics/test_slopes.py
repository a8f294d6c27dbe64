from dataclasses import replace
from math import inf

import numpy as np
import pytest

from wavequake.errors import UserError
from wavequake.kernels.device.devices import NUMPY
from wavequake.kernels.device.tiles import TILE
from wavequake.kernels.trace.status import MISS, lost_at
from wavequake.optics.polynomials.zernike import annular_zernike
from wavequake.optics.rays.pupils import PupilRays, sunflower
from wavequake.optics.segments.catalog import telescope
from wavequake.optics.segments.layout import monolithic
from wavequake.optics.segments.prepared import at_field, chief_rays, prepare, trace_states
from wavequake.optics.segments.slopes import slope_fit, wavefront_from_slopes
from wavequake.optics.segments.telescope import Row, segmented_telescope, sequential_surfaces
from wavequake.optics.segments.wavefront import analyse
from wavequake.optics.systems.kinematics import rest_states

WAVELENGTH = 550e-6
FIVE_ARCMIN = np.deg2rad(5 / 60)


def quadrature_rays(inner, outer, radii=16, azimuths=48):
    nodes, weights = np.polynomial.legendre.leggauss(radii)
    r = np.sqrt(inner**2 + (outer**2 - inner**2) * (nodes + 1) / 2)
    theta = 2 * np.pi * np.arange(azimuths) / azimuths
    x, y = np.outer(r, np.cos(theta)).ravel(), np.outer(r, np.sin(theta)).ravel()
    return PupilRays(x, y, np.repeat(weights / 2 / azimuths, azimuths), np.zeros(len(x), dtype=np.int64))


def states_of(prepared, batch=TILE):
    return rest_states(prepared.system, batch)


def trace(prepared, states):
    return trace_states(prepared, states, NUMPY), chief_rays(prepared, states)


@pytest.fixture(scope="module")
def thesis():
    system = telescope("tmt-thesis")
    return prepare(system, quadrature_rays(system.annulus.inner, system.annulus.outer), WAVELENGTH, 91)


@pytest.mark.parametrize(
    ("field", "m2"),
    [
        ((0.0, 0.0), np.zeros(6)),
        ((FIVE_ARCMIN, 0.0), np.zeros(6)),
        ((0.0, 0.0), [0, 0, 0, 1e-4, 0, 0]),
        ((0.0, 0.0), [0.3, -0.2, 0.05, 1e-5, -2e-5, 0]),
        ((-0.3 * FIVE_ARCMIN, 0.5 * FIVE_ARCMIN), [0.3, -0.2, 0.05, 1e-5, -2e-5, 0]),
    ],
)
def test_slopes_and_path_lengths_agree_at_the_reference(thesis, field, m2):
    states, prepared = states_of(thesis), at_field(thesis, field)
    states.surface_motion[:, 2] = m2
    states.surface_motion[:, -1] = 0.1, 0.2, 0.3, 1e-3, -2e-3, 3e-3  # a detector out of place changes little
    traced, chief = trace(prepared, states)
    expected = analyse(prepared, traced, chief).zernike
    coefficients = wavefront_from_slopes(slope_fit(prepared, states.surface_motion[0]), traced, chief)
    assert np.isnan(coefficients[:, 0]).all()
    np.testing.assert_allclose(coefficients[:, 1:], expected[:, 1:], rtol=0, atol=1e-7)
    assert np.abs(expected[0, 1:]).max() > 1e-3


def test_one_fit_holds_for_small_motions(thesis):
    """Waves of tilt, coma and defocus by motions of M2, all from the fit about rest."""
    states = states_of(thesis)
    for instant, dof in enumerate((0, 1, 2, 3, 4)):
        states.surface_motion[instant, 2, dof] = (0.1, 0.1, 0.05, 1e-5, 1e-5)[instant]
    traced, chief = trace(thesis, states)
    expected = analyse(thesis, traced, chief).zernike[:5, 1:]
    coefficients = wavefront_from_slopes(slope_fit(thesis), traced, chief)[:5, 1:]
    largest = np.abs(expected).max(axis=1)
    assert (largest > 0.5).all()
    assert (np.abs(coefficients - expected).max(axis=1) < 1e-5 * largest).all()


def test_slopes_agree_behind_an_intermediate_image():
    """A Gregorian telescope turns its pupil over: the exit pupil is M1's image behind the prime focus."""
    rows = [Row("M2", 500.0, -4 / 9, 1300.0), Row("image", inf, 0.0, 1500.0)]
    system = segmented_telescope(
        "gregorian", monolithic(100.0), -2000.0, -1.0, sequential_surfaces(rows), -2.5, 30.0, 100.0
    )
    prepared = prepare(system, quadrature_rays(30.0, 100.0), WAVELENGTH, 45)
    states = states_of(prepared)
    states.surface_motion[:, 2] = [0.2, -0.3, 0.1, 1e-3, 2e-3, 0]
    prepared = at_field(prepared, (1e-3, -2e-3))
    traced, chief = trace(prepared, states)
    expected = analyse(prepared, traced, chief).zernike
    coefficients = wavefront_from_slopes(slope_fit(prepared, states.surface_motion[0]), traced, chief)
    np.testing.assert_allclose(coefficients[:, 1:], expected[:, 1:], rtol=0, atol=1e-8)
    assert np.abs(expected[0, 1:]).max() > 0.1


def test_a_displaced_paraboloid_in_closed_form():
    """A paraboloid, moved, images the axis onto its own focus: the wavefront is a sphere about it.

    At f/1 the exit pupil is strongly distorted. OPD = |P - focus| + constant at the points P of the reference
    sphere about the undisplaced focus.
    """
    outer, inner, radius = 500.0, 150.0, -2000.0
    surfaces = sequential_surfaces([Row("camera", inf, 0.0, 1000.0)])
    system = segmented_telescope(
        "paraboloid", monolithic(outer), radius, -1.0, surfaces, outer**2 / 2 / radius, inner, outer
    )
    prepared = prepare(system, quadrature_rays(inner, outer), WAVELENGTH, 66)
    states = states_of(prepared)
    to_sky = np.array([1, 1, -1.0])
    moves = 1e-3 * np.array([[4, 0, 0], [0, -6, 0], [0, 0, 20], [2, 4, -20]])  # mm in the optics frame
    states.segment_motion[:4, 0, :3] = moves * to_sky
    coefficients = wavefront_from_slopes(slope_fit(prepared), *trace(prepared, states))
    x, y, weight = prepared.rays.x, prepared.rays.y, prepared.weight
    basis = annular_zernike(x / outer, y / outer, 66, inner / outer)
    center = np.array([0, 0, radius / 2])
    for move, measured in zip(moves, coefficients, strict=False):
        height = ((x - move[0]) ** 2 + (y - move[1]) ** 2) / 2 / radius + move[2]
        mirror, focus = np.stack([x, y, height], axis=1), center + move
        ray = (focus - mirror) / np.linalg.norm(focus - mirror, axis=1, keepdims=True)
        back = (focus - center) @ ray.T  # along the ray to the sphere, against the light
        back += np.sqrt(back**2 - np.sum((focus - center) ** 2) + prepared.train.sphere_radius**2)
        expected = basis.T @ (weight * back) / WAVELENGTH
        largest = np.abs(expected[1:]).max()
        assert largest > 1.0
        bound = np.linalg.norm(move) / (-radius / 2)  # relative change of the geometry that the fit is about
        np.testing.assert_allclose(measured[1:], expected[1:], rtol=0, atol=bound * largest)


def test_lost_rays_are_left_out(thesis):
    states = states_of(thesis)
    states.surface_motion[:, 2, 3] = 1e-5
    traced, chief = trace(thesis, states)
    fit = slope_fit(thesis)
    expected = wavefront_from_slopes(fit, traced, chief)
    status = traced.status.copy()
    status[0, ::7, 3] = lost_at(MISS, 1)
    status[0, 5:, 4] = lost_at(MISS, 1)
    status[0, :, 5] = lost_at(MISS, 1)
    lost = status != 0
    x, y = (np.where(lost, np.nan, values) for values in (traced.x, traced.y))
    coefficients = wavefront_from_slopes(fit, replace(traced, x=x, y=y, status=status), chief)
    assert np.isnan(coefficients[4:6]).all()
    kept = np.delete(np.arange(TILE), [4, 5])
    np.testing.assert_allclose(coefficients[kept, 1:], expected[kept, 1:], rtol=0, atol=1e-7)
    assert (coefficients[3, 1:] != expected[3, 1:]).any()


def test_segment_pistons_are_invisible_segment_tilts_are_not():
    system = telescope("tmt-18")
    centers = system.segments.centers
    rays = sunflower(system.annulus.inner, system.annulus.outer, 400)
    nearest = np.argmin(np.hypot(rays.x[:, None] - centers[:, 0], rays.y[:, None] - centers[:, 1]), axis=1)
    prepared = prepare(system, replace(rays, segment=nearest), WAVELENGTH, 21)
    states = states_of(prepared)
    random = np.random.default_rng(4)
    states.segment_motion[0, :, 2] = random.uniform(-1e-4, 1e-4, 18)  # pistons, mm
    states.segment_motion[1, :, 3] = (
        1e-7  # all tilted alike: stairs to the path lengths, a tilt to the slopes
    )
    traced, chief = trace(prepared, states)
    by_path = analyse(prepared, traced, chief).zernike
    by_slope = wavefront_from_slopes(slope_fit(prepared), traced, chief)
    by_path, by_slope = by_path - by_path[2], by_slope - by_slope[2]
    assert np.abs(by_slope[0, 1:]).max() < 0.03 * np.abs(by_path[0, 1:]).max()
    assert np.abs(by_slope[1, 1:3]).max() > 1.0


def test_an_unknown_motion_spoils_its_own_instant_only(thesis):
    states = states_of(thesis)
    states.surface_motion[:, 2, 3] = 1e-6
    fit = slope_fit(thesis)
    expected = wavefront_from_slopes(fit, *trace(thesis, states))
    states.surface_motion[7, 2, 0] = np.nan
    coefficients = wavefront_from_slopes(fit, *trace(thesis, states))
    assert np.isnan(coefficients[7]).all()
    np.testing.assert_array_equal(np.delete(coefficients, 7, axis=0), np.delete(expected, 7, axis=0))


def test_bad_references_are_named(thesis):
    with pytest.raises(UserError, match="do not reach the image"):
        slope_fit(at_field(thesis, (1.2, 0.0)))
    with pytest.raises(UserError, match="do not reach the image"):
        slope_fit(at_field(thesis, (np.nan, 0.0)))
    with pytest.raises(UserError, match=r"must be \(5, 6\)"):
        slope_fit(thesis, motion=np.zeros(6))
