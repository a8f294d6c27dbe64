"""`make -C firmware` builds the same image as `wavequake firmware build`."""

import os
import shlex
import shutil
import subprocess
import sys

import pytest

from wavequake.errors import UserError
from wavequake.files import folder
from wavequake.firmware.build import BOARDS, compiler_of, image_hash
from wavequake.firmware.elf import segments_of

try:
    compiler_of(BOARDS["due"])
except UserError as error:  # says which package is missing
    pytest.skip(str(error), allow_module_level=True)


@pytest.mark.skipif(not shutil.which("make"), reason="needs make")
def test_make_builds_the_image_of_the_command(tmp_path):
    python = shlex.quote(sys.executable)
    tools = [f"BUILD={tmp_path}", f"WAVEQUAKE={python} -m wavequake", f"PYTHON={python}"]
    words = ["make", "-s", "-C", str(folder("firmware")), "due", "qemu", *tools]
    done = subprocess.run(words, env=os.environ | {"MAKEFLAGS": ""}, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "warning" not in done.stderr
    words = ["firmware", "build", "--boards", "due,qemu", "--to", str(tmp_path / "own")]
    subprocess.run([sys.executable, "-m", "wavequake", *words], check=True, capture_output=True)
    for name in ("due-q31.elf", "qemu-q31.elf"):
        assert image_hash(tmp_path / name) == image_hash(tmp_path / "own" / name)
        assert segments_of(tmp_path / name) == segments_of(tmp_path / "own" / name)


@pytest.mark.skipif(not shutil.which("make"), reason="needs make")
def test_make_follows_the_study_and_builds_nothing_twice(tmp_path):
    python = shlex.quote(sys.executable)
    study = tmp_path / "bench.toml"
    tools = [f"BUILD={tmp_path / 'build'}", f"WAVEQUAKE={python} -m wavequake", f"PYTHON={python}"]

    def made(gain):
        study.write_text(f'[study]\nname = "bench"\nworkflow = "lens-experiment"\n[stage]\ngain = {gain}\n')
        words = ["make", "-s", "-C", str(folder("firmware")), "due", f"STUDY={study}", *tools]
        subprocess.run(words, env=os.environ | {"MAKEFLAGS": ""}, check=True, capture_output=True)
        image = tmp_path / "build" / "due-q31.elf"
        return image_hash(image), image.stat().st_mtime_ns

    first = made(0.97)
    assert made(0.97) == first
    assert made(0.9)[0] != first[0]


@pytest.mark.skipif(not shutil.which("make"), reason="needs make")
@pytest.mark.parametrize(
    ("target", "missing", "sentence"),
    [
        (
            "due",
            ["PYTHON=/none"],
            "install Debian's gcc-arm-none-eabi, or ziglang from PyPI for PYTHON=/none",
        ),
        ("uno", [], "avr-gcc is missing: install Debian's gcc-avr and avr-libc"),
        ("due", ["WAVEQUAKE=wavequake-not-there"], "install Wavequake or name its command by WAVEQUAKE="),
    ],
)
def test_make_says_what_is_missing(tmp_path, target, missing, sentence):
    make, python = shutil.which("make"), shlex.quote(sys.executable)
    tools = [f"BUILD={tmp_path}", f"WAVEQUAKE={python} -m wavequake", *missing]
    words = [make, "-s", "-C", str(folder("firmware")), target, *tools]
    alone = os.environ | {"MAKEFLAGS": "", "PATH": str(tmp_path)}
    done = subprocess.run(words, env=alone, capture_output=True, text=True)
    assert done.returncode == 2
    assert sentence in " ".join(done.stderr.split())
