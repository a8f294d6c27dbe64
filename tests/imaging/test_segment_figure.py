"""Bent and obstructed segments, against a sampled pupil of converging fineness and against closed forms."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from wavequake.errors import UserError
from wavequake.imaging.engines.polygon_transform import polygon_areas, polygon_transform
from wavequake.imaging.engines.segment_basis import segment_basis
from wavequake.imaging.engines.segment_figure import figure_error, figure_psf, segment_figure, terms_of_motion
from wavequake.imaging.engines.segment_moments import gauss_rule
from wavequake.imaging.engines.segment_psf import psf
from wavequake.imaging.pupils.outlines import Outline, blocked, segments, vane
from wavequake.optics.polynomials.zernike import annular_zernike

DIAMETER, PIXELS, SAMPLING = 2700.0, 16, 0.5
RNG = np.random.default_rng(11)


def direct(corners, centers, radius, coefficients, points):
    """The integral over each segment written out by a Gauss rule of `points` per side of its triangles."""
    places, weights = gauss_rule(corners, points)
    local = (places - centers[:, None]) / radius
    modes = annular_zernike(local[..., 0].ravel(), local[..., 1].ravel(), coefficients.shape[-1])
    modes = modes.reshape(*weights.shape, -1)
    waves = weights * np.exp(2j * np.pi * np.einsum("sqk,sk->sq", modes, coefficients))
    f = (np.arange(PIXELS) - PIXELS // 2) * SAMPLING / DIAMETER
    along_x, along_y = (np.exp(-2j * np.pi * places[..., k].reshape(-1, 1) * f) for k in (0, 1))
    field = (along_y * waves.reshape(-1, 1)).T @ along_x
    return np.abs(field / weights.sum()) ** 2


@pytest.fixture(scope="module")
def bent(flower):
    return segment_figure(flower.corners, flower.centers, PIXELS, SAMPLING, DIAMETER)


@pytest.mark.parametrize("term", range(4, 12))
def test_each_term_converges_to_the_sampled_integral(flower, bent, term):
    coefficients = np.zeros((1, 7, 11))
    coefficients[..., term - 1] = 0.03 * np.linspace(-1, 1, 7)
    coefficients[..., :3] = RNG.normal(0, 0.02, (1, 7, 3))
    image = figure_psf(bent, coefficients).reshape(PIXELS, PIXELS)
    radius = bent.basis.slope_scale
    coarse, fine, finest = (
        direct(flower.corners, flower.centers, radius, coefficients[0], n) for n in (3, 16, 24)
    )
    assert np.abs(fine - finest).max() < 1e-13  # the sampling has converged
    assert np.abs(coarse - finest).max() > 1e-6
    assert np.abs(image - finest).max() < 1e-5
    assert np.abs(image - finest).max() < figure_error(bent, coefficients)[0]


@settings(max_examples=15)
@given(seed=st.integers(0, 2**32 - 1), size=st.sampled_from([0.003, 0.02, 0.06]), alike=st.booleans())
def test_the_bound_holds(flower, bent, seed, size, alike):
    coefficients = np.random.default_rng(seed).normal(0, size, (1, 1 if alike else 7, 11))
    coefficients = np.broadcast_to(coefficients, (1, 7, 11))
    image = figure_psf(bent, coefficients, tolerance=1.0).reshape(PIXELS, PIXELS)
    exact = direct(flower.corners, flower.centers, bent.basis.slope_scale, coefficients[0], 20)
    bound = figure_error(bent, coefficients)[0]
    assert np.abs(image - exact).max() <= bound + 1e-12
    assert bound < 2000 * np.abs(image - exact).max() + 1e-9  # and says something


def test_pistons_and_slopes_are_the_series(flower, bent):
    motion = RNG.normal(0, 0.1, (20, 7, 3)) * [1.0, 1e-4, 1e-4]
    basis = segment_basis(flower.corners, flower.centers, PIXELS, SAMPLING, DIAMETER, 45, np.complex128)
    terms = terms_of_motion(np.pad(motion, ((0, 0), (0, 0), (0, 8))), bent.basis.slope_scale)
    assert figure_psf(bent, terms) == pytest.approx(psf(basis, motion, 1e-9), abs=1e-9)


def test_nan_stays_in_its_instant_and_too_much_is_refused(bent):
    coefficients = RNG.normal(0, 0.01, (18, 7, 11))
    clean = figure_psf(bent, coefficients)
    coefficients[3, 2, 5] = np.nan
    images = figure_psf(bent, coefficients)
    assert np.isnan(images[3]).all()
    others = np.delete(np.arange(18), 3)
    assert np.array_equal(images[others], clean[others])
    assert np.array_equal(figure_psf(bent, coefficients[17:]), clean[17:])
    with pytest.raises(UserError, match=r"bent segments \(0.001 is allowed\)"):
        figure_psf(bent, np.full((1, 7, 11), 0.5))
    with pytest.raises(UserError, match=r"\(batch, 7, 11\), not \(1, 7, 3\)"):
        figure_psf(bent, np.zeros((1, 7, 3)))


def test_vanes_are_taken_from_the_closed_forms(flower):
    outline = blocked(segments(flower.corners), vane([-2000.0, -300.0], [2000.0, 500.0], 60.0))
    outline = blocked(outline, vane([-100.0, -2000.0], [200.0, 2000.0], 45.0))
    shadows = Outline(outline.corners[7:], outline.sign[7:], outline.piece[7:])
    basis = segment_basis(
        flower.corners, flower.centers, PIXELS, SAMPLING, DIAMETER, 6, np.complex128, shadows
    )
    motion = RNG.normal(0, 0.2, (1, 7, 3)) * [1, 0, 0]
    image = psf(basis, motion)[0]
    f = (np.arange(PIXELS) - PIXELS // 2) * SAMPLING / DIAMETER
    fy, fx = (a.ravel() for a in np.meshgrid(f, f, indexing="ij"))
    areas = np.array([polygon_areas(c[None])[0] for c in outline.corners])
    waves = outline.sign * np.exp(2j * np.pi * motion[0, outline.piece, 0])
    field = polygon_transform(outline.corners, fx, fy) @ waves / (outline.sign * areas).sum()
    assert np.abs(image - np.abs(field) ** 2).max() < 1e-12
    bare = segment_basis(flower.corners, flower.centers, PIXELS, SAMPLING, DIAMETER, 6, np.complex128)
    assert np.abs(image - psf(bare, motion)[0]).max() > 1e-3
    dark = Outline(flower.corners, -np.ones(7), np.arange(7))
    other = Outline(flower.corners[:1], -np.ones(1), np.array([9]))
    with pytest.raises(UserError, match="everything is blocked"):
        segment_basis(flower.corners, flower.centers, 8, 0.5, DIAMETER, 1, np.complex128, dark)
    with pytest.raises(UserError, match="shadows must fall on segments 0 to 6"):
        segment_basis(flower.corners, flower.centers, 8, 0.5, DIAMETER, 1, np.complex128, other)
