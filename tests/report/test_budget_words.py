"""What budgets say of shares that so many cases do not resolve."""

import io

import pytest
import xarray as xr
from rich.console import Console

from wavequake.report.answers.budget import explanations, tables


def budget_of(shares):
    """A budget of two factors: (value, low, high) of all their shares."""
    values = {
        f"{key}{end}": (("quantity", "factor"), [[share[place] for share in shares]])
        for key in ("share", "first", "total")
        for place, end in enumerate(("", "_low", "_high"))
    }
    values |= {"rms": (("quantity",), [100.0]), "rms_rest": (("quantity",), [1.0])}
    values["rms_without"] = (("quantity", "factor"), [[60.0, 70.0]])
    coordinates = {
        "quantity": ["wfe_rms"],
        "factor": ["wind", "noise"],
        "kind": ("factor", ["source", "source"]),
        "segments": ("factor", [0, 0]),
    }
    return xr.Dataset(values, coordinates, {"population": "all", "cases": 16, "cases_used": 16})


def printed(shares):
    console = Console(file=io.StringIO(), width=160)
    for table in tables(budget_of(shares)):
        console.print(table)
    lines = [line.strip() for line in console.file.getvalue().splitlines()]
    return {line.split()[0]: line for line in lines if line.startswith(("wind", "noise"))}


def test_resolved_shares_are_given_with_their_intervals():
    rows = printed([(0.64, 0.6, 0.7), (0.36, 0.3, 0.4)])
    assert "80.0" in rows["wind"]  # the root of 0.64 times 100 nm
    assert "64.0 (60.0 to 70.0)" in rows["wind"]
    assert not any("nresolved" in line for line in explanations(budget_of([(0.6, 0.5, 0.7)] * 2)))


@pytest.mark.parametrize("value", [-0.03, 0.02])
def test_a_share_that_may_be_none_is_never_negative(value):
    row = printed([(0.9, 0.8, 0.95), (value, -0.05, 0.09)])["noise"]
    assert row.count("below 9.0") == 3
    assert "< 30.0" in row
    assert "-" not in row
    assert "(" not in row


def test_shares_too_small_for_the_table_are_neither_zero_nor_negative():
    row = printed([(0.9, 0.8, 0.95), (1e-6, -1e-6, 1e-5)])["noise"]
    assert row.count("below 0.1") == 3
    assert "-" not in printed([(0.9, 0.8, 0.95), (-1e-6, -2e-6, -1e-7)])["noise"].split("unresolved")[0]


def test_an_interval_that_says_nothing_is_called_so():
    shares = [(0.91, 0.48, 1.64), (0.09, 0.05, 0.13)]
    row = printed(shares)["wind"]
    assert row.count("unresolved (48 to 164)") == 3
    assert "91" not in row
    lines = explanations(budget_of(shares))
    assert any(line.startswith("Unresolved: ") and "take more" in line for line in lines)


def test_a_part_of_a_variance_is_never_said_to_be_negative():
    row = printed([(0.9, 0.8, 0.95), (-0.17, -0.33, -0.01)])["noise"]
    assert row.count("unresolved (-33 to -1)") == 2
    assert "-17.0 (-33.0 to -1.0)" in row  # of the mean square: what cancels others
