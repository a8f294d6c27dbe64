"""Kernels that an earlier process has built: the same bits, and never believed when they are damaged."""

import numpy as np
import pytest

from wavequake import tables
from wavequake.kernels.device import program
from wavequake.kernels.device.devices import POCL, list_devices
from wavequake.kernels.device.example import two_mirrors
from wavequake.kernels.trace.segmented import trace_segmented

ON_POCL = [device for device in list_devices() if device.platform == POCL and device.kind == "cpu"]


@pytest.fixture
def built(tmp_path, monkeypatch):
    """Give a function that traces with kernels as a new process has them, and the texts that it compiled."""
    compiled = []
    from_source = program._from_source

    def counted(device, text, options):
        compiled.append(text)
        return from_source(device, text, options)

    monkeypatch.setattr(tables, "table_folder", lambda: tmp_path)
    monkeypatch.setattr(program, "_from_source", counted)

    def traced(device):
        compiled.clear()
        program._kernel.cache_clear()
        program._program.cache_clear()
        return trace_segmented(**two_mirrors(), device=device).opd, len(compiled)

    yield traced
    program._kernel.cache_clear()
    program._program.cache_clear()


@pytest.mark.parametrize("device", ON_POCL, ids=lambda device: device.kind)
@pytest.mark.parametrize("damage", ["none", "no archive", "no program"])
def test_a_kept_program_gives_the_bits_of_its_source(built, tmp_path, monkeypatch, device, damage):
    expected, compiled = built(device)
    assert compiled == 1
    (file,) = tmp_path.glob("program-*.npz")
    if damage == "no archive":
        file.write_bytes(file.read_bytes()[:1000])
    if damage == "no program":  # of another version of the driver, say
        np.savez(file, content=np.arange(256, dtype=np.uint8))
    monkeypatch.setattr(tables, "_makers", lambda: "another version of this package")
    found, compiled = built(device)
    np.testing.assert_array_equal(found, expected)
    assert compiled == (1 if damage == "no archive" else 0)
