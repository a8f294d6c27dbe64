"""Samples that a pupil needs, against slopes known in closed form, and warnings where it has fewer."""

import warnings

import numpy as np
import pytest

from wavequake.imaging.engines.matrix_fourier import matrix_fourier, samples_needed
from wavequake.imaging.engines.zernike_psf import zernike_imager, zernike_images, zernike_sum
from wavequake.imaging.exposures.polychromatic import polychromatic_psf
from wavequake.imaging.exposures.through_focus import through_focus
from wavequake.imaging.pupils.nyquist import ray_samples_for, samples_for, too_coarse, zernike_samples_for
from wavequake.imaging.pupils.pupil_function import annular_pupil
from wavequake.imaging.pupils.wavefront_phase import zernike_phase

GRID = annular_pupil(32)


def term(j, waves):
    return np.eye(11)[None, j - 1] * waves


@pytest.mark.parametrize(
    ("coefficients", "slope"),
    [
        (term(2, 3.0), 2.0),  # 2 x
        (term(4, 3.0), 4.0 * np.sqrt(3.0)),  # sqrt(3) (2 rho^2 - 1), at the rim
        (term(11, 3.0), np.sqrt(5.0) * 12.0),  # sqrt(5) (6 rho^4 - 6 rho^2 + 1)
    ],
)
def test_zernike_wavefronts_need_two_samples_per_period(coefficients, slope):
    # 2 pi slope rad per radius are 2 slope periods across.
    needed = int(np.ceil(2.0 * (2.0 * 3.0 * slope + 4.0) - 1e-9))
    assert zernike_samples_for(coefficients, 0.0, 8.0) == pytest.approx(needed, abs=1)  # rounded up
    fine = annular_pupil(512)  # differences of neighbors lag behind the slope at the rim
    assert samples_for(fine, zernike_phase(fine, coefficients), 8.0) == pytest.approx(needed, rel=0.03, abs=1)
    assert not too_coarse(needed, needed, 8.0)
    assert f"has 20 samples across, but its phase and an image of 8 lambda/D need {needed}" in too_coarse(
        20, needed, 8.0
    )


def test_an_obscured_pupil_and_instants_that_are_no_numbers():
    both = np.concatenate([term(2, 1.0), term(2, np.nan), term(2, -4.0)])
    eps = 0.6
    slope = 4.0 * 2.0 / np.sqrt(1.0 + eps**2)
    assert zernike_samples_for(both, eps, 0.0) == int(np.ceil(4.0 * slope - 1e-9))
    assert zernike_samples_for(term(2, np.nan), eps, 8.0) == 8


def test_images_warn_once_a_call_of_what_they_fold_back():
    imager = zernike_imager(GRID, 16, 0.5, 11)
    steep, weights = np.concatenate([term(4, 0.1), term(4, 2.0)] * 10), np.ones(20)
    with pytest.warns(UserWarning, match="has 32 samples across, .* need 6") as caught:
        zernike_images(imager, steep)
    assert len(caught) == 1
    assert caught[0].filename == __file__
    with pytest.warns(UserWarning, match="has 32 samples"):
        zernike_sum(imager, steep, weights)
    with pytest.warns(UserWarning, match="has 32 samples"):
        through_focus(matrix_fourier(GRID, 16, 0.5), np.zeros(GRID.cells.size), [0.0, 2.0])
    phase = zernike_phase(GRID, term(4, 0.7))
    with pytest.warns(UserWarning, match="has 32 samples"):
        polychromatic_psf(GRID, phase, [1.0, 0.5], [1.0, 1.0], 16, 0.5)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        zernike_images(imager, steep, check=False)
        zernike_images(imager, steep[:1])
        zernike_sum(imager, steep, weights * (steep[:, 3] < 1.0))
        polychromatic_psf(GRID, phase, [1.0, 0.5], [1.0, 0.0], 16, 0.5)


def test_rays_need_two_per_period_of_their_own_pieces_phase():
    """A tilt of each half, exact between any two rays along it; the step between halves does not count."""
    along = (np.arange(40) - 19.5) / 20.0
    x, y = (values.ravel() for values in np.meshgrid(along, along))
    piece = (x > 0.0).astype(int)
    slope = 7.0  # rad per pupil radius
    phase = np.stack([slope * x + 400.0 * piece, np.where(piece, np.nan, 0.2 * slope * y)])
    assert ray_samples_for((x, y, piece), phase, 16.0) == samples_needed(slope, 16.0)
    assert ray_samples_for((x, y, piece), phase[1:], 16.0) == samples_needed(0.2 * slope, 16.0)
    assert ray_samples_for((x, y, piece), np.full_like(phase, np.nan), 16.0) == 16
    one = np.zeros(1)
    assert ray_samples_for((one, one, one.astype(int)), one[None], 16.0) == 16
    apart = ray_samples_for((x, y, np.arange(len(x))), phase, 16.0)  # each ray a piece of its own
    assert apart == 16
