"""The lens experiment on the engine: bits, pairing, labels, and studies that cannot be."""

import numpy as np
import pytest

from wavequake.campaign.contract import DONE, RAISED
from wavequake.control.bench import bench_modes, fitted_bench
from wavequake.control.experiment import CONTROLLERS
from wavequake.errors import UserError
from wavequake.workflows.lens import experiment as lens_experiment
from wavequake.workflows.lens.experiment import KIND
from wavequake.workflows.run import chunk_of, run
from wavequake.workflows.study import load_study

SHORT = ["time.duration_s=2.0"]
TEXT = load_study("lens-experiment", SHORT).identity_text()


@pytest.fixture(scope="module")
def chunk():
    return KIND.compute(TEXT, np.arange(4), "numpy")


def test_chunks_are_those_of_any_workflow():
    keys = {"campaign.cases": 1000}
    assert [chunk_of(load_study(name, keys)) for name in ("lens-experiment", "tmt-segments")] == [125, 125]
    assert chunk_of(load_study("lens-experiment", {"store.chunk_cases": 16})) == 16


def test_cases_are_paired_between_springs(chunk):
    table = KIND.case_table(TEXT, 0, 4)
    assert list(table["springs"]) == ["initial", "changed"] * 2
    assert list(table["realization"]) == [0, 0, 1, 1]
    frequency = chunk.arrays["true_frequency"]
    # One draw: the same springs are stiffer than nominal in both configurations, or softer.
    nominal = [bench_modes(fitted_bench(springs)).omega for springs in ("initial", "changed")]
    one, other = frequency[0] / nominal[0], frequency[1] / nominal[1]
    assert np.corrcoef(one, other)[0, 1] > 0.5
    assert not np.array_equal(frequency[0], frequency[2])


def test_stored_numbers_belong_together(chunk):
    arrays = chunk.arrays
    assert (chunk.status == DONE).all()
    image = arrays["image"].astype(float)
    np.testing.assert_allclose(
        arrays["peak_to_peak"], 100 * np.ptp(image, axis=2) / np.ptp(image[:, :1], axis=2), rtol=1e-5
    )
    late = KIND.template(TEXT).fixed["time"][1] > 1.0
    np.testing.assert_allclose(arrays["deviation_mm"], image[..., late].std(axis=2), rtol=1e-4)
    assert np.abs(arrays["identified_frequency"] / arrays["true_frequency"] - 1).max() < 0.2


def test_a_plant_that_fails_is_quarantined_alone(monkeypatch):
    sound = lens_experiment.run_cases

    def failing(text, springs, realizations):
        if 1 in realizations:
            raise UserError("The identification failed.")
        return sound(text, springs, realizations)

    monkeypatch.setattr(lens_experiment, "run_cases", failing)
    text = load_study("lens-experiment", [*SHORT, "bench.springs=['initial']"]).identity_text()
    found = KIND.compute(text, np.arange(2), "numpy")
    assert list(found.status) == [DONE, RAISED]
    assert found.messages == ("", "The identification failed.")
    assert np.isnan(found.arrays["image"][1]).all()


def test_a_store_reads_back(tmp_path):
    dataset = run("lens-experiment", cases=2, store=tmp_path / "s", time__duration_s=2.0)
    assert dataset.sizes["controller"] == 6
    assert list(dataset["controller"].to_numpy())[-1] == "identified"
    assert (dataset["status"] == DONE).all()
    assert float(dataset["peak_to_peak"].sel(controller="identified").max()) < 5.0


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["controller.ff_step_ms=4"], r"FF is unstable at a sample time of 4 ms.*spectral radius 6\."),
        (["controller.both_step_ms=8"], r"FF\+FI is unstable at a sample time of 8 ms"),
        (
            ["bench.lens_springs_n_m=[182, 114, 157, 206, 380, 0]"],
            r"Kalman filter of the bench cannot be designed: the measurement does not see mode 1 \(6\.26",
        ),
        (["bench.beta=0.2"], "Mode 1 of the bench does not swing"),
        (["stage.zeros=[[1000.0, 0.0]]"], "no proper inverse"),
        (["stage.poles=[[300.0, 0.0]]"], "3 zeros, more than its 1 poles"),
        (["bench.lens_kg=[1, 1, 1, -1, 1, 1]"], "lens_kg must be finite and positive"),
    ],
)
def test_designs_that_cannot_be_are_refused_before_a_store_is_made(overrides, words):
    with pytest.raises(UserError, match=words):
        KIND.check(load_study("lens-experiment", overrides).identity_text())


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("bench.springs=['soft']", r"bench\.springs"),
        ("bench.springs=['initial', 'initial']", "listed twice"),
        ("time.step_ms=7", "multiple of step_ms"),
        ("controller.fi_stepms=8", "fi_step_ms"),
    ],
)
def test_bad_keys_are_named(override, words):
    with pytest.raises(UserError, match=words):
        load_study("lens-experiment", [override])


def test_the_plan_names_modes_and_delay():
    lines = KIND.describe(TEXT)
    assert "8.0 ms" in lines["stage"]
    assert "11 modes of 19.8 to 79.7 rad/s" in lines["springs initial"]


def test_the_identified_regulator_keeps_its_target_on_every_plant():
    """5 % of range and deviation with all errors of the bundled study; of 1000 plants, the worst has 4.8."""
    arrays = KIND.compute(load_study("lens-experiment").identity_text(), np.arange(32), "numpy").arrays
    place = CONTROLLERS.index("identified")
    worst = [arrays[name][:, place].max() for name in ("peak_to_peak", "deviation")]
    assert max(worst) <= 5.0
    assert arrays["peak_to_peak"][:, CONTROLLERS.index("modal")].max() > 5.0
