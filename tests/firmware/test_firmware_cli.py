"""`wavequake firmware` as a user meets it."""

import re
import subprocess
import sys

import numpy as np
import pytest

from wavequake.control import experiment
from wavequake.control.experiment import tuned_regulator
from wavequake.errors import UserError
from wavequake.firmware import trial
from wavequake.firmware.build import BOARDS, compiler_of, image_hash
from wavequake.firmware.elf import segments_of
from wavequake.firmware.gains import gains_of
from wavequake.workflows.kinds import study_of
from wavequake.workflows.lens.experiment import chain_of, designs_of, run_cases
from wavequake.workflows.study import load_study

LENS = ["lens-experiment"]


@pytest.fixture
def firmware(wavequake):
    """Run `wavequake firmware`; give the exit code and what is said, on one line."""

    def run(*words):
        code, out, err = wavequake("firmware", *words)
        return code, " ".join((out + err).split())

    return run


def needs(board):
    try:
        compiler_of(BOARDS[board])
    except UserError as error:
        pytest.skip(str(error))


def test_build_then_flash_and_refuse_another_design(firmware, tmp_path):
    needs("due")
    code, said = firmware("build", "--to", tmp_path)
    assert code == 0
    assert "due-q31.elf" in said
    code, said = firmware("flash", "due", "--to", tmp_path)
    assert code == 0
    assert f"bossac -a -p ttyACM0 -e -w -v -b {tmp_path}/due-q31.bin -R" in said
    assert "Debian's bossa-cli" in said
    other = [*LENS, "controller.modal_step_ms=4", "--to", tmp_path]
    code, said = firmware("flash", "due", *other)
    assert code == 2
    assert "but the design has" in said


def test_without_gcc_flashing_needs_no_tool_of_it(monkeypatch, firmware, tmp_path):
    pytest.importorskip("ziglang", reason="needs ziglang (extra firmware)")
    monkeypatch.setenv("PATH", str(tmp_path))
    code, _ = firmware("build", "--to", tmp_path)
    assert code == 0
    code, said = firmware("flash", "due", "--to", tmp_path)
    assert code == 0
    assert "-m ziglang objcopy -O binary" in said
    elf, binary = tmp_path / "due-q31.elf", tmp_path / "due-q31.bin"
    subprocess.run([sys.executable, "-m", "ziglang", "objcopy", "-O", "binary", elf, binary], check=True)
    assert binary.read_bytes() == b"".join(one.data for one in segments_of(elf))


def test_all_images_give_the_commands_of_the_host(monkeypatch, firmware, tmp_path):
    needs("host")
    monkeypatch.setattr(trial, "DURATION", 1.1)  # floats are emulated slowly
    code, said = firmware("test", "--to", tmp_path)
    assert code == 0
    assert "DIFFER" not in said
    assert said.count("reference") == 3
    assert "Commands are compared over 551 steps" in said
    assert said.count("not run") + said.count("as the host's") == 8


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["flash", "uno"], "`wavequake firmware build --boards uno --arithmetic q31` makes it"),
        (["flash", "qemu"], "is no hardware"),
        (["build", "--boards", "mega"], "There is no board 'mega'"),
        (["build", "--arithmetic", "q7"], "There is no arithmetic 'q7'"),
        (
            ["build", "--controller", "best"],
            "no controller 'best'; there are nominal, identified, and .npz files",
        ),
        (["build", "--controller", "none.npz"], "none.npz"),
        (["build", "tmt-segments"], "firmware is made from one of lens-experiment"),
    ],
)
def test_bad_input(firmware, tmp_path, words, sentence):
    code, said = firmware(*words, "--to", tmp_path)
    assert code == 2
    assert sentence in said


def test_a_file_brings_any_linear_controller(firmware, tmp_path):
    needs("host")
    file = tmp_path / "own.npz"
    integrator = {"A": [[1.0]], "B": [[0.2]], "C": [[-1.0]], "D": [[-0.2]]}
    np.savez(file, **integrator, sample_time_s=0.0005)  # faster than the simulated bench
    code, said = firmware("test", "--controller", file, "--to", tmp_path)
    assert code == 0
    assert "DIFFER" not in said
    assert said.count("reference") == 3
    assert "Commands are compared over 2000 steps" in said
    assert firmware("build", "--controller", file, "--boards", "none", "--to", tmp_path)[0] == 0
    assert "#define WQ_SAMPLE_TIME_US 500L" in (tmp_path / "gains-q31" / "wq_gains.h").read_text()
    np.savez(file, **integrator | {"A": [[2.0]]}, sample_time_s=0.0005)
    code, said = firmware("build", "--controller", file, "--to", tmp_path)
    assert (code, "own.npz: The controller grows by itself" in said) == (2, True)
    code, said = firmware("build", "--controller", file, "--record", "run.csv", "--to", tmp_path)
    assert (code, "not both" in said) == (2, True)


