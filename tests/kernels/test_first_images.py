"""A device that computes images, transforms or Strehl ratios unlike NumPy's is refused at the first batch."""

import numpy as np
import pytest

from wavequake.errors import UserError
from wavequake.kernels import first_batch, fourier
from wavequake.kernels.devices import list_devices

CPUS = [device for device in list_devices() if device.kind == "cpu"]
DEVICES = pytest.mark.parametrize("device", CPUS, ids=lambda device: device.name)
RANDOM = np.random.default_rng(7)


@pytest.fixture(autouse=True)
def nothing_trusted(monkeypatch):
    monkeypatch.setattr(first_batch, "_TRUSTED", set())


def larger(outputs):
    for out in outputs.values():
        out *= 1.5


def lost(outputs):
    for out in outputs.values():
        out.fill(np.nan)


def dark(outputs):
    for out in outputs.values():
        out.fill(0.0)


def mirrored(outputs):
    for out in outputs.values():
        out[...] = out[:, ::-1].copy()


def spoil(monkeypatch, module, how):
    """Let what a module's launches write go wrong."""
    real = module.run_steps

    def wrong(device, steps, inputs, outputs, scratch):
        real(device, steps, inputs, outputs, scratch)
        how(outputs)

    monkeypatch.setattr(module, "run_steps", wrong)


def check(monkeypatch, module, call, ways):
    """A call is refused in each way to go wrong, and passes, once compared, when it is right again."""
    real = module.run_steps
    for how in ways:
        spoil(monkeypatch, module, how)
        with pytest.raises(UserError, match="computes wrong numbers"):
            call()
        assert not first_batch._TRUSTED
        monkeypatch.setattr(module, "run_steps", real)
    call()
    assert first_batch._TRUSTED
    spoil(monkeypatch, module, larger)
    call()  # later batches are not compared
    monkeypatch.setattr(module, "run_steps", real)


def smooth(rows, columns):
    """A round pupil: few of the numbers of its transform are large."""
    y, x = np.mgrid[-1 : 1 : rows * 1j, -1 : 1 : columns * 1j]
    return np.stack([(x**2 + y**2 < 0.2) * np.exp(1j * (x + 2 * y)), np.full((rows, columns), np.nan)])


@DEVICES
@pytest.mark.parametrize("inverse", [False, True])
@pytest.mark.parametrize("dtype", [np.complex64, np.complex128])
@pytest.mark.parametrize("size", [1e-12, 1e12])
def test_transforms(device, monkeypatch, dtype, inverse, size):
    values = (size * smooth(64, 64)).astype(dtype)
    for given in (values, values[::-1]):
        first_batch._TRUSTED.clear()
        ways = (larger, dark, lost, mirrored)
        check(monkeypatch, fourier, lambda g=given: fourier.fourier_2d(g, inverse, device, "opencl"), ways)


@DEVICES
def test_a_transform_of_another_sign_is_refused(device, monkeypatch):
    values = RANDOM.normal(size=(1, 45, 60)) + 1j
    real = fourier._plan
    monkeypatch.setattr(fourier, "_plan", lambda *given: real(*given[:3], not given[3], given[4]))
    with pytest.raises(UserError, match="of 16 rows of the image of the first batch 16 differ"):
        fourier.fourier_2d(values, device=device, engine="opencl")
    monkeypatch.setattr(fourier, "_plan", real)
    fourier.fourier_2d(0.0 * values, device=device, engine="opencl")
    assert not first_batch._TRUSTED  # nothing to compare yet
    fourier.fourier_2d(values, device=device, engine="opencl")
    assert first_batch._TRUSTED
