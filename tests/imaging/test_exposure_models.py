"""Exposures against closed forms: Gaussians, the sinusoid's arcsine density, the shift theorem, energy."""

import re
import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import j0

from wavequake.errors import UserError
from wavequake.imaging.engines.matrix_fourier import matrix_fourier, psf
from wavequake.imaging.exposures.exposure_models import (
    cut,
    exposure_error,
    full_exposure,
    gaussian_exposure,
    los_exposure,
)
from wavequake.imaging.exposures.placement import place
from wavequake.imaging.pupils.pupil_function import annular_pupil

SAMPLING = 0.25
MODELS = [
    pytest.param(
        lambda image, los: full_exposure([np.repeat(image[None], len(los), 0)], los, SAMPLING), id="full"
    ),
    pytest.param(lambda image, los: los_exposure(image, los, SAMPLING), id="los"),
    pytest.param(lambda image, los: gaussian_exposure(image, los, SAMPLING), id="gaussian"),
]


def axis_of(pixels):
    return (np.arange(pixels) - pixels // 2) * SAMPLING


def gaussian(pixels, covariance, middle=(0.0, 0.0)):
    """A normal density times the area of a pixel."""
    x, y = np.meshgrid(axis_of(pixels) - middle[0], axis_of(pixels) - middle[1])
    inverse = np.linalg.inv(covariance)
    exponent = inverse[0, 0] * x**2 + 2 * inverse[0, 1] * x * y + inverse[1, 1] * y**2
    return SAMPLING**2 / (2 * np.pi * np.sqrt(np.linalg.det(covariance))) * np.exp(-0.5 * exponent)


def test_gaussian_with_gaussian_adds_the_covariances():
    los = np.random.default_rng(1).normal(size=(500, 2)) @ [[0.9, 0.4], [0.0, 0.3]] + [0.7, -0.4]
    exposed = gaussian_exposure(gaussian(64, np.eye(2)), los, SAMPLING)
    wanted = gaussian(len(exposed), np.eye(2) + np.cov(los.T, bias=True), los.mean(axis=0))
    np.testing.assert_allclose(exposed, wanted, rtol=0, atol=1e-14)


def test_sinusoid_has_the_characteristic_function_of_the_arcsine_density():
    """A full period of a sinusoid of amplitude a multiplies the spectrum by J0(2 pi f a)."""
    amplitude, sigma = 2.3, 0.8
    los = np.stack([amplitude * np.sin(2 * np.pi * np.arange(400) / 400), np.zeros(400)], axis=1)
    exposed = los_exposure(gaussian(64, sigma**2 * np.eye(2)), los, SAMPLING)
    for frequency in (0.05, 0.1, 0.166, 0.3, 0.5):
        found = exposed.sum(axis=0) @ np.cos(2 * np.pi * frequency * axis_of(len(exposed)))
        wanted = np.exp(-2 * (np.pi * sigma * frequency) ** 2) * j0(2 * np.pi * frequency * amplitude)
        assert found == pytest.approx(wanted, abs=1e-13)


def test_sinusoid_piles_light_up_at_its_ends():
    """The density 1 / (pi sqrt(a^2 - x^2)) over a pixel-wide bin, for an image much narrower than a."""
    amplitude = 20.0
    los = np.stack([amplitude * np.sin(2 * np.pi * np.arange(8000) / 8000), np.zeros(8000)], axis=1)
    exposed = los_exposure(gaussian(32, 0.4**2 * np.eye(2)), los, SAMPLING).sum(axis=0)
    x = axis_of(len(exposed))
    inside = np.abs(x) < 0.5 * amplitude  # beyond, the curvature of the density shows
    wanted = SAMPLING / (np.pi * np.sqrt(amplitude**2 - x[inside] ** 2))
    np.testing.assert_allclose(exposed[inside], wanted, rtol=2e-3)
    assert np.abs(x[exposed.argmax()]) == pytest.approx(amplitude, abs=0.6)


@pytest.mark.parametrize("model", MODELS)
def test_without_motion_the_image_stays(model):
    image = np.random.default_rng(2).random((20, 20))
    np.testing.assert_allclose(cut(model(image, np.zeros((7, 2))), 20), image, rtol=0, atol=1e-14)


@pytest.mark.parametrize("model", MODELS)
@given(data=st.data())
def test_energy_is_kept(model, data):
    seed, spread = data.draw(st.integers(0, 99)), data.draw(st.floats(0.0, 30.0))
    random = np.random.default_rng(seed)
    image, los = random.random((12, 12)), spread * random.normal(size=(5, 2))
    assert model(image, los).sum() == pytest.approx(image.sum(), rel=1e-12)


def test_full_keeps_the_mean_energy_of_images_that_change():
    random = np.random.default_rng(3)
    images, los = random.random((90, 14, 14)), random.normal(size=(90, 2))
    exposed = full_exposure([images], los, SAMPLING)
    assert exposed.sum() == pytest.approx(images.sum() / 90, rel=1e-12)


def test_whole_pixels_are_placed_exactly():
    random = np.random.default_rng(4)
    images, shift = random.random((6, 16, 16)), random.integers(-5, 6, (6, 2))
    exposed = full_exposure([images], shift * SAMPLING, SAMPLING)
    np.testing.assert_allclose(exposed, place(images, shift, len(exposed)).mean(axis=0), rtol=0, atol=1e-14)


def test_between_pixels_an_image_moves_as_by_a_tilt_of_the_pupil():
    """The border of the frame cuts the rings off: what that leaves is of the size of the outermost ring."""
    pupil = annular_pupil(96)
    random = np.random.default_rng(5)
    los = random.uniform(-1.5, 1.5, (8, 2))
    wavy = random.normal(size=(8, 3)) @ np.stack([pupil.x**2, pupil.x * pupil.y, pupil.y**3])
    middles = pupil.axis[
        np.array(np.unravel_index(pupil.cells, pupil.amplitude.shape)[::-1])
    ]  # as the kernel has them
    tilt = np.pi * los @ middles
    local = psf(matrix_fourier(pupil, 160, SAMPLING), wavy)
    exposed = cut(full_exposure([local], los, SAMPLING), 64)
    moved = psf(matrix_fourier(pupil, 64, SAMPLING), wavy + tilt).mean(axis=0)
    np.testing.assert_allclose(exposed, moved, rtol=0, atol=2e-6)


def test_full_is_the_trajectory_where_the_image_does_not_change():
    los = np.random.default_rng(6).normal(size=(130, 2))
    image = gaussian(32, np.eye(2))
    full = full_exposure([np.repeat(image[None], 130, 0)], los, SAMPLING)
    np.testing.assert_allclose(full, los_exposure(image, los, SAMPLING), rtol=0, atol=1e-15)


def test_thousands_of_instants_are_streamed():
    random = np.random.default_rng(7)
    los, image = random.normal(size=(3000, 2)), random.random((24, 24))
    blocks = (np.repeat(image[None], 100, 0) for _ in range(30))
    tracemalloc.start()
    exposed = full_exposure(blocks, los, SAMPLING)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 30e6
    np.testing.assert_allclose(exposed, los_exposure(image, los, SAMPLING), rtol=0, atol=1e-13)


def test_blocks_do_not_matter():
    random = np.random.default_rng(8)
    images, los = random.random((40, 10, 10)), random.normal(size=(40, 2))
    whole = full_exposure([images], los, SAMPLING)
    parts = full_exposure([images[:7], images[7:33], images[33:]], los, SAMPLING)
    np.testing.assert_array_equal(parts, whole)


def test_error_of_a_wider_gaussian():
    """Of normal densities: peak sigma^2 ratio, L2 norm from their products' integrals, EE radii."""
    narrow, wide = 1.0, 1.3
    error = exposure_error(
        *(gaussian(96, sigma**2 * np.eye(2)) / SAMPLING**2 for sigma in (wide, narrow)), SAMPLING, 1.0, 1.0
    )
    overlap = [1 / (2 * np.pi * total) for total in (2 * wide**2, wide**2 + narrow**2, 2 * narrow**2)]
    assert error.l2 == pytest.approx(SAMPLING * np.sqrt(overlap[0] - 2 * overlap[1] + overlap[2]), rel=1e-9)
    assert error.peak == pytest.approx((narrow / wide) ** 2 - 1, rel=1e-12)
    for found, share in ((error.ee50, 0.5), (error.ee80, 0.8)):
        assert found == pytest.approx((wide - narrow) * np.sqrt(-2 * np.log(1 - share)), abs=1e-3)


def test_error_of_an_image_with_itself_is_nothing():
    image = gaussian(64, np.eye(2))
    error = exposure_error(image, image.copy(), SAMPLING, 1.0, 1.0)
    assert (error.l2, error.peak) == (0.0, 0.0)


@pytest.mark.parametrize(
    ("images", "los", "words"),
    [
        ([np.ones((2, 4, 4))], np.zeros((3, 2)), "2 images for 3"),
        ([np.ones((2, 4, 4))], np.zeros((1, 2)), "more images than"),
        ([np.full((1, 4, 4), np.nan)], np.zeros((1, 2)), "instant 0 is not finite"),
        ([np.ones((1, 4, 4))], np.full((1, 2), np.nan), "instant 0 is not finite"),
        ([np.ones((1, 4, 5))], np.zeros((1, 2)), "come as"),
        ([np.ones((1, 4, 4))], np.zeros(2), "shape"),
        ([], np.zeros((0, 2)), "shape"),
        ([], np.zeros((1, 2)), "0 images"),
    ],
)
def test_what_cannot_be_exposed(images, los, words):
    with pytest.raises(UserError, match=words):
        full_exposure(images, los, SAMPLING)


@pytest.mark.parametrize("far", [400.0, 1e300])
def test_motion_beyond_every_canvas_is_refused(far):
    """Two places `far` apart: 8 standard deviations to each side are 8 far / 0.25 pixels."""
    los = np.array([[far, 0.0], [0.0, 0.0]])
    image = np.ones((4, 4))
    for model in (los_exposure, gaussian_exposure):
        with pytest.raises(UserError, match=f"up to {re.escape(format(far, '.3g'))} wavelengths"):
            model(image, los, SAMPLING)
    with pytest.raises(UserError, match="have to fit into 6000 pixels"):
        full_exposure([image[None], image[None]], los, SAMPLING)


def test_long_canvases_hold_the_same_light():
    """Images one by one, on a canvas of 1700 pixels, against the same places on a short one."""
    image = np.random.default_rng(9).random((6, 8, 8))
    los = np.full((6, 2), [26.0, -3.0])
    far = np.concatenate([los, -los])
    both = np.concatenate([image, image])
    found = full_exposure([both], far, SAMPLING)
    assert len(found) > 1500
    middle = len(found) // 2
    there = found[middle - 12 - 4 : middle - 12 + 4, middle + 104 - 4 : middle + 104 + 4]
    np.testing.assert_allclose(there, 0.5 * image.mean(axis=0), rtol=0, atol=1e-13)
    assert found.sum() == pytest.approx(image.sum() / 6, rel=1e-12)


def test_static_images_are_checked():
    with pytest.raises(UserError, match="square"):
        los_exposure(np.ones((4, 5)), np.zeros((1, 2)), SAMPLING)
    with pytest.raises(UserError, match="not finite"):
        gaussian_exposure(np.full((4, 4), np.inf), np.zeros((1, 2)), SAMPLING)
    with pytest.raises(UserError, match="sampling"):
        los_exposure(np.ones((4, 4)), np.zeros((1, 2)), 0.0)
    with pytest.raises(UserError, match="does not fit"):
        cut(np.ones((5, 5)), 6)
    with pytest.raises(UserError, match="without light"):
        exposure_error(np.zeros((8, 8)), np.ones((8, 8)), SAMPLING, 1.0, 1.0)
