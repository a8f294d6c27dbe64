"""Rayleigh's and Abbe's resolution, measured on images."""

import numpy as np
import pytest
from scipy.special import j1

from wavequake.errors import UserError
from wavequake.imaging.engines.matrix_fourier import matrix_fourier, psf
from wavequake.imaging.exposures.mtf import ideal_mtf
from wavequake.imaging.exposures.resolution import (
    abbe_resolution,
    contrast,
    grating_image,
    saddle,
    two_point_resolution,
)
from wavequake.imaging.objects.formation import disk_source
from wavequake.imaging.objects.shapes import (
    double_slit,
    grating,
    point,
    rectangles,
    resolution_chart,
    slit,
)
from wavequake.imaging.pupils.pupil_function import annular_pupil
from wavequake.imaging.pupils.pupil_shape import PupilShape

RAYLEIGH = 3.8317059702075125 / np.pi  # the first zero of J1, 1.2197


@pytest.fixture(scope="module")
def airy_image():
    pupil = annular_pupil(128)
    return psf(matrix_fourier(pupil, 128, 0.25), np.zeros((1, len(pupil.cells))))[0]


def airy(distance):
    return (2 * j1(np.pi * distance) / (np.pi * distance)) ** 2


def test_two_points_at_rayleighs_distance_dip_by_a_quarter(airy_image):
    """The first dark ring of one point lies on the other: 2 Airy(0.61) between them, 1 at them."""
    found = saddle(airy_image, 0.25, RAYLEIGH)
    assert found == pytest.approx(2 * airy(RAYLEIGH / 2), abs=1e-3)
    assert found == pytest.approx(0.735, abs=1e-3)


@pytest.mark.parametrize("distance", [0.8, 1.0, 1.5, 2.0])
def test_saddles_of_two_airy_patterns(airy_image, distance):
    wanted = 2 * airy(distance / 2) / (1 + airy(distance))
    assert saddle(airy_image, 0.25, distance) == pytest.approx(wanted, abs=1e-3)


def test_two_point_resolution_is_rayleighs(airy_image):
    assert two_point_resolution(airy_image, 0.25) == pytest.approx(RAYLEIGH, abs=2e-3)


def test_two_points_of_a_blob_are_never_resolved():
    axis = (np.arange(32) - 16) * 0.25
    blob = np.exp(-(axis[:, None] ** 2 + axis**2) / (2 * 3.0**2))
    with pytest.raises(UserError, match="no saddle"):
        two_point_resolution(blob, 0.25)


@pytest.mark.parametrize("sigma", [0.3, 0.6, 1.0])
def test_abbes_resolution_with_a_source(sigma):
    """A grating is resolved while two of its orders pass: period 2 / (1 + sigma), the source at its rim."""
    source = disk_source(sigma, across=21)
    reach = np.hypot(*source.points.T).max()  # an order beside the axis passes a little less
    x, y = np.abs(source.points).T
    shifted = (x + np.sqrt(1 - np.minimum(y, 1.0) ** 2)).max()
    found = abbe_resolution(PupilShape(), source)
    assert found == pytest.approx(2 / shifted, abs=1e-5)
    assert 2 / (1 + sigma) < found + 1e-5 < 1.05 * 2 / (1 + reach)


def test_abbes_resolution_without_a_source():
    assert abbe_resolution(PupilShape(), coherent=True) == pytest.approx(2.0, abs=1e-5)
    assert abbe_resolution(PupilShape()) == pytest.approx(1.0, abs=5e-3)


@pytest.mark.parametrize("period", [1.2, 1.5, 2.5])
def test_contrast_of_a_grating_is_the_mtf_of_its_orders(period):
    """Bars of Fourier terms 1/2 and sin(k pi / 2) / (k pi); the third passes from period 3 on."""
    pixels = 48
    first = 1 / (pixels * np.tan(np.pi / pixels))
    wanted = 2 * first * ideal_mtf(1 / period) / 0.5
    assert contrast(grating_image(period, PupilShape())) == pytest.approx(wanted, abs=3e-4)


def test_unresolved_gratings_are_gray():
    assert contrast(grating_image(0.9, PupilShape())) < 1e-9
    assert contrast(grating_image(1.9, PupilShape(), coherent=True)) < 1e-12


def test_objects_hold_their_area():
    shape, pitch = (30, 40), 0.3
    cell = pitch**2
    assert rectangles(shape, pitch, [[-1.07, 2.13, -0.4, 0.55]]).sum() * cell == pytest.approx(3.2 * 0.95)
    assert slit(shape, pitch, 1.1).sum() * pitch == pytest.approx(1.1 * 30)
    assert double_slit(shape, pitch, 0.5, 2.0).sum() * pitch == pytest.approx(1.0 * 30)
    assert grating((1, 40), 0.1, 1.0, 0.3).mean() == pytest.approx(0.3)
    assert point(5)[2, 2] == 1.0
    assert point(5).sum() == 1.0
    widths = np.array([0.5, 0.25])
    chart = resolution_chart((80, 80), 0.15, widths)
    assert chart.sum() * 0.15**2 == pytest.approx(np.sum(2 * 3 * 5 * widths**2))
    assert chart.max() == pytest.approx(1.0)


def test_slits_are_symmetric():
    picture = double_slit((1, 41), 0.3, 0.7, 3.1)[0]
    np.testing.assert_allclose(picture, picture[::-1], rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: slit((4, 4), 1.0, 0.0), "width above 0"),
        (lambda: double_slit((4, 4), 1.0, 2.0, 1.0), "overlap"),
        (lambda: grating((4, 4), 1.0, -1.0), "period"),
        (lambda: resolution_chart((8, 8), 0.1, [1.0]), "the chart is"),
        (lambda: resolution_chart((8, 8), 0.1, []), "widths above 0"),
        (lambda: rectangles((4, 4), 1.0, [[1.0, 0.0, 0.0, 1.0]]), "left edge"),
        (lambda: rectangles((4, 0), 1.0, [[0.0, 1.0, 0.0, 1.0]]), "at least one"),
        (lambda: point(3) * slit((3, 3), np.nan, 1.0), "above 0"),
        (lambda: contrast(np.zeros(3)), "without light"),
        (lambda: contrast(np.zeros(0)), "without light"),
        (lambda: saddle(np.zeros((8, 8)), 0.25, 1.0), "no light at its middle"),
        (lambda: grating((4, 4), 1.0, 1e-9), "more than 10000 slits"),
        (lambda: rectangles((4, 4), 1.0, [0.0, 1.0, 0.0]), "four edges each"),
        (lambda: grating_image(0.0, PupilShape()), "period above 0"),
    ],
)
def test_bad_input(call, words):
    with pytest.raises(UserError, match=words):
        call()
