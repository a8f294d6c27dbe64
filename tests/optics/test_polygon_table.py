from io import StringIO

import numpy as np
import pytest

from wavequake.errors import UserError
from wavequake.optics.shapes.polygon_table import read_polygons

HEADER = "id,x1_m,y1_m,x2_m,y2_m,x3_m,y3_m,x4_m,y4_m\n"
SQUARE = "A,0,0,1,0,1,1,0,1\n"
BESIDE = "B,1,0,2,0,2,1,,\n"


def complaint(text, header=HEADER):
    with pytest.raises(UserError) as caught:
        read_polygons(StringIO(header + text))
    message = str(caught.value)
    assert message.endswith(".")
    assert "\n" not in message
    return message


def test_polygons_come_in_mm_and_shorter_ones_repeat_their_last_corner():
    names, corners, centers = read_polygons(StringIO(HEADER + SQUARE + "\n" + BESIDE))
    assert names == ["A", "B"]
    assert corners.tolist() == [
        [[0, 0], [1000, 0], [1000, 1000], [0, 1000]],
        [[1000, 0], [2000, 0], [2000, 1000], [2000, 1000]],
    ]
    assert centers is None


def test_clockwise_corners_are_turned_round():
    _, corners, _ = read_polygons(StringIO(HEADER + "A,0,0,0,1,1,1,1,0\n" + "B,2,0,2,1,3,1,,\n"))
    assert corners.tolist() == [
        [[1000, 0], [1000, 1000], [0, 1000], [0, 0]],
        [[3000, 1000], [2000, 1000], [2000, 0], [2000, 0]],
    ]


def test_centers_and_foreign_columns():
    header = "note,id,cx_m,cy_m,x1_m,y1_m,x2_m,y2_m,x3_m,y3_m\n"
    _, _, centers = read_polygons(StringIO(header + "old,A,0.25,0.125,0,0,1,0,0,1\n"))
    np.testing.assert_array_equal(centers, [[250.0, 125.0]])
    assert "line 2, column 4" in complaint("old,A,0.25,,0,0,1,0,0,1\n", header)
    assert "the pivot of 'A' lies 999 m from its corners" in complaint("old,A,1000,0,0,0,1,0,0,1\n", header)


def test_comments_are_skipped_and_lines_still_counted():
    table = "# glass\n\n" + HEADER + "# first\n" + SQUARE
    assert read_polygons(StringIO(table))[0] == ["A"]
    assert "line 6, column 2" in complaint("B,x,0,2,0,2,1,,\n", header=table)


def test_a_file_with_a_byte_order_mark(tmp_path):
    path = tmp_path / "polygons.csv"
    path.write_text(HEADER + SQUARE, encoding="utf-8-sig")
    assert read_polygons(path)[0] == ["A"]
    assert read_polygons(str(path))[0] == ["A"]


def test_a_missing_file_and_a_binary_one(tmp_path):
    with pytest.raises(UserError, match=r"no-such\.csv cannot be read \(No such file"):
        read_polygons(tmp_path / "no-such.csv")
    (tmp_path / "photo.csv").write_bytes(b"\xff\xfe\x00\x01")
    with pytest.raises(UserError, match=r"photo\.csv is no text in UTF-8"):
        read_polygons(tmp_path / "photo.csv")


@pytest.mark.parametrize("bad", ["one", "nan", "inf", "", "1,5"])
def test_a_bad_number_names_its_line(bad):
    quoted = f'"{bad}"'
    assert f"line 3, column 4: {bad!r} is not a number" in complaint(SQUARE + f"B,1,0,{quoted},0,2,1,1,1\n")


def test_an_empty_list_and_missing_columns():
    assert "has no polygons" in complaint("")
    assert "it has none" in complaint("", header="")
    assert "it has id, x1, y1" in complaint("A,1,2\n", header="id,x1,y1\n")


@pytest.mark.parametrize(("column", "other"), [("y4_m", "y5_m"), ("y4_m", "note"), ("y4_m", "x3_m")])
def test_corners_are_not_left_out_for_want_of_a_column(column, other):
    assert " has no place among x1_m, y1_m, x2_m, " in complaint(SQUARE, HEADER.replace(column, other))


def test_cells_beyond_the_columns_are_not_left_out():
    assert "line 2: there are 10 cells, but 9 columns" in complaint(SQUARE.replace("\n", ",7\n"))
    assert "line 3: there are 11 cells" in complaint(SQUARE + "B,1,0,2,5,0,2,1,1,5,1\n")
    assert read_polygons(StringIO(HEADER + SQUARE.replace("\n", ",, \n")))[0] == ["A"]


def test_too_few_corners_and_no_area():
    assert "line 2: the polygon has 2 corners" in complaint("A,0,0,1,0,,,,\n")
    assert "line 2: the polygon has 0 corners" in complaint("A\n")
    assert "'A' has no area" in complaint("A,0,0,1,1,2,2,3,3\n")


def test_polygons_that_cross_or_touch_themselves():
    assert "'A' crosses or touches itself" in complaint("A,0,0,1,0,0.2,1,1,-1.5\n")
    assert "'B' crosses or touches itself" in complaint(SQUARE + "B,2,0,4,0,3,0,2,2\n")
    assert read_polygons(StringIO(HEADER + "B,2,0,4,0,2.5,0.5,2,2\n"))[0] == ["B"]


def test_names_must_be_there_once():
    assert "line 3: the id is empty" in complaint(SQUARE + ",1,0,2,0,2,1,1,1\n")
    assert "two segments are called 'A'" in complaint(SQUARE + "A,1,0,2,0,2,1,1,1\n")


def test_overlapping_polygons_are_both_named():
    message = complaint(SQUARE + BESIDE + "C,0.5,0.5,3,0.5,3,3,0.5,3\n" + "D,5,0,6,0,6,1,5,1\n")
    assert "'A' and 'C' overlap (the first of 2 pairs)" in message
    assert "'A' and 'B' overlap;" in complaint(
        SQUARE + "B,0.2,0.2,0.8,0.2,0.8,0.8,0.2,0.8\n"
    )  # one inside the other


def test_touching_within_rounding_is_no_overlap():
    names, _, _ = read_polygons(StringIO(HEADER + SQUARE + "B,0.999999,0,2,0,2,1,0.999999,1\n"))
    assert names == ["A", "B"]
