"""A line of sight that moves leaves a streak: 16 traced instants against a thousand, and closed forms."""

import numpy as np
import pytest

from wavequake.workflows.kinds import find_kind
from wavequake.workflows.segments import launches
from wavequake.workflows.segments.bench import bench_of
from wavequake.workflows.segments.disturbance import draw
from wavequake.workflows.study import load_study

KIND = find_kind("segment-disturbance")
STUDY = """
[study]
name = "streaks"
workflow = "segment-disturbance"
[telescope]
name = "tmt-18"
[[disturbance]]
name = "pump"
model = "vibration-lines"
lines = [{{ frequency_hz = 50.0, fwhm_hz = 2.0, rms_mas = 12.0 }}]
duration_s = 1.0
instants = {instants}
act = "{act}"
direction_deg = 30.0
[[disturbance]]
name = "pistons"
model = "static-random"
piston_nm = 50.0
share = 0
[[disturbance]]
name = "both"
model = "combine"
of = ["pump", "pistons"]
duration_s = 1.0
instants = {instants}
[optics]
wavelength_nm = 1000.0
rays_per_segment = 6
[imaging]
pixels = 48
focus_um = {focus}
"""


def exposures(tmp_path, instants, act="mount", focus="[]", cases=(0, 1)):
    file = tmp_path / "study.toml"
    file.write_text(STUDY.format(instants=instants, act=act, focus=focus))
    text = load_study(file).identity_text()
    found = KIND.compute(text, np.array(cases), "numpy")
    assert found.messages == ("",) * len(cases)
    return text, found.arrays


@pytest.mark.parametrize("act", ["mount", "m2"])
def test_few_instants_leave_the_streak_of_a_thousand(tmp_path, act):
    _, few = exposures(tmp_path, 16, act)
    _, many = exposures(tmp_path, 1024, act)
    for row in range(2):  # the line of sight alone, and with pistons
        streak, dense = few["exposure"][row], many["exposure"][row]
        assert np.abs(streak - dense).max() < 0.02 * dense.max()
        assert few["peak"][row] == pytest.approx(many["peak"][row], rel=0.02)


def test_the_streak_is_the_mean_over_the_line_of_sight(tmp_path):
    """Along the motion the transform is the still one times the mean phase of the traced line of sight."""
    text, found = exposures(tmp_path, 1024, cases=(0,))
    bench = bench_of(text)
    still = load_study(
        tmp_path / "study.toml",
        {"disturbance.pump.lines": [{"frequency_hz": 50.0, "fwhm_hz": 2.0, "rms_mas": 1e-9}]},
    )
    rest = KIND.compute(still.identity_text(), np.array([0]), "numpy").arrays["exposure"][0]
    per_mas = np.deg2rad(1.0 / 3.6e6) * 2.0 * bench.system.annulus.outer / 1e-3
    los = found["los"][0] * per_mas
    axis = (np.arange(48) - 24) * 0.25
    for f in ([0.05, 0.0], [0.1, 0.05], [-0.05, 0.2]):
        wave = np.exp(-2j * np.pi * (f[0] * axis + f[1] * axis[:, None]))
        ratio = (found["exposure"][0] * wave).sum() / (rest * wave).sum()
        assert abs(ratio - np.exp(-2j * np.pi * los @ f).mean()) < 0.03  # what the frames cut off


def test_frames_that_lose_the_streak_are_told(tmp_path):
    text, _ = exposures(tmp_path, 2, cases=(0,))
    assert not [line for line in KIND.notices(text) if "streak" in line]
    narrow = text.replace('"pixels":48', '"pixels":24')
    [first, second] = [line for line in KIND.notices(narrow) if "streak" in line]
    assert first.startswith("pump moves the line of sight by 12 mas rms; frames reach")
    assert "take imaging.pixels =" in second


