"""Stores that keep images in single precision or not at all, against those that keep them as computed."""

import numpy as np
import pytest
import xarray as xr
from small_kinds import small_study

from wavequake.campaign.contract import DONE, Template, Variable
from wavequake.campaign.store.retention import kept_template, retention_of
from wavequake.campaign.store.store import open_store
from wavequake.campaign.store.verify import verify_store
from wavequake.errors import UserError
from wavequake.report.answers.comparison import compare
from wavequake.report.campaign import export_store, report_store, summary_table
from wavequake.report.exports.rerun import rerun_stored
from wavequake.workflows.planning.plan import plan
from wavequake.workflows.run import run_study
from wavequake.workflows.study import study_with

pytestmark = pytest.mark.usefixtures("mirror_models")

IMAGED = (
    "telescope-exposure",
    "telescope-loop",
    "mirror-exposure",
    "segment-disturbance",
    "mirror-mor",
    "segment-mor",
)
CLOCKS = ("seconds", "reduce_seconds")


@pytest.fixture(scope="module")
def stores(kept_stores, tmp_path_factory):
    """Return the store of a kind's small study under some keys, made once; of segments with images."""
    _, store_of = kept_stores
    folder = tmp_path_factory.mktemp("images")

    def imaged(name, **keys):
        if name != "segment-disturbance":
            return store_of(name, **keys)
        place = folder / "-".join(["imaged", *map(str, keys.values())])
        if not place.exists():
            chosen = {f"store.{key}": value for key, value in keys.items()}
            chosen |= {"imaging.enabled": True, "imaging.pixels": 16}
            run_study(study_with(small_study(name, folder), chosen), place, on="serial")
        return place

    return imaged


def images_of(dataset):
    return {name for name in dataset.data_vars if {"y", "x"} <= {*dataset[name].dims}}


@pytest.mark.parametrize("name", IMAGED)
def test_without_images_every_other_number_has_the_same_bits(stores, name):
    whole, short = open_store(stores(name)).load(), open_store(stores(name, images="none")).load()
    assert (short["status"] == DONE).all()
    assert images_of(whole)
    assert not {"y", "x", "focus"} & {*short.variables}
    assert set(short.variables) == set(whole.variables) - images_of(whole) - {"y", "x", "focus"}
    for key in set(short.variables) - {*CLOCKS}:
        np.testing.assert_array_equal(short[key].to_numpy(), whole[key].to_numpy(), err_msg=key)
    assert verify_store(stores(name, images="none")).ok


@pytest.mark.parametrize("name", IMAGED)
def test_images_in_single_precision_are_rounded_and_nothing_else_is(stores, name):
    whole, short = open_store(stores(name)).load(), open_store(stores(name, images="single")).load()
    assert set(short.variables) == set(whole.variables)
    for key in set(short.variables) - {*CLOCKS}:
        expected = whole[key].to_numpy()
        if key in images_of(whole):
            expected = expected.astype(np.float32)
        assert short[key].dtype == expected.dtype
        np.testing.assert_array_equal(short[key].to_numpy(), expected, err_msg=key)


@pytest.mark.parametrize("name", IMAGED)
def test_rerun_gives_the_images_of_one_case(stores, name, tmp_path):
    whole = open_store(stores(name)).load()
    for choice in ("none", "single"):
        found = rerun_stored(stores(name, images=choice), 1, tmp_path / f"{choice}.nc")
        assert found.differing == ()
        with xr.open_dataset(found.file) as detail:
            assert images_of(whole) <= images_of(detail)
            for key in images_of(whole):
                np.testing.assert_array_equal(detail[key], whole[key].isel(case=1), err_msg=key)
            np.testing.assert_array_equal(detail["x"], whole["x"])


@pytest.mark.parametrize("name", IMAGED)
def test_reports_and_exports_do_without_images_and_say_so(stores, name, tmp_path):
    store = stores(name, images="none")
    table, page = report_store(store)
    assert "The store keeps no images" in page.read_text()
    assert "<svg" in page.read_text()
    if name != "segment-disturbance":  # its report of numbers per case is another page
        for column, ours in zip(summary_table(stores(name)).columns, table.columns, strict=True):
            # Off the images of the reference; and a reading of a clock.
            if "made" not in column.header and column.header != "image\noff":
                assert [*ours.cells] == [*column.cells]
    for written in ("cases.csv", "all.nc"):
        (file,) = export_store(store, tmp_path / written)
        assert file.exists()


