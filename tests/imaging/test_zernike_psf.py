"""Images straight from Zernike coefficients, against phases that are evaluated cell by cell."""

import numpy as np
import pytest

from wavequake.errors import UserError
from wavequake.imaging.engines.matrix_fourier import matrix_fourier, psf
from wavequake.imaging.engines.zernike_psf import zernike_imager, zernike_images, zernike_sum
from wavequake.imaging.pupils.outlines import annulus, blocked, segments, vane
from wavequake.imaging.pupils.pupil_function import annular_pupil, sampled_pupil
from wavequake.imaging.pupils.wavefront_phase import zernike_phase
from wavequake.kernels.device.devices import NUMPY, Device, list_devices

OPENCL = [device for device in list_devices() if device.kind == "cpu"][:1]
OPENCL += [Device(device.name, "gpu", device.platform, 1) for device in OPENCL]
IDS = {"ids": lambda device: device.kind}
SPIDER = blocked(blocked(annulus(1.0, 0.3), vane([0, 0], [1.0, 0.3], 0.05)), vane([0, 0], [-0.9, 0.1], 0.03))
# Two pieces that meet inside cells: several patches there.
HALVES = segments(np.array([[[-0.7, -0.5], [0.013, -0.5], [0.013, 0.6], [-0.7, 0.6]],
                            [[0.013, -0.5], [0.6, -0.5], [0.6, 0.6], [0.013, 0.6]]]))  # fmt: skip
PUPILS = {
    "annulus": annular_pupil(64, 0.3),
    "spider, odd": sampled_pupil(SPIDER, 63, 2.0),
    "halves": sampled_pupil(HALVES, 40, 2.0),
}


def coefficients(terms, instants=5, rms=0.1):
    return np.random.default_rng(terms).normal(0.0, rms, (instants, terms))


@pytest.mark.parametrize("device", [NUMPY, *OPENCL], **IDS)
@pytest.mark.parametrize("pupil", PUPILS)
@pytest.mark.parametrize(("terms", "pixels", "tolerance"), [(1, 9, 1e-14), (21, 16, 1e-14), (105, 9, 1e-13)])
def test_images_are_those_of_phases_evaluated_cell_by_cell(device, pupil, terms, pixels, tolerance):
    grid, waves = PUPILS[pupil], coefficients(terms, rms=0.3 / np.sqrt(terms))
    expected = psf(matrix_fourier(grid, pixels, 0.5), zernike_phase(grid, waves, 0.3))
    imager = zernike_imager(grid, pixels, 0.5, terms, 0.3, device)
    assert np.abs(zernike_images(imager, waves, check=False) - expected).max() < tolerance


@pytest.mark.parametrize("device", OPENCL, **IDS)
def test_float32_is_good_to_its_precision(device):
    grid, waves = PUPILS["annulus"], coefficients(45, rms=0.03)
    expected = psf(matrix_fourier(grid, 16, 0.5), zernike_phase(grid, waves))
    imager = zernike_imager(grid, 16, 0.5, 45, 0.0, device, np.float32)
    assert 1e-12 < np.abs(zernike_images(imager, waves, check=False) - expected).max() < 2e-6


@pytest.mark.parametrize("device", [NUMPY, *OPENCL], **IDS)
def test_the_sum_skips_weight_0_and_does_not_depend_on_the_batch(device):
    imager = zernike_imager(PUPILS["annulus"], 16, 0.5, 21, 0.3, device)
    waves, weights = coefficients(21, 20), np.linspace(0.1, 1.0, 20)
    weights[7], waves[7, 3] = 0.0, np.nan
    images = zernike_images(imager, waves, check=False)
    assert np.isnan(images[7]).all()
    expected = np.tensordot(np.delete(weights, 7), np.delete(images, 7, axis=0), axes=1)
    assert zernike_sum(imager, waves, weights, check=False) == pytest.approx(expected, rel=1e-13)
    alone = [zernike_images(imager, waves[i : i + 1], check=False)[0] for i in (0, 13)]
    assert np.array_equal(alone, images[[0, 13]])


@pytest.mark.parametrize("device", OPENCL, **IDS)
def test_a_tilt_moves_the_image(device):
    imager = zernike_imager(annular_pupil(64), 33, 0.25, 3, 0.0, device)
    # 2 rho cos(theta) waves, 4 waves across the diameter per unit: 1/4 moves the image by 1 lambda/D.
    image = zernike_images(imager, np.array([[0.3, 0.25, -0.5]]))[0]
    assert np.unravel_index(image.argmax(), image.shape) == (16 - 8, 16 + 4)
    assert image.max() == pytest.approx(1.0, abs=1e-4)  # light on the rim has its own phase


def test_bad_input_is_refused():
    imager = zernike_imager(PUPILS["annulus"], 8, 0.5, 4)
    with pytest.raises(UserError, match=r"4 Zernike terms come as \(batch, 4\), not \(2, 5\)"):
        zernike_images(imager, np.zeros((2, 5)))
    with pytest.raises(UserError, match="2 instants need as many finite weights"):
        zernike_sum(imager, np.zeros((2, 4)), np.array([1.0, np.nan]))
    with pytest.raises(UserError, match="repeats every 64"):
        zernike_imager(PUPILS["annulus"], 100, 1.0, 4)
    assert zernike_images(imager, np.zeros((0, 4))).shape == (0, 8, 8)
