"""Images of segments that are not convex: rectangles in closed form, sampled pupils, counted cells."""

import numpy as np
import pytest
from matplotlib.path import Path

from wavequake.imaging.engines.choice import ENGINES, SegmentedPupil, point_spread, prepare_psf
from wavequake.imaging.engines.polygon_transform import polygon_areas, polygon_centroids, polygon_transform
from wavequake.imaging.engines.segment_figure import figure_error, figure_psf, segment_figure
from wavequake.imaging.engines.segment_moments import glass_rule, moments_on_grid
from wavequake.imaging.pupils.coverage import coverage
from wavequake.imaging.pupils.outlines import Outline, blocked, segments, vane
from wavequake.optics.polynomials.zernike import annular_zernike
from wavequake.optics.shapes.polygons import signed_areas

L = np.array([[0, 0], [3, 0], [3, 1], [1, 1], [1, 2], [0, 2.0]])
BASE, POST = np.array([[0, 0], [3, 0], [3, 1], [0, 1.0]]), np.array([[0, 1], [1, 1], [1, 2], [0, 2.0]])
TURN = np.pi / 5 * np.arange(10)
STAR = np.where(np.arange(10) % 2, 0.4, 1.0)[:, None] * np.stack([np.cos(TURN), np.sin(TURN)], axis=1)


def rectangle(corners, fx, fy):
    """Transform of a rectangle along the axes, a product of two sincs."""
    (x0, y0), (x1, y1) = corners[0], corners[2]
    wave = np.exp(-1j * np.pi * (fx * (x0 + x1) + fy * (y0 + y1)))
    return (x1 - x0) * (y1 - y0) * np.sinc(fx * (x1 - x0)) * np.sinc(fy * (y1 - y0)) * wave


def test_the_transform_of_an_l_is_that_of_two_rectangles():
    """From frequencies at which the series is used to 50 cycles across, and along the axes."""
    size = np.geomspace(1e-4, 20.0, 60)
    turn = np.linspace(0, 6, 60)
    everywhere = [size * np.cos(turn), size * np.sin(turn)]
    fx, fy = np.concatenate([everywhere, [size, 0 * size], [0 * size, size]], axis=1)
    got = polygon_transform(L[None], fx, fy)[:, 0]
    assert np.abs(got - rectangle(BASE, fx, fy) - rectangle(POST, fx, fy)).max() < 2e-14 * 4.0
    assert polygon_areas(L[None]) == pytest.approx([4.0], rel=1e-15)
    np.testing.assert_allclose(polygon_centroids(L[None]), [[1.25, 0.75]], rtol=1e-15)


def test_the_transform_of_a_star_is_that_of_its_triangles():
    random = np.random.default_rng(1)
    fx, fy = random.normal(0, 3.0, (2, 50))
    fan = np.stack([np.zeros((10, 2)), STAR, np.roll(STAR, -1, axis=0)], axis=1)
    expected = polygon_transform(fan, fx, fy).sum(axis=1)
    np.testing.assert_allclose(polygon_transform(STAR[None], fx, fy)[:, 0], expected, rtol=0, atol=1e-14)


def test_cells_know_how_much_of_an_l_they_hold():
    corners = 0.9 * L + [0.35, 0.65]
    both = [coverage(Outline(c, np.ones(len(c)), np.zeros(len(c), dtype=int)), 4)
            for c in (corners[None], 0.9 * np.stack([BASE, POST]) + [0.35, 0.65])]  # fmt: skip
    np.testing.assert_array_equal(both[0].cells, both[1].cells)
    for name in ("share", "x", "y"):
        np.testing.assert_allclose(getattr(both[0], name), getattr(both[1], name), rtol=0, atol=1e-13)
    assert both[0].share.sum() == pytest.approx(4.0 * 0.81, rel=1e-14)


def test_vanes_and_concave_obstructions_take_their_areas():
    glass = segments(L[None])

    def area(outline):
        return float(outline.sign @ polygon_areas(outline.corners))

    # Up through both arms, then across all that the first leaves of the base and the post.
    assert area(blocked(glass, vane([0.5, -1], [0.5, 3], 0.2))) == pytest.approx(4 - 0.4, rel=1e-13)
    cross = blocked(blocked(glass, vane([0.5, -1], [0.5, 3], 0.2)), vane([-1, 1.5], [4, 1.5], 0.4))
    assert area(cross) == pytest.approx(4 - 0.4 - 0.4 + 0.08, rel=1e-13)
    # A vane that cuts arms off: the L's shadow is in two pieces.
    slanted = blocked(glass, vane([-1, 3.5], [4, -1.5], 0.5))
    sampled = coverage(Outline(slanted.corners * 100, slanted.sign, slanted.piece), 300).share.sum() / 1e4
    x, y = (np.arange(3000) + 0.5) / 1000, (np.arange(2000)[:, None] + 0.5) / 1000
    free = ((y < 1) | (x < 1)) & (np.abs(x + y - 2.5) > 0.25 * np.sqrt(2))
    assert area(slanted) == pytest.approx(np.count_nonzero(free) / 1e6, abs=1e-3)
    assert sampled == pytest.approx(area(slanted), rel=1e-9)
    block = blocked(segments(5.0 * BASE[None] - 1.0), L)
    assert area(block) == pytest.approx(75.0 - 4.0, rel=1e-13)
    assert area(blocked(glass, 0.5 * STAR + [1.0, 1.0])) == pytest.approx(
        4.0 - overlap(L, 0.5 * STAR + np.array([1.0, 1.0])), abs=2e-4
    )


