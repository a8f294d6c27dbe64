"""The workflow mirror-trace: two methods, their difference, and what it is made of."""

import numpy as np
import pytest
from small_mirrors import TRACE
from typer.testing import CliRunner

from wavequake import cli
from wavequake.campaign.engine.rerun import retry_store, statuses
from wavequake.campaign.stopwatch import Stopwatch
from wavequake.campaign.store.journal import read_journal
from wavequake.campaign.store.store import open_store
from wavequake.campaign.store.verify import verify_store
from wavequake.kernels.device.devices import choose_device
from wavequake.mechanics.vibration.excitations import drive_of
from wavequake.mechanics.vibration.modal import modal_model
from wavequake.mechanics.vibration.response import displacements, respond
from wavequake.optics.shapes.fit import apply
from wavequake.optics.shapes.motion_fit import motion_fit
from wavequake.workflows.kinds import find_kind
from wavequake.workflows.mirrors import trace as mirror_trace
from wavequake.workflows.mirrors.bench import bench_of, variant_of
from wavequake.workflows.mirrors.optics import displacements_mm
from wavequake.workflows.mirrors.residual import coordinates_of
from wavequake.workflows.mirrors.trace import KIND, MODAL, STAGES, STANDARD, standard_method
from wavequake.workflows.planning.plan import plan
from wavequake.workflows.run import run_study
from wavequake.workflows.study import load_study

pytestmark = pytest.mark.usefixtures("mirror_models")


def _arrays(keys):
    text = load_study("mirror-trace", TRACE | keys).identity_text()
    result = KIND.compute(text, np.arange(1), "auto")
    assert list(result.status) == [1], result.messages
    return {name: values[0] for name, values in result.arrays.items()}


def _apart(arrays, name="wfe_difference"):
    """Largest difference as a share of the largest wavefront error, per excitation."""
    return arrays[name].max(axis=1) / arrays["wfe_rms_standard"].max(axis=1)


@pytest.mark.parametrize("shape", ["circular", "annular"])
def test_the_methods_agree_to_a_thousandth_at_ten_micrometers(shape):
    """The thesis saw 1 %; measured here 5e-5 on the fine mesh with 231 terms, and as much on this one."""
    rings = 2 if shape == "circular" else 3
    found = _arrays({"model.shapes": [shape], "model.rings": rings})
    assert found["wfe_rms_standard"].max(axis=1).min() > 5000.0
    assert _apart(found).max() < 1e-4
    assert found["los_difference"].max() < 1e-4 * found["resolution_mm"]
    np.testing.assert_allclose(
        found["wfe_rms_modal"], found["wfe_rms_standard"], rtol=0, atol=1e-4 * found["wfe_rms_standard"].max()
    )


def test_a_mirror_moved_at_one_mount_turns_the_light():
    """The line of sight moves by many resolutions; tilt is in neither rms."""
    one_mount = {f"excitation.{name}.interfaces": [1] for name in ("sine100", "sine300")}
    found = _arrays(one_mount | {"optics.residual_limit": 1.0})
    assert np.abs(found["los_standard"]).max() > 10 * found["resolution_mm"]
    assert found["los_difference"].max() < 1e-3 * np.abs(found["los_standard"]).max()
    assert _apart(found).max() < 1e-3
    # Rms over the rays about their plane: what the fit catches, and a little more.
    ratio = found["wfe_rms_raw"].max(axis=1) / found["wfe_rms_standard"].max(axis=1)
    np.testing.assert_allclose(ratio, 1.0, rtol=0, atol=0.03)


def test_the_difference_grows_with_the_square_of_the_amplitude():
    """So it is of second order, in the sag and in the optics; nothing is left at first order."""
    found = [
        _arrays({f"excitation.{name}.amplitude": amplitude for name in ("sine100", "sine300")})
        for amplitude in (1e-5, 1e-4, 1e-3)
    ]
    for name in ("wfe_difference", "wfe_difference_sag", "wfe_difference_optics"):
        sizes = np.array([arrays[name].max(axis=1) for arrays in found])
        np.testing.assert_allclose(np.log10(sizes[2] / sizes[1]), 2.0, rtol=0, atol=0.03, err_msg=name)
        if name != "wfe_difference_sag":  # which is near rounding at 10 um
            np.testing.assert_allclose(np.log10(sizes[1] / sizes[0]), 2.0, rtol=0, atol=0.03, err_msg=name)
    # The parts make up the whole, and that of the optics is the large one.
    whole, sag, optics = (
        found[2][name] for name in ("wfe_difference", "wfe_difference_sag", "wfe_difference_optics")
    )
    assert (whole <= sag + optics + 1e-6).all()
    assert sag.max() < 0.05 * optics.max()


