"""Zernike polynomials with a grid of what they leave: traced, and against closed forms."""

from dataclasses import replace

import numpy as np
import pytest

from wavequake.errors import UserError
from wavequake.kernels.device.devices import NUMPY, choose_device
from wavequake.optics.rays.packing import moving, pack
from wavequake.optics.rays.pupils import sunflower
from wavequake.optics.shapes.fit import coefficients, heights, residual, residual_grid, surface_fit
from wavequake.optics.shapes.sag import deformation_sag
from wavequake.optics.shapes.shapes import Conic, GridDeformation, ZernikeDeformation
from wavequake.optics.systems.kinematics import rest_states
from wavequake.optics.systems.system import OpticalSystem, Pupil, Surface
from wavequake.optics.wavefronts.wavefront import prepare_system, trace_system

A, F, TERMS = 100.0, 2000.0, 15
GRID = GridDeformation(61, 81, 2.6, 3.5)
BOTH = ZernikeDeformation(TERMS, A, 0.0, GRID)
PARABOLA = Conic(-2.0 * F, -1.0)


def mirror(form):
    """A parabolic mirror that images a star on its axis."""
    surface = Surface("mirror", PARABOLA, action="reflect", deformation=form)
    image = Surface("image", position=np.array([0.0, 0.0, -F]))
    return OpticalSystem("mirror", (surface, image), 0, Pupil("entrance_diameter", 2.0 * A))


def deformed(prepared, numbers, device=NUMPY):
    states = rest_states(prepared.system, len(numbers))
    return trace_system(prepared, replace(states, deformations=(numbers, None)), device)


@pytest.fixture(scope="module")
def prepared():
    x, y, *_ = vars(sunflower(0.0, 1.0, 400)).values()
    return prepare_system(mirror(BOTH), x, y, np.ones(len(x)), TERMS)


def numbers(instants=3, size=1e-4):
    return np.random.default_rng(5).normal(size=(instants, BOTH.size)) * size


def test_heights_and_slopes_are_the_sum_of_both():
    x, y = np.random.default_rng(1).uniform(-70, 70, (2, 50))
    given = numbers()[0]
    parts = (
        deformation_sag(ZernikeDeformation(TERMS, A), given[:TERMS], x, y),
        deformation_sag(GRID, given[TERMS:].reshape(61, 81), x, y),
    )
    for whole, one, two in zip(deformation_sag(BOTH, given, x, y), *parts, strict=True):
        np.testing.assert_array_equal(whole, one + two)
    with pytest.raises(UserError, match="takes 4956 coefficients"):
        deformation_sag(BOTH, given[:TERMS], x, y)


@pytest.mark.parametrize("platform", ["auto", "numpy"])
def test_a_grid_per_instant_traces_on_the_device_as_in_numpy(prepared, platform):
    smooth = numbers(5)
    smooth[:, TERMS:] = (
        np.cos(np.linspace(0, 9, 61))[:, None] * np.sin(np.linspace(0, 7, 81))
    ).ravel() * 1e-4
    smooth[:, TERMS:] *= np.arange(5)[:, None]
    opd, traced, _ = deformed(prepared, smooth, choose_device(platform))
    twin, expected, _ = deformed(prepared, smooth)
    np.testing.assert_allclose(opd * prepared.wavelength, twin * prepared.wavelength, rtol=0, atol=2e-9)
    np.testing.assert_allclose(traced.x, expected.x, rtol=0, atol=1e-9)
    # Every instant has a grid of its own, and the grid is not that of another.
    assert np.ptp(opd - opd[0], axis=1)[1:].min() > 0.1


def test_numbers_that_are_not_finite_or_too_few_are_refused(prepared):
    bad = numbers()
    bad[1, -1] = np.nan
    for given, message in ((bad, "not finite"), (numbers()[:, :TERMS], r"must be \(3, 4956\)")):
        states = replace(rest_states(prepared.system, 3), deformations=(given, None))
        with pytest.raises(UserError, match=message):
            moving(prepared.system, states)
    with pytest.raises(UserError, match="at least 4 of each"):
        pack(mirror(replace(BOTH, residual=replace(GRID, rows=3))), 550e-6)


def ripple(x, y, size=2e-5, wave=2 * np.pi / 25.0):
    return size * np.sin(wave * x) * np.cos(wave * y), size * wave


def nodes(apart):
    """A square lattice within the rim, and nodes on it."""
    place = np.arange(-A, A + 1, apart)
    x, y = (part.ravel() for part in np.meshgrid(place, place))
    kept = np.hypot(x, y) < A - apart
    around = np.linspace(0, 2 * np.pi, round(2 * np.pi * A / apart), endpoint=False)
    rim = 0.999 * A * np.stack([np.cos(around), np.sin(around)])
    return np.hstack([[x[kept], y[kept]], rim]).T


def flat(prepared, path):
    """Return a wavefront without its plane."""
    basis = np.column_stack([np.ones(len(path)), prepared.pupil])
    return path - basis @ np.linalg.lstsq(basis, path)[0]


def rms(values):
    return np.sqrt(np.mean(values**2))


def test_a_ripple_beyond_the_polynomials_is_lost_without_the_grid_and_found_with_it(prepared):
    """A ripple h lengthens the path by 2 h f / (f + sag) to first order: 2 h where upright."""
    x, y = (prepared.pupil * A).T
    height, slope = ripple(x, y)
    far = F + (x**2 + y**2) / (4 * F)
    # The chief ray meets the ripple's slope at the vertex, and its image is the center of the sphere.
    truth = flat(prepared, 2 * F * (slope * x - height) / far)
    assert rms(truth) > 1.9e-5  # near 2 h, whose rms is the ripple's height here
    errors = []
    for apart in (5.0, 3.2, 2.0):
        xy = nodes(apart)
        fit = surface_fit(xy, np.ones(len(xy)), TERMS, A, 0.0, PARABOLA)
        moved = np.zeros((1, len(xy), 3))
        moved[0, :, 2] = ripple(*xy.T)[0]
        above = heights(fit, moved)
        figure = coefficients(fit, above)
        grid = residual_grid(fit, residual(fit, above, figure), GRID).reshape(1, -1)
        lost, found = (
            flat(prepared, deformed(prepared, np.hstack([figure, rest]))[0][0] * prepared.wavelength)
            for rest in (0 * grid, grid)
        )
        assert rms(lost) < 0.1 * rms(truth)
        errors.append(rms(found - truth) / rms(truth))
    assert errors[2] < 0.5 * errors[1] < 0.25 * errors[0]
    assert errors[2] < 0.01
