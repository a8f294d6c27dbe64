import numpy as np
import pytest
from scipy.special import j1

from wavequake.errors import UserError
from wavequake.imaging.engines.matrix_fourier import matrix_fourier, psf
from wavequake.imaging.exposures.detector import expected_photons, pixel_means
from wavequake.imaging.exposures.polychromatic import polychromatic_psf
from wavequake.imaging.pupils.pupil_function import annular_pupil
from wavequake.imaging.pupils.wavefront_phase import zernike_phase

GRID = annular_pupil(256)


def airy(x, y):
    t = np.pi * np.hypot(x, y)
    return (2 * j1(t) / t) ** 2


def test_pixels_hold_the_integral_of_the_airy_pattern():
    axis = (np.arange(160) - 80) * 0.4
    image = psf(matrix_fourier(GRID, 160, 0.4), np.zeros((1, GRID.cells.size)))
    means = pixel_means(image, 0.4, 0.4)[0]
    u, weight = np.polynomial.legendre.leggauss(8)
    for row, column in ((80, 80), (81, 79), (83, 80), (90, 70)):
        x, y = axis[column] + 0.2 * u, axis[row] + 0.2 * u[:, None]
        assert means[row, column] == pytest.approx(weight @ airy(x, y) @ weight / 4, abs=2e-5)


def test_photons_are_counted_completely():
    grid = annular_pupil(64, 0.3)
    phase = zernike_phase(grid, np.array([[0, 0, 0, 0.1, 0.05]]), 0.3)
    images = psf(matrix_fourier(grid, 128, 0.5), phase)  # one whole period
    area = np.sum(grid.amplitude**2) * (2 / 64) ** 2
    scale = (np.sum(grid.amplitude) * (2 / 64) ** 2 / area) ** 2
    counted = expected_photons(pixel_means(images, 0.5, 0.5), 0.5, area, 2.0, 1e6)
    assert counted.sum() * scale == pytest.approx(1e6, rel=1e-10)


def test_one_wavelength_is_the_monochromatic_image():
    phase = zernike_phase(GRID, np.array([[0, 0, 0, 0.1]]))
    assert np.array_equal(
        polychromatic_psf(GRID, phase, [550.0], [3.0], 16, 0.25), psf(matrix_fourier(GRID, 16, 0.25), phase)
    )


def test_white_light_is_the_sum_of_scaled_airy_patterns():
    wavelengths, flux = np.array([550.0, 440.0, 700.0]), np.array([1.0, 2.0, 0.5])
    image = polychromatic_psf(GRID, np.zeros((1, GRID.cells.size)), wavelengths, flux, 32, 0.25)[0]
    axis = (np.arange(32) - 16) * 0.25
    bright = flux * (550 / wavelengths) ** 2
    expected = sum(b * airy(550 / w * axis, 550 / w * 0.75) for b, w in zip(bright, wavelengths, strict=True))
    assert image[19] == pytest.approx(expected / bright.sum(), abs=1e-4)


def test_strehl_falls_toward_short_wavelengths():
    phase = zernike_phase(GRID, np.array([[0, 0, 0, 0.1]]))
    found = polychromatic_psf(GRID, phase, [1.0, 0.5], [1.0, 1.0], 8, 0.25)[0, 4, 4]
    strehl = np.sinc(2 * np.sqrt(3) * 0.1 * np.array([1.0, 2.0])) ** 2
    assert found == pytest.approx((strehl[0] + 4 * strehl[1]) / 5, abs=1e-4)


def test_a_tilt_of_the_path_moves_all_wavelengths_alike():
    tilt = np.pi * 2.0 * GRID.x[None]  # 2 first wavelengths / diameter
    found = polychromatic_psf(GRID, tilt, [1.0, 0.8], [1.0, 1.0], 24, 0.5)[0]
    assert np.unravel_index(found.argmax(), found.shape) == (12, 16)
    assert found.max() == pytest.approx(1.0, abs=3e-3)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: pixel_means(np.ones((4, 4)), 0.6, 0.6), "at most 0.5"),
        (lambda: pixel_means(np.ones((4, 4)), 0.4, -1.0), "width of a pixel"),
        (lambda: pixel_means(np.ones(4), 0.4, 0.4), "rows and columns"),
        (lambda: expected_photons(np.ones((4, 4)), 0.4, 0.0, 1.0, 1.0), "above 0"),
        (lambda: expected_photons(np.ones((4, 4)), 0.4, 1.0, 1.0, -1.0), "at least 0"),
        (lambda: polychromatic_psf(GRID, np.zeros((1, 1)), [1.0], [1.0, 2.0], 8, 0.2), "as many fluxes"),
        (lambda: polychromatic_psf(GRID, np.zeros((1, 1)), [0.0], [1.0], 8, 0.2), "above 0 and finite"),
        (lambda: polychromatic_psf(GRID, np.zeros((1, 1)), [1.0], [0.0], 8, 0.2), "one above 0"),
    ],
)
def test_bad_input_is_refused(call, message):
    with pytest.raises(UserError, match=message):
        call()
