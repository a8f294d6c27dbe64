"""Smeared images against characteristic functions in closed form and exposures of single instants."""

import numpy as np
import pytest
from scipy.special import j0, ndtri

from wavequake.errors import UserError
from wavequake.imaging.exposures.exposure_models import cut, full_exposure
from wavequake.imaging.exposures.smear import (
    Smeared,
    add_smeared,
    empty_total,
    smear_canvas,
    smeared_image,
)

SAMPLING = 0.25
AXIS = (np.arange(48) - 24) * SAMPLING


def gauss(sigma, dx=0.0, dy=0.0):
    return np.exp(-0.5 * ((AXIS - dx) ** 2 + (AXIS[:, None] - dy) ** 2) / sigma**2)


def transfer(way):
    """What a way multiplies the transform of an image by: of one pixel, whose own transform is flat."""
    point = np.zeros((9, 9))
    point[4, 4] = 1.0
    canvas = smear_canvas(9, way, SAMPLING)
    total = np.zeros((canvas, canvas // 2 + 1), dtype=complex)  # whatever the way: the transform is wanted
    add_smeared(Smeared(canvas, total), point[None], way[None], SAMPLING)
    phase = np.exp(2j * np.pi * 4 * np.fft.fftfreq(canvas))
    return total * phase[:, None] * phase[: canvas // 2 + 1], np.fft.rfftfreq(canvas, SAMPLING)


def test_a_sinusoid_is_a_bessel_function():
    t = (np.arange(1024) + 0.5) / 1024
    amplitude = 2.3
    way = np.stack([amplitude * np.sin(2.0 * np.pi * t), np.zeros(1024)], axis=1)
    found, f = transfer(way)
    np.testing.assert_allclose(found[0], j0(2.0 * np.pi * amplitude * f), atol=1e-12)
    np.testing.assert_allclose(found[7], found[0], atol=1e-12)  # nothing moves along y


def test_normal_jitter_is_a_gaussian():
    sigma, count = 1.4, 32768
    way = np.stack([np.full(count, 0.5), sigma * ndtri((np.arange(count) + 0.5) / count)], axis=1)
    found, f = transfer(way)
    along = found[: len(f), 0]
    np.testing.assert_allclose(along, np.exp(-2.0 * np.pi**2 * sigma**2 * f**2), atol=1e-4)
    np.testing.assert_allclose(found[0], np.exp(-2j * np.pi * 0.5 * f), atol=1e-12)


def test_jitter_widens_a_gaussian_image():
    count, sigma = 8192, 0.8
    way = np.zeros((count, 2))
    way[:, 0] = sigma * ndtri((np.arange(count) + 0.5) / count)
    way[:, 1] = 1.5
    total = empty_total(48, way, SAMPLING)
    add_smeared(total, gauss(0.6)[None], way[None], SAMPLING)
    wide = np.hypot(0.6, sigma)
    expected = 0.6 / wide * np.exp(-0.5 * (AXIS / wide) ** 2 - 0.5 * ((AXIS[:, None] - 1.5) / 0.6) ** 2)
    np.testing.assert_allclose(cut(smeared_image(total, way[None], 48, SAMPLING), 48), expected, atol=2e-4)


@pytest.mark.parametrize("frame", [0, 48, 31])
@pytest.mark.parametrize("at_y", [None, 0.8, 0.0], ids=["both axes", "along x", "along x, in rows of pixels"])
def test_ways_of_one_place_are_the_full_exposure_in_any_blocks(at_y, frame):
    random = np.random.default_rng(3)
    los = 2.0 * random.standard_normal((5, 2))
    images = np.array([gauss(sigma) for sigma in (0.5, 0.6, 0.7, 0.8, 0.9)])
    los[:, 1] = los[:, 1] if at_y is None else at_y
    totals = [empty_total(48, los, SAMPLING, frame) for _ in range(2)]
    add_smeared(totals[0], images, los[:, None], SAMPLING)
    for part in (slice(0, 2), slice(2, 5)):
        add_smeared(totals[1], images[part], los[part, None], SAMPLING)
    np.testing.assert_array_equal(*(one.total for one in totals))
    full = full_exposure([images], los, SAMPLING)
    np.testing.assert_allclose(
        cut(smeared_image(totals[0], los[:, None], 48, SAMPLING), frame or 48),
        cut(full, frame or 48),
        atol=1e-10,
    )


@pytest.mark.parametrize("still", [(), (0,), (1,)], ids=["both axes", "along y", "along x"])
def test_a_way_is_the_full_exposure_of_the_image_at_all_its_places(still):
    way = 2.0 * np.random.default_rng(4).standard_normal((7, 2))
    way[:, still] = 0.6
    total = empty_total(48, way, SAMPLING)
    add_smeared(total, gauss(0.7)[None], way[None], SAMPLING)
    full = full_exposure([np.stack(7 * [gauss(0.7)])], way, SAMPLING)
    np.testing.assert_allclose(
        cut(smeared_image(total, way[None], 48, SAMPLING), 48), cut(full, 48), atol=1e-12
    )


def test_ways_beyond_all_canvases_are_refused():
    for far in (1e4, np.nan, np.inf):
        with pytest.raises(UserError, match="too far for an exposure"):
            smear_canvas(48, np.array([[far, 0.0]]), SAMPLING)
