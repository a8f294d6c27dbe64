"""Dask stays out of processes that have no array of it, and arrays of it are known where it is."""

import subprocess
import sys

import numpy as np
import xarray as xr

from wavequake.campaign.store.spared import spare_dask

CODE = """
import sys
import numpy as np
from wavequake.campaign.store.whole import labelled
found = labelled({"a": (("x",), np.arange(3.0), {})}, {"x": (("x",), np.arange(3), {})}, {})
assert found["x"].to_numpy().tolist() == [0, 1, 2]
assert "dask" not in sys.modules
"""


def test_a_dataset_of_numpy_s_arrays_loads_no_dask():
    subprocess.run([sys.executable, "-c", CODE], check=True)


def test_arrays_of_dask_stay_lazy():
    spare_dask()
    spare_dask()
    lazy = xr.DataArray(np.arange(6.0), dims="x").chunk(x=2)
    assert lazy.chunks == ((2, 2, 2),)
    assert (2 * lazy).chunks == ((2, 2, 2),)
    assert float((2 * lazy).sum()) == 30.0
