"""The table's text: digits, intervals, units, and what does not exist."""

import io
import json

import numpy as np
import pytest
import xarray as xr
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from wavequake.report.loops import telescope
from wavequake.report.populations import populations
from wavequake.report.statistics import Quantile
from wavequake.report.table import empty_table, interval, number, row_of, share, terminal_table
from wavequake.terminal import in_blocks


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.0, "0"), (1234.5, "1234"), (12.345, "12.3"), (9.996, "10.0"), (0.99951, "1.00"), (0.012345, "0.0123"),
     (-45.67, "-45.7"), (1.234e-7, "1.23e-07"), (7.654e8, "7.65e+08"), (np.nan, "–"), (np.inf, "inf")],
)  # fmt: skip
def test_numbers_have_three_digits(value, text):
    assert number(value) == text


def test_intervals_leave_out_the_bound_that_does_not_exist():
    assert interval(Quantile(5.0, 4.0, 6.0)) == "4.00–6.00"
    assert interval(Quantile(5.0, 4.0, np.inf)) == "≥ 4.00"
    assert interval(Quantile(5.0, -np.inf, 6.0)) == "≤ 6.00"
    assert interval(Quantile(5.0, -np.inf, np.inf)) == "–"


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.0, "0 %"), (0.004, "< 1 %"), (0.5, "50 %"), (0.996, "> 99 %"), (1.0, "100 %"), (np.nan, "–")],
)
def test_only_all_is_100_percent(value, text):
    assert share(value) == text


def test_names_fold_and_numbers_stay_on_one_line():
    table = empty_table(("case", "verdict", "value"), ("case", "verdict"), fixed=True)
    table.add_row("a name of many letters", "differs", "1.25 ± 0.05")
    text = io.StringIO()
    Console(file=text, width=40).print(table)
    assert [line.split() for line in text.getvalue().splitlines() if line.strip()][2:] == [
        ["a", "name", "of", "differs", "1.25", "±", "0.05"],
        ["many", "letters"],
    ]
    assert [one.justify for one in table.columns] == ["left", "left", "right"]
    assert [one.justify for one in empty_table("ab").columns] == ["left", "right"]
    assert [one.justify for one in empty_table("ab", ()).columns] == ["right", "right"]


def test_rows_of_a_hand_made_campaign(campaign):
    models = dict.fromkeys(("wind", "shake", "empty"), (5.1, "mas"))
    wind, shake, empty = map(row_of, populations(campaign, models))
    assert wind["disturbance"] == ("wind", "")
    assert wind["cases"] == ("3", "1 quarantined")
    assert wind["WFE on glass P50 (nm)"] == ("20.0", "–")
    assert wind["WFE on glass P95 (nm)"] == ("29.0", "≥ 20.0")  # P(two of three below P95) = 0.0073
    assert wind["EE80 P50 (λ/D)"][0] == "1.250"
    assert shake["cases"] == ("2", "1 quarantined, 1 to do")
    assert shake["LOS jitter (mas)"] == ("7.07", "")  # two cases tell no error
    assert shake["LOS model (mas)"] == ("5.10", "")
    # Cases of 10 and 20 and 30 nm, of which the segments move a quarter: rms of 2.5, 5 and 7.5 nm.
    assert wind["segments (nm)"] == ("5.40", "")
    assert wind["segments model (nm)"] == ("–", "")
    assert shake["EE80 P50 (λ/D)"][0] == "> 1, the frame"
    assert empty["cases"] == ("0", "2 to do")
    assert empty["WFE on glass P50 (nm)"] == ("–", "")
    assert empty["Strehl P5"] == ("–", "")
    assert (wind["Rayleigh"], wind["Maréchal"]) == (("25 %", ""), ("67 %", ""))
    assert shake["Maréchal"] == ("50 %", "")
    assert empty["Maréchal"] == ("–", "")
    numbers = ("disturbance", "cases", "Strehl P5", "Strehl P50", "peak P5", "Rayleigh", "Maréchal")
    for header in wind:
        assert header in numbers or header.endswith(("(nm)", "(mas)", "(λ/D)"))


def test_a_model_in_nm_is_that_of_the_segments(campaign):
    wind = row_of(populations(campaign, {"wind": (5.4, "nm")})[0])
    assert wind["segments model (nm)"] == ("5.40", "")
    assert wind["LOS model (mas)"] == ("–", "")


def test_terminal_table_fits_80_columns_and_takes_names_as_they_are(campaign):
    campaign = campaign.assign_coords(
        disturbance=("case", np.array(["wind [bold]on-all-segments"] * 10, dtype=object))
    )
    console = Console(width=80, file=io.StringIO())
    console.print(terminal_table(populations(campaign)))
    text = console.file.getvalue()
    assert "…" not in text
    assert "[bold]" in text.replace("\n", "")
    assert "2 quarantined" in " ".join(text.split())


def test_no_population_gives_an_empty_table():
    assert terminal_table([]).row_count == 0


@pytest.mark.parametrize("width", [60, 80, 200])
def test_wide_tables_become_blocks_that_hold_every_number(width):
    table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0), caption="what it says")
    table.add_column("a rather long name of what is told apart")
    headers = [f"column {k} (nm)" for k in range(9)]
    for header in headers:
        table.add_column(header, justify="right")
    rows = {f"row number {r}": [f"{100 * r + k}.25" for k in range(9)] for r in range(1, 4)}
    for name, cells in rows.items():
        table.add_row(name, *cells)
    console = Console(width=width, file=io.StringIO(), highlight=False)
    blocks = in_blocks(table, width)
    assert (len(blocks) == 1) == (width == 200)
    for block in blocks:
        console.print(block)
    said = console.file.getvalue()
    assert max(map(len, said.splitlines())) <= width
    assert "…" not in said
    for name, cells in rows.items():
        assert said.count(name) == len(blocks)
        assert all(said.count(cell) == 1 for cell in cells)
    assert all(said.count(header) == 1 for header in headers)


def test_largest_positions_have_the_unit_of_every_kind_of_actuator():
    actuators = [
        {"name": "a", "model": "m2-rigid", "dofs": ["dx", "rx"]},
        {"name": "b", "model": "m2-figure"},
        {"name": "c", "model": "m2-influence"},
        {"name": "d", "model": "m2-body"},
        {"name": "e", "model": "segments", "dofs": ["dz"]},
    ]
    dataset = xr.Dataset(attrs={"study": json.dumps({"actuator": actuators})})
    assert telescope._units_of(dataset) == {"a": "nm or nrad", "b": "nm", "c": "nm", "d": "nm", "e": "nm"}