def test_a_machine_without_compilers_is_told_what_to_install(monkeypatch, firmware, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr("wavequake.firmware.build.find_spec", lambda name: None)
    code, said = firmware("build", "--to", tmp_path)
    assert code == 2
    assert "it needs ziglang from PyPI (extra firmware) or Debian's gcc-arm-none-eabi" in said


def test_an_identified_plant_has_an_image_of_its_own(firmware, tmp_path):
    needs("due")
    words = [*LENS, "time.duration_s=2", "--controller", "identified", "--to", tmp_path]
    code, said = firmware("build", *words)
    assert code == 0
    carried = image_hash(tmp_path / "due-q31.elf")
    # It is the image that the study's campaign runs for the same plant.
    text = load_study(LENS[0], ["time.duration_s=2", "firmware.arithmetic=['q31']"]).identity_text()
    study = study_of(text)
    runs = run_cases(text, "initial", [0, 1])
    models = [one.model for one in runs.identified]
    designs = designs_of(text, "initial")
    tuned = [tuned_regulator(designs, one) for one in runs.identified]
    assert carried == gains_of(tuned[0], chain_of(study), "q31").digest
    assert not np.array_equal(models[0].poles, models[1].poles)
    code, said = firmware("flash", "due", *words)
    assert code == 0
    code, said = firmware("flash", "due", *words, "--plant", "1")
    assert code == 2
    assert f"was built from gains {carried}, but the design has" in said


def test_a_recording_of_a_plant_gives_the_image_of_that_plant(monkeypatch, firmware, tmp_path):
    """What the simulated plant's sensor and camera saw, as a file, identifies what the plant itself does."""
    needs("due")
    seen = []
    found = experiment.identify

    def noted(record, nominal):
        seen.append(record)
        return found(record, nominal)

    monkeypatch.setattr(experiment, "identify", noted)
    words = [*LENS, "time.duration_s=2", "--to", tmp_path]
    drawn = firmware("build", *words, "--controller", "identified")
    (record,) = seen
    lens = dict(zip(np.rint(1e3 * record.time).astype(int), 1e3 * record.measured, strict=True))
    image = dict(zip(np.rint(1e3 * record.frame_time).astype(int), 1e3 * record.image, strict=True))
    rows = [f"{ms / 1000},{lens.get(ms, '')},{image.get(ms, '')}" for ms in sorted({*lens, *image})]
    path = tmp_path / "run.csv"
    path.write_text("\n".join(["time_s,sensor_mm,image_mm", *rows]))
    header = (tmp_path / "gains-q31" / "wq_gains.h").read_text()
    code, said = firmware("build", *words, "--record", path)
    assert code == drawn[0] == 0
    # Decimal numbers of the file move the last digits of the gains, not more.
    again = (tmp_path / "gains-q31" / "wq_gains.h").read_text()
    numbers = [np.array([int(n) for n in re.findall(r"(-?\d+)L[,)]", text)]) for text in (header, again)]
    assert len(numbers[0]) == 11 * 6 + 8 * 11 * 2
    np.testing.assert_allclose(numbers[1], numbers[0], rtol=1e-4, atol=1e4)
    code, said = firmware("flash", "due", *words, "--record", path)
    assert code == 0
    code, said = firmware("flash", "due", *words)
    assert code == 2
    assert "but the design has" in said


def test_recordings_that_identify_nothing_are_refused(firmware, tmp_path):
    path = tmp_path / "run.csv"
    code, said = firmware("build", "--record", path, "--to", tmp_path)
    assert code == 2
    assert "cannot be read" in said
    rest = [f"{0.002 * k:.3f},{k % 2},{k % 3}" for k in range(1000)]
    path.write_text("\n".join(["time_s,sensor_mm,image_mm", *rest]))
    code, said = firmware("build", "--record", path, "--to", tmp_path)
    assert code == 2
    assert "The identification failed" in said
    path.write_text("\n".join(["time_s,sensor_mm,image_mm", *rest[:20]]))
    code, said = firmware("build", "--record", path, "--to", tmp_path)
    assert code == 2
    assert "11 modes cannot be identified: the record needs at least 44 finite samples" in said


def test_an_identified_plants_image_steadies_it(monkeypatch, firmware, tmp_path):
    """From one uncontrolled run to the bits of the board, on a plant with all errors on."""
    needs("host")
    monkeypatch.setattr(trial, "VARIANTS", ("q31",))
    words = [*LENS, "--controller", "identified", "--plant", "2", "--to", tmp_path]
    code, said = firmware("test", *words)
    assert code == 0
    assert "DIFFER" not in said
    found = re.search(r"host q31 - - - ([\d.]+) ([\d.]+) reference", said)
    assert max(map(float, found.groups())) < 5


def test_an_arithmetic_that_cannot_hold_a_design_is_skipped_by_name(monkeypatch, firmware, tmp_path):
    needs("host")
    monkeypatch.setattr(trial, "DURATION", 1.1)
    monkeypatch.setattr(trial, "VARIANTS", ("float", "q16"))
    words = ["controller.modal_step_ms=8", "errors.friction_mn=0", "--to", tmp_path]
    code, said = firmware("test", *LENS, *words)
    assert code == 0
    assert "all q16 - - - - - not run" in said
    assert "Not run: The step of mode 11 is 0.6242, beyond the range of q16, which ends at 0.5" in said
    assert "host float" in said
