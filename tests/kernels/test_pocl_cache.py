"""A home or a cache that nobody can write does not take PoCL away."""

import os
import subprocess
import sys

import pytest

from wavequake.kernels.device.devices import list_devices

SEEN = """
from wavequake.kernels.device.devices import list_devices
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
