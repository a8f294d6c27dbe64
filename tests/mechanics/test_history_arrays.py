"""Arrays of motions over time: the same as a table of them, figures on grids, and what is refused."""

import base64
import io
import zipfile

import numpy as np
import pytest
from pydantic import ValidationError

from wavequake.errors import UserError
from wavequake.mechanics.disturbances import history_arrays, history_facts
from wavequake.mechanics.disturbances.history_arrays import read_arrays
from wavequake.mechanics.disturbances.history_table import read_table
from wavequake.mechanics.disturbances.layout import NO_SEGMENTS
from wavequake.mechanics.disturbances.registry import draw_case
from wavequake.mechanics.disturbances.sources.element_history import SurfaceHistory

TIME = np.array([0.5, 0.75, 2.0])
COLUMNS = {
    "time_s": TIME,
    "L1 front.dx_um": np.array([1.0, -10.0, 0.1]),
    "M1/2.z5_nm": np.array([4, 5, 6]),
    "line_of_sight.y_mas": np.array([6.0, 60.0, 1.0], dtype=np.float32),
}
HEIGHTS = np.arange(3 * 4 * 5).reshape(3, 4, 5) / 7.0
GRID = {"time_s": TIME, "M1.grid_nm": HEIGHTS, "M1.grid_spacing_mm": np.array([2.0, 3.0])}


def packed(arrays, save=np.savez):
    file = io.BytesIO()
    save(file, **arrays)
    return base64.b64encode(file.getvalue()).decode()


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_arrays_are_what_a_table_of_them_is(save):
    found = read_arrays(packed(COLUMNS, save))
    names = list(COLUMNS)
    rows = "\n".join(",".join(repr(float(COLUMNS[name][k])) for name in names) for k in range(3))
    expected = read_table(f"{','.join(names)}\n{rows}")
    assert found.names == expected.names == ("L1 front", "M1/2")
    for part in ("rigid", "figure"):
        for name, values in getattr(expected, part).items():
            np.testing.assert_array_equal(getattr(found, part)[name], values)
    np.testing.assert_array_equal(found.sight, expected.sight)
    np.testing.assert_array_equal(found.time, TIME)


