"""The promise of the whole: the real study gives the same bits however it is run."""

import numpy as np
from threadpoolctl import threadpool_limits

import wavequake as wq

CASES = 8


def test_serial_and_interrupted_and_parallel_runs_agree_bit_for_bit(tmp_path):
    """One process with two BLAS threads; two workers in two runs, the first ending in a short chunk."""
    keys = {"store__chunk_cases": 4, "imaging__pixels": 32}
    with threadpool_limits(2):
        serial = wq.run("tmt-segments", cases=CASES, store=tmp_path / "serial", **keys).load()
    keys |= {"store": tmp_path / "local", "on": "local", "workers": 2}
    wq.run("tmt-segments", cases=3, **keys)
    local = wq.run("tmt-segments", cases=CASES, **keys).load()
    assert (serial.status == 1).all()
    for name in serial.data_vars:
        np.testing.assert_array_equal(local[name].values, serial[name].values, err_msg=name)
