"""Telemetry is read as it is, or refused in a sentence that says what and where."""

import time

import numpy as np
import pytest

from wavequake.errors import UserError
from wavequake.mechanics.telemetry.columns import channel_of
from wavequake.mechanics.telemetry.record import read_record, record_of

NAMES = ("line_of_sight.x_mas", "wavefront[2].z4_nm", "camera.ax_m_s2")
STEP, COUNT = 0.002, 600


def table(names=NAMES, count=COUNT):
    values = np.random.default_rng(0).standard_normal((count, len(names)))
    return STEP * np.arange(count), values


def csv(path, time_s, values, names=NAMES, note="# a note\n"):
    rows = [",".join(f"{one:.9g}" for one in (t, *row)) for t, row in zip(time_s, values, strict=True)]
    path.write_text(note + ",".join(["time_s", *names]) + "\n" + "\n".join(rows) + "\n")
    return path


def test_all_kinds_of_files_hold_the_same(tmp_path):
    time_s, values = table()
    csv(tmp_path / "a.csv", time_s, values)
    columns = dict(zip(NAMES, values.T, strict=True))
    np.savez(tmp_path / "b.npz", time_s=time_s, **columns)
    np.savez(tmp_path / "c.npz", rate_hz=500.0, **columns)
    names = ["a.csv", "b.npz", "c.npz"]
    fits = pytest.importorskip("astropy.io.fits")
    arrays = {"time_s": time_s, **columns}
    fits.BinTableHDU.from_columns(
        [fits.Column(name, "D", array=one) for name, one in arrays.items()]
    ).writeto(tmp_path / "d.fits")
    for name in [*names, "d.fits"]:
        record = read_record(tmp_path / name)
        np.testing.assert_allclose(record.values, values, rtol=1e-8)
        assert record.step == pytest.approx(STEP)
        assert record.nyquist_hz == pytest.approx(250.0)
        assert [one.name for one in record.channels] == list(NAMES)


def test_a_column_says_what_where_and_in_which_unit():
    one = channel_of("wavefront[2].z11_um")
    assert (one.element, one.axis, one.field, one.unit, one.si) == ("wavefront", "z11", 1, "um", 1e-6)
    one = channel_of("tube.cell1.ay_mg")
    assert (one.element, one.axis, one.field, one.si) == ("tube.cell1", "ay", 0, pytest.approx(9.80665e-3))
    assert channel_of("line_of_sight.y_arcsec").si == pytest.approx(np.pi / 180 / 3600)


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("x", "names nothing that is measured; write such as"),
        ("line_of_sight.x", "has no unit; write x_uas"),
        ("line_of_sight.x_mass", "did you mean x_mas"),
        ("line_of_sight.dx_um", "line_of_sight has x and y"),
        ("wavefront.x_mas", "wavefront Noll coefficients such as z4"),
        ("wavefront.z4_mas", "'mas', which is none of it"),
        ("wavefront.z0_nm", "names nothing"),
        ("M1[2].dx_um", "names a field point"),
        ("wavefront[0].z4_nm", "names a field point, from 1"),
        ("M1.z4_nm", "everything else dx"),
    ],
)
def test_columns_that_name_nothing_are_a_sentence(name, said):
    with pytest.raises(UserError) as error:
        channel_of(name)
    assert said in str(error.value)


def damaged(change):
    time_s, values = table()
    return change(time_s, values)


def gap(time_s, values):
    return np.delete(time_s, 100), np.delete(values, 100, axis=0)


def twice(time_s, values):
    time_s[100] = time_s[99]
    return time_s, values


def early(time_s, values):
    time_s[100] -= 0.7 * STEP
    return time_s, values


def drifting(time_s, values):
    """A clock that runs 2 % faster in the end smears every line over 2 % of its frequency."""
    return time_s + 0.01 * time_s**2 / time_s[-1], values


def backwards(time_s, values):
    return time_s[::-1], values


def hole(time_s, values):
    values[7, 1] = np.nan
    return time_s, values


def clipped(time_s, values):
    values[:, 0] = np.clip(np.repeat(values[:100, 0], 6), -1.0, 1.0)
    return time_s, values


def dead(time_s, values):
    values[:, 2] = 3.0
    return time_s, values


def huge(time_s, values):
    return time_s, values * np.where(np.arange(values.shape[1]) == 0, 1e200, 1.0)


def endless(time_s, values):
    values[7:9, 0] = -1.7e308, 1.7e308
    return time_s, values


def eternal(time_s, values):
    time_s[7:9] = -1.7e308, 1.7e308
    return time_s, values