def test_a_case_has_the_same_bits_alone_and_in_pieces(tmp_path, monkeypatch):
    _, whole = exposures(tmp_path, 40, focus="[1000.0]")
    _, alone = exposures(tmp_path, 40, focus="[1000.0]", cases=(1,))
    monkeypatch.setattr(launches, "_LAUNCH_TILES", 2)
    _, pieces = exposures(tmp_path, 40, focus="[1000.0]")
    for name in ("exposure", "exposure_focus", "peak", "ee80"):
        np.testing.assert_array_equal(whole[name][1], alone[name][0], err_msg=name)
        np.testing.assert_array_equal(whole[name], pieces[name], err_msg=name)
    assert whole["exposure_focus"][0, 0].max() < whole["exposure"][0].max()


GIVEN = """
[study]
name = "given"
workflow = "segment-disturbance"
[telescope]
name = "tmt-18"
[[disturbance]]
name = "given"
model = "surface-history"
file = "given.csv"
[optics]
wavelength_nm = 1000.0
rays_per_segment = 6
[imaging]
pixels = 96
"""


def given_exposure(folder, time, sight):
    np.savetxt(
        folder / "given.csv",
        np.column_stack([time, sight]),
        "%.12g",
        ",",
        header="time_s,line_of_sight.x_mas,line_of_sight.y_mas",
        comments="",
    )
    (folder / "study.toml").write_text(GIVEN)
    text = load_study(folder / "study.toml").identity_text()
    return text, KIND.compute(text, np.array([0]), "numpy").arrays["exposure"][0]


def box(start, end):
    """Transform of a place that goes from one phase to another at one speed."""
    return np.exp(-1j * np.pi * (start + end)) * np.sinc(end - start)


def test_a_history_of_the_line_of_sight_leaves_a_streak(tmp_path):
    """Along straight lines, about every row half the way to its neighbors: transforms of boxes."""
    time = np.array([0.0, 0.1, 0.2, 0.4])
    way = np.array([[0.0, 0.0], [12.0, 6.0], [24.0, 12.0], [36.0, 18.0]]) - [18.0, 9.0]
    text, found = given_exposure(tmp_path, time, way)
    _, rest = given_exposure(tmp_path, time, np.zeros((4, 2)))
    per_mas = np.deg2rad(1.0 / 3.6e6) * 2.0 * bench_of(text).system.annulus.outer / 1e-3
    axis = (np.arange(96) - 48) * 0.25
    assert np.ptp(way @ [1.0, 0.0]) * per_mas > 2.0
    for f in ([0.1, 0.0], [0.2, 0.1], [0.0, 0.3]):
        wave = np.exp(-2j * np.pi * (f[0] * axis + f[1] * axis[:, None]))
        ratio = (found * wave).sum() / (rest * wave).sum()
        turns = way * per_mas @ f
        # Each piece of a row's time is passed at one speed: half the way to a neighbor.
        middles, lengths = 0.5 * (turns[1:] + turns[:-1]), 0.5 * np.diff(time)
        boxes = np.zeros((2, 4), dtype=complex)  # before and after each row, times how long that takes
        boxes[0, 1:] = [box(one, two) * t for one, two, t in zip(middles, turns[1:], lengths, strict=True)]
        boxes[1, :-1] = [box(one, two) * t for one, two, t in zip(turns[:-1], middles, lengths, strict=True)]
        spans = np.concatenate([[0.0], lengths]) + np.concatenate([lengths, [0.0]])
        expected = (boxes.sum(axis=0) / spans).mean()
        assert abs(ratio - expected) < 0.02
        assert abs(np.exp(-2j * np.pi * turns).mean() - expected) > 0.03  # dots would be something else


def test_a_history_that_rests_is_exposed_as_ever(tmp_path):
    time = np.array([0.0, 0.1])
    text, found = given_exposure(tmp_path, time, np.full((2, 2), 5.0))
    drawn = draw(bench_of(text), 0)
    assert drawn.way is None or not np.ptp(drawn.way, axis=(0, 1)).any()
    assert found.max() > 0.9
