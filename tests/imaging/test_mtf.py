"""Transfer functions against closed forms of perfect and annular pupils."""

import numpy as np
import pytest
from scipy.integrate import dblquad

from wavequake.errors import UserError
from wavequake.imaging.engines.matrix_fourier import matrix_fourier, psf
from wavequake.imaging.exposures.mtf import ideal_mtf, modulation_transfer, optical_transfer_function
from wavequake.imaging.pupils.pupil_function import annular_pupil
from wavequake.imaging.pupils.pupil_shape import PupilShape


def lens(distance, one, two):
    """Area that two circles share."""
    if distance >= one + two:
        return 0.0
    if distance <= abs(one - two):
        return np.pi * min(one, two) ** 2
    d = (distance**2 + one**2 - two**2) / (2 * distance)
    e = distance - d
    return (
        one**2 * np.arccos(d / one)
        - d * np.sqrt(one**2 - d**2)
        + two**2 * np.arccos(e / two)
        - e * np.sqrt(two**2 - e**2)
    )


def annular_mtf(frequency, eps):
    """Area that two rings share, by inclusion and exclusion (O'Neill 1956)."""
    d = 2.0 * frequency
    shared = lens(d, 1, 1) - 2 * lens(d, 1, eps) + lens(d, eps, eps)
    return shared / (np.pi * (1 - eps**2))


@pytest.mark.parametrize("eps", [0.0, 0.1, 0.4])
def test_perfect_pupils(eps):
    frequency = np.linspace(0.0, 1.05, 64)
    found = optical_transfer_function(PupilShape(eps), frequency, [0.0])[0]
    wanted = [1.0 if f == 0 else annular_mtf(f, eps) for f in frequency]
    np.testing.assert_allclose(found, wanted, rtol=0, atol=2e-4)
    if eps == 0.0:
        np.testing.assert_allclose(ideal_mtf(frequency), wanted, rtol=0, atol=1e-12)


def test_defocus_against_the_integral_of_the_overlap():
    """OTF of w (x² + y²): the phase difference over the shared lens is linear, integrated numerically."""
    waves, frequency = 0.4, 0.3
    found = optical_transfer_function(
        PupilShape(0.0, lambda x, y: waves * (x**2 + y**2)), [frequency], [0.0]
    )[0, 0]
    edge = 1.0 - frequency

    def integrand(y, x):
        return np.cos(2 * np.pi * waves * 4 * x * frequency)

    area = dblquad(
        integrand,
        -edge,
        edge,
        lambda x: -np.sqrt(1 - (abs(x) + frequency) ** 2),
        lambda x: np.sqrt(1 - (abs(x) + frequency) ** 2),
        epsabs=1e-9,
    )[0]
    assert found.real == pytest.approx(area / np.pi, abs=2e-4)
    assert abs(found.imag) < 2e-4


def test_band_limit_and_symmetry():
    pupil = PupilShape(0.2, lambda x, y: 0.2 * x**3 + 0.1 * y**2 * x)
    axis = np.linspace(-1.21, 1.21, 13)
    found = optical_transfer_function(pupil, axis, axis)
    assert not found[np.hypot(axis[:, None], axis) >= 1].any()
    np.testing.assert_allclose(found, found[::-1, ::-1].conj(), rtol=0, atol=1e-12)
    assert np.abs(found).max() == 1.0
    perfect = optical_transfer_function(PupilShape(0.2), axis, axis)
    assert (np.abs(found) <= perfect.real + 2e-4).all()


def test_mtf_of_a_point_spread_function():
    """Light beyond the frame, 0.4 % of it, is missing; the band limit is met but for the frame's edge."""
    pupil = annular_pupil(256)
    image = psf(matrix_fourier(pupil, 400, 0.25), np.zeros((1, len(pupil.cells))))[0]
    frequency, mtf = modulation_transfer(image, 0.25)
    row = mtf[200]
    np.testing.assert_allclose(row, ideal_mtf(frequency), rtol=0, atol=1e-2)
    assert row[200] == 1.0
    assert row[np.abs(frequency) > 1.05].max() < 1e-3


@pytest.mark.parametrize(
    ("image", "words"),
    [
        (np.zeros((4, 4)), "without light"),
        (np.ones((4, 5)), "square"),
        (np.full((4, 4), np.nan), "not finite"),
    ],
)
def test_bad_images(image, words):
    with pytest.raises(UserError, match=words):
        modulation_transfer(image, 0.25)


def test_bad_sampling():
    with pytest.raises(UserError, match="sampling"):
        modulation_transfer(np.ones((4, 4)), 0.0)
