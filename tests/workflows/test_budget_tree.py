"""Budgets as trees: roll-ups against closed forms, groups against direct draws, and what is no tree."""

import io

import numpy as np
import pytest
import xarray as xr
from rich.console import Console

from wavequake import terminal
from wavequake.campaign.engine.pool import Place
from wavequake.errors import UserError
from wavequake.report.answers.budget import pictures, tables
from wavequake.report.answers.budget_tree import tree_explanations, tree_figure, verdict
from wavequake.workflows.asked_sections import BudgetSection
from wavequake.workflows.budgets.budget import budget, plan_budget, stored_budget, summed
from wavequake.workflows.budgets.elements import Factors, variants
from wavequake.workflows.budgets.segments import rings_of
from wavequake.workflows.budgets.tree import Branch, branches_of, rolled_up
from wavequake.workflows.segments.bench import bench_of
from wavequake.workflows.study import load_study, study_with

COVARIANCE = np.array([[4.0, 1.5, -0.6], [1.5, 2.0, 0.4], [-0.6, 0.4, 1.0]])
TREE = (
    Branch("both", "", frozenset()),
    Branch("one", "both", frozenset()),
    Branch("two", "both", frozenset()),
    Branch("three", "", frozenset()),
)


def drawn(covariance, cases, seed=4):
    """The rms over ten thousand instants of what three sources cause, of the groups of TREE."""
    random = np.random.default_rng(seed)
    parts = random.multivariate_normal(np.zeros(3), covariance, (cases, 10_000))
    sums = [parts.sum(axis=2), parts[..., 0] + parts[..., 1], *np.moveaxis(parts, 2, 0)]
    return np.sqrt(np.mean(np.square(sums), axis=2)).T


def test_a_roll_up_of_known_covariance_is_the_closed_form():
    found = rolled_up(drawn(COVARIANCE, 60), 0.0, TREE)
    both = COVARIANCE[:2, :2]
    wanted = [COVARIANCE.sum(), both.sum(), 4.0, 2.0, 1.0]
    np.testing.assert_allclose(found.rms.value, np.sqrt(wanted), rtol=5e-3)
    np.testing.assert_allclose(found.apart[:2], np.sqrt([both.sum() + 1.0, 6.0]), rtol=5e-3)
    assert np.isnan(found.apart[2:]).all()
    sizes = np.sqrt(both.sum()), 1.0
    exact = [2.0 * (-0.6 + 0.4) / (2.0 * sizes[0] * sizes[1]), 1.5 / np.sqrt(8.0)]
    np.testing.assert_allclose(found.correlation.value[:2], exact, atol=0.02)
    assert (found.correlation.low[:2] < exact).all()
    assert (exact < found.correlation.high[:2]).all()


def test_independent_branches_are_the_root_of_the_sum_of_squares():
    found = rolled_up(drawn(np.diag([4.0, 2.0, 1.0]), 60), 0.0, TREE)
    np.testing.assert_allclose(found.rms.value[:2], found.apart[:2], rtol=5e-3)
    assert found.correlation.low[1] < 0.0 < found.correlation.high[1]
    alike = np.ones((40, 1)) * [3.0, 3.0, 1.0, 2.0, 0.0]  # two that add up
    np.testing.assert_allclose(rolled_up(alike, 0.0, TREE).correlation.value[1], 1.0, rtol=1e-12)


def test_what_there_is_at_rest_belongs_to_the_whole_alone():
    rest = 5.0
    values = np.sqrt(drawn(COVARIANCE, 60) ** 2 + rest**2)
    found, before = rolled_up(values, rest, TREE), rolled_up(drawn(COVARIANCE, 60), 0.0, TREE)
    np.testing.assert_allclose(found.rms.value[1:], before.rms.value[1:], rtol=1e-9)
    np.testing.assert_allclose(found.rms.value[0] ** 2, before.rms.value[0] ** 2 + 25.0, rtol=1e-9)
    np.testing.assert_allclose(found.apart[0] ** 2, before.apart[0] ** 2 + 25.0, rtol=1e-9)


MOVING = frozenset(
    {("wind", "M1"), ("wind", "M2"), ("floor", "M1"), ("floor", "M2"), ("floor", "line of sight")}
)


