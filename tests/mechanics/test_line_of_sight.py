import numpy as np
import pytest
from pydantic import TypeAdapter, ValidationError
from scipy import stats

from wavequake.mechanics.disturbances.motion import RAD_PER_MAS
from wavequake.mechanics.disturbances.registry import (
    Disturbance,
    analytic_rms,
    draw_case,
    line_of_sight_rms_mas,
)
from wavequake.mechanics.disturbances.sources.line_of_sight import LineOfSight
from wavequake.mechanics.disturbances.sources.vibration_lines import Line, VibrationLines, lines_of

adapter = TypeAdapter(Disturbance)
CSV = "frequency_hz,psd\n1,2\n3,2\n4,0\n"


def sampled_mas(entry, layout, cases=300):
    """Radial rms of one instant of each case, so that all samples are independent."""
    motions = [draw_case([entry], entry, layout, 8, realization) for realization in range(cases)]
    return np.array([getattr(motion, entry.act)[-1] for motion in motions]) / RAD_PER_MAS


@pytest.mark.parametrize(
    ("entry", "rms"),
    [
        (LineOfSight(name="wind"), 18.96),
        (LineOfSight(name="wind", percentile=75), 27.83),
        (LineOfSight(name="wind", rms_mas=5.0, duration_s=0.1), 5.0),
        (LineOfSight(name="shake", spectrum="tmt-vibration", act="m2"), 14.93),
        (
            LineOfSight(name="f", spectrum="file", file="a.csv", file_csv=CSV, file_unit="mas2/Hz"),
            np.sqrt(5.0),
        ),
        (LineOfSight(name="f", spectrum="file", file="a.csv", file_csv=CSV, rms_mas=3.0), 3.0),
        (VibrationLines(name="keck", set="keck"), 6.7),
        (VibrationLines(name="keck", set="keck", rms_mas=2.0, act="m2"), 2.0),
        (VibrationLines(name="eris", set="vlt-eris", rms_mas=4.0), 4.0 * np.sqrt(2)),
        (VibrationLines(name="elt", set="elt-windshake-8ms", rms_mas=4.0), 4.0),
    ],
)
def test_sampled_rms_is_the_analytic_rms_within_sampling_error(entry, rms, few):
    analytic, unit = analytic_rms(entry, few)
    assert unit == "mas"
    assert analytic == pytest.approx(rms, rel=5e-4)
    samples = sampled_mas(entry, few)
    low, high = stats.chi2.ppf([1e-5, 1 - 1e-5], 300) / 300
    assert low < np.mean(np.sum(samples**2, axis=1)) / analytic**2 < high


def test_motion_is_along_its_direction_and_by_what_acts(few):
    entry = LineOfSight(name="wind", direction_deg=30.0, act="m2", duration_s=60.0)
    motion = draw_case([entry], entry, few, 1, 0)
    assert not motion.mount.any()
    assert not motion.segment_motion.any()
    across = motion.m2 @ [-np.sin(np.pi / 6), np.cos(np.pi / 6)]
    assert np.abs(across).max() < 1e-12 * np.abs(motion.m2).max()
    assert line_of_sight_rms_mas(motion) == pytest.approx(np.sqrt(np.mean(motion.m2**2) * 2) / RAD_PER_MAS)


def test_wind_shake_drifts_within_100_ms_and_swings_within_minutes(few):
    def swing(duration):
        entry = LineOfSight(name="wind", duration_s=duration)
        motions = [draw_case([entry], entry, few, 1, realization).mount[:, 0] for realization in range(40)]
        return np.sqrt(np.mean([np.var(motion) for motion in motions])) / RAD_PER_MAS

    assert swing(0.1) < 0.1 * 18.96
    assert swing(120.0) == pytest.approx(18.96, rel=0.1)


