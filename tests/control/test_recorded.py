"""Recordings of uncontrolled runs: what is written is read, and what cannot be used is named."""

import numpy as np
import pytest

from wavequake.control.recorded import read_recorded
from wavequake.errors import UserError


def test_signals_are_read_at_their_own_instants():
    """Sensor at 2 ms, camera at 5 ms: they share every tenth millisecond alone."""
    lens, frames = np.arange(0, 41, 2), np.arange(0, 41, 5)
    rows = ["# a comment", " image_mm , time_s,sensor_mm,command_mm"]
    for ms in sorted({*lens, *frames}):
        image = f"{-0.5 * ms}" if ms in frames else ""
        rows.append(f"{image},{ms / 1000},{0.25 * ms if ms in lens else ''},0")
    record = read_recorded("\n".join(rows), "run.csv")
    np.testing.assert_allclose(record.time, lens / 1e3, rtol=0, atol=1e-15)
    np.testing.assert_allclose(record.measured, 0.25e-3 * lens, rtol=0, atol=1e-18)
    np.testing.assert_allclose(record.frame_time, frames / 1e3, rtol=0, atol=1e-15)
    np.testing.assert_allclose(record.image, -0.5e-3 * frames, rtol=0, atol=1e-18)


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        ([], "lacks the columns time_s, sensor_mm, image_mm"),
        (["time_s,sensor_mm"], "lacks the columns image_mm"),
        (["time_s,sensor_mm,image_mm"], "column sensor_mm has 0 values"),
        (["time_s,sensor_mm,image_mm", "0,1,1", "x,1,1"], "row 2: time_s is 'x'; it must be a finite number"),
        (["time_s,sensor_mm,image_mm", "0,1,1", "1,nan,1"], "row 2: sensor_mm is 'nan'"),
        (["time_s,sensor_mm,image_mm", "0,1,1", "0,1,1"], "row 2: time_s must be there and increase"),
        (["time_s,sensor_mm,image_mm", "0,1,1", ",1,1"], "row 2: time_s must be there"),
        (["time_s,sensor_mm,image_mm", "0,1,1", "1,1"], "column image_mm has 1 values"),
        (
            ["time_s,sensor_mm,image_mm", "0,1,1", "1,1,1", "3,1,1"],
            "must be evenly spaced; that at 1 s is 500",
        ),
        (["time_s,command_mm,sensor_mm,image_mm", "0,0,1,1", "1,0.1,1,1"], "row 2: the stage was commanded"),
    ],
)
def test_recordings_that_cannot_be_used_are_refused(rows, words):
    with pytest.raises(UserError, match=r"run\.csv") as refused:
        read_recorded("\n".join(rows), "run.csv")
    assert words in str(refused.value)
