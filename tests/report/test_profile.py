"""Where the time of a campaign went: kinds of work and kernels, by the journal."""

import re

import numpy as np
import pytest

import wavequake as wq
from wavequake.kernels.device import opencl
from wavequake.kernels.device.devices import Device, list_devices, opencl_handle
from wavequake.report.answers.profile import profile

SMALL = {"optics.rays": 40, "store.chunk_cases": 2, "imaging.pixels": 16}
SMALL |= {"disturbance.vibration.instants": 8, "disturbance.all.instants": 8}


def test_kinds_of_work_and_kernels_have_their_shares(tmp_path):
    if len(list_devices()) == 1:
        pytest.skip("needs an OpenCL device")
    store = tmp_path / "store"
    wq.run("double-gauss", cases=4, store=store, on="serial", **SMALL)
    told = profile(store)
    shares = {name: float(line.split()[2].rstrip("%")) for name, line in told.items() if " s  " in line}
    assert shares.pop("all chunks") == 100.0
    assert sum(share for name, share in shares.items() if not name.startswith("kernel ")) == pytest.approx(
        100.0, abs=0.5
    )
    assert all(told[name].endswith(" s CPU") for name in ("draw", "trace", "wavefront", "all chunks"))
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


def test_a_device_with_memory_of_its_own_gives_no_rays_away(tmp_path, monkeypatch):
    """A processor that poses as one, with a campaign's numbers and how much was copied for them."""
    cpu = next((device for device in list_devices() if device.kind == "cpu"), None)
    if cpu is None:
        pytest.skip("needs an OpenCL processor")
    found, options = {}, {"on": "serial", "optics.rays": 400, "store.chunk_cases": 2}
    for kind in ("cpu", "gpu"):
        device = Device(cpu.name, kind, cpu.platform, 1 if kind == "gpu" else cpu.vector_width)
        handle = opencl_handle(cpu)
        monkeypatch.setattr(opencl, "_found", lambda pair=(device, handle): (pair,))
        found[kind] = wq.run("double-gauss", cases=4, store=tmp_path / kind, **options)
    told = {kind: profile(tmp_path / kind) for kind in found}
    assert not [name for name in told["cpu"] if name.startswith("copied")]
    to, back = (float(told["gpu"][f"copied {way} device"].removesuffix(" MB")) for way in ("to", "from"))
    instants, rays = found["gpu"]["wfe_rms"][..., 0, 0].size, 400
    assert 0.1 < back < 0.25e-6 * 9 * instants * rays * 26
    assert to > 0.1
    for name in ("wfe_rms", "zernike", "los_mm", "strehl", "spot_rms"):
        one, other = (found[kind][name].values for kind in ("gpu", "cpu"))
        np.testing.assert_allclose(one, other, rtol=0.0, atol=1e-6 * np.nanmax(np.abs(other)), err_msg=name)
