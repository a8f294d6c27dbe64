"""Tables of motions over time: units, names, instants, and what is refused."""

import csv
import io
import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from wavequake.errors import UserError
from wavequake.mechanics.disturbances import history_facts, history_table
from wavequake.mechanics.disturbances.layout import NO_SEGMENTS
from wavequake.mechanics.disturbances.registry import Combine, draw_case, instants_of
from wavequake.mechanics.disturbances.sources.element_history import SurfaceHistory, history_of, read_table
from wavequake.mechanics.disturbances.sources.surface_random import SurfaceDeformation, SurfaceRandom

TABLE = """# measured on a Tuesday
time_s, L1 front.dx_um ,M1.rz_urad,M1.z3_nm,M1.z5_nm,L1 front.dz_um,line_of_sight.y_mas

0.5,1,2,3,4,5,6

# a pause
0.75,-1e1,20,30,40,50,60
"""
SHAKE = SurfaceHistory(name="shake", file_csv=TABLE)


def table(names, time, values):
    """Write a table as any program does."""
    text = io.StringIO()
    rows = np.column_stack([time, values]).tolist()
    csv.writer(text).writerows([["time_s", *names], *rows])
    return text.getvalue()


def test_columns_are_motions_in_si_units():
    found = read_table(TABLE)
    np.testing.assert_array_equal(found.time, [0.5, 0.75])
    np.testing.assert_allclose(
        found.rigid["L1 front"], [[1e-6, 0, 5e-6, 0, 0, 0], [-1e-5, 0, 5e-5, 0, 0, 0]], rtol=1e-15
    )
    np.testing.assert_allclose(found.rigid["M1"], [[0, 0, 0, 0, 0, 2e-6], [0, 0, 0, 0, 0, 2e-5]], rtol=1e-15)
    np.testing.assert_allclose(found.figure["M1"], [[0, 0, 3e-9, 0, 4e-9], [0, 0, 3e-8, 0, 4e-8]], rtol=1e-15)
    mas = np.deg2rad(1 / 3600) / 1000
    np.testing.assert_allclose(found.sight, [[0, 6 * mas], [0, 60 * mas]], rtol=1e-14)
    assert found.names == ("L1 front", "M1")


ELEMENTS = st.text(st.characters(codec="utf-8", exclude_categories=["Cc", "Zl", "Zp", "Zs"]), min_size=1)


@given(ELEMENTS, st.lists(st.floats(-1e9, 1e9), min_size=1, max_size=4), st.booleans())
def test_any_name_and_number_comes_back_from_a_file(element, values, spaced):
    """Names may hold spaces, dots, commas, quotes; numbers keep every bit but that of the change of unit."""
    name = f"{element} front.a" if spaced else element
    found = read_table(table([f"{name}.dy_um"], np.arange(len(values)), values))
    np.testing.assert_array_equal(found.rigid[name][:, 1], np.array(values) * 1e-6)


def test_the_instants_are_the_rows_and_part_of_the_record():
    assert (SHAKE.instants, SHAKE.duration_s) == (2, 0.75)
    np.testing.assert_array_equal(instants_of((SHAKE,), SHAKE), [0.5, 0.75])
    again = SurfaceHistory.model_validate(json.loads(SHAKE.model_dump_json()))
    assert again == SHAKE
    assert SHAKE.of == ("L1 front", "M1")
    assert SHAKE.figure_terms(NO_SEGMENTS) == {"M1": 5}
    before = SurfaceHistory(name="early", file_csv="time_s,M.dx_um\n-2,1\n-1,1")
    assert (before.instants, before.duration_s) == (2, 0.1)


@pytest.mark.parametrize("realization", [0, 7])
def test_every_case_is_the_table(realization):
    drawn = draw_case((SHAKE,), SHAKE, NO_SEGMENTS, 1, realization)
    expected = history_of(SHAKE)
    np.testing.assert_array_equal(drawn.rigid["M1"], expected.rigid["M1"])
    np.testing.assert_array_equal(drawn.figure["M1"], expected.figure["M1"])
    np.testing.assert_array_equal(drawn.mount, expected.sight)


def test_a_combination_has_the_instants_of_its_history():
    askew = SurfaceRandom(name="askew", of=("M1",), rms={"dx_um": 2.0})
    figure = SurfaceDeformation(name="figure", of=("M1", "M2"), rms_nm={8: 4.0})
    for of in (("shake", "askew", "figure"), ("figure", "askew", "shake")):
        whole = Combine(name="all", of=of)
        populations = (SHAKE, askew, figure, whole)
        np.testing.assert_array_equal(instants_of(populations, whole), [0.5, 0.75])
        drawn = draw_case(populations, whole, NO_SEGMENTS, 1, 3)
        alone = {
            part.name: draw_case(populations, part, NO_SEGMENTS, 1, 3) for part in (SHAKE, askew, figure)
        }
        moved = alone["shake"].rigid["M1"] + alone["askew"].rigid["M1"][0]
        np.testing.assert_array_equal(drawn.rigid["M1"], moved)
        np.testing.assert_array_equal(drawn.figure["M1"][:, :5], alone["shake"].figure["M1"])
        np.testing.assert_array_equal(drawn.figure["M1"][:, 7], [alone["figure"].figure["M1"][7]] * 2)
        np.testing.assert_array_equal(drawn.figure["M2"], alone["figure"].figure["M2"])
        np.testing.assert_array_equal(drawn.mount, alone["shake"].mount)
    np.testing.assert_array_equal(history_of(SHAKE).figure["M1"][:, 0], 0.0)  # nobody wrote into it


