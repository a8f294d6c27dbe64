"""`wavequake firmware` as a user meets it."""

import sys

import pytest

from wavequake import cli
from wavequake.errors import UserError
from wavequake.firmware import trial
from wavequake.firmware.build import BOARDS, compiler_of

LENS = ["lens-experiment"]


def run(monkeypatch, capsys, *words):
    monkeypatch.setattr(sys, "argv", ["wavequake", "firmware", *map(str, words)])
    with pytest.raises(SystemExit) as end:
        cli.main()
    said = capsys.readouterr()
    return end.value.code or 0, " ".join((said.out + said.err).split())


def needs(board):
    try:
        compiler_of(BOARDS[board])
    except UserError as error:
        pytest.skip(str(error))


def test_build_then_flash_and_refuse_another_design(monkeypatch, capsys, tmp_path):
    needs("due")
    code, said = run(monkeypatch, capsys, "build", "--to", tmp_path)
    assert code == 0
    assert "due-q31.elf" in said
    code, said = run(monkeypatch, capsys, "flash", "due", "--to", tmp_path)
    assert code == 0
    assert f"bossac -a -p ttyACM0 -e -w -v -b {tmp_path}/due-q31.bin -R" in said
    other = [*LENS, "controller.modal_step_ms=4", "--to", tmp_path]
    code, said = run(monkeypatch, capsys, "flash", "due", *other)
    assert code == 2
    assert "but the design has" in said


def test_all_images_give_the_commands_of_the_host(monkeypatch, capsys, tmp_path):
    needs("host")
    monkeypatch.setattr(trial, "DURATION", 1.1)  # floats are emulated slowly
    code, said = run(monkeypatch, capsys, "test", "--to", tmp_path)
    assert code == 0
    assert "DIFFER" not in said
    assert said.count("reference") == 3
    assert said.count("not run") + said.count("as the host's") == 6


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["flash", "due"], "There is no image"),
        (["flash", "qemu"], "is no hardware"),
        (["build", "--boards", "mega"], "There is no board 'mega'"),
        (["build", "--arithmetic", "q7"], "There is no arithmetic 'q7'"),
        (["build", "tmt-segments"], "firmware is made from one of lens-experiment"),
    ],
)
def test_bad_input(monkeypatch, capsys, tmp_path, words, sentence):
    code, said = run(monkeypatch, capsys, *words, "--to", tmp_path)
    assert code == 2
    assert sentence in said


def test_a_machine_without_compilers_is_told_what_to_install(monkeypatch, capsys, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr("wavequake.firmware.build.find_spec", lambda name: None)
    code, said = run(monkeypatch, capsys, "build", "--to", tmp_path)
    assert code == 2
    assert "it needs ziglang from PyPI (extra firmware) or Debian's gcc-arm-none-eabi" in said
