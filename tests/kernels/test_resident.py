"""Arrays that stay on a device, against arrays of NumPy."""

import copy
import gc
import pickle
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import xarray as xr
from hypothesis import given
from hypothesis import strategies as st
from scipy.sparse import csr_matrix

from wavequake.errors import UserError
from wavequake.kernels.device import first_batch, resident
from wavequake.kernels.device.devices import NUMPY, Device, list_devices
from wavequake.kernels.device.example import lens
from wavequake.kernels.device.launches import kernel_launches, launches_since
from wavequake.kernels.device.program import device_copy, device_empty
from wavequake.kernels.device.resident import Resident, device_of, floats_for
from wavequake.kernels.sums import opd
from wavequake.kernels.sums.opd import count_status, path_differences, without_planes
from wavequake.kernels.sums.ray_sums import ray_coefficients, ray_moments
from wavequake.kernels.trace.sequential import trace_sequence

OPENCL = [device for device in list_devices() if device.kind != "numpy"]
# Processors pose as devices with memory of their own.
GPUS = [Device(device.name, "gpu", device.platform, 1) for device in OPENCL]
NAMES = {"argvalues": GPUS, "ids": lambda device: device.name}
WHOLE = np.arange(7 * 5, dtype=np.float64).reshape(7, 5) - 11.0


def copied(before):
    """Bytes to and from the device since then."""
    counted = launches_since(before)
    return [counted.get(f"bytes {way} device", 0) for way in ("to", "from")]


slices = st.builds(slice, *[st.none() | st.integers(-9, 9)] * 2, st.none() | st.integers(1, 3) | st.just(-1))
KEYS = st.one_of(
    st.integers(-7, 6),
    st.integers(-7, 6).map(np.int64),
    slices,
    st.lists(st.integers(-7, 6), max_size=9).map(lambda rows: np.array(rows, dtype=np.intp)),
    st.lists(st.booleans(), min_size=7, max_size=7).map(np.array),
)
MORE = st.one_of(
    st.tuples(slices, st.integers(0, 4)),
    st.just(Ellipsis),
    st.just((slice(None), None)),
    st.just(WHOLE > 3.0),
    st.just(np.array([[1, 2], [3, 0]])),
    st.just([0, 3]),
)


@pytest.mark.parametrize("device", **NAMES)
@given(key=KEYS)
def test_some_rows_come_alone(device, key):
    array, before = device_copy(device, WHOLE), kernel_launches()
    expected = WHOLE[key]
    found = array[key]
    assert type(found) is np.ndarray
    np.testing.assert_array_equal(found, expected)
    assert found.dtype == expected.dtype
    assert copied(before) == [0, expected.nbytes]
    all_shown = isinstance(key, slice) and len(expected) == len(WHOLE)
    assert device_of(array) == (None if all_shown else device)
    copied_or_all = all_shown or isinstance(key, np.ndarray)
    assert found.flags.writeable == copied_or_all  # else NumPy would show the array's own numbers
    np.testing.assert_array_equal(array, WHOLE)


@pytest.mark.parametrize("device", **NAMES)
@given(key=KEYS | MORE)
def test_parts_are_those_of_an_array(device, key):
    array, expected = device_copy(device, WHOLE), WHOLE.copy()
    np.testing.assert_array_equal(array[key], expected[key])
    array[key] = expected[key] = 3.5
    np.testing.assert_array_equal(array, expected)


@pytest.mark.parametrize("device", **NAMES)
def test_rows_that_are_not_there_are_refused_as_by_numpy(device):
    array = device_copy(device, WHOLE)
    for key in (7, -8, np.array([0, 7]), np.array([True, False])):
        with pytest.raises(IndexError):
            array[key]
    assert device_of(array) == device


FUNCTIONS = {
    "ufunc": np.isfinite,
    "operator": lambda a: 2.0 - a,
    "other operator": lambda a: a[:, None] @ np.ones((7, 5, 2)),
    "scalar first": lambda a: np.float64(2.0) * a,
    "matrix first": lambda a: csr_matrix(np.eye(3, 7)) @ a,
    "in xarray": lambda a: xr.DataArray(a).values,
    "comparison": lambda a: (a == 3.0) | (a > 9.0),
    "array first": lambda a: np.ones(5) * a,
    "reduction": lambda a: np.sum(a, axis=1),
    "stack": lambda a: np.stack([a, WHOLE]),
    "concatenate": lambda a: np.concatenate([a, a[:2]]),
    "where": lambda a: np.where(a > 0.0, a, 0.0),
    "einsum": lambda a: np.einsum("tn,tn->t", a, a),
    "method": lambda a: a.max(axis=0),
    "transposed": lambda a: a.T.copy(),
    "rows": lambda a: np.array([row.sum() for row in a]),
    "to other numbers": lambda a: np.asarray(a, dtype=np.float32),
    "to a copy": lambda a: np.array(a),
    "pickled": lambda a: pickle.loads(pickle.dumps(a)),
    "deep copy": copy.deepcopy,
    "length": lambda a: np.array([len(a), a.size, a.ndim, a.nbytes, *a.shape]),
}