def overlap(one, other, fine=1500):
    at = np.stack(np.meshgrid(*[3.0 * (np.arange(fine) + 0.5) / fine] * 2), axis=-1).reshape(-1, 2)
    return np.mean(Path(one).contains_points(at) & Path(other).contains_points(at)) * 9.0


@pytest.fixture
def pupil():
    """An L and a square in its notch, a star beside them, mm."""
    shapes = [100 * L + [-220, -120], 100 * POST + [-110, -110], 90 * STAR + [150, 120]]
    corners = np.stack([np.pad(c, ((0, 10 - len(c)), (0, 0)), "edge") for c in shapes])
    return SegmentedPupil(corners, polygon_centroids(corners), 600.0)


def test_the_image_of_an_l_is_exact_at_any_pixel():
    centers = np.array([[1.0, 0.5]])
    alone = SegmentedPupil(L[None], centers, 6.0)
    engine = prepare_psf(alone, 24, 0.3, "segments")
    image = point_spread(engine, np.zeros((1, 1, 3))).reshape(24, 24)
    f = (np.arange(24) - 12) * 0.3 / 6.0
    fx, fy = (axis.ravel() for axis in np.meshgrid(f, f))
    field = rectangle(BASE, fx, fy) + rectangle(POST, fx, fy)
    np.testing.assert_allclose(image.ravel(), np.abs(field / 4.0) ** 2, rtol=0, atol=1e-14)


def test_engines_agree_on_concave_segments(pupil):
    motion = np.random.default_rng(3).normal(0, 0.1, (2, 3, 3)) * [1.0, 1e-3, 1e-3]
    obstructed = SegmentedPupil(pupil.corners, pupil.centers, 600.0, (vane([0, -300], [30, 300], 20.0),))
    for glass in (pupil, obstructed):
        images = {}
        for name in ENGINES:
            engine = prepare_psf(glass, 12, 0.5, name, corner_phase=0.5, samples=256)
            images[name] = point_spread(engine, motion)
        assert np.abs(images["fft"] - images["matrix"]).max() < 1e-12
        assert np.abs(images["segments"] - images["matrix"]).max() < 1e-4


def test_bent_concave_segments(pupil):
    """Against a rule of many points; its own bound holds, and no point counts negative."""
    _, weights = glass_rule(pupil.corners, 5)
    assert (weights >= 0.0).all()
    np.testing.assert_allclose(weights.sum(axis=1), signed_areas(pupil.corners), rtol=1e-13)
    figure = segment_figure(
        pupil.corners, pupil.centers, 8, 0.5, 600.0, terms=8, moments=28, dtype=np.complex128
    )
    coefficients = np.random.default_rng(5).normal(0, 0.03, (1, 3, 8))
    got = figure_psf(figure, coefficients)[0]
    places, weights = glass_rule(pupil.corners, 16)
    local = (places - pupil.centers[:, None]) / pupil.reach
    modes = annular_zernike(local[..., 0].ravel(), local[..., 1].ravel(), 8).reshape(*weights.shape, 8)
    waves = weights * np.exp(2j * np.pi * np.einsum("sqk,sk->sq", modes, coefficients[0]))
    f = (np.arange(8) - 4) * 0.5 / 600.0
    along_x, along_y = (np.exp(-2j * np.pi * places[..., k].reshape(-1, 1) * f) for k in (0, 1))
    field = (along_y * waves.reshape(-1, 1)).T @ along_x
    error = np.abs(np.abs(field / weights.sum()).ravel() ** 2 - got).max()
    assert error <= figure_error(figure, coefficients)[0] < 1e-3


def test_moments_of_an_l_are_those_of_its_rectangles():
    f = np.linspace(-0.7, 0.9, 5)
    center = np.array([[1.0, 0.5]])
    whole, base, post = (moments_on_grid(c[None], center, f, f, 4, 2.0) for c in (L, BASE, POST))
    np.testing.assert_allclose(whole, base + post, rtol=0, atol=1e-13)
