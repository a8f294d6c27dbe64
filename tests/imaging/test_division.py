"""Steep segments are imaged by their parts."""

import numpy as np
import pytest

from wavequake.imaging.engines.division import divide, divided_phase
from wavequake.imaging.engines.polygon_transform import polygon_areas, polygon_transform
from wavequake.imaging.engines.segment_basis import segment_basis
from wavequake.imaging.engines.segment_psf import psf, truncation_error

CONCAVE = np.array([[[0, 0], [2, 0], [2, 2], [1, 0.5], [0, 2.0]]])
PADDED = np.array([[[0, 0], [2, 0], [1, 2], [1, 2.0]]])


@pytest.mark.parametrize("corners", [CONCAVE, PADDED])
@pytest.mark.parametrize("halvings", [0, 2])
def test_parts_make_up_the_whole(corners, halvings):
    parts = divide(corners, corners.mean(axis=1), halvings)
    areas = polygon_areas(parts.corners)
    assert areas.sum() == pytest.approx(polygon_areas(corners).sum(), rel=1e-14)
    assert areas.max() <= polygon_areas(corners).sum() / 4**halvings
    frequency = np.random.default_rng(2).uniform(-1, 1, (2, 20))
    whole = polygon_transform(corners, *frequency).sum(axis=1)
    np.testing.assert_allclose(
        polygon_transform(parts.corners, *frequency).sum(axis=1), whole, rtol=0, atol=1e-14
    )


def test_steep_segments_equal_shifted_polygons(flower):
    """Slopes of 6 rad at a corner, where no number of moments of whole segments converges."""
    rng = np.random.default_rng(7)
    reach = np.hypot(*np.moveaxis(flower.corners - flower.centers[:, None], -1, 0)).max()
    phase = rng.normal(0, 0.2, (1, len(flower.centers), 3))
    phase[..., 1:] = rng.normal(0, 6.0 / (2 * np.pi * reach), phase[..., 1:].shape)
    axis = (np.arange(24) - 12) * 0.3 / flower.diameter
    y, x = (one.ravel() for one in np.meshgrid(axis, axis, indexing="ij"))
    exact = np.zeros(x.size, dtype=complex)
    for corners, center, (piston, gx, gy) in zip(flower.corners, flower.centers, phase[0], strict=True):
        local = polygon_transform((corners - center)[None], x - gx, y - gy)[:, 0]
        exact += local * np.exp(2j * np.pi * (piston - x * center[0] - y * center[1]))
    exact = np.abs(exact / polygon_areas(flower.corners).sum()) ** 2
    bounds, errors = [], []
    for halvings in (0, 1, 2):
        parts = divide(flower.corners, flower.centers, halvings)
        grid = (24, 0.3, flower.diameter)
        basis = segment_basis(parts.corners, parts.centers, *grid, moments=28, dtype=np.complex128)
        finer = divided_phase(parts, phase)
        bounds.append(truncation_error(basis, finer)[-1, 0])
        errors.append(np.abs(psf(basis, finer, bounds[-1])[0] - exact).max())
    assert (np.array(errors) < bounds).all()
    assert errors[2] < 1e-7
    assert errors[1] > 30.0 * errors[2]