def test_histories_are_added_at_the_same_instants_only():
    time = np.cumsum(np.full(50, 0.1))
    one, other = (
        SurfaceHistory(name=name, file_csv=table(["M.dx_um"], at, np.arange(50.0)))
        for name, at in (("one", time), ("two", 0.1 * np.arange(1, 51)))  # which differ by rounding
    )
    whole = Combine(name="all", of=("one", "two"))
    drawn = draw_case((one, other, whole), whole, NO_SEGMENTS, 1, 0)
    np.testing.assert_allclose(drawn.rigid["M"][:, 0], 2e-6 * np.arange(50.0), rtol=1e-15)
    whole = Combine(name="all", of=("one", "shake"))
    with pytest.raises(UserError, match=r"'shake' has 2 instants from 0.5 to 0.75 s, which are not .*'one'"):
        draw_case((one, SHAKE, whole), whole, NO_SEGMENTS, 1, 0)
    with pytest.raises(UserError, match="which are not those of what it is a part of"):
        draw_case((SHAKE,), SHAKE, NO_SEGMENTS, 1, 0, time=np.array([0.5, 0.76]))


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("", "it is empty; its first line"),
        ("# nothing\n\n", "it is empty"),
        ("0,1\n1,2", "begins with '0,1', but its first line must name"),
        ("time_ms,M.dx_um\n0,1", "begins with 'time_ms,M.dx_um'"),
        ("time_s;M.dx_um\n0;1", "divided by ';'; divide them by commas"),
        ("time_s\tM.dx_um\n0\t1", "divided by .*commas"),
        ("time_s\n0\n1", "no column beside time_s"),
        ("time_s,M.dx_um", "no rows below the line that names"),
        ("time_s,M.dx_um,\n0,1,", "the column '' does not say what moves"),
        ("time_s,dx_um\n0,1", "'dx_um' does not say what moves; write SURFACE.dx_um"),
        ("time_s,.dx_um\n0,1", "does not say what moves"),
        ("time_s,M.dx_mm\n0,1", "'M.dx_mm' is no motion with a known unit; M.dx_um would be one"),
        ("time_s,M.z4_um\n0,1", "M.z4_nm would be one"),
        ("time_s,M.speed\n0,1", "'M.speed' is no motion with a known unit; write SURFACE"),
        ("time_s,M.z0_nm\n0,1", "'M.z0_nm' is no Noll coefficient; they are counted from 1"),
        ("time_s,M.z-4_nm\n0,1", "is no Noll coefficient"),
        ("time_s,M.z2017_nm\n0,1", "is no Noll coefficient; .* to 2016"),
        ("time_s,M.x_mas\n0,1", "'M.x_mas' is unknown; light turns by line_of_sight.x_mas"),
        ("time_s,line_of_sight.dx_um\n0,1", "'line_of_sight.dx_um' is unknown"),
        ("time_s,M.dx_um,M.dx_um\n0,1,2", "two columns 'M.dx_um'"),
        ("time_s,M.z4_nm,M.dx_um,M.z04_nm\n0,1,2,3", "two columns 'M.z4_nm'"),
        ("time_s,M.dx_um\n\n# one\n0,1\n1,nan", "line 5, column 'M.dx_um': 'nan' is no finite number"),
        ("time_s,M.dx_um\n0,-inf", "line 2, column 'M.dx_um': '-inf'"),
        ("time_s,M.dx_um,M.dy_um\n0,1,", "line 2, column 'M.dy_um': '' is no finite number"),
        ("time_s,M.dx_um\ninf,1", "line 2, column 'time_s': 'inf'"),
        ("time_s,M.dx_um\n0,one", "column 'M.dx_um': 'one' is no finite number"),
        ("time_s,M.dx_um\n0,1,2", "line 2 has 3 cells, but there are 2 columns"),
        ("time_s,M.dx_um\n0,1\n1", "line 3 has 1 cells"),
        ("time_s,M.dx_um\n0,1\n1,2\n1,3", "line 4: time_s 1 does not increase, the row before has 1"),
        ("time_s,M.dx_um\n1,1\n0,2", "line 3: time_s 0 does not increase"),
        ('time_s,"' + "M" * 200_000, "line 1: it is no CSV"),
    ],
)
def test_a_bad_table_is_refused_with_line_and_column(text, complaint):
    with pytest.raises(UserError, match=complaint):
        read_table(text)
    with pytest.raises(ValidationError, match=r"the history my\.csv: .*"):
        SurfaceHistory(name="shake", file="my.csv", file_csv=text)


@pytest.mark.parametrize(
    ("module", "limit", "size", "complaint"),
    [
        (history_table, "MOST_INSTANTS", 1, "more than 1 rows"),
        (history_facts, "MOST_NUMBERS", 33, "2 instants of 2 moving elements, 5 coef.* 34 numbers; 33 are"),
        (history_table, "MOST_TEXT", 100, "MB of text"),
    ],
)
def test_a_table_that_is_too_large_is_refused(monkeypatch, module, limit, size, complaint):
    monkeypatch.setattr(module, limit, size)
    with pytest.raises(UserError, match=complaint):
        read_table.__wrapped__(TABLE)


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"file_csv": None}, "a history needs one file, a CSV of time_s and columns"),
        ({"instants": 16}, "the history has 2 rows, which are its instants: leave instants = 16 out"),
        ({"duration_s": 0.1}, "leave duration_s = 0.1 out"),
        ({"of": ("M1",)}, "of"),
    ],
)
def test_keys_that_do_not_fit_are_refused(change, complaint):
    with pytest.raises(ValidationError, match=complaint):
        SurfaceHistory(**{"name": "shake", "file_csv": TABLE, **change})
