import numpy as np
import pytest
import scipy.special
from hypothesis import given, settings
from hypothesis import strategies as st

from wavequake.errors import UserError
from wavequake.kernels.device import first_batch
from wavequake.kernels.device.devices import NUMPY, Device, list_devices
from wavequake.kernels.device.program import launch, source
from wavequake.kernels.random.normals import normal_numbers, normal_quantiles

DEVICES = [device for device in list_devices() if device.kind != "numpy"]
DEVICES += [Device(device.name, "gpu", device.platform, 1) for device in DEVICES if device.kind == "cpu"]
NAMES = {"argvalues": DEVICES, "ids": lambda device: f"{device.kind}-{device.vector_width}"}
KEY = np.array([3, 2**64 - 5], np.uint64)

# Reads quantiles where no counter leads within a lifetime.
AT = """
__kernel void at(const int count, __global const double *places, __global double *found)
{
    const size_t item = get_global_id(1);
    if (item >= count)
        return;
    real q = (real)(places[item]);
    const real all = quantile(q);
    found[item] = LANE(all, 0);
}
"""


@pytest.mark.parametrize("device", **NAMES)
@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**32), before=st.integers(0, 2**62), steps=st.integers(0, 700))
def test_devices_draw_the_numbers_of_numpys_generator(device, seed, before, steps):
    key = np.random.SeedSequence(seed).generate_state(2, np.uint64)
    uniform = np.random.Generator(np.random.Philox(counter=before, key=key)).random(4 * steps)
    below, above = scipy.special.ndtri(uniform + 2.0**-54), -scipy.special.ndtri(1 - uniform - 2.0**-54)
    found = normal_numbers(key, before, steps, device)
    np.testing.assert_allclose(found, np.where(uniform < 0.5, below, above), rtol=3e-15, atol=0)
    np.testing.assert_allclose(found, normal_numbers(key, before, steps, NUMPY), rtol=3e-15, atol=0)


@pytest.mark.parametrize("device", **NAMES)
@settings(max_examples=20, deadline=None)
@given(first=st.integers(0, 200), steps=st.integers(1, 100))
def test_bits_do_not_depend_on_how_many_are_drawn(device, first, steps):
    together = normal_numbers(KEY, 1000, 300, device)
    assert np.array_equal(
        normal_numbers(KEY, 1000 + first, steps, device), together[4 * first : 4 * (first + steps)]
    )


@pytest.mark.parametrize("device", **NAMES)
def test_quantiles_to_the_ends_of_the_distribution(device):
    tails = np.concatenate(
        [[1e-3, 1e-9], 2.0 ** np.linspace(-54, -1, 4001), [np.exp(-25.0), 0.075, 0.25, 0.5 - 1e-9]]
    )
    places = np.concatenate([tails - 0.5, 0.5 - tails])
    nearer = 0.5 - np.abs(places)  # what is left of the tail as numbers about 1/2 have it
    found, width = np.empty_like(places), device.vector_width if device.kind == "gpu" else 8
    text, given = source("normals.cl") + AT, [np.int32(len(places)), places]
    launch(device, "at", (("W", width),), (1, len(places), 1), given, [found], text)
    np.testing.assert_allclose(found, np.sign(places) * -scipy.special.ndtri(nearer), rtol=2e-15, atol=1e-24)
    # Published tables; 1/2 less 1e-9 is rounded by 5e-17.
    assert found[:2] == pytest.approx([-3.090232306167813, -5.997807015007687], abs=1e-8)


def test_quantiles_are_as_exact_at_one_as_at_zero():
    grid = np.arange(1, 2**10) * 2.0**-53
    assert np.array_equal(normal_quantiles(grid - 2.0**-53), -normal_quantiles(1 - grid)[::1])
    assert np.isfinite(normal_quantiles(np.array([0.0, 1 - 2.0**-53]))).all()


@pytest.mark.parametrize("device", **NAMES)
def test_numbers_are_normal(device):
    numbers = normal_numbers(KEY, 0, 100_000, device)
    moments = [np.mean(numbers**power) for power in (1, 2, 3, 4)]
    # Standard errors of the moments of 400,000 numbers.
    assert np.abs(np.subtract(moments, [0, 1, 0, 3]) / np.sqrt(np.array([1, 2, 15, 96]) / 4e5)).max() < 4


def test_a_device_that_errs_is_refused(monkeypatch):
    first_batch._TRUSTED.clear()
    wrong = source("normals.cl").replace("3.38713287", "3.38723287")
    monkeypatch.setattr("wavequake.kernels.random.normals._text", lambda: wrong)
    with pytest.raises(UserError, match="of 16 numbers of the first batch"):
        normal_numbers(KEY, 0, 100, DEVICES[0])
    first_batch._TRUSTED.clear()
