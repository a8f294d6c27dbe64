"""Widths and two-point distances against closed forms; pixels of any width against integrals."""

import numpy as np
import pytest
from scipy.special import erf, j1
from scipy.stats import poisson

from wavequake.errors import UserError
from wavequake.imaging.exposures.detector import detector_pixels, pixel_means, read_out
from wavequake.imaging.exposures.resolution import two_point_resolution
from wavequake.imaging.exposures.sharpness import sharpness

AXIS = (np.arange(96) - 48) * 0.25


def airy(dx=0.0, dy=0.0):
    r = np.maximum(np.pi * np.hypot(AXIS - dx, AXIS[:, None] - dy), 1e-12)
    return (2.0 * j1(r) / r) ** 2


def gauss(sx, sy, dx=0.0, dy=0.0):
    return np.exp(-0.5 * ((AXIS - dx) / sx) ** 2 - 0.5 * ((AXIS[:, None] - dy) / sy) ** 2)


@pytest.mark.parametrize("place", [(0.0, 0.0), (0.1, -0.07), (-3.33, 2.5)])
def test_a_perfect_pupil_resolves_what_rayleigh_and_sparrow_say(place):
    found = sharpness(airy(*place), 0.25)
    # Half of (2 J1(x) / x)^2 at x = 1.616340; between two patterns its second derivative is 0 at 1.487756.
    np.testing.assert_allclose(found["fwhm"], 2.0 * 1.616340 / np.pi, rtol=2e-5)
    np.testing.assert_allclose(found["sparrow"], 2.0 * 1.487756 / np.pi, rtol=2e-4)
    np.testing.assert_allclose(found["two_point"], two_point_resolution(airy(), 0.25), rtol=2e-4)
    np.testing.assert_allclose(found["two_point"], 1.22, atol=1e-3)
    np.testing.assert_allclose(found["mtf50"], 0.404, atol=0.01)  # the frame leaves 1 % of the light out


def test_a_gaussian_is_as_wide_along_each_axis_as_its_deviations_say():
    found = sharpness(gauss(1.0, 1.5, 0.37, -1.2), 0.25)
    both = np.array([1.0, 1.5])
    np.testing.assert_allclose(found["fwhm"], np.sqrt(8.0 * np.log(2.0)) * both, rtol=1e-6)
    np.testing.assert_allclose(found["sparrow"], 2.0 * both, rtol=1e-5)
    np.testing.assert_allclose(found["mtf50"], np.sqrt(0.5 * np.log(2.0)) / np.pi / both, rtol=5e-3)
    # exp(-d^2/8) over (1 + exp(-d^2/2)) / 2 is 0.735: with q = exp(-d^2/8), 0.735 q^4 - 2 q + 0.735 = 0.
    q = next(root.real for root in np.roots([0.735, 0, 0, -2, 0.735]) if abs(root.imag) < 1e-9 and root < 0.9)
    np.testing.assert_allclose(found["two_point"], np.sqrt(-8.0 * np.log(q)) * both, rtol=1e-5)


def test_what_the_frame_does_not_hold_is_not_a_number():
    wide = sharpness(gauss(30.0, 1.0), 0.25)
    assert np.isnan(wide["fwhm"][0])
    assert np.isfinite(wide["fwhm"][1])
    for nothing in (np.zeros((16, 16)), np.full((16, 16), np.nan)):
        assert all(np.isnan(values).all() for values in sharpness(nothing, 0.25).values())


@pytest.mark.parametrize("outside", np.linspace(12.2, 16.0, 20))
def test_rings_of_an_image_outside_the_frame_have_no_width(outside):
    for found in (sharpness(airy(outside, 0.3), 0.25), sharpness(airy(-1.0, -outside), 0.25)):
        assert all(np.isnan(values).all() for values in found.values())


@pytest.mark.parametrize("width", [0.1, 0.25, 0.7, 1.5, 7.8])
def test_pixels_of_any_width_hold_the_integral(width):
    found = detector_pixels(gauss(0.8, 1.1, 0.3, 0.5), 0.25, width)
    across = len(found)
    edges = (np.arange(across + 1) - across // 2 - 0.5) * width
    assert edges[0] >= -12.125 - 1e-9  # the frame, whose points are -12, -11.75 ... 11.75
    assert edges[-1] <= 11.875 + 1e-9
    assert max(edges[0] - width + 12.125, 11.875 - edges[-1] - width) < max(width, 0.25)
    along = [
        np.diff(erf((edges - middle) / (sigma * np.sqrt(2.0)))) * sigma * np.sqrt(np.pi / 2.0)
        for sigma, middle in ((0.8, 0.3), (1.1, 0.5))
    ]
    np.testing.assert_allclose(found, np.outer(along[1], along[0]) / width**2, atol=1e-9)


@pytest.mark.parametrize("width", [6.0, 8.0, 11.9])
def test_no_pixel_counts_light_of_the_opposite_rim(width):
    """An even number of wide pixels about a central one would reach beyond the frame on one side."""
    found = detector_pixels(gauss(0.5, 0.5, 9.0, 0.0), 0.25, width)
    assert np.abs(found[:, : len(found) // 2]).max(initial=0.0) < 1e-9


def test_pixels_on_the_samples_are_their_means():
    np.testing.assert_allclose(
        detector_pixels(airy(0.1, 0.2), 0.25, 0.25), pixel_means(airy(0.1, 0.2), 0.25, 0.25), atol=1e-13
    )


@pytest.mark.parametrize("width", [30.0, 1e-9, 0.001])
def test_pixels_that_do_not_suit_the_frame_are_refused(width):
    with pytest.raises(UserError, match=r"does not suit a frame of 24"):
        detector_pixels(airy(), 0.25, width)


def test_counts_have_the_moments_of_poisson_and_gauss():
    random = np.random.default_rng(5)
    for mean, noise in ((0.0, 3.0), (4.0, 0.0), (200.0, 5.0)):
        counts = read_out(np.full(200_000, mean), noise, random)
        variance = mean + noise**2
        assert abs(counts.mean() - mean) < 5.0 * np.sqrt(variance / 2e5)
        fourth = mean + 3.0 * variance**2  # cumulants add: mean of Poisson's, none of the Gaussian
        assert abs(counts.var() - variance) < 5.0 * np.sqrt((fourth - variance**2) / 2e5)
        third = np.mean((counts - counts.mean()) ** 3)
        assert abs(third - mean) < 5.0 * np.sqrt(15.0 * variance**3 / 2e5) + 1e-9
    few = read_out(np.full(100_000, 2.0), 0.0, random)
    shares = np.bincount(few.astype(int), minlength=12)[:12] / 1e5
    assert np.abs(shares - poisson.pmf(np.arange(12), 2.0)).max() < 5.0 * 0.5 / np.sqrt(1e5)
    assert (read_out(np.full(9, -1e-9), 0.0, random) == 0.0).all()
