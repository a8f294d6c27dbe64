"""A home or a cache that nobody can write does not take PoCL away."""

import os
import subprocess
import sys

import pytest

from wavequake.kernels.device.devices import POCL, list_devices

SEEN = """
from wavequake.kernels.device.devices import POCL, list_devices
print(*[one.kind for one in list_devices()])
"""


@pytest.mark.skipif(all(one.kind == "numpy" for one in list_devices()), reason="there is no OpenCL device")
@pytest.mark.parametrize("named", ["HOME", "XDG_CACHE_HOME", "POCL_CACHE_DIR"])
def test_devices_are_seen_where_no_cache_can_be_written(named, tmp_path):
    (tmp_path / "file").write_text("")
    left = {key: text for key, text in os.environ.items() if key not in ("XDG_CACHE_HOME", "POCL_CACHE_DIR")}
    env = left | {named: str(tmp_path / "file" / "below"), "TMPDIR": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", SEEN], env=env, capture_output=True, text=True, check=True)
    assert done.stdout.split() == [one.kind for one in list_devices()]
    assert [one.name for one in tmp_path.iterdir()] == ["file"]  # nothing stays


SUMMED = """
import numpy as np
from wavequake.kernels.device.devices import POCL, list_devices
from wavequake.kernels.sums.ray_sums import ray_coefficients
(device,) = [one for one in list_devices() if one.platform == POCL and one.kind == "cpu"]
print(ray_coefficients(np.ones((1, 30)), np.ones((2, 30)), device)[0].ravel())
"""


@pytest.mark.skipif(all(one.platform != POCL for one in list_devices()), reason="there is no PoCL")
def test_programs_that_are_empty_in_the_cache_of_pocl_are_built_anew(tmp_path):
    """As after a crash; what PoCL makes of them has no kernels, and was kept for good."""
    env = os.environ | {"XDG_CACHE_HOME": str(tmp_path), "POCL_CACHE_DIR": str(tmp_path / "pocl")}

    def summed():
        done = subprocess.run([sys.executable, "-c", SUMMED], env=env, capture_output=True, text=True)
        return done.stdout

    assert summed() == "[30. 30.]\n"
    for damaged in ("program.bc", "program-*.npz"):
        (file,) = tmp_path.rglob(damaged)
        file.write_bytes(b"")
    assert summed() == "[30. 30.]\n"
    assert summed() == "[30. 30.]\n"
