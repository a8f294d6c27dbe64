import numpy as np
import pytest

from wavequake.errors import UserError
from wavequake.imaging.engines.polygon_transform import polygon_areas, polygon_transform
from wavequake.imaging.engines.segment_basis import MOMENTS, ray_basis, segment_basis
from wavequake.imaging.engines.segment_moments import gauss_rule, largest_means, moments_on_grid
from wavequake.imaging.engines.segment_psf import (
    moments_needed,
    psf,
    shift_phase,
    strehl_exact,
    truncation_error,
)

RNG = np.random.default_rng(11)


def phases(pupil, slope_rms=0.0, batch=1, seed=0):
    """Random pistons and slopes (waves/mm); slope_rms is the phase in rad at a corner, rms per axis."""
    rng = np.random.default_rng(seed)
    reach = np.hypot(*np.moveaxis(pupil.corners - pupil.centers[:, None], -1, 0)).max()
    phase = rng.normal(0, 0.07, (batch, len(pupil.centers), 3))
    phase[..., 1:] = rng.normal(0, slope_rms / (2 * np.pi * reach), phase[..., 1:].shape)
    return phase


def image_points(pixels, sampling, diameter, picked):
    y, x = np.divmod(picked, pixels)
    return (x - pixels // 2) * sampling / diameter, (y - pixels // 2) * sampling / diameter


def exact_images(pupil, phase, fx, fy):
    """Shift each segment's closed-form transform by its slopes, one segment at a time."""
    total = np.zeros(fx.size, dtype=complex)
    for corners, center, (piston, gx, gy) in zip(pupil.corners, pupil.centers, phase, strict=True):
        local = polygon_transform((corners - center)[None], fx - gx, fy - gy)[:, 0]
        total += local * np.exp(2j * np.pi * (piston - fx * center[0] - fy * center[1]))
    return np.abs(total / polygon_areas(pupil.corners).sum()) ** 2


def vertex_sum(corners, kx, ky):
    """Textbook transform of a polygon by its corners (k not perpendicular to an edge); shares no code."""
    total = 0.0
    for v in range(len(corners)):
        before, after = corners[v] - corners[v - 1], corners[(v + 1) % len(corners)] - corners[v]
        along = (kx * before[0] + ky * before[1]) * (kx * after[0] + ky * after[1])
        turn = before[0] * after[1] - before[1] * after[0]
        total -= np.exp(-1j * (kx * corners[v][0] + ky * corners[v][1])) * turn / along
    return -total


@pytest.mark.parametrize("case", ["perfect", "opd35nm"])
def test_strehl_equals_the_reference(tmt, case):
    pistons = tmt.pistons * (case == "opd35nm")
    reference = tmt.reference[case]["strehl_at_origin"]
    areas = polygon_areas(tmt.corners)
    assert areas.sum() == pytest.approx(1e6 * tmt.reference["definition"]["area_m2"], rel=1e-12)
    assert strehl_exact(areas, pistons) == pytest.approx(reference, abs=1e-12)
    basis = segment_basis(tmt.corners, tmt.centers, 16, 0.25, tmt.diameter, moments=1, dtype=np.complex128)
    assert psf(basis, pistons[None])[0].reshape(16, 16)[8, 8] == pytest.approx(reference, abs=1e-12)


def test_pixels_equal_a_direct_sum_over_polygons(tmt):
    basis = segment_basis(tmt.corners, tmt.centers, 64, 0.25, tmt.diameter, moments=1, dtype=np.complex128)
    image = psf(basis, tmt.pistons[None])[0]
    picked = np.array([0, 63, 64 * 63, 64 * 63 + 63, 64 * 31 + 35, 64 * 40 + 25, 64 * 7 + 51, 64 * 50 + 37])
    for index, fx, fy in zip(picked, *image_points(64, 0.25, tmt.diameter, picked), strict=True):
        kx, ky = 2 * np.pi * fx, 2 * np.pi * fy
        # The outline of the TMT has an edge along x in no turned sector, so that no k·edge vanishes here.
        field = sum(
            vertex_sum(c, kx, ky) * np.exp(2j * np.pi * p)
            for c, p in zip(tmt.corners, tmt.pistons, strict=True)
        )
        assert image[index] == pytest.approx(abs(field / basis.peak) ** 2, abs=1e-12)


def test_ring_and_minimum_equal_the_reference(tmt):
    azimuth = 2 * np.pi * np.arange(180) / 180
    coefficients = np.stack([np.ones(492), np.exp(2j * np.pi * tmt.pistons)], axis=1)

    def ring(radius):
        f = radius / tmt.diameter
        field = polygon_transform(tmt.corners, f * np.cos(azimuth), f * np.sin(azimuth)) @ coefficients
        return (np.abs(field / polygon_areas(tmt.corners).sum()) ** 2).mean(axis=0)

    for column, case in enumerate(("perfect", "opd35nm")):
        reference = tmt.reference[case]
        assert ring(1.25)[column] == pytest.approx(reference["first_min_mean"], abs=1e-12)
        assert ring(1.7)[column] == pytest.approx(reference["first_ring_mean"], abs=1e-12)
        assert min(ring(1.2)[column], ring(1.3)[column]) > reference["first_min_mean"]
        assert max(ring(1.65)[column], ring(1.75)[column]) < reference["first_ring_mean"]


@pytest.mark.parametrize("highest", [1e-5, 1e-3, 7e-3])  # cycles/mm: up to 0.03, 3 and 19 rad at a corner
def test_zeroth_moments_equal_closed_forms(flower, highest):
    fy, fx = highest * np.linspace(0, 1, 8), highest * np.linspace(-1, 1, 9)
    x, y = (f.ravel() for f in np.meshgrid(fx, fy))
    found = moments_on_grid(flower.corners, flower.centers, fy, fx, 0, 1.0)[:, 0]
    exact = polygon_transform(flower.corners, x, y)
    np.testing.assert_allclose(found, exact, rtol=0, atol=2e-14 * polygon_areas(flower.corners).max())


@pytest.mark.parametrize(("slope_rms", "errors"), [(0.114, (1.2e-5, 2e-8)), (0.228, (1.6e-4, 1e-6))])
def test_tilted_segments_equal_shifted_polygons(tmt, slope_rms, errors):
    phase = phases(tmt, slope_rms)
    picked = np.concatenate([RNG.integers(0, 64**2, 40), [64 * 32 + 32]])
    exact = exact_images(tmt, phase[0], *image_points(64, 0.25, tmt.diameter, picked))
    for moments, error in zip((6, 15), errors, strict=True):
        basis = segment_basis(tmt.corners, tmt.centers, 64, 0.25, tmt.diameter, moments, np.complex128)
        bound = truncation_error(basis, phase)[-1, 0]  # as the tolerance it makes psf use all moments
        assert np.abs(psf(basis, phase, bound)[0, picked] - exact).max() < min(error, bound)


def test_every_number_of_moments_keeps_its_bound(flower):
    phase = phases(flower, 0.6)
    picked = np.arange(0, 40**2, 7)
    exact = exact_images(flower, phase[0], *image_points(40, 0.3, flower.diameter, picked))
    basis = segment_basis(flower.corners, flower.centers, 40, 0.3, flower.diameter, 45, np.complex128)
    bounds = truncation_error(basis, phase)[:, 0]
    found = np.array([np.abs(psf(basis, phase, bound)[0, picked] - exact).max() for bound in bounds])
    assert (found < bounds).all()
    assert (found > bounds / 1e3).all()
    assert found[-1] < 1e-6


def test_a_rigid_tilt_moves_the_image(tmt):
    basis = segment_basis(tmt.corners, tmt.centers, 32, 0.25, tmt.diameter, 28, np.complex128)
    phase = np.zeros((2, 492, 3))
    phase[..., 0] = tmt.pistons
    moved = shift_phase(phase, [[0.0, 0.0], [1.5, -0.75]], tmt.centers, tmt.diameter)
    still, image = psf(basis, moved, 1e-7).reshape(2, 32, 32)
    # +1.5 is 6 pixels along x (axis 1), -0.75 is 3 pixels back along y (axis 0).
    np.testing.assert_allclose(image[:-3, 6:], still[3:, :-6], rtol=0, atol=1e-9)
    assert image[13, 22] == pytest.approx(tmt.reference["opd35nm"]["strehl_at_origin"], abs=1e-9)


def test_energy_is_that_of_the_pupil():
    # One square of side D: the sum over 32 wavelengths/D on each side misses 1 / (π² 32) per axis.
    square = 500.0 * np.array([[[-1, -1], [1, -1], [1, 1], [-1, 1.0]]])
    basis = segment_basis(square, np.zeros((1, 2)), 129, 0.5, 1000.0, 1, np.complex128)
    energy = psf(basis, np.zeros((1, 1))).sum() * 0.5**2
    assert energy == pytest.approx((1 - 1 / (np.pi**2 * 32)) ** 2, abs=1e-6)


def test_a_tile_does_not_depend_on_its_neighbors(flower):
    basis = segment_basis(flower.corners, flower.centers, 24, 0.3, flower.diameter, 15)
    phase = phases(flower, 0.05, batch=48)
    phase[16:32, :, 1:] *= 8.0  # this tile needs more moments
    together = psf(basis, phase)
    alone = [psf(basis, phase[first : first + 16]) for first in (0, 16, 32)]
    assert np.array_equal(together, np.concatenate(alone))
    assert np.array_equal(psf(basis, phase[:5]), psf(basis, np.pad(phase[:5], ((0, 11), (0, 0), (0, 0))))[:5])
    assert np.array_equal(psf(basis, phase[:37]), together[:37])


def test_moments_that_are_not_used_do_not_change_bits(tmt):
    phase = phases(tmt, 0.02, batch=16)
    few, many = (
        segment_basis(tmt.corners, tmt.centers, 32, 0.25, tmt.diameter, moments) for moments in (6, 28)
    )
    assert np.array_equal(psf(few, phase), psf(many, phase))


def test_an_instant_without_numbers_spoils_no_other(flower):
    basis = segment_basis(flower.corners, flower.centers, 24, 0.3, flower.diameter, 6)
    phase = phases(flower, 0.05, batch=16)
    broken = phase.copy()
    broken[3, 2] = np.nan
    images = psf(basis, broken)
    assert np.isnan(images[3]).all()
    assert np.array_equal(np.delete(images, 3, axis=0), np.delete(psf(basis, phase), 3, axis=0))


def test_single_precision_is_good_to_two_millionths(tmt):
    phase = phases(tmt, 0.2, batch=3)
    single, double = (
        psf(segment_basis(tmt.corners, tmt.centers, 64, 0.25, tmt.diameter, 6, dtype), phase, 1.0)
        for dtype in (np.complex64, np.complex128)
    )
    assert single.dtype == np.float32
    np.testing.assert_allclose(single, double, rtol=0, atol=2e-6)


def test_rays_on_a_gauss_rule_equal_polygons(flower):
    points, weights = gauss_rule(flower.corners, 16)
    rays = ray_basis(*points.reshape(-1, 2).T, weights.ravel(), 33, 0.2, flower.diameter, np.complex128)
    glass = segment_basis(flower.corners, flower.centers, 33, 0.2, flower.diameter, 15, np.complex128)
    phase = phases(flower, 0.01, batch=3)
    arm = points - flower.centers[:, None]
    opd = phase[:, :, None, 0] + (phase[:, :, None, 1:] * arm).sum(axis=-1)
    np.testing.assert_allclose(psf(rays, opd.reshape(3, -1)), psf(glass, phase, 1e-9), rtol=0, atol=1e-10)


def test_a_pupil_far_from_the_origin_makes_the_same_image(flower):
    away = np.array([3e4, -1e4])
    here, there = (
        psf(
            segment_basis(flower.corners + d, flower.centers + d, 20, 0.4, 2600.0, 6, np.complex128),
            phases(flower, 0.1),
        )
        for d in (0.0, away)
    )
    np.testing.assert_allclose(there, here, rtol=0, atol=1e-11)


@pytest.mark.parametrize(
    ("corner_phase", "moments"), [(0.0, 1), (2e-4, 1), (0.1, 6), (0.6, 15), (1.2, 28), (2.0, 45)]
)
def test_moments_follow_the_slopes(corner_phase, moments):
    assert moments_needed(corner_phase, 1e-3) == moments


def test_moments_needed_keep_the_error_of_a_rigid_tilt(tmt):
    # Worst case of the bound: all segments tilt alike; the exact image is the perfect one, shifted.
    reach = np.hypot(*np.moveaxis(tmt.corners - tmt.centers[:, None], -1, 0)).max()
    perfect = np.zeros((1, 492, 3))
    for shift in (0.5, 2.0, 5.0):
        moments = moments_needed(2 * np.pi * shift / tmt.diameter * reach, 1e-3)
        basis = segment_basis(tmt.corners, tmt.centers, 48, 0.25, tmt.diameter, moments)
        moved = psf(basis, shift_phase(perfect, [shift, 0.0], tmt.centers, tmt.diameter), 2e-3).reshape(
            48, 48
        )
        still = psf(basis, perfect).reshape(48, 48)
        pixels = int(shift / 0.25)
        np.testing.assert_allclose(moved[:, pixels:], still[:, :-pixels], rtol=0, atol=1e-3)


def test_slopes_beyond_the_basis_are_refused(flower):
    basis = segment_basis(flower.corners, flower.centers, 16, 0.4, flower.diameter, 6)
    assert psf(basis, phases(flower, 0.05)).shape == (1, 256)
    with pytest.raises(UserError, match=r"tilted by up to .* by 6 moments"):
        psf(basis, phases(flower, 1.0))
    with pytest.raises(UserError, match="more than 45 moments"):
        moments_needed(10.0, 1e-3)
    with pytest.raises(UserError, match="finite"):
        moments_needed(np.nan, 1e-3)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"moments": 3}, "1, 6, 15, 28, 45 moments per segment, not 3"),
        ({"pixels": 1}, "at least 2 x 2"),
        ({"sampling": 0.0}, "sampling"),
        ({"sampling": np.nan}, "sampling"),
        ({"diameter": -1.0}, "diameter"),
        ({"dtype": np.float64}, "complex64 or complex128"),
        ({"centers": np.zeros((6, 2))}, "7 segments need as many finite centers"),
        ({"corners": np.zeros((0, 6, 2))}, "corners of shape"),
    ],
)
def test_impossible_bases_are_refused(flower, change, message):
    arguments = {
        "corners": flower.corners,
        "centers": flower.centers,
        "pixels": 16,
        "sampling": 0.25,
        "diameter": 2600.0,
    }
    with pytest.raises(UserError, match=message):
        segment_basis(**{**arguments, **change})


def test_pupils_without_light_are_refused():
    with pytest.raises(UserError, match="above 0"):
        ray_basis(np.zeros(3), np.zeros(3), np.zeros(3), 16, 0.25, 100.0)
    with pytest.raises(UserError, match="lost rays"):
        ray_basis(np.array([0.0, np.nan]), np.zeros(2), np.ones(2), 16, 0.25, 100.0)


def test_bounds_are_the_largest_means_over_directions():
    # Means of |x| and of |x + y|³ / √8 over the unit square; a few percent more for directions not tried.
    square = 0.5 * np.array([[[-1, -1], [1, -1], [1, 1], [-1, 1.0]]])
    means = largest_means(square, np.zeros((1, 2)), 2)[:, 0]
    expected = 2 * np.pi / 4, (2 * np.pi) ** 3 / 6 * 0.1 / np.sqrt(8)
    assert (means >= expected).all()
    np.testing.assert_allclose(means, expected, rtol=0.02)


def test_moments_are_listed_by_even_degree():
    assert tuple((n + 1) * (n + 2) // 2 for n in range(0, 9, 2)) == MOMENTS
