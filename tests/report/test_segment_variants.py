"""A segment-mor study through the command line: run, report, comparison of two meshes."""

import numpy as np
import pytest
from typer.testing import CliRunner

from wavequake.campaign.store.store import open_store, read_manifest
from wavequake.cli import app
from wavequake.report.answers.comparison import compare
from wavequake.report.mirrors.report import results_of
from wavequake.report.segments.variants import detail
from wavequake.workflows.mirrors import model_store
from wavequake.workflows.run import run_study
from wavequake.workflows.segments.mor_bench import model_of
from wavequake.workflows.study import load_study

KEYS = [
    "telescope.name=tmt-18",
    'segments.name="6"',
    "segments.figure_terms=6",
    "model.thickness_m=0.5",
    "model.spring_n_m=[5e7, 5e7, 5e7]",
    'reduction.variants=["guyan9", "modal18"]',
    "reduction.frequencies=10",
    "reduction.spot_checks=1",
    "time.duration_s=0.02",
    "time.traced=16",
    "optics.rays_per_segment=18",
    "optics.zernike_terms=11",
    "imaging.pixels=16",
]


@pytest.fixture(scope="module")
def stores(tmp_path_factory):
    folder = tmp_path_factory.mktemp("segments")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(model_store, "model_folder", lambda: folder / "models")
        fine, coarse = folder / "fine", folder / "coarse"
        words = [*KEYS, "model.divisions=3", "--store", str(fine), "--on", "serial"]
        done = CliRunner().invoke(app, ["run", "tmt-segment-mor", *words])
        assert done.exit_code == 0, done.output
        run_study(load_study("tmt-segment-mor", [*KEYS, "model.divisions=2"]), coarse, on="serial")
        yield fine, coarse, done.output


def test_the_table_recommends_a_variant_for_one_and_for_all(stores):
    words = " ".join(stores[2].split())
    assert "one segment: modal18 (18 coordinates) is the smallest variant" in words
    assert "all segments: modal18 (18 coordinates) is the smallest variant" in words
    assert "modal18 ←" in words


def test_the_report_has_its_maps(stores):
    page = (stores[0] / "report.html").read_text()
    for name in (
        "order",
        "segment-eps_opt",
        "one-segment-wavefront",
        "all-segments-off",
        "all-segments-floor-time",
    ):
        assert f'id="{name}"' in page, name


def test_the_map_shows_the_stored_wavefront(stores):
    store = stores[0]
    dataset, text = open_store(store).load(), read_manifest(store).study
    weight = model_of(text).bench.prepared.weight
    for model in results_of(dataset)[0]:
        stored = dataset.sel(case=model.reference.case)["wfe_rms"]
        shown = detail(dataset, model.reference, text, "auto")
        rms = np.sqrt(weight @ shown.flat_opd[0] ** 2)
        np.testing.assert_allclose(rms, float(stored.max()), rtol=0.02)
        moving = np.flatnonzero(shown.segment_motion[0].any(axis=1))
        assert len(moving) == {"one segment": 1, "all segments": 18}[model.name]
        (other,) = (one for one in model.variants if one.variant == "guyan9")
        off = detail(dataset, model.reference, text, "auto", other)
        rms = np.sqrt(weight @ off.flat_opd[0] ** 2)
        place = np.unravel_index(int(stored.to_numpy().argmax()), stored.shape)
        expected = dataset.sel(case=other.case)["wfe_error"].to_numpy()[place]
        np.testing.assert_allclose(rms, expected, rtol=0.02)


def test_two_meshes_are_compared_variant_by_variant(stores):
    coarse, fine = (open_store(store).load() for store in (stores[1], stores[0]))
    found = compare(coarse, fine, "coarse", "fine")
    names = {one.measure for one in found}
    assert {"wfe_rms", "wfe_error", "eps_opt", "exposure"} <= names