@pytest.mark.parametrize("device", **NAMES)
@pytest.mark.parametrize("name", FUNCTIONS)
def test_numpy_takes_it_as_an_array(device, name):
    found, expected = FUNCTIONS[name](device_copy(device, WHOLE)), FUNCTIONS[name](WHOLE)
    assert type(found) is type(expected)
    assert found.dtype == expected.dtype
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("device", **NAMES)
def test_it_comes_once_and_then_the_host_has_it(device):
    array, before = device_copy(device, WHOLE), kernel_launches()
    host = np.asarray(array)
    assert np.asarray(array) is host
    assert array.numpy() is host
    assert copied(before) == [0, WHOLE.nbytes]
    assert device_of(array) is None
    host[2, 3] = np.nan  # what is written there counts
    array += 1.0
    assert array is host
    waves = device_copy(device, WHOLE)
    waves[4] = np.nan
    _, lost = ray_coefficients(np.ones((3, 5)), waves, device)
    assert lost.tolist() == [0, 0, 0, 0, 5, 0, 0]


@pytest.mark.parametrize("device", **NAMES)
def test_names_that_arrays_lack_are_refused(device):
    array = device_copy(device, WHOLE)
    for name in ("rows", "_mask", "__cuda_array_interface__"):
        assert not hasattr(array, name)


def test_processors_keep_their_arrays():
    for device in OPENCL:
        if device.kind == "cpu":
            assert device_copy(device, WHOLE) is WHOLE
            assert type(device_empty(device, (3, 4))) is np.ndarray
    for device in GPUS:
        assert type(device_empty(device, (0, 4))) is np.ndarray
        assert type(device_copy(device, WHOLE[:0])) is np.ndarray


@pytest.mark.parametrize("device", **NAMES)
@given(seed=st.integers(0, 2**32 - 1), rays=st.sampled_from([1, 63, 64, 65, 300]), instants=st.integers(1, 9))
def test_wavefronts_are_made_there_to_the_bits_of_numpy(device, seed, rays, instants):
    random = np.random.default_rng(seed)
    path, chief = random.normal(1e3, 1e-3, (instants, rays)), random.normal(1e3, 1e-3, instants)
    path[random.random(path.shape) < 0.1] = np.nan
    slopes, planes = random.normal(size=(2, rays)), random.normal(size=(instants, 2))
    status = random.integers(0, 4, path.shape).astype(np.int8)
    there, before = [device_copy(device, values) for values in (path, status)], kernel_launches()
    waves = path_differences(there[0], chief, 5e-4)
    rest = without_planes(waves, slopes, planes)
    counts = count_status(there[1], 1)
    assert all(device_of(values) == device for values in (*there, waves, rest))
    assert copied(before)[0] == chief.nbytes + slopes.nbytes + planes.nbytes
    expected = path_differences(path, chief, 5e-4)
    np.testing.assert_array_equal(waves, expected)
    np.testing.assert_array_equal(rest, without_planes(expected, slopes, planes))
    assert counts.tolist() == np.sum(status == 1, axis=1).tolist() == count_status(status, 1).tolist()


@pytest.mark.parametrize("device", **NAMES)
@pytest.mark.parametrize(("right", "wrong"), [("chief[instant] -", "chief[0] -"), ("+ ray;", "+ ray / 2;")])
def test_a_device_that_makes_them_wrong_is_refused(device, right, wrong, monkeypatch):
    text = opd._text()
    assert right in text
    monkeypatch.setattr(opd, "_text", lambda: text.replace(right, wrong))
    monkeypatch.setattr(first_batch, "_TRUSTED", set())
    path = device_copy(device, np.random.default_rng(1).normal(size=(20, 30)))
    with pytest.raises(UserError, match="computes wrong numbers: of 480 numbers"):
        path_differences(path, np.arange(20.0), 1.0)


@pytest.mark.parametrize("device", **NAMES)
def test_sums_take_what_is_there(device):
    random = np.random.default_rng(4)
    waves, x, y = random.normal(size=(3, 9, 200))
    matrix, weight, slopes = random.normal(size=(6, 200)), np.ones(200), random.normal(size=(2, 200))
    ray_coefficients(matrix, waves, device)
    expected = ray_moments(waves, x, y, weight, slopes, np.zeros((9, 2)), device)
    there, before = [device_copy(device, values) for values in (waves, x, y)], kernel_launches()
    sums, _ = ray_coefficients(matrix, there[0], device)
    found = ray_moments(*there, weight, slopes, np.zeros((9, 2)), device)
    to, back = copied(before)
    assert to <= matrix.nbytes + weight.nbytes + slopes.nbytes + 9 * 16
    assert back == 9 * (6 * 8 + 4 + 8 * 8)
    for name, values in vars(expected).items():
        np.testing.assert_array_equal(getattr(found, name), values)
    np.testing.assert_array_equal(sums, ray_coefficients(matrix, waves, device)[0])
    # Elsewhere they are taken as arrays.
    np.testing.assert_allclose(ray_coefficients(matrix, there[0], NUMPY)[0], sums, atol=1e-12)
    assert device_of(there[0]) is None
    assert floats_for(device, there[1]) is there[1]
    assert type(floats_for(device, device_copy(device, np.ones(3, np.float32)))) is np.ndarray


