"""Segments that are mirror images, and transforms parted by parity."""

import numpy as np
import pytest

from wavequake.imaging.engines.mirror_twins import Twins, find_twins, fold, lone, parts_of, unfold
from wavequake.imaging.engines.segment_moments import exponents

SQUARE = 0.1 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1.0]])
BOTH = [(0.3, 0.4), (-0.3, 0.4), (0.3, -0.4), (-0.3, -0.4), (0.0, 0.7), (0.0, -0.7), (0.8, 0.0), (-0.8, 0.0)]


def found(places):
    centers = np.array(places)
    return find_twins(centers[:, None] + SQUARE, centers)


def test_twins_are_found_in_both_axes_and_on_them():
    twins = found(BOTH)
    assert twins.segment[:, 0].tolist() == [0, 1, 2, 3]
    assert twins.segment.shape == (4, 3)
    np.testing.assert_array_equal(twins.share, np.array([[1.0, 0.5, 0.5]] * 4))
    counts = np.zeros(len(BOTH))
    np.add.at(counts, twins.segment, twins.share)
    np.testing.assert_array_equal(counts, 1.0)  # every segment counts once


@pytest.mark.parametrize(
    ("places", "representatives", "images"),
    [
        ([(0.3, 0.4), (-0.3, 0.4), (0.0, -0.2)], 2, [True, True, False, False]),
        ([(0.3, 0.4), (0.3, -0.4)], 1, [True, False, True, False]),
        ([(0.3, 0.4), (-0.3, -0.4)], 2, [True, False, False, False]),
        ([(0.3, 0.4), (-0.3 - 1e-9, 0.4)], 2, [True, False, False, False]),
    ],
)
def test_an_axis_counts_if_every_polygon_has_an_image_in_it(places, representatives, images):
    twins = found(places)
    assert twins.segment.shape == (4, representatives)
    assert (twins.share.sum(axis=1) > 0.0).tolist() == images


def test_an_equal_middle_is_not_enough():
    corners = np.array([SQUARE + np.array([0.3, 0.0]), 2.0 * SQUARE - np.array([0.3, 0.0])])
    assert find_twins(corners, corners.mean(axis=1)).segment.shape == (4, 2)


def test_centers_must_be_images_too():
    centers = np.array([[0.3, 0.0], [-0.3, 0.01]])
    assert find_twins(np.array([[0.3, 0.0], [-0.3, 0.0]])[:, None] + SQUARE, centers).segment.shape == (4, 2)


@pytest.mark.parametrize("with_twins", [True, False])
def test_folded_fields_are_sums_over_all_points(with_twins):
    """Points that carry moments x^a y^b about themselves: each is exp(-2πi f·x) times its share of them."""
    rng = np.random.default_rng(4)
    places, powers = np.array(BOTH), np.array(exponents(2))
    offset = rng.uniform(0.01, 0.05, 2)  # a mass at an offset that mirrors with its point
    side = np.where(places == 0.0, 0.0, np.sign(places)) * offset
    twins = found(BOTH) if with_twins else lone(len(BOTH))
    half = np.array([0.4, 1.3, 2.2])
    nodes = np.concatenate([-half[::-1], half])
    amplitude = rng.normal(size=(len(powers), len(BOTH), 2, 3))

    def transform(fy, fx, point, about, power):
        y, x = np.meshgrid(fy, fx, indexing="ij")
        return np.prod(about**power) * np.exp(-2j * np.pi * (x * (point + about)[0] + y * (point + about)[1]))

    fields = [
        [transform(half, nodes, places[one], side[one], power) for one in twins.segment[0]]
        for power in powers
    ]
    matrix = np.moveaxis(np.stack([parts_of(np.moveaxis(np.array(row), 0, -1)) for row in fields]), 0, 3)
    folded = fold(twins, powers, amplitude.reshape(len(powers), len(BOTH), -1))
    product = matrix.reshape(4, half.size**2, -1) @ folded
    result = unfold(product.reshape(4, half.size, half.size, 2, 3))
    complex_amplitude = amplitude[:, :, 0] + 1j * amplitude[:, :, 1]
    expected = sum(
        transform(nodes, nodes, places[one], side[one], power)[..., None] * complex_amplitude[index, one]
        for index, power in enumerate(powers)
        for one in range(len(BOTH))
    )
    np.testing.assert_allclose(result[:, :, 0] + 1j * result[:, :, 1], expected, rtol=0, atol=1e-13)


def test_lone_segments_are_as_they_are():
    twins = lone(3)
    assert isinstance(twins, Twins)
    factors = np.arange(12.0).reshape(2, 3, 2)
    np.testing.assert_array_equal(fold(twins, np.array(exponents(1))[:2], factors), factors.reshape(1, 6, 2))
