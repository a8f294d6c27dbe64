"""Amplitudes that are doubted before a run, and those of every bundled study, which are not."""

import pytest

from wavequake.workflows.early_notices import doubts
from wavequake.workflows.study import bundled_studies, load_study


def test_no_bundled_study_is_doubted():
    assert not [words for name in bundled_studies() for words in doubts(load_study(name))]


@pytest.mark.parametrize(
    ("study", "key", "value", "words"),
    [
        ("tmt-segments", "alignment.piston_nm", 3e12, "piston_nm = 3e+12 is 3e+03 m; is nm its unit?"),
        ("tmt-segments", "alignment.figure_nm", {"4": 2e7}, "figure_nm.4 = 2e+07 is 0.02 m; is nm its unit?"),
        ("tmt-segments", "alignment.tip_nrad", 2e8, "tip_nrad = 2e+08 is 0.2 rad; is nrad its unit?"),
        ("tmt-segments", "wind-shake.rms_mas", 1e8, "rms_mas = 1e+08 is 0.485 rad; is mas its unit?"),
        ("tmt18-history", "history.peak_nm", 1e300, "peak_nm = 1e+300 is 1e+291 m; is nm its unit?"),
        ("euv", "drift.rms", {"dx_um": 2e4}, "rms.dx_um = 20000 is 0.02 m; is um its unit?"),
    ],
)
def test_an_amplitude_that_nobody_means_is_doubted(study, key, value, words):
    (said,) = doubts(load_study(study, {f"disturbance.{key}": value}))
    assert said == f"warning: disturbance.{key.rpartition('.')[0]}.{words}"


def test_the_command_line_says_so_before_it_runs(wavequake, tmp_path):
    keys = ["disturbance.history.peak_nm=1e300", "campaign.cases=1", "optics.rays=200", "imaging.pixels=8"]
    code, said, trouble = wavequake(
        "run", "tmt18-history", *keys, "--on", "serial", "--store", tmp_path / "s"
    )
    assert code == 3
    assert "is nm its unit?" in " ".join(said.split())
    assert "Traceback" not in trouble
