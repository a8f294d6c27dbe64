import pickle

import numpy as np
import pyopencl as cl
import pytest
from typer.testing import CliRunner

from wavequake.cli import app
from wavequake.errors import UserError
from wavequake.kernels.device import devices, opencl
from wavequake.kernels.device.devices import (
    NUMPY,
    Device,
    choose_device,
    lens_test,
    list_devices,
    self_test,
    self_tests,
)
from wavequake.kernels.device.example import lens
from wavequake.kernels.trace.sequential import trace_sequence

CPU = Device("a processor", "cpu", "somebody", 16)
GPU = Device("Some GPU 3000", "gpu", "somebody else", 1)


class Handle:
    """A device as OpenCL shows it."""

    type = cl.device_type.CPU
    version = "OpenCL 3.0 znver3"

    def __init__(self, name, doubles=63, available=True):
        self.name, self.double_fp_config, self.available = name, doubles, available


class Platform:
    """A platform as OpenCL shows it; one without devices is broken."""

    def __init__(self, name, handles):
        self.name, self.handles = name, handles

    def get_devices(self):
        if not self.handles:
            raise RuntimeError("no driver")
        return self.handles


def forget_devices():
    for cached in (opencl.seen, devices._trusted, opencl.opencl_handle):
        cached.cache_clear()


def with_platforms(monkeypatch, platforms):
    monkeypatch.setattr(cl, "get_platforms", lambda: platforms)
    forget_devices()
    monkeypatch.setattr(opencl, "ensure_linker", lambda: None)


@pytest.fixture(autouse=True)
def real_devices_again(monkeypatch):
    yield
    monkeypatch.undo()
    forget_devices()


def test_every_listed_device_agrees_with_numpy():
    found = list_devices()
    assert found[-1] == NUMPY
    for device in found:
        assert self_test(device) < 1e-9
        assert lens_test(device) < 1e-9


@pytest.fixture
def untested(monkeypatch):
    """Devices that exist by name only."""
    monkeypatch.setattr(devices, "self_test", lambda device: 0.0)
    forget_devices()


def test_auto_prefers_a_gpu_then_a_cpu(monkeypatch, untested):
    monkeypatch.setattr(opencl, "_found", lambda: ((CPU, None), (GPU, None)))
    assert choose_device() == GPU
    assert choose_device("cpu") == CPU
    assert choose_device("gpu") == GPU
    assert choose_device("gpu 3000") == GPU
    assert choose_device("numpy") == NUMPY
    monkeypatch.setattr(opencl, "_found", lambda: ((CPU, None),))
    assert choose_device("auto") == CPU


def test_pocl_comes_first_whatever_else_is_installed(monkeypatch, untested):
    pocl = Platform(devices.POCL, [Handle("pthread-EPYC")])
    other = Platform("Another OpenCL", [Handle("EPYC")])
    for platforms in ([pocl, other], [other, pocl]):
        with_platforms(monkeypatch, platforms)
        assert choose_device().label == choose_device("cpu").label == f"{devices.POCL}: pthread-EPYC"


def test_devices_are_told_apart_by_whole_name_and_by_platform(monkeypatch, untested):
    names = [("A", "EPYC 2"), ("A", "EPYC"), ("B", "EPYC 2"), ("B", "[GPU] 7")]
    with_platforms(monkeypatch, [Platform(p, [Handle(n) for q, n in names if q == p]) for p in "AB"])
    wanted = {"EPYC": "A: EPYC", "epyc 2": "A: EPYC 2", "b": "B: EPYC 2", "B: EPYC 2": "B: EPYC 2"}
    wanted |= {"A": "A: EPYC 2", "7": "B: [GPU] 7", "A: EPYC": "A: EPYC"}
    assert {request: choose_device(request).label for request in wanted} == wanted
    for device in list_devices():  # stores keep the name alone
        assert choose_device(device.name) == device


def test_broken_platforms_and_devices_are_listed_with_the_reason_and_hide_nothing(monkeypatch, untested):
    platforms = [
        Platform("Broken", []),
        Platform("Fine", [Handle("a"), Handle("wrong"), Handle("crashes")]),
        Platform("Old", [Handle("float32", doubles=0), Handle("away", available=False)]),
    ]
    with_platforms(monkeypatch, platforms)

    def test_result(device):
        if device.name == "crashes":
            raise RuntimeError("clBuildProgram failed:\nvery\nlong")
        return {"wrong": 1e-3}.get(device.name, 1e-12)

    monkeypatch.setattr(devices, "self_test", test_result)
    monkeypatch.setattr(devices, "lens_test", lambda device: 0.0)
    rows = {device.label: result for device, result in self_tests()}
    assert list(rows) == ["Fine: a", "Fine: wrong", "Fine: crashes", "NumPy: numpy", "Broken: -"]
    assert rows["Fine: a"] == rows["NumPy: numpy"] == "1.0e-12"
    assert rows["Fine: wrong"].startswith("unusable: it computes wrong numbers, 1.0e-03 mm")
    assert rows["Fine: crashes"] == "unusable: clBuildProgram failed:"
    assert rows["Broken: -"] == "unusable: no driver"
    result = CliRunner().invoke(app, ["devices"])
    assert result.exit_code == 0
    assert "no driver" in result.output
    with pytest.raises(UserError, match=r"'Fine: crashes' is unusable: clBuildProgram failed:"):
        choose_device("crashes")


def test_a_request_that_nothing_fits_names_what_there_is(monkeypatch):
    monkeypatch.setattr(opencl, "_found", lambda: ((CPU, None),))
    for request in ("gpu", "other", ""):
        with pytest.raises(UserError, match="a processor"):
            choose_device(request)


def test_without_opencl_the_error_says_what_to_install(monkeypatch):
    monkeypatch.setattr(opencl, "_found", lambda: ())
    assert list_devices() == [NUMPY]
    assert choose_device("numpy") == NUMPY
    with pytest.raises(UserError, match=r"pip install pocl-binary-distribution.*campaign\.device=numpy"):
        choose_device()


def test_a_device_travels_to_another_process():
    assert pickle.loads(pickle.dumps(GPU)) == GPU


@pytest.mark.parametrize("difference", [1e-6, float("nan")])
def test_a_device_that_computes_something_else_is_refused(monkeypatch, untested, difference):
    monkeypatch.setattr(opencl, "_found", lambda: ((GPU, None),))
    monkeypatch.setattr(devices, "self_test", lambda device: difference)
    with pytest.raises(UserError, match=r"computes wrong numbers.*campaign\.device=numpy"):
        choose_device()


def test_the_example_lens_bends_and_loses_no_ray():
    sequence, rays, moving = lens()
    traced = trace_sequence(sequence, rays, moving, NUMPY)
    assert (traced.status == 0).all()
    assert np.abs(traced.x).max() < 0.5 * np.abs(rays.position[0]).max()
    assert np.ptp(traced.path) > 1e-3
