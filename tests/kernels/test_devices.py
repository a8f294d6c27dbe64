import pickle

import pytest

from wavequake.errors import UserError
from wavequake.kernels import devices
from wavequake.kernels.devices import NUMPY, Device, choose_device, list_devices, self_test

CPU = Device("a processor", "cpu", "somebody", 16)
GPU = Device("Some GPU 3000", "gpu", "somebody else", 1)


def test_every_listed_device_agrees_with_numpy():
    found = list_devices()
    assert found[-1] == NUMPY
    for device in found:
        assert self_test(device) < 1e-9


def test_auto_prefers_a_gpu_then_a_cpu(monkeypatch):
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
