"""Where the time of a campaign went: kinds of work and kernels, by the journal."""

import re

import pytest

import wavequake as wq
from wavequake.kernels.devices import list_devices
from wavequake.workflows.campaign import profile

SMALL = {"optics.rays": 40, "store.chunk_cases": 2}


def test_kinds_of_work_and_kernels_have_their_shares(tmp_path):
    if len(list_devices()) == 1:
        pytest.skip("needs an OpenCL device")
    store = tmp_path / "store"
    wq.run("double-gauss", cases=4, store=store, on="serial", **SMALL)
    told = profile(store)
    shares = {name: float(line.split()[2].rstrip("%")) for name, line in told.items() if " s  " in line}
    assert sum(share for name, share in shares.items() if not name.startswith("kernel ")) == pytest.approx(
        100.0, abs=0.5
    )
    for kernel in ("sequential", "coefficients", "moments"):
        found = re.fullmatch(r" *([\d.]+) s +([\d.]+)%  (\d+) x ([\d.e-]+) ms", told[f"kernel {kernel}"])
        assert found is not None, told
        seconds, _, launches, each = map(float, found.groups())
        assert launches >= 9 * 2  # fields and wavelengths of every chunk
        assert seconds == pytest.approx(1e-3 * each * launches, abs=6e-3)


def test_numpy_launches_no_kernels(tmp_path):
    store = tmp_path / "store"
    wq.run("double-gauss", cases=2, store=store, on="serial", **{"campaign.device": "numpy"} | SMALL)
    assert not [name for name in profile(store) if name.startswith("kernel ")]
