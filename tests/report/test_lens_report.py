"""The report of the lens experiment: its table, its answer, and figures that can be drawn."""

import numpy as np
import pytest
from rich.console import Console

from wavequake.errors import UserError
from wavequake.firmware.build import BOARDS, compiler_of
from wavequake.report.lens import figures as draw
from wavequake.report.lens import report as lens
from wavequake.report.lens.over_frequency import over_frequency
from wavequake.report.page import render_page
from wavequake.workflows.lens.loops import looked
from wavequake.workflows.loops.curves import frequencies, kept
from wavequake.workflows.loops.loop_margins import loops_of
from wavequake.workflows.run import run
from wavequake.workflows.study import load_study


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """Two finished plants of one configuration, a third one failed, none of the other configuration."""
    path = tmp_path_factory.mktemp("lens") / "s"
    found = run("lens-experiment", cases=3, store=path, time__duration_s=2.0).load()
    found["status"][1] = 2
    found["message"] = found["message"].astype(object)
    found["message"][1] = "The identification failed."
    return found


def test_table_and_answer_tell_medians(dataset, tmp_path):
    one, other = lens.configurations(dataset)
    assert list(one.rows) == [0, 2]
    assert not len(other.rows)
    console = Console(width=140, record=True, file=(tmp_path / "t").open("w"))
    console.print(lens.table_of(tmp_path, dataset))
    text = console.export_text()
    value = np.median(dataset["peak_to_peak"].to_numpy()[[0, 2], 1])
    assert f"{value:.1f}" in text
    assert "initial springs, 2 plants" in text
    assert "Changed springs: no plant is done." in text
    assert "30, 30" in text


def test_report_holds_all_figures_and_what_is_left_out(dataset, tmp_path):
    page = render_page(dataset, lens.page_of(tmp_path, dataset, "numpy"))
    for key in (
        "bars-initial",
        "initial-model",
        "initial-filter",
        "initial-remaining",
        "hammer",
        "step",
        "follow",
    ):
        assert f'id="{key}"' in page or key in page
    assert "The identification failed." in page
    assert page.count("<svg") == 17  # with the layout


def test_loops_through_the_image_are_drawn_with_their_margins_and_noise(dataset, tmp_path):
    assert [one.id for one in over_frequency(dataset, "initial", [0, 2])] == ["initial-spectrum"]
    path = tmp_path / "s.toml"
    path.write_text(
        '[study]\nname = "s"\nworkflow = "lens-experiment"\n[bench]\nsprings = ["initial"]\n'
        '[[sensor]]\nname = "camera"\nmodel = "line-of-sight"\nrate_hz = 200.0\nnoise = 5.0\n'
        '[[loop]]\nname = "slow"\nmodel = "integrator"\nsensor = "camera"\nlatency_frames = 0.2\n'
        "bandwidth_hz = 4.0\n"
    )
    study = load_study(path)
    known = dataset.assign_attrs(study=study.identity_text())
    shown = [one.id for one in over_frequency(known, "initial", [0, 2])]
    assert shown == [f"initial-{key}" for key in ("spectrum", "bode", "nyquist", "rejection", "noise")]
    hertz, found = frequencies(study.sensor, [0.005]), looked(study, "initial")
    (margins,), curves = loops_of(study), kept(["slow"], hertz, found, "um")
    assert curves["gain_up"][1] == pytest.approx(margins.gain_up, rel=2e-3)
    assert curves["phase_margin"][1] == pytest.approx(margins.phase_deg, abs=0.3)
    # Noise of a camera frame moves the image by what an integrator makes of it: |T|^2, seen as means.
    heard, passed = curves["noise_los"][1][0], curves["passed_noise"][1][0]
    np.testing.assert_allclose(heard[:50], 2 * 0.005 * 25 * passed[:50] ** 2, rtol=1e-9)


def test_simulated_stage_is_close_to_the_actual_one(dataset):
    """Fig. 5.12: the nominal stage without the delay of the control unit explains the actual one's motion."""
    case = draw.Shown.of(dataset, 0)
    bench, stage = lens.bench_of(lens.study_of(dataset.attrs["study"]), "initial"), draw.Stage()
    nominal = draw.nominal_of(bench, stage, case)
    error = nominal.stage["FF"] - case.stage["FF"]
    assert error.std() < 0.1 * case.stage["FF"].std()
    # The filter knows the force: better at once; without it as good later (Fig. 5.28, 5.29).
    free, early, late = case.image["uncontrolled"], case.time < 0.5, case.time > 1.5
    off = {
        name: np.abs(values - free)
        for name, values in (("with", nominal.with_force), ("not", nominal.without_force))
    }
    assert off["with"][early].max() < 0.5 * off["not"][early].max()
    assert off["not"][late].max() < 0.5 * off["not"][early].max()


def test_identified_stage_is_the_true_one():
    record = draw.step_record(draw.Stage())
    assert record.identified.fit > 0.998
    assert record.identified.stage.gain == pytest.approx(0.97, abs=2e-3)


def test_firmware_is_shown_beside_double_precision(tmp_path):
    try:
        compiler_of(BOARDS["host"])
    except UserError as error:
        pytest.skip(str(error))
    only = {"time__duration_s": 2.0, "bench__springs": ["initial"], "firmware__arithmetic": ["q31", "q16"]}
    dataset = run("lens-firmware", cases=2, store=tmp_path / "s", **only).load()
    (one,) = lens.configurations(dataset)
    firmware = one.firmware
    modal, q16 = 4, 7
    np.testing.assert_array_equal(firmware.apart[0, :, 1], one.ranges[:, q16] - one.ranges[:, modal])
    np.testing.assert_array_equal(firmware.apart[1, :, 1], one.deviations[:, q16] - one.deviations[:, modal])
    digest = f"{int(dataset['firmware_hash'][0, 0]):016x}"
    assert firmware.cells("firmware-q31")[0] == (digest, "")
    assert firmware.cells("modal")[0] == ("", "")
    page = render_page(dataset, lens.page_of(tmp_path, dataset, "numpy"))
    assert digest in page
    assert "In 4 runs of the firmware" in page
    assert page.count("<svg") == 19  # with the layout