def section(*groups):
    return BudgetSection(group=[{"name": name, "of": of} for name, of in groups])


def test_groups_hold_parts_and_what_is_left_is_said():
    found = branches_of(section(("a", ("wind",)), ("b", ("c",)), ("c", ("floor",))), MOVING, {})
    assert [(one.name, one.parent) for one in found] == [("a", ""), ("b", ""), ("c", "b")]
    assert found[0].parts == {("wind", "M1"), ("wind", "M2")}
    assert found[1].parts == found[2].parts == {part for part in MOVING if part[0] == "floor"}
    left = branches_of(section(("mirrors", ("M?",))), MOVING, {})
    assert [one.name for one in left] == ["mirrors", "in no group"]
    assert left[1].parts == {("floor", "line of sight")}
    rings = branches_of(section(("inner", ("ring 1",))), MOVING, {"ring 1": ["M1"]})
    assert rings[0].parts == {("wind", "M1"), ("floor", "M1")}


@pytest.mark.parametrize(
    ("groups", "message"),
    [
        ([("a", ("M3",))], "'a': 'M3' names nothing that moves in this budget; there is floor, wind, M1, M2"),
        ([("a", ("wind",)), ("b", ("M1",))], "'a' and 'b' both hold M1 as 'wind' moves it"),
        ([("a", ("b", "wind")), ("b", ("floor",))], "is of the group 'b' and of 'wind', which is none"),
        ([("a", ("b",)), ("b", ("a",))], "contains itself"),
        ([("a", ("c",)), ("b", ("c",)), ("c", ("M1",))], "'c' is in 'a' and in 'b'; a group has one place"),
        ([("a", ("M1",)), ("a", ("M2",))], "two groups are called 'a'"),
    ],
)
def test_what_is_no_tree_is_a_sentence(groups, message):
    with pytest.raises((UserError, ValueError), match=message):
        branches_of(section(*groups), MOVING, {})


STUDY = """
[study]
name = "two"
workflow = "segment-disturbance"
seed = 11
[telescope]
name = "tmt-18"
[optics]
rays_per_segment = 6
[imaging]
enabled = false
[[disturbance]]
name = "coarse"
model = "static-random"
instants = 1
piston_nm = 40.0
[[disturbance]]
name = "fine"
model = "static-random"
instants = 1
piston_nm = 20.0
[budget]
allocation = { wfe_rms_raw = "80 nm" }
[[budget.group]]
name = "inside"
of = ["ring 1"]
allocation = { wfe_rms_raw = "0.06 um" }
[[budget.group]]
name = "outside"
of = ["ring 2"]
allocation = { wfe_rms_raw = "60 nm" }
"""


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    path = tmp_path_factory.mktemp("tree") / "two.toml"
    path.write_text(STUDY)
    return load_study(path)


@pytest.fixture(scope="module")
def found(study):
    return budget(study, 80)


def test_a_group_moves_its_part_of_the_same_draws(study):
    bench = bench_of(study.identity_text())
    rings = rings_of(bench.layout)
    names = [bench.layout.names[place] for place in np.flatnonzero(rings == 1)]
    inside = Branch("inside", "", frozenset({("fine", name) for name in names}))
    motions = variants(summed(study, None), Factors(study.disturbance, rings), bench.layout, 11, 3, (inside,))
    only_fine, alone = motions[2].segment_motion, motions[-1].segment_motion
    np.testing.assert_array_equal(alone[:, rings == 1], only_fine[:, rings == 1])
    assert not alone[:, rings == 2].any()