def test_lines_of_eris_lie_on_both_axes_with_equal_power():
    lines = lines_of(VibrationLines(name="eris", set="vlt-eris", rms_mas=4.0))
    for across in (False, True):
        axis = [line for line in lines if line.across == across]
        assert len(axis) == 12
        assert sum(line.rms_mas**2 for line in axis) == pytest.approx(16.0)


def test_listed_lines_across_the_direction_move_that_way(few):
    lines = (Line(frequency_hz=20.0, fwhm_hz=0.5, rms_mas=3.0, across=True),)
    entry = VibrationLines(name="pump", lines=lines, direction_deg=30.0)
    mount = draw_case([entry], entry, few, 1, 0).mount
    # Along is (cos 30, sin 30); across is a quarter turn further.
    np.testing.assert_allclose(mount @ [np.sqrt(0.75), 0.5], 0, rtol=0, atol=1e-12 * np.abs(mount).max())
    np.testing.assert_allclose(mount[:, 0], -mount[:, 1] / np.sqrt(3), rtol=1e-12)


def test_a_narrow_line_is_a_slowly_changing_sinusoid_of_its_frequency(few):
    lines = (Line(frequency_hz=20.0, fwhm_hz=0.1, rms_mas=3.0),)
    entry = VibrationLines(name="pump", lines=lines, duration_s=1.0, instants=128)
    series = draw_case([entry], entry, few, 1, 0).mount[:, 0]
    power = np.abs(np.fft.rfft(series * np.hanning(128))) ** 2
    assert power.argmax() == 20
    assert power[19:22].sum() > 0.98 * power.sum()


@pytest.mark.parametrize(
    ("table", "complaint"),
    [
        ({"model": "vibration-lines"}, "give either lines or the name of a set"),
        ({"model": "vibration-lines", "set": "vlt-eris"}, "gives the shape only; state its rms_mas"),
        ({"model": "vibration-lines", "set": "elt-windshake-8ms"}, "state its rms_mas"),
        ({"model": "vibration-lines", "set": "gemini"}, "Input should be 'keck'"),
        (
            {"model": "vibration-lines", "lines": [{"frequency_hz": 1.0, "fwhm_hz": 2.0, "rms_mas": 1.0}]},
            "it is no line",
        ),
        ({"model": "vibration-lines", "lines": [{"frequency_hz": 1.0, "fwhm_hz": 0.1}]}, "Field required"),
        ({"model": "line-of-sight", "spectrum": "file"}, "needs a file, a CSV"),
        ({"model": "line-of-sight", "file_csv": CSV}, "takes no file"),
        ({"model": "line-of-sight", "spectrum": "file", "file_csv": CSV}, "shape only; state its rms_mas"),
        (
            {
                "model": "line-of-sight",
                "spectrum": "file",
                "file": "x.csv",
                "file_csv": "1,nan\n2,1",
                "rms_mas": 1,
            },
            "x.csv, line 1: '1,nan' has a value that is not finite",
        ),
        ({"model": "line-of-sight", "rms_mas": 0.0}, "greater than 0"),
        ({"model": "line-of-sight", "percentile": 60}, "50 or 75"),
        ({"model": "line-of-sight", "vibration_low_hz": 60.0}, "below vibration_high_hz"),
    ],
)
def test_bad_parameters_are_refused_with_what_would_be_right(table, complaint):
    with pytest.raises(ValidationError, match=complaint):
        adapter.validate_python(table | {"name": "x"})


def test_study_tables_survive_json():
    for entry in (
        VibrationLines(name="p", lines=(Line(frequency_hz=20.0, fwhm_hz=0.1, rms_mas=3.0),)),
        LineOfSight(name="f", spectrum="file", file="a.csv", file_csv=CSV, rms_mas=3.0),
    ):
        again = adapter.validate_json(entry.model_dump_json())
        # The path of a file is dropped: what counts is what it says.
        assert again == entry.model_copy(update={"file": None} if entry.model == "line-of-sight" else {})
