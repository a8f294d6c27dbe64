"""`make -C firmware` builds the same image as `wavequake firmware build`."""

import os
import shlex
import shutil
import subprocess
import sys

import pytest

from wavequake.files import folder
from wavequake.firmware.build import image_hash


@pytest.mark.skipif(not shutil.which("make"), reason="needs make")
@pytest.mark.skipif(not shutil.which("arm-none-eabi-gcc"), reason="needs Debian's gcc-arm-none-eabi")
def test_make_builds_the_image_of_the_command(tmp_path):
    wavequake = f"{shlex.quote(sys.executable)} -m wavequake"
    subprocess.run(
        ["make", "-s", "-C", str(folder("firmware")), "due", f"BUILD={tmp_path}", f"WAVEQUAKE={wavequake}"],
        check=True,
        env=os.environ | {"MAKEFLAGS": ""},
    )
    made = tmp_path / "due-q31.elf"
    words = ["firmware", "build", "--to", str(tmp_path / "own")]
    subprocess.run([sys.executable, "-m", "wavequake", *words], check=True, capture_output=True)
    assert image_hash(made) == image_hash(tmp_path / "own" / "due-q31.elf")
    assert made.read_bytes() == (tmp_path / "own" / "due-q31.elf").read_bytes()
