"""Kernels must build on a machine without a compiler; PoCL would abort the process there."""

import os
import shutil
import subprocess
import sys

import pytest

from wavequake.errors import UserError
from wavequake.kernels.device import devices, linker

HAS_POCL = any(device.platform == "Portable Computing Language" for device in devices.list_devices())


def test_the_wrapper_leaves_out_the_libraries_of_a_compiler_and_nothing_else(tmp_path):
    echo = [sys.executable, "-c", "import sys; print(sys.argv[1:])"]
    program = linker.wrapped(echo, tmp_path) / "ld"
    words = ["-shared", "-o", "a b.so", "-L/usr/lib", "in.o", "-lgcc", "--as-needed", "-lgcc_s", "-lc"]
    out = subprocess.run([program, *words], capture_output=True, text=True, check=True).stdout
    assert eval(out) == ["-shared", "-o", "a b.so", "-L/usr/lib", "in.o", "--as-needed"]


def test_without_any_linker_the_user_learns_what_to_install(monkeypatch):
    monkeypatch.setenv("PATH", "/nowhere")
    monkeypatch.setattr(linker, "machine_can_link", lambda: False)
    monkeypatch.setattr(linker, "find_linker", list)
    with pytest.raises(UserError, match="pip install ziglang"):
        linker.ensure_linker()


@pytest.mark.skipif(not HAS_POCL or not shutil.which("ld"), reason="needs PoCL and a linker")
def test_a_kernel_builds_without_a_compilers_libraries(tmp_path):
    """A process whose only ``ld`` on PATH is the wrapper compiles, links and runs a kernel."""
    script = (
        "from wavequake.kernels.device import linker, devices\n"
        "linker.machine_can_link = lambda: False\n"
        "assert devices.self_test(devices.choose_device('cpu')) < 1e-9\n"
        "import os; print(os.environ['PATH'].split(os.pathsep)[0])\n"
    )
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin" / "ld").symlink_to(shutil.which("ld"))
    env = os.environ | {
        "PATH": f"{tmp_path / 'bin'}:/bin",
        "XDG_CACHE_HOME": str(tmp_path / "cache"),
        "POCL_CACHE_DIR": str(tmp_path / "pocl"),
    }
    (tmp_path / "pocl").mkdir()
    done = subprocess.run(
        [sys.executable, "-c", script], env=env, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip().startswith(str(tmp_path / "cache"))