def test_modes_of_which_only_z_is_kept_are_off_by_percents():
    """What the 1 % of the thesis may have been: motion across the slope, left out of the modes."""
    study = load_study("mirror-trace", TRACE)
    bench = bench_of(study.identity_text(), "circular")
    variant, instants = variant_of(bench, "craigb18"), study.time.seconds
    drive = drive_of(study.excitation[0], 3, instants, 0)
    response = respond(modal_model(variant, drive.prescribed), [drive], instants)
    motion, coordinates = (
        motion_fit(bench.optics.surface, displacements_mm(variant.surface.T)),
        coordinates_of(response),
    )
    traced = standard_method(bench.optics, motion, coordinates, choose_device("auto"), Stopwatch())
    moved = displacements_mm(displacements(response, variant.surface)[0])
    truth = traced.aberrations[:, 5:]
    size = np.sqrt(np.sum(truth**2, axis=1)).max()
    for part, low, high in ((np.ones(3), 0.0, 1e-4), (np.array([0.0, 0.0, 1.0]), 5e-3, 5e-2)):
        summed = apply(bench.optics.surface, moved * part) @ bench.optics.sensitivity[5:].T
        assert low <= np.sqrt(np.sum((truth - summed) ** 2, axis=1)).max() / size < high


def test_a_case_alone_has_the_bits_it_has_in_a_chunk():
    keys = TRACE | {"reduction.variants": ["craigb18", "rubin18"]}
    text = load_study("mirror-trace", keys).identity_text()
    together, alone = KIND.compute(text, np.arange(2), "auto"), KIND.compute(text, np.array([1]), "auto")
    for name, values in alone.arrays.items():
        if name != "seconds":
            np.testing.assert_array_equal(values[0], together.arrays[name][1], err_msg=name)


def test_many_instants_are_traced_in_parts(monkeypatch):
    whole = _arrays({})
    monkeypatch.setattr(mirror_trace, "_INSTANTS", 16)
    for name, values in _arrays({}).items():
        if name != "seconds":
            np.testing.assert_allclose(values, whole[name], rtol=1e-9, atol=1e-9 * np.abs(values).max())


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    path = tmp_path_factory.mktemp("trace") / "store"
    study = load_study("mirror-trace", TRACE | {"reduction.variants": ["craigb18", "modal9"]})
    run_study(study, path, on="serial")
    return path


def test_the_store_has_labels_and_seconds_per_stage(store):
    found = open_store(store).load()
    assert list(found["variant"].values) == ["craigb18", "modal9"]
    assert list(found["status"].values) == [1, 2]
    assert list(found["excitation"].values) == ["sine100", "sine300"]
    assert found["wfe_rms_standard"].dims == ("case", "excitation", "time")
    seconds = found["seconds"].isel(case=0)
    assert (seconds > 0).all()
    assert set(STANDARD) | set(MODAL) < set(map(str, found["stage"].values)) == set(STAGES)
    assert verify_store(store).ok


def test_a_retried_store_keeps_its_numbers_but_not_the_readings_of_the_clock(store):
    before = open_store(store)["wfe_rms_modal"].isel(case=0).values
    summary = retry_store(find_kind("mirror-trace"), store, statuses("raised"), on="serial")
    assert (summary.computed, summary.quarantined) == (2, 1)
    np.testing.assert_array_equal(open_store(store)["wfe_rms_modal"].isel(case=0).values, before)


def test_a_run_that_is_cut_off_and_resumed_has_the_digests_of_a_whole_one(tmp_path, monkeypatch):
    keys = TRACE | {"reduction.variants": ["craigb18", "rubin18"], "store.chunk_cases": 1}
    study = load_study("mirror-trace", keys)
    run_study(study, tmp_path / "whole", on="serial")
    judged = mirror_trace.judged

    def cut_off(study, bench, variant, device):
        if variant == "rubin18":
            raise KeyboardInterrupt
        return judged(study, bench, variant, device)

    with monkeypatch.context() as patch:
        patch.setattr(mirror_trace, "judged", cut_off)
        with pytest.raises(KeyboardInterrupt):
            run_study(study, tmp_path / "resumed", on="serial")
    assert run_study(study, tmp_path / "resumed", on="serial").computed == 1
    whole, resumed = (_digests(tmp_path / name) for name in ("whole", "resumed"))
    assert len(whole) == 2
    assert resumed == whole


def _digests(path):
    """Those of all arrays of every chunk but the readings of the clock."""
    records = read_journal(path / "done").records.values()
    return {one.first: {k: v for k, v in one.digests.items() if k != "seconds"} for one in records}


def test_the_plan_says_what_is_traced():
    lines = plan(load_study("mirror-trace", TRACE))
    assert lines["model circular"] == "855 degrees of freedom, 51 instants of 120 rays, 11 Zernike terms"


def test_a_quarantined_variant_ends_the_command_with_code_3(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    keys = [f"{key}={value}".replace("'", '"') for key, value in TRACE.items()]
    keys += ['reduction.variants=["craigb18", "modal9"]', "--on", "serial", "--store", "s"]
    result = CliRunner().invoke(cli.app, ["run", "mirror-trace", *keys])
    assert result.exit_code == 3, result.output
    assert "The two methods differ by at most" in " ".join(result.stdout.split())
    assert (tmp_path / "s" / "report.html").exists()