@pytest.mark.parametrize("device", **NAMES)
def test_a_matrix_that_nobody_writes_goes_there_once(device):
    matrix, values = np.random.default_rng(2).normal(size=(5, 300)), np.ones((1, 300))
    expected = ray_coefficients(matrix, values, device)[0]
    matrix.flags.writeable = False
    ray_coefficients(matrix, values, device)
    before = kernel_launches()
    np.testing.assert_array_equal(ray_coefficients(matrix, values, device)[0], expected)
    assert copied(before)[0] == values.nbytes


@pytest.mark.parametrize("device", **NAMES)
def test_memory_is_bounded_by_bringing_the_oldest_to_the_host(device, monkeypatch):
    monkeypatch.setattr(resident, "_KEPT", type(resident._KEPT)())
    monkeypatch.setattr(resident, "_KEPT_BYTES", 3 * WHOLE.nbytes)
    arrays = [device_copy(device, WHOLE + i) for i in range(3)]
    ray_coefficients(np.ones((1, 5)), arrays[0], device)  # used again, so that it is not the oldest any more
    arrays += [device_copy(device, WHOLE + i) for i in range(3, 5)]
    assert [i for i, array in enumerate(arrays) if device_of(array)] == [0, 3, 4]
    for i, array in enumerate(arrays):
        np.testing.assert_array_equal(array, WHOLE + i)
    path = device_copy(device, np.ones((40, 5)))  # larger than all that may be kept
    waves = path_differences(path, np.full(40, 3.0), 2.0)
    np.testing.assert_array_equal(waves, np.ones((40, 5)))


@pytest.mark.parametrize("device", **NAMES)
def test_what_nobody_has_any_more_takes_no_memory(device):
    gc.collect()
    before = len(resident._KEPT)
    arrays = [device_copy(device, WHOLE) for _ in range(4)]
    assert len(resident._KEPT) == before + 4
    arrays[0].numpy()
    assert len(resident._KEPT) == before + 3
    path_differences(arrays[1], np.zeros(7), 1.0)
    buffer = arrays[1]._place
    del arrays
    assert len(resident._KEPT) == before
    assert sys.getrefcount(buffer) == 2  # this name, and what asks
    assert buffer.reference_count == 1


@pytest.mark.parametrize("device", **NAMES)
def test_a_device_without_memory_is_told_in_a_sentence(device):
    with pytest.raises(UserError, match=r"has not enough memory left \(\w+\); end other programs"):
        device_copy(device, np.broadcast_to(0.0, (1 << 45,)))


@pytest.mark.parametrize("device", **NAMES)
def test_copies_are_of_arrays_that_lie_anyhow(device):
    for array in (np.broadcast_to(WHOLE[0], (7, 5)), WHOLE[::-2, 1:4], WHOLE.T):
        np.testing.assert_array_equal(device_copy(device, array), array)


@pytest.mark.parametrize("device", **NAMES)
def test_threads_share_it(device):
    """Some fetch while others sum, and all get the one array that there is."""
    random = np.random.default_rng(7)
    values, matrix = random.normal(size=(40, 300)), random.normal(size=(5, 300))
    expected = ray_coefficients(matrix, values, device)[0]
    for _ in range(10):
        array = device_copy(device, values)

        def work(i, array=array):
            return ray_coefficients(matrix, array, device)[0] if i % 2 else np.asarray(array)

        with ThreadPoolExecutor(8) as pool:
            found = list(pool.map(work, range(16)))
        assert all(one is found[0] for one in found[::2])
        np.testing.assert_array_equal(found[0], values)
        for one in found[1::2]:
            np.testing.assert_array_equal(one, expected)


@pytest.mark.parametrize("device", **NAMES)
def test_a_trace_stays_and_its_memory_is_used_again(device):
    traced = trace_sequence(*lens(), device)
    before, places = kernel_launches(), [traced.path._place, traced.status._place]
    again = trace_sequence(*lens(), device, out=traced)
    assert [again.path._place, again.status._place] == places
    assert copied(before)[1] == 0
    expected = trace_sequence(*lens(), NUMPY)
    for name in ("path", "x", "y", "u", "v", "w_sign", "status", "surface", "vignetted"):
        np.testing.assert_allclose(getattr(again, name), getattr(expected, name), atol=1e-9)
    for processor in OPENCL:  # which work in the host's memory
        trace_sequence(*lens(), processor, out=again)
        np.testing.assert_allclose(again.path, expected.path, atol=1e-9)


def test_what_no_launch_has_filled_is_no_devices():
    for device in GPUS:
        array = Resident(device, (2, 3), np.int8)
        assert device_of(array) is None
        assert np.asarray(array).shape == (2, 3)
