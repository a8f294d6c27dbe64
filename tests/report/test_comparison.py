import json
from io import StringIO

import numpy as np
import pytest
import xarray as xr
from rich.console import Console

from wavequake import cli
from wavequake.errors import UserError
from wavequake.report.answers.comparison import compare, comparison_figure
from wavequake.report.answers.comparison_table import comparison_table


def other(campaign, scale=1.0, shift=0.0):
    """The same cases in another order, with other wavefront errors."""
    changed = campaign.copy(deep=True)
    changed["wfe_rms"] = changed["wfe_rms"] * scale + shift * (1 + changed["realization"])
    return changed.isel(case=slice(None, None, -1))


def of(differences, group, measure):
    return next(one for one in differences if (one.group, one.measure) == (group, measure))


def test_equal_stores_do_not_differ(campaign):
    differences = compare(campaign, other(campaign), "A", "B")
    assert {one.group for one in differences} == {"wind", "shake"}  # "empty" has no finished case
    assert all(np.all(one.differences == 0.0) for one in differences)
    table = comparison_table(["A", "B"], [differences])
    assert table.caption.endswith("No case of B differs from A in any number.")
    assert table.row_count == 1  # its name


def test_stores_that_differ_in_one_number_are_not_called_equal(campaign):
    comparisons = [
        compare(campaign, store, "A", "B") for store in (other(campaign, shift=1e-9), other(campaign))
    ]
    caption = comparison_table(["A", "B", "C"], comparisons).caption
    assert "No case of B" not in caption
    assert "No case of C differs" in caption


def test_cases_are_paired_by_their_labels(campaign):
    wind = of(compare(campaign, other(campaign, shift=1.0), "A", "B"), "wind", "wfe_rms")
    # Cases 0, 2, 4 have 5, 10, 15 nm and realizations 0, 1, 2.
    assert (wind.cases, wind.first, wind.second) == (3, 10.0, 12.0)
    assert wind.differences.tolist() == [1.0, 2.0, 3.0]
    # Student's t for two degrees of freedom and 95 %: 4.3027; standard error 1 / sqrt(3).
    assert wind.margin == pytest.approx(4.302653 / np.sqrt(3.0), rel=1e-6)


def test_stratified_cases_are_as_sure_as_their_sets_agree():
    generator = np.random.default_rng(5)
    sets, strata = np.repeat(np.arange(8), 50), np.tile(np.arange(50), 8)
    draws = (strata + generator.uniform(size=400)) / 50  # each set is even in (0, 1)

    def store(scale, **labels):
        coords = {"case": np.arange(400), **{name: ("case", values) for name, values in labels.items()}}
        data = {"strehl": ("case", scale * draws), "status": ("case", np.ones(400, dtype=np.int8))}
        return xr.Dataset(data, coords)

    def margin(**labels):
        (found,) = compare(store(1.0, **labels), store(2.0, **labels), "A", "B")
        assert found.mean == pytest.approx(draws.mean())
        return found.margin

    means = draws.reshape(8, 50).mean(axis=1)
    known = margin(realization=np.arange(400), replicate=sets)
    assert known == pytest.approx(2.364624 * means.std(ddof=1) / np.sqrt(8))  # Student, 7 degrees of freedom
    assert known < 0.05 * margin(realization=np.arange(400))
    assert np.isnan(margin(realization=np.arange(400), replicate=0 * sets))


def test_instants_that_do_not_exist_do_not_count(campaign):
    shake = of(compare(campaign, other(campaign), "A", "B"), "shake", "los")
    assert shake.first == pytest.approx(np.sqrt([103**2 + 4**2, 97**2 + 4**2]).mean())


def test_images_differ_by_the_norm_of_unit_energy_images(campaign):
    changed = other(campaign)
    values = changed["exposure"].to_numpy().copy()
    values[:] = 0.0
    values[:, 0, 0] = 5.0
    changed["exposure"] = (changed["exposure"].dims, values)
    image = of(compare(campaign, changed, "A", "B"), "wind", "exposure")
    assert image.differences == pytest.approx(np.sqrt((1 - 1 / 64) ** 2 + 63 / 64**2))


def test_stores_without_common_cases_say_why(campaign):
    shifted = campaign.assign_coords(realization=campaign["realization"] + 100)
    with pytest.raises(UserError, match="share no case: realization is 0 there, 100 here"):
        compare(campaign, shifted, "A", "B")
    with pytest.raises(UserError, match="no labels in common"):
        compare(campaign, campaign.drop_vars(["disturbance", "realization"]), "A", "B")
    twice = campaign.assign_coords(realization=0 * campaign["realization"])
    with pytest.raises(UserError, match="several cases of A have the same"):
        compare(twice, twice, "A", "B")
    with pytest.raises(UserError, match="B has no finished case"):
        compare(campaign, campaign.isel(case=[7, 8]), "A", "B")


