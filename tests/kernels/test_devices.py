import pickle

import numpy as np
import pytest

from wavequake.errors import UserError
from wavequake.kernels import devices
from wavequake.kernels.devices import NUMPY, Device, choose_device, list_devices, self_test
from wavequake.kernels.example import lens
from wavequake.kernels.sequential import trace_sequence

CPU = Device("a processor", "cpu", "somebody", 16)
GPU = Device("Some GPU 3000", "gpu", "somebody else", 1)


def test_every_listed_device_agrees_with_numpy():
    found = list_devices()
    assert found[-1] == NUMPY
    for device in found:
        assert self_test(device) < 1e-9


@pytest.fixture
def untested(monkeypatch):
    """Devices that exist by name only."""
    monkeypatch.setattr(devices, "self_test", lambda device: 0.0)
    devices._trusted.cache_clear()
    yield
    devices._trusted.cache_clear()


def test_auto_prefers_a_gpu_then_a_cpu(monkeypatch, untested):
    monkeypatch.setattr(devices, "_found", lambda: ((CPU, None), (GPU, None)))
    assert choose_device() == GPU
    assert choose_device("cpu") == CPU
    assert choose_device("gpu") == GPU
    assert choose_device("gpu 3000") == GPU
    assert choose_device("numpy") == NUMPY
    monkeypatch.setattr(devices, "_found", lambda: ((CPU, None),))
    assert choose_device("auto") == CPU


def test_a_request_that_nothing_fits_names_what_there_is(monkeypatch):
    monkeypatch.setattr(devices, "_found", lambda: ((CPU, None),))
    for request in ("gpu", "other", ""):
        with pytest.raises(UserError, match="a processor"):
            choose_device(request)


def test_without_opencl_the_error_says_what_to_install(monkeypatch):
    monkeypatch.setattr(devices, "_found", lambda: ())
    assert list_devices() == [NUMPY]
    assert choose_device("numpy") == NUMPY
    with pytest.raises(UserError, match=r"pip install pocl-binary-distribution.*campaign\.device=numpy"):
        choose_device()


def test_a_device_travels_to_another_process():
    assert pickle.loads(pickle.dumps(GPU)) == GPU


@pytest.mark.parametrize("difference", [1e-6, float("nan")])
def test_a_device_that_computes_something_else_is_refused(monkeypatch, untested, difference):
    monkeypatch.setattr(devices, "_found", lambda: ((GPU, None),))
    monkeypatch.setattr(devices, "self_test", lambda device: difference)
    with pytest.raises(UserError, match=r"computes wrong numbers.*campaign\.device=numpy"):
        choose_device()


def test_the_example_lens_bends_and_loses_no_ray():
    sequence, rays, moving = lens()
    traced = trace_sequence(sequence, rays, moving, NUMPY)
    assert (traced.status == 0).all()
    assert np.abs(traced.x).max() < 0.5 * np.abs(rays.position[0]).max()
    assert np.ptp(traced.path) > 1e-3
