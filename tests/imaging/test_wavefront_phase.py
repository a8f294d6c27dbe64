import numpy as np
import pytest
from scipy.special import j0

from wavequake.errors import UserError
from wavequake.imaging.engines.matrix_fourier import matrix_fourier, psf
from wavequake.imaging.engines.segment_basis import segment_basis
from wavequake.imaging.engines.segment_psf import psf as exact_psf
from wavequake.imaging.pupils.outlines import segments
from wavequake.imaging.pupils.pupil_function import annular_pupil, sampled_pupil
from wavequake.imaging.pupils.wavefront_phase import ray_phase, segment_phase, zernike_phase

RNG = np.random.default_rng(4)
GRID = annular_pupil(256, 0.3)


def sunflower(count, inner):
    radius = np.sqrt(inner**2 + (1 - inner**2) * (np.arange(count) + 0.5) / count)
    angle = np.arange(count) * np.pi * (3 - np.sqrt(5))
    return radius * np.cos(angle), radius * np.sin(angle)


def test_zernike_terms_are_their_polynomials():
    coefficients = np.zeros((2, 4))
    coefficients[0, 1], coefficients[1, 3] = 0.3, 0.2
    tilt, focus = zernike_phase(GRID, coefficients, 0.3)
    assert tilt == pytest.approx(2 * np.pi * 0.3 * 2 * GRID.x / np.sqrt(1 + 0.09), abs=1e-12)
    rho = GRID.x**2 + GRID.y**2
    expected = np.sqrt(3) * (2 * rho - 1 - 0.09) / (1 - 0.09)
    assert focus == pytest.approx(2 * np.pi * 0.2 * expected, abs=1e-12)


def test_a_defocused_ring_has_the_closed_form_strehl():
    waves = 0.11
    image = psf(matrix_fourier(GRID, 8, 0.25), zernike_phase(GRID, np.array([[0, 0, 0, waves]]), 0.3))
    assert image[0, 4, 4] == pytest.approx(np.sinc(2 * np.sqrt(3) * waves) ** 2, abs=1e-4)


def test_rays_of_a_polynomial_give_it_back():
    x, y = sunflower(200, 0.3)
    wanted = RNG.normal(0, 0.1, (3, 21))
    opd = np.array([zernike_phase(_at(x, y), row[None], 0.3)[0] for row in wanted]) / (2 * np.pi)
    opd[1, [5, 77]] = np.nan
    found = ray_phase(GRID, x, y, opd, 21, 0.3)
    assert found.phase == pytest.approx(zernike_phase(GRID, wanted, 0.3), abs=1e-10)
    assert found.residual == pytest.approx(np.zeros(3), abs=1e-12)


def test_the_residual_tells_what_the_fit_misses():
    """Of a ripple a cos(k x) beyond the terms the rms is left; it costs a Strehl of 1 - J0(2 pi a)^2."""
    x, y = sunflower(2000, 0.0)
    ripple = 0.02 * np.cos(60 * x)
    found = ray_phase(GRID, x, y, ripple[None], 15)
    assert found.residual[0] == pytest.approx(0.02 / np.sqrt(2), rel=0.02)
    assert (2 * np.pi * found.residual[0]) ** 2 == pytest.approx(1 - j0(2 * np.pi * 0.02) ** 2, rel=0.05)
    assert np.abs(found.phase).max() < 2 * np.pi * 0.02


def test_an_instant_without_enough_rays_is_nan_alone():
    x, y = sunflower(60, 0.3)
    opd = np.zeros((2, 60))
    opd[0, 10:] = np.nan
    found = ray_phase(GRID, x, y, opd, 10, 0.3)
    assert np.isnan(found.phase[0]).all()
    assert np.isnan(found.residual[0])
    assert np.isfinite(found.phase[1]).all()


@pytest.mark.parametrize(("samples", "error"), [(64, 2.5e-3), (256, 1e-4)])
def test_moved_segments_give_the_exact_image(flower, samples, error):
    motion = np.zeros((2, 7, 3))
    motion[..., 0] = RNG.normal(0, 0.1, (2, 7))
    motion[..., 1:] = RNG.normal(0, 2e-4, (2, 7, 2))
    grid = sampled_pupil(segments(flower.corners), samples, 2700.0)
    phase = segment_phase(grid, flower.centers, motion, 1350.0)
    exact = segment_basis(flower.corners, flower.centers, 32, 0.3, 2700.0, 45, np.complex128)
    image = psf(matrix_fourier(grid, 32, 0.3), phase)
    assert np.abs(image - exact_psf(exact, motion, 1e-6).reshape(2, 32, 32)).max() < error


def test_bad_input_is_refused():
    x, y = sunflower(20, 0.3)
    with pytest.raises(UserError, match="20 rays cannot carry 11"):
        ray_phase(GRID, x, y, np.zeros((1, 20)), 11)
    with pytest.raises(UserError, match="do not tell 3 Zernike terms apart"):
        ray_phase(GRID, x, 0.0 * y, np.zeros((1, 20)), 3)
    with pytest.raises(UserError, match="need OPDs of shape"):
        ray_phase(GRID, x, y, np.zeros((1, 19)), 3)
    with pytest.raises(UserError, match="shape \\(batch, terms\\)"):
        zernike_phase(GRID, np.zeros(3))
    with pytest.raises(UserError, match="needs motions of shape"):
        segment_phase(GRID, np.zeros((1, 2)), np.zeros((1, 2, 3)), 1.0)


def _at(x, y):
    from dataclasses import replace

    return replace(GRID, x=x, y=y)