def test_images_in_single_precision_are_drawn(stores, request):
    texts = [report_store(stores("telescope-exposure"))[1].read_text()]
    request.getfixturevalue("drawn")
    texts.append(report_store(stores("telescope-exposure", images="single"))[1].read_text())
    assert "The store keeps no images" not in "".join(texts)
    assert texts[0].count("<svg") == texts[1].count("<svg") > 8


def test_the_report_of_every_other_instant_of_imaged_segments_says_so(stores):
    for keys, said in (({}, False), ({"every": 2}, True)):
        table, page = report_store(stores("segment-disturbance", **keys))
        for text in (table.caption, page.read_text()):
            assert ("The store keeps one of every 2 instants" in text) is said
        assert "Image of case" in page.read_text()


@pytest.mark.parametrize("name", ["telescope-exposure", "mirror-exposure"])
def test_stores_with_other_images_are_compared_by_what_both_have(stores, name):
    whole = open_store(stores(name))
    found = {one.measure: one for one in compare(whole, open_store(stores(name, images="none")), "a", "b")}
    assert {"peak", "wfe_rms", "image_error"} <= found.keys()
    assert "exposure" not in found
    assert not any(one.differences.any() for one in found.values())
    found = {one.measure: one for one in compare(whole, open_store(stores(name, images="single")), "a", "b")}
    assert 0.0 < found["exposure"].differences.max() < 1e-7  # 2^-24 of the image's energy, about


def test_summaries_without_images_fit_a_million_cases_in_gigabytes(stores, tmp_path):
    keys = {"reduce": "summary", "images": "none"}
    whole, short = (
        open_store(stores("telescope-exposure", **chosen)).load() for chosen in ({"reduce": "summary"}, keys)
    )
    for key in set(short.variables):
        np.testing.assert_array_equal(short[key].to_numpy(), whole[key].to_numpy(), err_msg=key)
    assert not images_of(short)
    study = study_with(small_study("telescope-exposure", tmp_path), {})
    study = study_with(study, {f"store.{key}": value for key, value in keys.items()})
    words = plan(study)["store"]
    assert float(words.rpartition(", ")[2].split()[0]) < 3.0  # kB per case
    assert words.endswith("kB per case")


def test_what_is_kept_of_images_is_part_of_the_identity_only_where_it_is_less(tmp_path):
    for name in ("segment-disturbance", "telescope-exposure", "mirror-mor"):
        study = small_study(name, tmp_path)
        study = study_with(study, {"imaging.enabled": True} if "disturbance" in name else {})
        assert "images" not in study.identity_text()
        others = [study_with(study, {"store.images": choice}) for choice in ("double", "single", "none")]
        assert others[0].identity() == study.identity()
        assert len({one.identity() for one in others}) == 3
        assert [retention_of(one.identity_text()).images for one in others] == ["double", "single", "none"]


@pytest.mark.parametrize("name", ["system-disturbance", "lens-experiment", "mirror-trace"])
def test_a_study_without_images_has_none_to_leave_out(tmp_path, name):
    with pytest.raises(UserError, match=r"there are no images to keep; leave store\.images out"):
        study_with(small_study(name, tmp_path), {"store.images": "none"})
    segments = small_study("segment-disturbance", tmp_path)  # which has imaging.enabled = false
    with pytest.raises(UserError, match=r"there are no images to keep; leave store\.images out"):
        study_with(segments, {"store.images": "single"})
    with pytest.raises(UserError, match=r"store.images: .*'double', 'single' or 'none'"):
        study_with(segments, {"store.images": "some"})


def test_labels_that_only_images_have_go_with_them():
    words = {"units": "1", "long_name": "x"}
    computed = Template(
        {
            "focused": Variable(("focus", "y", "x"), (5, 4, 4), words),
            "peak": Variable(("focus",), (5,), words),
        },
        {name: ((name,), np.arange(4.0), {}) for name in ("focus", "y", "x", "axis")},
    )
    kept = kept_template(retention_of('{"store": {"images": "none"}}'), computed)
    assert set(kept.per_case) == {"peak"}
    assert set(kept.fixed) == {"focus", "axis"}
    assert kept.working_bytes == (80 + 5) * 8  # what a chunk takes while it is computed
    single = kept_template(retention_of('{"store": {"images": "single"}}'), computed)
    assert single.per_case["focused"].dtype == "float32"
    assert single.fixed == computed.fixed