@pytest.mark.parametrize("spacing", [2.0, [2.0], [2.0, 3.0]])
def test_grids_are_heights_in_m(spacing):
    shake = SurfaceHistory(name="shake", file_npz=packed(GRID | {"M1.grid_spacing_mm": spacing}))
    assert (shake.instants, shake.duration_s, shake.of) == (3, 2.0, ("M1",))
    grid = shake.figure_grids()["M1"]
    assert grid.spacing_mm == (2.0, np.ravel(spacing)[-1])
    assert shake.figure_terms(NO_SEGMENTS) == {}
    drawn = draw_case((shake,), shake, NO_SEGMENTS, 1, 2)
    np.testing.assert_allclose(drawn.grid["M1"], 1e-9 * HEIGHTS, rtol=1e-15)
    assert SurfaceHistory.model_validate(shake.model_dump()) == shake


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"time_s": None}, "it lacks time_s, the instants; it holds M1.grid_nm, M1.grid_spacing_mm"),
        ({"time_s": np.array([0.0, 1.0, 1.0])}, r"increase from instant 1 \(1\) to the next \(1\)"),
        ({"time_s": np.array([0.0, np.nan, 1.0])}, "'time_s' is nan at instant 1"),
        ({"time_s": np.zeros((3, 1))}, r"time_s has the shape \(3, 1\)"),
        ({"time_s": np.zeros(0)}, r"time_s has the shape \(0,\)"),
        ({"time_s": np.arange(4.0)}, r"'M1.grid_nm' has the shape \(3, 4, 5\); it must be 4 instants"),
        ({"M1.grid_nm": HEIGHTS[:, :3]}, r"shape \(3, 3, 5\); .* at least 4 of each"),
        ({"M1.grid_nm": HEIGHTS[:, 0]}, r"shape \(3, 5\); it must be 3 instants, rows and columns"),
        ({"M1.grid_nm": np.where(HEIGHTS == 3.0, np.inf, HEIGHTS)}, "'M1.grid_nm' is inf at instant 1"),
        ({"M1.grid_nm": HEIGHTS.astype(complex)}, "'M1.grid_nm' holds complex128; it must hold numbers"),
        ({"M1.grid_nm": HEIGHTS > 1}, "holds bool"),
        ({"M1.grid_nm": None}, "'M1.grid_spacing_mm' has no grid"),
        ({"M1.grid_spacing_mm": None}, "'M1.grid_nm' lacks its spacing: add M1.grid_spacing_mm"),
        ({"M1.grid_spacing_mm": 0.0}, "'M1.grid_spacing_mm' is 0.0; it must be a positive number"),
        ({"M1.grid_spacing_mm": [1.0, np.nan]}, "must be a positive number, or two"),
        ({"M1.grid_spacing_mm": [1.0, 1.0, 1.0]}, "must be a positive number, or two"),
        ({"M1.dx_um": np.zeros((3, 1))}, r"'M1.dx_um' has the shape \(3, 1\), but time_s has \(3,\)"),
        ({"M1.dx_um": np.array([0.0, 0.0, -np.inf])}, "'M1.dx_um' is -inf at instant 2"),
        ({"M1.dx_mm": np.zeros(3)}, "'M1.dx_mm' is no motion with a known unit; M1.dx_um would be one"),
        ({"M1.z4_nm": np.zeros(3), "M1.z04_nm": np.zeros(3)}, "two columns 'M1.z4_nm'"),
        ({"M1.grid_nm": None, "M1.grid_spacing_mm": None}, "nothing beside time_s that moves"),
    ],
)
def test_bad_arrays_are_refused_by_name(change, complaint):
    arrays = {name: values for name, values in (GRID | change).items() if values is not None}
    text = packed(arrays)
    with pytest.raises(UserError, match=complaint):
        read_arrays(text)
    with pytest.raises(ValidationError, match=r"the history my\.npz: "):
        SurfaceHistory(name="shake", file="my.npz", file_npz=text)


def other_file(write):
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w") as file:
        write(file)
    return base64.b64encode(data.getvalue()).decode()


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("", "it is no"),
        ("%%%", "it is no"),
        (base64.b64encode(b"time_s,M1.dx_um\n0,1\n").decode(), "it is no"),
        (packed(GRID)[:400], "it is no"),
        (packed({"time_s": np.array([None, 1])}), "'time_s.npy' is no array .*object, not numbers"),
        (other_file(lambda file: file.writestr("time_s", "0,1")), "'time_s' is no array"),
        (other_file(lambda file: None), "it lacks time_s, the instants; it holds nothing"),
    ],
    ids=range(7),  # an archive holds the time of day
)
def test_what_is_no_file_of_arrays_is_refused(text, complaint):
    with pytest.raises(UserError, match=complaint):
        read_arrays(text)


@pytest.mark.parametrize(
    ("module", "limit", "size", "complaint"),
    [
        (history_arrays, "MOST_INSTANTS", 2, "more than 2 instants"),
        (history_arrays, "MOST_TEXT", 100, "MB as text"),
        (history_arrays, "_MOST_BYTES", 100, "MB are possible"),
        (history_facts, "MOST_NUMBERS", 59, "3 instants of .* 20 heights are 60 numbers; 59 are possible"),
    ],
)
def test_arrays_that_are_too_large_are_refused(monkeypatch, module, limit, size, complaint):
    monkeypatch.setattr(module, limit, size)
    with pytest.raises(UserError, match=complaint):
        read_arrays.__wrapped__(packed(GRID))


def test_a_grid_is_no_column_and_a_history_has_one_file():
    with pytest.raises(UserError, match="cannot hold a grid; give its heights in an"):
        read_table("time_s,M1.grid_nm\n0,1")
    with pytest.raises(ValidationError, match="a history needs one file"):
        SurfaceHistory(name="shake", file_npz=packed(GRID), file_csv="time_s,M1.dx_um\n0,1")
