import numpy as np
import pytest
from pydantic import ValidationError

from wavequake.mechanics.disturbances.registry import draw_case
from wavequake.mechanics.disturbances.sources.segment_history import SegmentHistory

FINE = SegmentHistory(name="quake", instants=2048)


def to_sky(motion, layout):
    """Displacements of the segments in sky orientation, (n, S, 3)."""
    return np.einsum("sij,nsj->nsi", layout.axes, motion.segment_motion[..., :3])


def test_the_motion_is_along_the_telescope_axis_whatever_the_segments_tilt(tmt):
    motion = draw_case([FINE], FINE.model_copy(update={"instants": 16}), tmt, 1, 0)
    sky = to_sky(motion, tmt)
    assert np.abs(sky[..., :2]).max() < 1e-8 * 70e-9
    assert not motion.segment_motion[..., 3:].any()
    # The outer segments lean by 13 degrees: their local motion has a part in plane.
    assert np.abs(motion.segment_motion[..., :2]).max() > 5e-9


def test_the_largest_excursion_is_the_peak_and_motion_starts_from_rest(few):
    z = to_sky(draw_case([FINE], FINE, few, 1, 0), few)[..., 2]
    assert np.abs(z).max() == pytest.approx(70e-9, rel=2e-3)
    early = z[:40]
    time = 0.1 * np.arange(1, 41) / 2048
    # From rest: the displacement grows with the square of time.
    assert np.abs(early / time[:, None] ** 2).max() < 2 * np.abs(early[-1] / time[-1] ** 2).max()
    assert np.abs(z[0]).max() < 1e-4 * 70e-9


def test_histories_are_band_limited_and_differ_between_segments(few):
    entry = SegmentHistory(name="quake", duration_s=0.4, instants=512, ramp_s=0.0)
    z = to_sky(draw_case([entry], entry, few, 2, 0), few)[..., 2]
    power = np.sum(np.abs(np.fft.rfft(z * np.hanning(512)[:, None], axis=0)) ** 2, axis=1)
    assert power[2:19].sum() > 0.999 * power.sum()
    assert np.abs(np.corrcoef(z.T) - np.eye(5)).max() < 0.9


def test_a_history_does_not_depend_on_the_instants_at_which_it_is_looked_at(few):
    coarse = FINE.model_copy(update={"instants": 16})
    fine, looked = (draw_case([FINE], entry, few, 1, 4).segment_motion for entry in (FINE, coarse))
    np.testing.assert_allclose(fine[127::128], looked, rtol=0, atol=1e-20)


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"low_hz": 50.0}, "low_hz 50 is above high_hz 40"),
        ({"duration_s": 10.0}, "more than 16 periods"),
        ({"peak_nm": -1.0}, "greater than or equal to 0"),
    ],
)
def test_bad_parameters_are_refused(change, complaint):
    with pytest.raises(ValidationError, match=complaint):
        SegmentHistory(name="quake", **change)
