"""The engines of one function agree on segments that are bent and stand behind a spider."""

import numpy as np
import pytest

from wavequake.errors import UserError
from wavequake.imaging.engines.choice import SegmentedPupil, point_spread, prepare_psf
from wavequake.imaging.pupils.outlines import vane
from wavequake.imaging.pupils.pupil_function import sampled_pupil
from wavequake.imaging.pupils.wavefront_phase import segment_phase

RNG = np.random.default_rng(8)
VANES = (vane([-2000.0, -300.0], [2000.0, 500.0], 60.0), vane([-100.0, -2000.0], [200.0, 2000.0], 45.0))


def motions(batch, figure):
    size = np.r_[0.1, 1e-5, 1e-5, np.full(8, figure)]
    return RNG.normal(0.0, 1.0, (batch, 7, 11)) * size


def test_sampling_converges_to_the_moments(flower):
    pupil = SegmentedPupil(flower.corners, flower.centers, 2700.0, VANES, 11)
    motion = motions(2, 0.01)
    exact = point_spread(prepare_psf(pupil, 24, 0.5, "segments", tolerance=0.01), motion)
    errors = []
    for samples in (64, 128, 256, 512):
        engine = prepare_psf(pupil, 24, 0.5, "matrix", samples=samples)
        errors.append(np.abs(point_spread(engine, motion) - exact).max())
    assert errors[-1] < 2e-5
    assert errors[0] > 3 * errors[1] > 6 * errors[2]


def test_too_much_bending_is_sampled(flower):
    pupil = SegmentedPupil(flower.corners, flower.centers, 2700.0, VANES, 11)
    engine = prepare_psf(pupil, 16, 0.5, "segments", tolerance=1e-3, samples=128)
    motion = motions(3, 0.005)
    motion[1, 2, 3:] = 0.3
    images = point_spread(engine, motion, check=False)
    sampled = point_spread(prepare_psf(pupil, 16, 0.5, "matrix", samples=128), motion, check=False)
    assert np.array_equal(images[1], sampled[1])
    assert np.abs(images[[0, 2]] - sampled[[0, 2]]).max() > 1e-9
    motion[0, 0, 7] = np.nan
    assert np.isnan(point_spread(engine, motion, check=False)[0]).all()


def test_terms_need_their_number_and_their_circle(flower):
    pupil = SegmentedPupil(flower.corners, flower.centers, 2700.0, figure_terms=6)
    engine = prepare_psf(pupil, 8, 0.5, "matrix", samples=64)
    with pytest.raises(UserError, match=r"7 segments of 6 terms need motions of shape \(batch, 7, 6\)"):
        point_spread(engine, np.zeros((1, 7, 3)))
    grid = sampled_pupil(pupil.outline(), 64, 2700.0)
    with pytest.raises(UserError, match="radius of their circle above 0, not 0"):
        segment_phase(grid, flower.centers, np.zeros((1, 7, 6)), 1350.0)
