import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from wavequake.errors import UserError
from wavequake.kernels.device.devices import NUMPY, Device, list_devices
from wavequake.kernels.sums.strehl import strehl_ratios

DEVICES = list_devices()
DEVICES += [Device(device.name, "gpu", device.platform, 1) for device in DEVICES if device.kind == "cpu"]
NAMES = {"argvalues": DEVICES, "ids": lambda device: f"{device.kind}-{device.vector_width}"}


@pytest.mark.parametrize("device", **NAMES)
@pytest.mark.parametrize("patches", [1, 3, 37, 492])
def test_ratios_are_the_sum_written_out(device, patches):
    random = np.random.default_rng(patches)
    phase, weight = random.normal(0, 5, (70, patches)), random.uniform(0.5, 2, patches)
    cosine, sine = (wave(phase.astype(np.longdouble)) @ weight for wave in (np.cos, np.sin))
    expected = (cosine**2 + sine**2) / weight.sum() ** 2
    assert np.abs(strehl_ratios(phase, weight, device) - expected).max() < 1e-14


@pytest.mark.parametrize("device", **NAMES)
def test_closed_forms(device):
    assert strehl_ratios(np.full((1, 37), 2.0), np.ones(37), device)[0] == pytest.approx(1, abs=1e-15)
    opposite = np.where(np.arange(37) < 9, np.pi, 0.0)[None]
    assert strehl_ratios(opposite, np.ones(37), device)[0] == pytest.approx((19 / 37) ** 2, abs=1e-15)


@pytest.mark.parametrize("device", **NAMES)
def test_instants_do_not_depend_on_each_other(device):
    phase, weight = np.random.default_rng(1).normal(0, 1, (300, 37)), np.ones(37)
    healthy = strehl_ratios(phase, weight, device)
    assert np.array_equal(healthy, [strehl_ratios(row[None], weight, device)[0] for row in phase])
    phase[5, 35] = np.nan
    broken = strehl_ratios(phase, weight, device)
    assert np.isnan(broken[5])
    assert np.array_equal(np.delete(broken, 5), np.delete(healthy, 5))
    assert strehl_ratios(phase[:0], weight, device).shape == (0,)


SEEDS = st.integers(0, 2**32 - 1)


def contract(device, patches, seed, steepness, dark):
    """Ratios of the device and of the NumPy twin."""
    random = np.random.default_rng(seed)
    phase = 10.0**steepness * random.normal(size=(random.integers(1, 200), patches))
    weight = random.uniform(0.1, 2.0, patches) * (random.uniform(size=patches) >= dark)
    weight[random.integers(patches)] = 1.0  # no pupil is all dark
    return strehl_ratios(phase, weight, device), strehl_ratios(phase, weight, NUMPY)


@pytest.mark.parametrize("device", [device for device in DEVICES if device.kind != "numpy"], ids=NAMES["ids"])
@pytest.mark.parametrize(
    "patches", [1, 2, 7, 8, 19, 36, 130]
)  # each is built: fewer than lanes, and left over
@given(seed=SEEDS, steepness=st.floats(-6.0, 3.0), dark=st.floats(0.0, 0.9))
def test_ratios_are_those_of_the_twin(device, patches, seed, steepness, dark):
    found, twin = contract(device, patches, seed, steepness, dark)
    assert np.abs(found - twin).max() < 5e-15


@pytest.mark.parametrize("device", [device for device in DEVICES if device.kind != "numpy"], ids=NAMES["ids"])
@settings(max_examples=4)  # each is built
@given(patches=st.integers(1, 600), seed=SEEDS, steepness=st.floats(-6.0, 3.0))
def test_ratios_of_any_number_of_patches_are_those_of_the_twin(device, patches, seed, steepness):
    found, twin = contract(device, patches, seed, steepness, 0.2)
    assert np.abs(found - twin).max() < 5e-15


@given(SEEDS, st.integers(1, 40), st.integers(1, 40))
def test_ratios_do_not_depend_on_the_order_or_a_common_phase(seed, patches, instants):
    """Neither do they exceed 1."""
    random = np.random.default_rng(seed)
    phase, weight = random.normal(0, 2, (instants, patches)), random.uniform(0.1, 2.0, patches)
    order = random.permutation(patches)
    ratios = strehl_ratios(phase, weight, NUMPY)
    assert ratios.max() <= 1.0 + 1e-14
    assert np.abs(strehl_ratios(phase[:, order] + 0.7, 3.0 * weight[order], NUMPY) - ratios).max() < 1e-14


def test_bad_input_is_refused():
    with pytest.raises(UserError, match="3 patches need phases of shape"):
        strehl_ratios(np.zeros((2, 4)), np.ones(3), NUMPY)
    with pytest.raises(UserError, match="not sum to 0"):
        strehl_ratios(np.zeros((2, 2)), np.array([1.0, -1.0]), NUMPY)
