import numpy as np
import pytest

from wavequake.errors import UserError
from wavequake.imaging.engines.matrix_fourier import matrix_fourier, psf
from wavequake.imaging.engines.polygon_transform import polygon_areas, polygon_transform
from wavequake.imaging.exposures.exposure import encircled_energy, radial_profile
from wavequake.imaging.pupils.outlines import annulus, blocked, segments, vane
from wavequake.imaging.pupils.pupil_function import annular_pupil, apodized, pupil_function, sampled_pupil
from wavequake.imaging.pupils.wavefront_phase import segment_phase


@pytest.mark.parametrize("case", ["perfect", "opd35nm"])
def test_the_sampled_tmt_agrees_with_its_reference(tmt, case):
    reference = tmt.reference[case]
    grid = sampled_pupil(segments(tmt.corners), 512, tmt.diameter)
    motion = np.zeros((1, 492, 3))
    motion[0, :, 0] = tmt.pistons * (case == "opd35nm")
    phase = segment_phase(grid, tmt.centers, motion, tmt.diameter / 2)
    image = psf(matrix_fourier(grid, 128, 0.25), phase)[0]
    assert image[64, 64] == pytest.approx(reference["strehl_at_origin"], abs=1e-12)
    area = polygon_areas(tmt.corners).sum()
    for radius, energy in reference["EE_at_lamD"].items():
        found = encircled_energy(image, 0.25, area, tmt.diameter, [float(radius)], "origin")[0]
        assert found == pytest.approx(energy, abs=1e-4)
    means = radial_profile(image, 0.25, 0.05 * np.arange(35), "origin")
    ring = [reference["first_min_mean"], reference["first_ring_mean"]]
    assert means[[25, 34]] == pytest.approx(ring, abs=1e-4)


def test_pixels_of_the_sampled_tmt_agree_with_a_sum_over_polygons(tmt):
    grid = sampled_pupil(segments(tmt.corners), 512, tmt.diameter)
    motion = np.zeros((1, 492, 3))
    motion[0, :, 0] = tmt.pistons
    image = psf(matrix_fourier(grid, 128, 0.25), segment_phase(grid, tmt.centers, motion, tmt.diameter / 2))[
        0
    ]
    y, x = np.random.default_rng(0).integers(0, 128, (2, 60))
    fy, fx = (0.25 * (k - 64) / tmt.diameter for k in (y, x))
    field = polygon_transform(tmt.corners, fx, fy) @ np.exp(2j * np.pi * tmt.pistons)
    exact = np.abs(field / polygon_areas(tmt.corners).sum()) ** 2
    assert np.abs(image[y, x] - exact).max() < 1e-5


def test_a_blocked_pupil_images_by_babinet():
    """The field of a ring with a vane is that of the ring less that of the blocked rectangle."""
    spider = vane([0.45, 0.0], [0.9, 0.0], 0.06)  # well inside the ring
    transform = matrix_fourier(sampled_pupil(blocked(annulus(1.0, 0.4), spider), 256, 2.0), 48, 0.25)
    ring = matrix_fourier(annular_pupil(256, 0.4), 48, 0.25)
    field = ring.kernel @ ring.pupil.amplitude @ ring.kernel.T * (2 / 256) ** 2
    fx, fy = (f.ravel() for f in np.meshgrid(ring.axis / 2, ring.axis / 2))
    field = field - polygon_transform(spider[None], fx, fy)[:, 0].reshape(48, 48)
    image = psf(transform, np.zeros((1, transform.pupil.cells.size)))[0]
    peak = np.pi * (1 - 0.16) - 0.45 * 0.06
    assert image == pytest.approx(np.abs(field / peak) ** 2, abs=1e-5)


def test_apodization_weakens_amplitudes():
    """Amplitudes (1 - r^2) give (8 J2(t) / t^2)^2, t = pi r: the next Sonine integral after Airy's."""
    from scipy.special import jv

    grid = annular_pupil(256)
    soft = apodized(grid, np.clip(1 - grid.x**2 - grid.y**2, 0, None))
    transform = matrix_fourier(soft, 40, 0.3)
    t = np.pi * np.hypot(transform.axis, 0.3 * 5)
    found = psf(transform, np.zeros((1, soft.cells.size)))[0, 25]
    assert found == pytest.approx((8 * jv(2, t) / t**2) ** 2, abs=1e-5)


def test_a_cell_where_pieces_meet_sums_their_amplitudes():
    halves = np.array([[[-1, -1], [0.1, -1], [0.1, 1], [-1, 1]], [[0.1, -1], [1, -1], [1, 1], [0.1, 1.0]]])
    grid = sampled_pupil(segments(halves), 8, 2.0)
    field = pupil_function(grid, np.where(grid.piece == 1, np.pi / 2, 0.0)[None])[0]
    share = 0.1 / 0.25
    assert field[3] == pytest.approx([1, 1, 1, 1, share + 1j * (1 - share), 1j, 1j, 1j], abs=1e-12)
    assert grid.amplitude == pytest.approx(np.ones((8, 8)), abs=1e-12)


def test_bad_pupils_are_refused():
    disc = annulus(1.0)
    with pytest.raises(UserError, match="beyond its grid"):
        sampled_pupil(disc, 16, 1.9)
    with pytest.raises(UserError, match="diameter of the pupil"):
        sampled_pupil(disc, 16, np.nan)
    with pytest.raises(UserError, match="no light passes"):
        sampled_pupil(blocked(disc, np.array([[-2, -2], [2, -2], [2, 2], [-2, 2.0]])), 16, 2.0)
    grid = annular_pupil(16)
    with pytest.raises(UserError, match="at least 0"):
        apodized(grid, -np.ones(grid.light.size))
    with pytest.raises(UserError, match="no light passes"):
        apodized(grid, np.zeros(grid.light.size))
    with pytest.raises(UserError, match="as many factors"):
        apodized(grid, np.ones(3))
