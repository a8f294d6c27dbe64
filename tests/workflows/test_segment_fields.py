"""Several field points of a segmented telescope in one study: each is what a study of its own gives."""

import numpy as np
import pytest
import xarray as xr
from small_telescope import STUDY

from wavequake.campaign.contract import DONE, RAISED
from wavequake.campaign.store.store import open_store
from wavequake.chain.sampling import slot
from wavequake.errors import UserError
from wavequake.report.answers.comparison import compare
from wavequake.report.segments.fields import base_name, by_field, of_population
from wavequake.workflows.allow import allowances
from wavequake.workflows.rare import rare_study
from wavequake.workflows.run import run_study
from wavequake.workflows.segments import disturbance as workflow
from wavequake.workflows.segments.bench import bench_of, benches_of
from wavequake.workflows.segments.study import without_images
from wavequake.workflows.segments.template import OF_ALL_PLACES, of_one_place, place_axis
from wavequake.workflows.study import load_study, study_with

FIELDS = ((0.0, 0.0), (0.1, -0.3))
CASES = np.arange(6)


def loaded(folder, *overrides):
    path = folder / "small.toml"
    path.write_text(STUDY)
    return load_study(path, ["imaging.pixels=16", *overrides])


def both(*fields):
    return "optics.fields_arcmin=" + str([list(one) for one in fields])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("fields")


def test_each_field_point_has_the_bits_of_a_study_of_its_own(folder):
    several = workflow.KIND.compute(loaded(folder, both(*FIELDS)).identity_text(), CASES, "numpy")
    assert (several.status == DONE).all()
    for place, field in enumerate(FIELDS):
        text = loaded(folder, f"optics.field_arcmin={list(field)}").identity_text()
        # M2 is tilted by what moves the line of sight of the first field point: one motion for all.
        steered = [
            row for row in CASES if place == 0 or slot(bench_of(text).study.disturbance, row)[0].name != "m2"
        ]
        alone = workflow.KIND.compute(text, CASES, "numpy")
        for name, one in of_one_place(text).items():
            found = several.arrays[name]
            if name not in OF_ALL_PLACES:
                found = np.take(found, place, axis=1 + place_axis(one))
            np.testing.assert_array_equal(found[steered], alone.arrays[name][steered], err_msg=name)


def test_m2_moves_alike_for_all_field_points(folder):
    first, second = benches_of(loaded(folder, both(*FIELDS)).identity_text())
    np.testing.assert_array_equal(first.m2_tilt, second.m2_tilt)
    assert first.prepared.fit is second.prepared.fit  # what is of the pupil is there once


def test_one_field_point_in_a_list_has_the_dimension_and_the_same_numbers(folder):
    listed, plain = loaded(folder, both((0.0, 0.0))).identity_text(), loaded(folder).identity_text()
    assert "fields_arcmin" in listed
    assert "fields_arcmin" not in plain
    one, other = (workflow.KIND.compute(text, CASES[:1], "numpy").arrays for text in (listed, plain))
    assert one["wfe_rms"].shape == (1, 20, 1)
    np.testing.assert_array_equal(one["zernike"][:, :, 0], other["zernike"])
    np.testing.assert_array_equal(one["exposure"][:, 0], other["exposure"])


def test_a_segment_that_leaves_the_beam_at_one_field_point_is_told_with_it(folder):
    study = loaded(folder, both(*FIELDS))
    text = study.identity_text()
    drawn = workflow.draw(bench_of(text), 0)
    drawn.motion.segment_motion[:, 3, 0] = 100.0
    found = workflow.trace_draws(text, [drawn], "numpy")
    assert found.status[0] == RAISED
    assert found.messages[0].startswith("at the field (0, 0) arcmin: segment 4 lost all its rays")
    assert np.isnan(found.arrays["los"]).all()


