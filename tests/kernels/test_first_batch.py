"""A device that computes something else than NumPy is refused at the first batch of any program."""

import numpy as np
import pytest

from wavequake.errors import UserError
from wavequake.kernels.device import first_batch
from wavequake.kernels.device.devices import list_devices
from wavequake.kernels.device.example import lens, two_mirrors
from wavequake.kernels.device.first_batch import compare_first
from wavequake.kernels.trace import segmented, sequential
from wavequake.kernels.trace.segmented import trace_segmented
from wavequake.kernels.trace.sequential import trace_sequence

DEVICES = [device for device in list_devices() if device.kind != "numpy"]
BY = np.linspace(1.0, 2.0, 40)


@pytest.fixture(autouse=True)
def nothing_trusted(monkeypatch):
    monkeypatch.setattr(first_batch, "_TRUSTED", set())


def trace_lens(device):
    trace_sequence(*lens(), device)


def trace_mirrors(device):
    trace_segmented(**two_mirrors(), device=device)


def shifted(outputs):
    outputs[0][...] += 1e-5


def of_other_rays(outputs):
    outputs[1][...] = np.roll(outputs[1], 1, axis=1)


def lost(outputs):
    outputs[0][...] = np.nan


def left_alone(outputs):
    pass


@pytest.mark.parametrize("device", DEVICES, ids=lambda device: device.name)
@pytest.mark.parametrize(("module", "trace"), [(sequential, trace_lens), (segmented, trace_mirrors)])
@pytest.mark.parametrize("spoil", [shifted, of_other_rays, lost, left_alone])
def test_a_program_that_computes_something_else_is_refused(monkeypatch, device, module, trace, spoil):
    launch = module.launch

    def spoiled(device, name, constants, size, inputs, outputs, *more):
        launch(device, name, constants, size, inputs, outputs, *more)
        spoil(outputs)

    monkeypatch.setattr(module, "launch", spoiled)
    if spoil is left_alone:
        trace(device)
        assert first_batch._TRUSTED
        return
    with pytest.raises(UserError, match=r"rays of the first batch .*campaign\.device=numpy"):
        trace(device)
    assert not first_batch._TRUSTED


@pytest.mark.parametrize("device", DEVICES, ids=lambda device: device.name)
def test_later_batches_are_not_compared(monkeypatch, device):
    trace_lens(device)
    monkeypatch.setattr(sequential, "trace_sequence_numpy", None)
    trace_lens(device)


def test_rays_at_edges_and_grazing_ones_are_no_error():
    found = BY.copy()
    found[:8], found[-4:] = np.nan, 3.0
    compare_first(DEVICES[0] if DEVICES else None, "program", [found], lambda pick: [BY[pick]])
    assert first_batch._TRUSTED


def test_a_batch_without_light_leaves_the_comparison_to_the_next():
    dark = np.full(40, np.nan)
    compare_first(None, "program", [dark], lambda pick: [dark[pick]])
    compare_first(None, "program", [BY[:0]], lambda pick: [BY[:0]])
    compare_first(None, "program", [], lambda pick: [])
    assert not first_batch._TRUSTED
