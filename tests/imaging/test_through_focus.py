"""Defocus against the closed form of the irradiance on the axis."""

import numpy as np
import pytest

from wavequake.errors import UserError
from wavequake.imaging.engines.matrix_fourier import matrix_fourier
from wavequake.imaging.exposures.through_focus import through_focus
from wavequake.imaging.pupils.pupil_function import annular_pupil


@pytest.mark.parametrize("eps", [0.0, 0.4])
def test_irradiance_on_the_axis(eps):
    """The phase is uniform in rho², so that the axis has sinc² of its range (Born and Wolf, section 8.8)."""
    pupil = annular_pupil(128, eps)
    transform = matrix_fourier(pupil, 16, 0.25)
    defocus = np.array([-0.4, -0.1, 0.0, 0.05, 0.2, 0.3])
    found = through_focus(transform, np.zeros(len(pupil.cells)), defocus)[:, 8, 8]
    np.testing.assert_allclose(
        found, np.sinc(2 * np.sqrt(3) * defocus * (1 - eps**2)) ** 2, rtol=0, atol=3e-4
    )


def test_a_shift_of_the_image_plane():
    """Its path difference, dz (1 - cos) = dz NA² rho² / 2, in Noll's normalization."""
    aperture, shift, wavelength = 0.1, 0.05, 550e-6
    c4 = aperture**2 * shift / (4 * np.sqrt(3) * wavelength)
    rho = np.linspace(0, 1, 9)
    added = np.sqrt(3) * c4 * (2 * rho**2 - 1)
    wanted = shift * aperture**2 * rho**2 / 2 / wavelength
    np.testing.assert_allclose(added - added[0], wanted - wanted[0])


def test_the_same_wavefront_refocuses():
    pupil = annular_pupil(64)
    transform = matrix_fourier(pupil, 16, 0.25)
    blurred = 2 * np.pi * 0.25 * np.sqrt(3) * (2 * (pupil.x**2 + pupil.y**2) - 1)
    images = through_focus(transform, blurred, [0.0, -0.25])
    assert images[0].max() < 0.5
    assert images[1].max() == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("defocus", [[], [np.nan]])
def test_bad_defocus(defocus):
    pupil = annular_pupil(16)
    with pytest.raises(UserError, match="finite"):
        through_focus(matrix_fourier(pupil, 8, 0.25), np.zeros(len(pupil.cells)), defocus)


def test_a_phase_of_another_pupil_is_refused():
    with pytest.raises(UserError, match=r"it must be \(224,\)"):
        through_focus(matrix_fourier(annular_pupil(16), 8, 0.25), np.zeros(3), [0.0])