def straight(time_s, values):
    values[:, 0] = 3.0 + 0.1 * time_s
    return time_s, values


def quick(time_s, values):
    return time_s * 1e-300, values


def slow(time_s, values):
    return time_s * 1e300, values


def tiny(time_s, values):
    return time_s, values * 1e-200


def short(time_s, values):
    return time_s[:100], values[:100]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (gap, "after row 100 (0.198 s) there is a gap of 0.004 s where the step is 0.002 s"),
        (twice, "time_s does not increase after row 100 (0.198 s); sort the rows by time"),
        (early, "after row 100 (0.198 s) the next comes 0.0006 s later, where the step is 0.002 s"),
        (drifting, "steps off even spacing"),
        (backwards, "time_s does not increase"),
        (hole, "row 8 of 'wavefront[2].z4_nm' is no finite number"),
        (clipped, "'line_of_sight.x_mas' is clipped"),
        (dead, "'camera.ax_m_s2' is 3 throughout"),
        (straight, "'line_of_sight.x_mas' is a straight line but for rounding"),
        (quick, "its time step is 2e-303 s; instants increase evenly, by 1e-09 to 1e+06 s"),
        (slow, "its time step is 2e+297 s"),
        (huge, "which no sensor measures"),
        (endless, "which no sensor measures"),
        (eternal, "'time_s' reaches 1.7e+308 s, which no clock shows"),
        (tiny, "which no sensor measures"),
        (short, "it has 100 rows; spectra need at least 512"),
    ],
)
def test_records_that_have_no_spectrum_are_a_sentence(tmp_path, change, said):
    path = csv(tmp_path / "bad.csv", *damaged(change))
    with pytest.raises(UserError) as error:
        read_record(path)
    assert str(error.value).startswith(str(path))
    assert said in str(error.value)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "it is empty"),
        ("a;b\n1;2\n", "must name its columns, divided by commas: time_s"),
        ("time_s\n0.0\n", "there is no column beside time_s"),
        ("time_s,M1.dx_um\n0.0,1.0\n0.1,one\n", "line 3, column 'M1.dx_um': 'one' is no number"),
        ("time_s,M1.dx_um\n0.0,1.0\n0.1\n", "line 3 has 1 cells, but there are 2 columns"),
        ("time_s,M1.dx_um\n", "it has 0 rows of numbers"),
    ],
)
def test_tables_that_are_none_are_a_sentence(tmp_path, text, said):
    (tmp_path / "bad.csv").write_text(text)
    with pytest.raises(UserError) as error:
        read_record(tmp_path / "bad.csv")
    assert said in str(error.value)


def test_arrays_that_do_not_fit_are_a_sentence(tmp_path):
    values = np.random.default_rng(0).standard_normal(600)
    for arrays, said in (
        ({"M1.dx_um": values}, "needs the array time_s, or the number rate_hz"),
        ({"M1.dx_um": values, "rate_hz": np.array(-1.0)}, "rate_hz must be one positive number"),
        ({"M1.dx_um": values, "time_s": np.arange(599.0)}, "has 600 samples, but others have 599"),
        ({"M1.dx_um": values.reshape(2, 300), "rate_hz": 5.0}, "a column is one of numbers"),
    ):
        np.savez(tmp_path / "bad.npz", **arrays)
        with pytest.raises(UserError) as error:
            read_record(tmp_path / "bad.npz")
        assert said in str(error.value)
    for name in ("bad.txt2", "bad.fits"):
        (tmp_path / name).write_bytes(b"none")
        with pytest.raises(UserError):
            read_record(tmp_path / name)
    with pytest.raises(UserError, match="say the same; keep one of them"):
        record_of(["M1.dx_um", "M1.dx_nm"], 0.01, np.stack([values, values], axis=1))


def test_quantized_signals_are_not_clipped_ones():
    values = np.round(np.random.default_rng(0).standard_normal((5000, 1)) * 3.0)
    assert record_of(["M1.dx_um"], 0.01, values).step == 0.01


def test_ten_minutes_at_a_kilohertz_are_read_in_seconds(tmp_path):
    count = 600_000
    values = np.random.default_rng(0).standard_normal((count, 2))
    time_s = np.arange(count) / 1000.0
    text = "\n".join(
        f"{t:.3f},{x:.5f},{y:.5f}" for t, (x, y) in zip(time_s.tolist(), values.tolist(), strict=True)
    )
    (tmp_path / "long.csv").write_text("time_s,M1.dx_um,M1.dy_um\n" + text + "\n")
    began = time.process_time()
    assert len(read_record(tmp_path / "long.csv").values) == count
    assert time.process_time() - began < 5.0
