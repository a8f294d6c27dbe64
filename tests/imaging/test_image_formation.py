"""Images of objects against closed forms: truncated Fourier series, sine integrals, Hopkins' double sum."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import j1, sici

from wavequake.errors import UserError
from wavequake.imaging.exposures.mtf import ideal_mtf
from wavequake.imaging.objects.formation import (
    Source,
    coherent_image,
    disk_source,
    geometric_image,
    incoherent_image,
    partially_coherent_image,
    star_field_image,
)
from wavequake.imaging.objects.shapes import double_slit, grating, point, slit
from wavequake.imaging.pupils.pupil_shape import PupilShape, coherent_transfer

PERFECT = PupilShape()


def coma_and_focus(x, y):
    return 0.3 * (x**2 + y**2) + 0.2 * x * (x**2 + y**2)


def square_wave(pixels):
    """Fourier coefficients 0 and 1 of half of `pixels` samples lit, centered on one."""
    return 0.5, 1.0 / (pixels * np.tan(np.pi / pixels))


def test_a_coherent_grating_keeps_the_orders_that_pass():
    """Period 3: the orders 0 and +-1 pass, so that the amplitude is a cosine about 1/2."""
    pixels, period = 48, 3.0
    image = coherent_image(grating((1, pixels), period / pixels, period), period / pixels, PERFECT)[0]
    mean, first = square_wave(pixels)
    x = (np.arange(pixels) - pixels // 2) / pixels
    np.testing.assert_allclose(image, (mean + 2 * first * np.cos(2 * np.pi * x)) ** 2, rtol=0, atol=1e-14)


@pytest.mark.parametrize(("period", "share"), [(1.9, 0.0), (2.0, 0.5), (2.1, 1.0)])
def test_the_rim_of_the_pupil_halves_an_order(period, share):
    """Störkle 2018, Eq. 3.68."""
    pixels = 40
    image = coherent_image(grating((1, pixels), period / pixels, period), period / pixels, PERFECT)[0]
    mean, first = square_wave(pixels)
    assert image[pixels // 2] == pytest.approx((mean + 2 * share * first) ** 2, abs=1e-13)


def test_an_incoherent_grating_loses_contrast_by_the_mtf():
    pixels, period = 48, 1.6
    image = incoherent_image(grating((1, pixels), period / pixels, period), period / pixels, PERFECT)[0]
    mean, first = square_wave(pixels)
    x = (np.arange(pixels) - pixels // 2) / pixels
    wanted = mean + 2 * first * ideal_mtf(1 / period) * np.cos(2 * np.pi * x)
    np.testing.assert_allclose(image, wanted, rtol=0, atol=2e-5)


def low_pass_edge(x):
    """Amplitude of a bright half plane x > 0 behind a pupil that passes |f| < 1/2."""
    return 0.5 + sici(np.pi * x)[0] / np.pi


def test_a_coherent_slit_is_a_difference_of_sine_integrals():
    pixels, pitch, width = 4096, 0.05, 3.0
    image = coherent_image(slit((1, pixels), pitch, width), pitch, PERFECT)[0]
    x = (np.arange(pixels) - pixels // 2) * pitch
    near = np.abs(x) < 20.0
    wanted = (low_pass_edge(x + width / 2) - low_pass_edge(x - width / 2)) ** 2
    np.testing.assert_allclose(image[near], wanted[near], rtol=0, atol=2e-3)


def test_a_coherent_double_slit_adds_amplitudes():
    pixels, pitch, width, distance = 4096, 0.05, 1.0, 2.5
    image = coherent_image(double_slit((1, pixels), pitch, width, distance), pitch, PERFECT)[0]
    x = (np.arange(pixels) - pixels // 2) * pitch
    near = np.abs(x) < 20.0
    edges = [(m - width / 2, m + width / 2) for m in (-distance / 2, distance / 2)]
    field = sum(low_pass_edge(x - left) - low_pass_edge(x - right) for left, right in edges)
    np.testing.assert_allclose(image[near], field[near] ** 2, rtol=0, atol=2e-3)


@pytest.mark.parametrize("light", ["coherent", "incoherent"])
def test_a_pinhole_shows_the_airy_pattern(light):
    """Störkle 2018, Eq. 3.74; the sharp pupil of the coherent image has 100 frequencies across only."""
    pixels, pitch = 400, 0.25
    image = {"coherent": coherent_image, "incoherent": incoherent_image}[light](point(pixels), pitch, PERFECT)
    t = np.pi * (np.arange(pixels) - pixels // 2) * pitch
    with np.errstate(invalid="ignore"):
        airy = np.where(t == 0, 1.0, (2 * j1(t) / t) ** 2)
    row = image[pixels // 2] / image.max()
    np.testing.assert_allclose(row, airy, rtol=0, atol={"coherent": 1e-2, "incoherent": 1e-4}[light])


def test_partially_coherent_light_is_hopkins_double_sum():
    """Sum over pairs of object frequencies with the transmission cross coefficients, term by term."""
    random = np.random.default_rng(1)
    rows, columns, pitch = 5, 6, 0.45
    field = random.normal(size=(rows, columns)) + 1j * random.normal(size=(rows, columns))
    source, pupil = disk_source(0.7, 0.2, across=5), PupilShape(0.3, coma_and_focus)
    fx, fy = (np.fft.fftfreq(n, pitch) for n in (columns, rows))
    orders = [(a, b) for b in fy for a in fx]
    spectrum = np.array(
        [
            sum(
                field[i, j] * np.exp(-2j * np.pi * pitch * (a * j + b * i))
                for i in range(rows)
                for j in range(columns)
            )
            for a, b in orders
        ]
    ) / (rows * columns)
    passed = np.array(
        [[coherent_transfer(pupil, a - x / 2, b - y / 2) for a, b in orders] for x, y in source.points]
    )
    cross = np.einsum("s,sk,sl->kl", source.weights, passed, passed.conj())
    image = partially_coherent_image(field, pitch, pupil, source)
    for row, column in [(0, 0), (2, 5), (4, 3)]:
        wave = np.array([np.exp(2j * np.pi * pitch * (a * column + b * row)) for a, b in orders])
        wanted = np.einsum("k,l,kl->", spectrum * wave, (spectrum * wave).conj(), cross)
        assert image[row, column] == pytest.approx(wanted.real, rel=1e-12)
        assert abs(wanted.imag) < 1e-12


def test_a_point_source_on_the_axis_is_coherent():
    field = np.random.default_rng(2).normal(size=(9, 12))
    pupil = PupilShape(0.2, coma_and_focus)
    source = Source(np.zeros((1, 2)), np.ones(1))
    np.testing.assert_array_equal(
        partially_coherent_image(field, 0.3, pupil, source), coherent_image(field, 0.3, pupil)
    )


def test_a_very_large_source_is_incoherent():
    """A source that covers all the pupil's shifts, at the object's own frequencies (Parseval)."""
    random = np.random.default_rng(3)
    pixels, pitch = 12, 0.5
    frequency = np.fft.fftfreq(pixels, pitch)
    # Smooth enough for its intensity to be sampled, too.
    slow = (np.abs(frequency) < 0.5) & (np.abs(frequency[:, None]) < 0.5)
    spectrum = random.normal(size=(pixels, pixels)) + 1j * random.normal(size=(pixels, pixels))
    field = np.fft.ifft2(spectrum * slow)
    # Tilts by whole frequencies of the picture, up to where no light of it meets the pupil.
    steps = 2.0 * np.arange(-10, 11) / (pixels * pitch)
    points = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    source = Source(points, np.full(len(points), 1 / pixels**2))
    total = partially_coherent_image(field, pitch, PERFECT, source)
    transfer = coherent_transfer(PERFECT, frequency[None], frequency[:, None])
    psf = np.abs(np.fft.ifft2(transfer)) ** 2
    wanted = np.fft.ifft2(np.fft.fft2(np.abs(field) ** 2) * np.fft.fft2(psf)).real
    np.testing.assert_allclose(total, wanted, rtol=0, atol=1e-14)


def test_a_tilted_wavefront_moves_all_images_alike():
    """An OPD that rises by one wave over the radius moves the image by +2."""
    pixels, pitch, shift = 64, 0.25, 8
    tilted = PupilShape(0.0, lambda x, y: x)
    for image, tolerance in ((coherent_image, 1e-13), (incoherent_image, 1e-6)):
        straight, moved = (image(point(pixels), pitch, pupil) for pupil in (PERFECT, tilted))
        np.testing.assert_allclose(moved, np.roll(straight, shift, axis=1), rtol=0, atol=tolerance)


@given(seed=st.integers(0, 99))
def test_incoherent_images_keep_the_energy(seed):
    picture = np.random.default_rng(seed).random((8, 10))
    image = incoherent_image(picture, 0.4, PupilShape(0.4))
    assert image.sum() == pytest.approx(picture.sum(), rel=1e-12)
    assert image.min() > -1e-3 * picture.max()


def test_stars_between_pixels():
    """A Gaussian star is a Gaussian about its place."""
    pitch, pixels, sigma = 0.25, 64, 0.6
    axis = (np.arange(pixels) - pixels // 2) * pitch

    def star(x, y):
        return np.exp(-((axis[None] - x) ** 2 + (axis[:, None] - y) ** 2) / (2 * sigma**2))

    image = star_field_image(star(0, 0), [[1.03, -0.41], [-2.2, 1.7]], [2.0, 0.5], pitch)
    np.testing.assert_allclose(image, 2.0 * star(1.03, -0.41) + 0.5 * star(-2.2, 1.7), rtol=0, atol=1e-12)


@pytest.mark.parametrize("pixels", [7, 8])
def test_the_4f_system_turns_the_object_about_its_axis(pixels):
    field = np.random.default_rng(4).normal(size=(pixels, pixels))
    turned, pitch = geometric_image(field, 0.5, -1.0)
    assert pitch == 0.5
    middle = pixels // 2
    for row, column in [(0, 0), (1, 2), (-3, 1)]:
        assert turned[middle - row, middle - column] == field[middle + row, middle + column]


@given(magnification=st.floats(0.1, 10.0), sign=st.sampled_from([-1, 1]))
def test_magnification_keeps_the_power(magnification, sign):
    """Störkle 2018, Excursion 3: |U|² falls by M², the area of a pixel grows by M²."""
    field = np.random.default_rng(5).normal(size=(6, 6))
    image, pitch = geometric_image(field, 2.0, sign * magnification)
    assert np.sum(np.abs(image) ** 2) * pitch**2 == pytest.approx(np.sum(field**2) * 4.0)


@pytest.mark.parametrize(
    ("picture", "words"),
    [
        (np.array([[1.0, -2.0]]), "row 0, column 1 is negative"),
        (np.array([[1.0], [np.nan]]), "row 1, column 0 is not finite"),
        (np.ones(4), "shape"),
        (np.ones((0, 3)), "shape"),
        (np.ones((2, 2, 3)), "shape"),
        (1j * np.ones((2, 2)), "complex"),
        ([["bright"]], "picture of numbers"),
        ([[1.0], [1.0, 2.0]], "picture of numbers"),
    ],
)
def test_pictures_that_cannot_be_imaged(picture, words):
    with pytest.raises(UserError, match=words):
        incoherent_image(picture, 0.25, PERFECT)


@pytest.mark.parametrize("image", [coherent_image, incoherent_image])
def test_pictures_of_one_pixel_and_without_light(image):
    """A single pixel repeats: it is an even plane, which keeps its brightness."""
    np.testing.assert_allclose(image([[4.0]], 0.25, PERFECT), [[16.0 if image is coherent_image else 4.0]])
    assert not image(np.zeros((5, 3)), 0.25, PERFECT).any()


def test_bad_input_is_named():
    with pytest.raises(UserError, match=r"at most 0\.5"):
        coherent_image(np.ones((4, 4)), 0.6, PERFECT)
    with pytest.raises(UserError, match=r"needs as many numbers, not \(2,\)"):
        coherent_image(np.ones((8, 8)), 0.25, PupilShape(0.0, lambda x, y: np.zeros(2)))
    with pytest.raises(UserError, match=r"needs as many numbers, not \(3,\)"):
        incoherent_image(np.ones((8, 8)), 0.25, PupilShape(0.0, lambda x, y: np.zeros(3)))
    with pytest.raises(UserError, match="row 1, column 1 is not finite"):
        coherent_image(np.diag([1.0, np.inf]), 0.25, PERFECT)
    with pytest.raises(UserError, match="magnification"):
        geometric_image(np.ones((2, 2)), 1.0, 0.0)
    with pytest.raises(UserError, match="obscuration"):
        PupilShape(1.0)
    with pytest.raises(UserError, match="inner < outer"):
        disk_source(0.5, 0.5)
    with pytest.raises(UserError, match="take more"):
        disk_source(1.0, 0.99, across=2)
    with pytest.raises(UserError, match="not finite in the whole pupil"):
        coherent_image(np.ones((8, 8)), 0.25, PupilShape(0.0, lambda x, y: np.full_like(x, np.nan)))
    with pytest.raises(UserError, match="too steep"):
        incoherent_image(np.ones((8, 8)), 0.25, PupilShape(0.0, lambda x, y: 200.0 * x))
    with pytest.raises(UserError, match="fluxes"):
        star_field_image(np.ones((4, 4)), [[0.0, 0.0]], [-1.0], 0.25)


def test_rounding_below_zero_is_no_negative_light():
    """An exposure that was placed between pixels has -1e-13 where it is dark; stars take it as it is."""
    psf = np.zeros((16, 16))
    psf[8, 8], psf[2, 3] = 1.0, -1e-13
    seen = star_field_image(psf, np.array([[0.0, 0.0], [1.0, 0.0]]), np.array([1.0, 0.5]), 0.5)
    assert seen[8, 8] == pytest.approx(1.0, abs=1e-12)
    assert seen[8, 10] == pytest.approx(0.5, abs=1e-12)
    psf[2, 3] = -1e-6
    with pytest.raises(UserError, match="row 2, column 3 is negative"):
        star_field_image(psf, np.zeros((1, 2)), np.ones(1), 0.5)