def test_table_and_figure_show_what_changed(campaign):
    comparisons = [compare(campaign, other(campaign, scale=1.25), "A", "B")]
    console = Console(width=140, record=True, file=StringIO())
    console.print(comparison_table(["A", "B"], comparisons))
    text = console.export_text()
    assert "+25.00%" in text
    assert "wfe_rms_raw" not in text  # only wfe_rms of two groups has changed
    equal = len(comparisons[0]) - 2
    assert f"Left out: {equal} numbers in which no case of B differs." in " ".join(text.split())
    figure = comparison_figure(["A", "B"], comparisons)
    labels = [label.get_text() for label in figure.axes[0].get_yticklabels()]
    assert labels == ["wfe_rms  wind", "wfe_rms  shake"]
    alike = comparison_figure(["A", "B"], [compare(campaign, other(campaign), "A", "B")])
    assert "wfe_rms_raw  wind" in [label.get_text() for label in alike.axes[0].get_yticklabels()]


def test_the_command_pairs_draws_of_two_models(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for name, pixels in (("a", 16), ("b", 32)):
        words = ["run", "tmt18-history", "campaign.cases=2", f"imaging.pixels={pixels}", "--store", name]
        monkeypatch.setattr("sys.argv", ["wavequake", *words, "--on", "serial"])
        with pytest.raises(SystemExit) as exit_:
            cli.main()
        assert exit_.value.code == 0
    capsys.readouterr()
    monkeypatch.setattr("sys.argv", ["wavequake", "compare", "a", "b"])
    with pytest.raises(SystemExit):
        cli.main()
    shown = capsys.readouterr().out
    assert "numbers in which no case of b differs." in " ".join(shown.split())
    assert (tmp_path / "b" / "comparison.png").stat().st_size > 5000
    monkeypatch.setattr("sys.argv", ["wavequake", "compare", "a"])
    with pytest.raises(SystemExit) as exit_:
        cli.main()
    assert exit_.value.code == 2
    assert "at least two" in capsys.readouterr().err


def test_stores_of_other_fields_or_workflows_are_refused(campaign):
    fields = campaign.assign_coords(wavelength=("wavelength", [500.0, 600.0]))
    with pytest.raises(UserError, match=r"differ in their wavelength: 500.0, 600.0 there, 700.0 here"):
        compare(fields, campaign.assign_coords(wavelength=("wavelength", [700.0])), "A", "B")
    mirrors = campaign.assign_attrs(study=json.dumps({"study": {"workflow": "mirror-mor"}}))
    with pytest.raises(UserError, match="A holds results of None, B of mirror-mor"):
        compare(campaign, mirrors, "A", "B")


def variants(seed=1, factor=1.0, worst=1.0):
    """A store of two reduced models, one case each."""
    wfe = np.array([[1.0, 3.0], [2.0, 4.0]]) * factor
    wfe[1] *= worst
    return xr.Dataset(
        {
            "wfe_rms": (("case", "time"), wfe, {"units": "nm"}),
            "eps": ("case", [0.0, 0.5 * factor], {"units": "1"}),
            "still": ("case", [0.0, 0.0], {"units": "1"}),
            "reduce_seconds": ("case", [1.0, 2.0 * factor], {"units": "s"}),
            "status": ("case", [1, 1]),
        },
        coords={
            "case": [0, 1],
            "model": ("case", np.array(["disc", "disc"], dtype=object)),
            "variant": ("case", np.array(["full", "craigb18"], dtype=object)),
            "seed": ("case", [seed, seed]),
        },
    )


def test_reduced_models_of_two_seeds_or_meshes_are_paired_by_name():
    found = compare(variants(), variants(seed=2, factor=1.1, worst=2.0), "A", "B")
    wfe = of(found, "disc", "wfe_rms")
    assert wfe.variants == ("full", "craigb18")
    np.testing.assert_allclose(wfe.relative, [0.1, 1.2])
    np.testing.assert_allclose(wfe.each, np.sqrt([5.0, 10.0]))
    np.testing.assert_allclose(of(found, "disc", "eps").relative, [np.nan, 0.1])
    assert not any(one.measure == "reduce_seconds" for one in found)


def test_the_table_of_reduced_models_names_the_one_that_differs_most():
    found = compare(variants(), variants(factor=1.1, worst=2.0), "A", "B")
    console = Console(width=200, record=True, file=StringIO())
    console.print(comparison_table(["A", "B"], [found]))
    words = " ".join(console.export_text().split())
    assert "disc wfe_rms (nm) 2 +65.00% +120.00% craigb18 3.16 6.96" in words
    assert "disc eps 2 +10.00% +10.00% craigb18 0.500 0.550" in words
    assert "nan" not in words
    figure = comparison_figure(["A", "B"], [found])
    assert "median and each variant" in figure.axes[0].get_xlabel()
    marks = [line.get_xdata() for line in figure.axes[0].lines if len(line.get_xdata()) == 2]
    assert any(np.allclose(one, [10.0, 120.0]) for one in marks)
