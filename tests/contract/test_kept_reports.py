"""Reports and exports of stores that keep less than all instants, against those of whole stores."""

import csv

import numpy as np
import pytest
from small_kinds import SMALL

from wavequake.campaign.store.store import open_store
from wavequake.report.campaign import export_store, report_store

pytestmark = pytest.mark.usefixtures("mirror_models")

NOT_HERE = {"segment-disturbance"}  # whose report of numbers per case is another page, and has its own tests
# Columns of terminal tables that summaries and whole stores have other numbers in: about rest, not about the
# mean; means of cases, not instants; and readings of a clock.
OTHER = ("LOS", "Strehl", "made in", "standard (ms)", "modal (ms)")


def cells(table):
    """Return the cells of a table by column, but for those that must differ."""
    columns = {str(column.header).replace("\n", " "): list(column.cells) for column in table.columns}
    return {name: found for name, found in columns.items() if not name.startswith(OTHER)}


@pytest.mark.parametrize("name", sorted(set(SMALL) - NOT_HERE))
def test_the_report_of_a_summary_has_the_same_table_and_says_what_is_left_out(kept_stores, request, name):
    _, store_of = kept_stores
    whole, page = report_store(store_of(name))
    request.getfixturevalue("drawn")  # those of whole stores are in tests of reports
    short, other = report_store(store_of(name, reduce="summary"))
    assert cells(short) == cells(whole)
    assert len(cells(short)) > 3
    assert "The store keeps" not in page.read_text()
    text = other.read_text()
    assert "statistics of each case over its instants" in text
    assert "figures over time are left out" in text
    assert "<svg" in text
    if name != "system-disturbance":  # which has none over time
        assert text.count("<svg") < page.read_text().count("<svg")


def test_the_report_of_a_summary_of_segments_says_so(kept_stores):
    _, store_of = kept_stores
    (whole, page), (short, other) = (
        report_store(store_of("segment-disturbance", **keys)) for keys in ({}, {"reduce": "summary"})
    )
    for text in (page.read_text(), whole.caption):
        assert "The store keeps" not in text
    for text in (other.read_text(), short.caption):
        assert "statistics of each case over its instants" in text
    assert [[*column.cells] for column in short.columns] == [[*column.cells] for column in whole.columns]


@pytest.mark.parametrize("name", sorted(SMALL))
def test_the_report_of_every_other_instant_says_so(kept_stores, name):
    _, store_of = kept_stores
    table, page = report_store(store_of(name, every=2))
    assert "The store keeps one of every 2 instants" in page.read_text()
    assert name != "segment-disturbance" or "The store keeps one of every 2 instants" in table.caption
    assert "<svg" in page.read_text()
    assert table.row_count > 0


@pytest.mark.parametrize("name", sorted(SMALL))
def test_a_csv_file_of_a_summary_has_a_column_per_statistic(kept_stores, tmp_path, name):
    _, store_of = kept_stores
    short = open_store(store_of(name, reduce="summary")).load()
    (target,) = export_store(store_of(name, reduce="summary"), tmp_path / "cases.csv")
    with target.open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    key = next(name for name in short.data_vars if "statistic" in short[name].dims)
    unit, others = (
        short[key].attrs["units"],
        [dim for dim in short[key].dims if dim not in ("case", "statistic")],
    )
    first = short[key].isel(dict.fromkeys(others, 0))
    for number, statistic in enumerate(("mean", "rms", "min", "max", "p95", "last")):
        column = [name for name in rows[0] if name.startswith(key) and f"_{statistic}" in name[len(key) :]]
        assert column
        assert all(name.endswith(f" ({unit})") for name in column)
        found = [float(row[column[0]]) for row in rows]
        np.testing.assert_array_equal(found, first.isel(statistic=number).to_numpy().astype(np.float64))