def test_a_store_has_the_field_points_and_its_report_a_row_for_each(folder):
    overrides = (both(*FIELDS), "campaign.cases=6", "campaign.device=numpy")
    run_study(loaded(folder, *overrides), folder / "store", on="serial")
    with open_store(folder / "store") as dataset:
        assert dataset["field"].to_numpy().tolist() == ["(0, 0) arcmin", "(0.1, -0.3) arcmin"]
        assert dataset["field_y"].to_numpy().tolist() == [0.0, -0.3]
        assert dataset["los"].dims == ("case", "time", "field", "axis")
        assert dataset["exposure"].dims == ("case", "field", "y", "x")
        # Astigmatism points to the field: z5 / z6 = tan(2 phi).
        z5, z6 = (dataset["zernike_static"].sel(noll=noll).to_numpy() for noll in (5, 6))
        assert z5[1] / z6[1] == pytest.approx(np.tan(2.0 * np.arctan2(-0.3, 0.1)), rel=1e-3)
        assert np.hypot(z5, z6)[1] > 1.0 > 1e3 * np.hypot(z5, z6)[0]
        apart = by_field(dataset)
        names = list(dict.fromkeys(apart["disturbance"].to_numpy().tolist()))
        assert names[:2] == ["pistons at (0, 0) arcmin", "pistons at (0.1, -0.3) arcmin"]
        assert [base_name(name) for name in names[:2]] == ["pistons"] * 2
        mine = of_population(apart, names[1])
        expected = dataset.isel(case=[0, 1], field=1)["peak"].to_numpy()
        np.testing.assert_array_equal(mine["peak"].to_numpy(), expected)
        assert base_name("pistons") == "pistons"
        assert by_field(dataset.isel(field=0, drop=True)).sizes["case"] == 6


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (("optics.fields_arcmin=[[0,0],[0,0]]",), "names a field point twice"),
        ((both(*FIELDS), "optics.light=modal", "imaging.enabled=false"), "give one optics.field_arcmin"),
        ((both(*FIELDS), "optics.field_arcmin=[0,1]"), "choose one"),
        (("optics.fields_arcmin=[]",), "fields_arcmin"),
    ],
)
def test_what_cannot_be_is_said(folder, overrides, words):
    with pytest.raises(UserError, match=words.replace(".", r"\.")):
        loaded(folder, *overrides)


def test_what_is_of_one_place_point_says_so(folder):
    with pytest.raises(UserError, match=r"Sensitivities are of one field point: choose one by optics\.field"):
        loaded(folder, both(*FIELDS)).require_one_place("Sensitivities are")


def test_what_is_asked_of_one_place_point_says_so(folder):
    study = loaded(folder, both(*FIELDS))
    with pytest.raises(UserError, match="Allowances are of one field point"):
        allowances(study, "wfe_rms", 0.95, 60.0)
    with pytest.raises(UserError, match="Rare events are of one field point"):
        rare_study(study, "wfe_rms", 100.0)


def test_a_study_without_its_images_is_a_sound_study(folder):
    colors = ("imaging.wavelengths_nm=[550.0, 500.0]", "imaging.weights=[1.0, 0.5]", "imaging.focus_um=[1.0]")
    plain = without_images(loaded(folder, *colors, "detector.pixel_um=9.0", "detector.photons=1e4"))
    assert study_with(plain, {}).identity_text() == plain.identity_text()
    assert plain.identity_text() == loaded(folder, "imaging.enabled=false").identity_text()


def test_stores_of_several_field_points_and_of_one_are_not_compared():
    cases = {"status": ("case", [0, 0]), "realization": ("case", [0, 1])}
    numbers = xr.Dataset({"piston": ("case", [1.0, 2.0])}, cases)
    several = numbers.assign_coords(field=["(0, 0) arcmin", "(0, 1) arcmin"])
    with pytest.raises(
        UserError, match=r"in their field: \(0, 0\) arcmin, \(0, 1\) arcmin there, a single one here"
    ):
        compare(several, numbers, "A", "B")
    with pytest.raises(UserError, match=r"in their field: a single one there, \(0, 0\) arcmin"):
        compare(numbers, several, "B", "A")