def test_rings_of_independent_pistons_add_up_but_for_their_common_piston(study, found):
    # A ring alone: sum of w p^2 - (sum of w p)^2 with the glass w of all, which anticorrelates rings.
    bench = bench_of(study.identity_text())
    rings, glass = rings_of(bench.layout), bench.layout.axes[:, 2, 2]
    weights = np.ones(18) / 18
    size = 2.0 * np.hypot(40.0, 20.0) * glass
    covariance = np.diag(weights * size**2) - np.outer(weights * size, weights * size)
    exact = [
        np.sqrt(np.trace(np.diag(np.diag(covariance))[np.ix_(rings == ring, rings == ring)]))
        for ring in (1, 2)
    ]
    one = found.sel(quantity="wfe_rms_raw")
    assert found["branch"].to_numpy().tolist() == ["all", "inside", "outside"]
    for row, wanted in enumerate(exact, start=1):
        low, high = (float(one[f"branch_rms{end}"][row]) for end in ("_low", "_high"))
        assert low < wanted < high
        assert high - low < 0.25 * wanted
    np.testing.assert_allclose(one["allocation"], [80.0, 60.0, 60.0])
    np.testing.assert_array_equal(
        found["value"].sel(variant="only inside"), found["value"].sel(variant="without ring 2")
    )


def test_the_numbers_do_not_depend_on_where_they_are_computed_nor_on_allocations(study, found, tmp_path):
    made, kept = stored_budget(study, tmp_path / "s", 80, place=Place("local", 2))
    assert not kept
    np.testing.assert_array_equal(made["value"], found["value"])
    other = study_with(study, {"budget.group.inside.allocation": {"wfe_rms_raw": "40 nm"}})
    assert other.identity() == study.identity()
    again, kept = stored_budget(other, tmp_path / "s", 80)
    assert kept
    assert float(again["allocation"].sel(branch="inside", quantity="wfe_rms_raw")) == 40.0
    assert float(xr.open_zarr(tmp_path / "s" / "budget.zarr")["allocation"][1, 0]) == 40.0
    assert [one.id for one in pictures(tmp_path / "s")] == ["budget-groups", "budget"]
    grouped = study_with(
        study, {"budget.group.inside.of": ["ring 1", "coarse"], "budget.group.outside.of": ["1"]}
    )
    with pytest.raises(UserError, match="both hold"):
        stored_budget(grouped, tmp_path / "s", 80)


def test_allocations_that_do_not_fit_are_said(study, found):
    lines = tree_explanations(found)
    assert any(
        "The branches of all may be 84.9 nm together" in line and "80.0 only" in line for line in lines
    )
    with pytest.raises(
        UserError, match="The allocation of 'inside' is of 'strehl', which this budget does not"
    ):
        budget(study_with(study, {"budget.group.inside.allocation": {"strehl": "1"}}), 16)
    with pytest.raises(UserError, match="The allocation of 'the whole' '3 mas' has the unit 'mas'"):
        budget(study_with(study, {"budget.allocation": {"wfe_rms": "3 mas"}}), 16)
    with pytest.raises(UserError, match="'fine' is the name of a disturbance"):
        budget(study_with(study, {"budget.group.inside.name": "fine"}), 16)


def test_a_plan_says_what_a_budget_takes_and_keeps_nothing(study):
    said = plan_budget(study, 80)
    assert said["groups"] == "inside, outside"
    assert said["cases"] == "80, each traced 12 times"
    assert said["estimate"].endswith("s of one process")


@pytest.mark.parametrize(
    ("row", "word"),
    [
        ((2, 1, 0.9, 1.1), "kept"),
        ((1, 2, 1.8, 2.2), "over"),
        ((1, 1, 0.9, 1.1), "open"),
        ((1, 1, 0.6, 1.4), "unresolved"),
        ((np.nan, 1, 0.9, 1.1), ""),
    ],
)
def test_a_verdict_needs_the_whole_interval(row, word):
    assert verdict(*row) == word


def test_no_column_is_lost_where_the_terminal_is_narrow(found, monkeypatch):
    assert len(tree_figure(found, {"wfe_rms_raw": "x"}).axes) == 1
    words = ("mean square", "switched off", "with interactions", "coarse", "ring 2")
    for width in (40, 60, 80, 100, 140):
        console = Console(width=width, record=True, file=io.StringIO())
        monkeypatch.setattr(terminal, "out", console)
        for table in tables(found):
            terminal.print_fitting(table)
        said = console.export_text()
        assert max(map(len, said.splitlines())) <= width
        whole = " ".join(said.split())
        assert "…" not in said
        for word in words if width > 60 else ("coarse", "correlation"):
            assert word in whole, (width, word)
