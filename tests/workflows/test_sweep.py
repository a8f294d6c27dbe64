"""Studies over lists of values of their keys."""

import csv
import dataclasses
import html
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

import wavequake as wq
from wavequake.campaign.contract import DONE, RAISED
from wavequake.campaign.statistics.judged import populations_of
from wavequake.campaign.store.grid import unstack
from wavequake.errors import UserError
from wavequake.reduction.intermediate import intermediate
from wavequake.report import plain, sweeps
from wavequake.report.campaign import report_store
from wavequake.report.mirrors import swept as variants
from wavequake.report.mirrors.variants import largest
from wavequake.report.table import number
from wavequake.workflows import sweep as swept
from wavequake.workflows.kinds import compared_labels
from wavequake.workflows.mirrors import bench as mirror_bench
from wavequake.workflows.mirrors import model_store
from wavequake.workflows.run import kind_of
from wavequake.workflows.study import load_study, study_with

SMALL = {
    "telescope.name": "tmt-18",
    "imaging.enabled": False,
    "campaign.cases": 4,
    "campaign.device": "numpy",
    "optics.rays_per_segment": 6,
}
WAVES = {"sweep.optics.wavelength_nm": [500.0, 1000.0], "sweep.disturbance.wind.instants": [2, 1]}
MIRROR = {
    "model.shapes": ["circular"],
    "model.rings": 2,
    "reduction.variants": ["craigb{18:36:18}"],
    "reduction.frequencies": 20,
    "imaging.pixels": 8,
    "imaging.pupil_samples": 16,
    "imaging.instants": 2,
    "optics.rays": 120,
    "optics.zernike_terms": 15,
    "time.duration_s": 0.001,
    "campaign.device": "numpy",
}
THIN = {"sweep.model.thickness_m": [0.01, 0.04], "sweep.model.damping_beta": [5e-6, 1e-5]}


@pytest.fixture(scope="module")
def mirror(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sweep") / "store"
    return folder, wq.run("mirror-mor", store=folder, **_words(MIRROR | THIN))


def _words(keys):
    return {key.replace(".", "__"): one for key, one in keys.items()}


def test_a_point_has_the_bits_of_its_own_study(mirror):
    """Points follow each other, the last key fastest; each has the cases of the study there."""
    _, dataset = mirror
    point = MIRROR | {"model.thickness_m": 0.04, "model.damping_beta": 5e-6}
    alone = load_study("mirror-mor", point)
    found = kind_of(alone).compute(alone.identity_text(), np.arange(alone.cases), "numpy")
    mine = dataset.isel(case=slice(2 * alone.cases, 3 * alone.cases))
    assert (mine["thickness_m"] == 0.04).all()
    assert (mine["damping_beta"] == 5e-6).all()
    assert mine["variant"].to_numpy().tolist() == ["full", "craigb18", "craigb36"]
    for name, values in found.arrays.items():
        if name != "reduce_seconds":
            np.testing.assert_array_equal(mine[name], values, err_msg=name)


def test_thin_mirrors_are_soft(mirror):
    """A plate's frequencies rise with its thickness, its deflection under inertia falls with its square."""
    _, dataset = mirror
    grid = unstack(dataset)
    assert set(grid["eps_opt"].dims) == {"frequency", "thickness_m", "damping_beta", "variant"}
    fast = grid["mode_frequency"].sel(variant="full", damping_beta=5e-6).isel(mode=6)
    thick = float(fast.sel(thickness_m=0.04) / fast.sel(thickness_m=0.01))
    assert 2.5 < thick < 4.0  # 4 of a thin plate; shear softens a thick one


def test_stores_open_as_grids_over_method_order_and_swept_keys(mirror):
    """An order is a number of each case; a grid with gaps has its texts there, too."""
    folder, dataset = mirror
    grid = wq.open_store(folder, unstack=("method", "order", "thickness_m", "damping_beta"))
    assert set(grid.dims) == set(grid.dims) & set(grid.coords)
    assert grid["order"].to_numpy()[:2].tolist() == [18.0, 36.0]
    at = {"method": "craigb", "order": 36.0, "thickness_m": 0.04, "damping_beta": 5e-6}
    labels = ("variant", "thickness_m", "damping_beta")
    row = [tuple(one) for one in zip(*(dataset[name].to_numpy().tolist() for name in labels), strict=True)]
    place = row.index(("craigb36", 0.04, 5e-6))
    np.testing.assert_array_equal(grid["eps_opt"].sel(at), dataset["eps_opt"][place])
    assert grid["message"].sel(at).item() == ""
    assert np.isnan(grid["eps_opt"].sel({**at, "method": "full"})).all()
    whole = wq.open_store(folder, unstack=True)
    assert whole.sizes == unstack(dataset).sizes
    for labels, words in (("wind", "'wind' is no label"), (["order"], "Several cases have the same order")):
        with pytest.raises(UserError, match=words):
            wq.open_store(folder, unstack=labels)


def test_commands_take_stores_of_sweeps(mirror, wavequake):
    folder, _ = mirror
    for words in (("report", folder), ("status", folder), ("verify", folder), ("rerun", folder, "--case", 7)):
        code, out, err = wavequake(*words)
        assert (code, err) == (0, ""), out
    page = (folder / "report.html").read_text()
    assert "smallest good enough" in page
    assert "over thickness_m" in page
    assert "at all 4 points." in page
    assert "reduce_seconds over" not in page  # a stopwatch's


def test_a_complete_store_is_run_again_and_its_table_says_which_case_is_what(mirror, tmp_path):
    folder, dataset = mirror
    again = wq.run("mirror-mor", store=folder, **_words(MIRROR | THIN))
    assert again.identical(dataset)
    rows = list(csv.DictReader(wq.export(folder, tmp_path / "cases.csv").open()))
    for name in ("thickness_m", "damping_beta"):
        np.testing.assert_array_equal([float(row[name]) for row in rows], dataset[name])
    for name in ("model", "variant"):
        np.testing.assert_array_equal([row[name] for row in rows], dataset[name])


def test_every_point_is_a_population_of_its_own(mirror):
    """Cases of two points are of two distributions: no tail or quantile takes them together."""
    _, dataset = mirror
    found = populations_of(dataset, compared_labels(dataset.attrs["study"]))
    assert len(set(found)) == 4 * 3
    assert found[-1] == "circular, craigb36, 0.04, 1e-05"


def test_reports_picture_points_that_are_done_beside_numbers_of_no_case():
    images = np.arange(2 * 3 * 3.0).reshape(2, 3, 3)
    dataset = xr.Dataset({"strehl_static": ((), 0.9), "exposure": (("case", "y", "x"), images)})
    groups = {"thin": np.array([False, False]), "thick": np.array([False, True])}
    (found,) = plain._images(dataset, groups)
    assert "case 1, thick" in str(found)


def test_overrides_and_files_say_the_same(tmp_path):
    file = tmp_path / "waves.toml"
    file.write_text(
        Path("workflows/tmt-segments.toml").read_text()
        + "\n[sweep]\noptics.wavelength_nm = [500.0, 1000.0]\n'disturbance.wind.instants' = [2, 1]\n"
    )
    study, other = load_study("tmt-segments", SMALL | WAVES), load_study(file, SMALL)
    assert study.identity() == other.identity()
    assert study.cases == 16
    assert study_with(study, {"campaign.cases": 8}).cases == 32
    changed = study_with(study, {"optics.rays_per_segment": 18, "sweep.optics.wavelength_nm": [600.0]})
    assert changed.cases == 8
    assert changed.base["optics"]["rays_per_segment"] == 18
    again = study_with(changed, {"optics.rays_per_segment": 6, "sweep.optics.wavelength_nm": [500.0, 1000.0]})
    assert again.identity() == study.identity()


def test_labels_are_whole_keys_where_their_last_part_is_taken():
    study = load_study("tmt-segments", SMALL | WAVES | {"sweep.disturbance.wind-shake.instants": [2]})
    labels = kind_of(study).case_table(study.identity_text(), 0, 16)
    assert {"wavelength_nm", "disturbance_wind_instants", "disturbance_wind-shake_instants"} <= labels.keys()
    np.testing.assert_array_equal(labels["wavelength_nm"], np.repeat([500.0, 1000.0], 8))
    study = load_study("tip-tilt-vibration", {"loop.rates_hz": [500.0], "sweep.loop.gain": [0.1, 0.2]})
    labels = kind_of(study).case_table(study.identity_text(), 0, 1)  # each case has a number "gain"
    assert labels.keys() == {"controller", "rate_hz", "realization", "loop_gain"}


def test_the_answer_of_variants_names_the_smallest_that_is_enough_at_every_point(mirror, tmp_path):
    """The shares are taken anew from what is stored."""
    store, _ = mirror
    dataset = wq.open_store(store).load()
    shares = {}
    for thickness, damping, variant in zip(
        *(dataset[name].to_numpy() for name in ("thickness_m", "damping_beta", "variant")), strict=True
    ):
        here = (dataset.thickness_m == thickness) & (dataset.damping_beta == damping)
        one, full = (
            dataset.isel(case=np.flatnonzero((here & (dataset.variant == name)).to_numpy())[0])
            for name in (variant, "full")
        )
        share = one.wfe_error.max(one.wfe_error.dims[-1]) / full.wfe_rms.max(full.wfe_rms.dims[-1])
        decide = ["sine100", "sine300", "floor"]
        shares[thickness, damping, variant] = float(share.sel(excitation=decide).max())
    points = variants.points_done(store, dataset)
    assert [tuple(one.values.values()) for one in points] == [
        (0.01, 5e-6), (0.01, 1e-5), (0.04, 5e-6), (0.04, 1e-5),
    ]  # fmt: skip
    for point in points:
        for one in point.model.variants:
            expected = shares[(*point.values.values(), one.variant)]
            assert largest(one, point.criterion) == pytest.approx(expected, rel=1e-12)

    def judged(bound):
        limited = [dataclasses.replace(one.criterion, bound=bound) for one in points]
        enough = [
            next((v for v in one.model.variants if largest(v, criterion) <= bound), None)
            for one, criterion in zip(points, limited, strict=True)
        ]
        return [
            dataclasses.replace(one, criterion=criterion, model=dataclasses.replace(one.model, enough=found))
            for one, criterion, found in zip(points, limited, enough, strict=True)
        ]

    coarse = [share for (_, _, variant), share in shares.items() if variant == "craigb18"]
    fine = [share for (_, _, variant), share in shares.items() if variant == "craigb36"]
    assert max(fine) < min(coarse)
    middle = (min(coarse) + max(coarse)) / 2
    assert "craigb18 (18 coordinates) is the smallest variant" in variants.answer(judged(2 * max(coarse)))
    words = variants.answer(judged(middle))
    assert "craigb36 (36 coordinates) is the smallest variant" in words
    assert "at all 4 points" in words
    assert "At single points from 18 (craigb18 at thickness_m" in words
    assert "to 36 (craigb36 at" in words
    none = variants.answer(judged(min(fine) / 2))
    assert none.startswith("circular: no variant keeps the wavefront error below")
    least = min(shares, key=lambda key: shares[key] or np.inf)
    assert f"at any point; the least is {number(100 * shares[least])} % ({least[2]} at" in none
    assert "At single" not in none
    some = variants.answer(judged((min(fine) + max(fine)) / 2))
    assert "no variant keeps" in some
    assert "None does at" in some


def test_the_report_of_swept_variants_draws_errors_over_order_and_what_is_enough(mirror, tmp_path):
    store, _ = mirror
    table, page = report_store(store)
    text = page.read_text()
    assert [" ".join(column.header.split()) for column in table.columns][:5] == [
        "model", "thickness_m", "damping_beta", "smallest good enough", "order",
    ]  # fmt: skip
    assert table.row_count == 4
    for title in (
        "Least error over the number of coordinates",
        "Coordinates that are enough, over thickness_m",
    ):
        assert title in text
    assert str(table.caption) in html.unescape(text)


def test_the_answer_compares_like_with_like_and_leaves_failures_out():
    """Wind grows with its speed until its cases fail, and noise does not: medians of both would fall."""
    speed, kinds_of = np.repeat([1.0, 2.0, 4.0], 4), np.tile(["wind", "wind", "noise", "noise"], 3)
    numbers = np.where(kinds_of == "wind", 10.0 * speed**2, 1.0)
    failed = (kinds_of == "wind") & (speed == 4.0)
    dataset = xr.Dataset(
        {"status": ("case", np.where(failed, RAISED, DONE).astype(np.int8))},
        coords={"speed": ("case", speed), "disturbance": ("case", kinds_of.astype(object))},
    )
    row = plain.Row("wfe_rms", "", "nm", np.where(failed, np.nan, numbers))
    assert sweeps._words(dataset, [row], "speed", ["speed"]) == (
        "With speed, wfe_rms of wind changes most: its median is 10.0 nm at 1 and 40.0 nm at 2. 2 cases "
        "failed; values at which some did are left out of this."
    )


def test_the_answer_says_what_comes_of_a_key_and_not_what_it_sets():
    size = np.repeat([10.0, 40.0], 3)
    dataset = xr.Dataset({"status": ("case", np.full(6, DONE, np.int8))}, coords={"peak_nm": ("case", size)})
    found = [
        plain.Row("wfe_rms", "", "nm", 2.0 * size),
        plain.Row("strehl", "", "", 1.0 - size / 60.0),
        plain.Row("segment_piston_rms", "", "nm", size**2),
    ]
    assert sweeps._words(dataset, found, "peak_nm", ["peak_nm"]) == (
        "With peak_nm, wfe_rms changes most: its median is 20.0 nm at 10 and 80.0 nm at 40."
    )
    found[1] = plain.Row("strehl", "", "", 1.0 - size / 41.0)
    assert sweeps._words(dataset, found, "peak_nm", ["peak_nm"]) == (
        "With peak_nm, strehl changes most: its median is 0.0244 at 40 and 0.756 at 10; that of wfe_rms is "
        "20.0 nm at 10 and 80.0 nm at 40."
    )
    assert sweeps._words(dataset, found[2:], "peak_nm", ["peak_nm"]) == "Nothing changes with peak_nm."


def test_damping_shares_one_intermediate_model_over_all_points(tmp_path, monkeypatch):
    """Its basis does not depend on damping: it is built once, and each point answers with its own damping."""
    built = []
    monkeypatch.setattr(model_store, "model_folder", lambda: tmp_path / "models")
    monkeypatch.setattr(
        mirror_bench, "intermediate", lambda *a, **k: built.append(1) or intermediate(*a, **k)
    )
    keys = {"sweep.model.damping_beta": [4.1e-6, 8.2e-6, 1.64e-5], "reduction.variants": ["craigb18"]}
    study = wq.load_study("mirror-mor", MIRROR | keys)
    swept = wq.run(study, store=tmp_path / "swept", on="serial").load()
    assert len(built) == 1
    for value in (4.1e-6, 1.64e-5):
        keys = {"model.damping_beta": value, "reduction.variants": ["craigb18"]}
        one = wq.load_study("mirror-mor", MIRROR | keys)
        alone = wq.run(one, store=tmp_path / f"{value}", on="serial").load()
        mine = swept.isel(case=swept.damping_beta.values == value)
        np.testing.assert_array_equal(mine.wfe_rms.values, alone.wfe_rms.values)
    assert len(built) == 1
    peaks = swept.wfe_rms.max([dim for dim in swept.wfe_rms.dims if dim != "case"])
    assert (np.diff(peaks.values[:: len(peaks) // 3]) != 0.0).all()


def test_lists_of_numbers_are_swept_too(tmp_path):
    """Several field points of a segmented telescope, on the same draws."""
    keys = SMALL | {
        "sweep.optics.field_arcmin": [[0.0, 0.0], [3.0, -1.5]],
        "sweep.optics.wavelength_nm": [550.0, 1000.0],
    }
    found = wq.unstack(wq.run(wq.load_study("tmt-segments", keys), store=tmp_path / "s", on="serial"))
    assert found.field_arcmin.values.tolist() == ["0, 0", "3, -1.5"]
    alone = {key: value for key, value in keys.items() if not key.startswith("sweep")}
    alone |= {"optics.field_arcmin": [3.0, -1.5], "optics.wavelength_nm": 1000.0}
    one = wq.run(wq.load_study("tmt-segments", alone), store=tmp_path / "one", on="serial")
    assert "over wavelength_nm" in wq.report(tmp_path / "s").read_text()
    mine = found.sel(field_arcmin="3, -1.5", wavelength_nm=1000.0).wfe_rms.values
    expected = one.wfe_rms.values
    assert np.sort(mine[np.isfinite(mine)]).tolist() == np.sort(expected[np.isfinite(expected)]).tolist()
    with pytest.raises(UserError, match=r"field_arcmin: .* is neither a number nor a text, nor a list"):
        wq.load_study("tmt-segments", {"sweep.optics.field_arcmin": [[0.0, "a"]]})


def test_lists_that_nearly_agree_have_labels_of_their_own():
    keys = SMALL | {"sweep.optics.field_arcmin": [[0.1234567, 0.0], [0.1234568, 2.5]]}
    study = load_study("tmt-segments", keys)
    labels = swept.case_table(study.identity_text(), 0, study.cases)["field_arcmin"]
    assert list(dict.fromkeys(labels)) == ["0.1234567, 0", "0.1234568, 2.5"]
