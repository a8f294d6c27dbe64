"""The OpenCL transform against the textbook's double sum, and its edges."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from wavequake.kernels.device.devices import Device, list_devices
from wavequake.kernels.transforms import folded as module
from wavequake.kernels.transforms.folded import folded_images, folded_sum, folded_transform
from wavequake.kernels.transforms.folded_pupils import LitPhase

OPENCL = [device for device in list_devices() if device.kind != "numpy"]
OPENCL += [Device(device.name, "gpu", device.platform, 1) for device in OPENCL if device.kind == "cpu"]
NAMES = {"argvalues": OPENCL, "ids": lambda device: f"{device.kind}-{device.vector_width}"}
# Even and odd, an image that reaches to the period, and fewer cells than lanes. Each is built.
# In the last, fewer numbers than pixels make the image.
SIZES = [(24, 10, 0.5), (33, 21, 0.3), (20, 13, 1.5), (9, 6, 0.5), (40, 96, 0.1)]
TOLERANCE = {"float64": 1e-14, "float32": 2e-6}


def double_sum(field, pixels, sampling):
    """The transform written out, in 80-bit numbers, with no symmetry."""
    n = len(field)
    x = (np.arange(n, dtype=np.longdouble) + 0.5) / n - 0.5
    f = (np.arange(pixels) - pixels // 2) * np.longdouble(sampling)
    wave = np.exp(-2j * np.longdouble(np.pi) * np.outer(f, x))
    return np.abs(wave @ field @ wave.T) ** 2


def case(samples, seed, batch=3, phase=3.0):
    random = np.random.default_rng(seed)
    amplitude = random.uniform(0, 1, (samples, samples)) * (random.uniform(0, 1, (samples, samples)) > 0.3)
    amplitude[: samples // 5] = 0.0  # dark rows, and a pupil without any symmetry
    return amplitude, random.normal(0, phase, (batch, samples, samples))


@pytest.mark.parametrize("device", **NAMES)
@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize(("samples", "pixels", "sampling"), SIZES)
def test_images_are_the_double_sum(device, dtype, samples, pixels, sampling):
    amplitude, phase = case(samples, 5)
    peak = amplitude.sum() ** 2
    transform = folded_transform(amplitude, pixels, sampling, 1 / peak, device, dtype)
    expected = [double_sum(amplitude * np.exp(1j * p), pixels, sampling) / peak for p in phase]
    assert transform.width == 1 or device.kind == "cpu"
    fields = [amplitude * np.exp(1j * phase)] * (samples in (24, 33))  # even and odd: programs of their own
    for pupils in (phase, *fields):
        images = folded_images(transform, pupils)
        assert images.dtype == dtype
        assert np.abs(images - np.array(expected)).max() < TOLERANCE[dtype]


@pytest.mark.parametrize("device", **NAMES)
@given(seed=st.integers(0, 2**32 - 1), phase=st.sampled_from([0.0, 1.0, 30.0, 1e4]))
def test_any_phase_is_reduced_without_loss(device, seed, phase):
    amplitude, pupils = case(24, seed, 1, phase)
    amplitude[8, 8] = 1.0
    peak = amplitude.sum() ** 2
    images = folded_images(folded_transform(amplitude, 10, 0.5, 1 / peak, device), pupils)
    expected = double_sum(amplitude * np.exp(1j * pupils[0].astype(np.longdouble)), 10, 0.5) / peak
    # The phase itself, ramp included, is rounded to half a unit of its last place.
    assert np.abs(images[0] - expected).max() < 1e-14 + 4e-16 * phase


@pytest.mark.parametrize("device", **NAMES)
def test_an_instant_does_not_depend_on_its_batch(device):
    amplitude, phase = case(24, 1, batch=19)
    transform = folded_transform(amplitude, 10, 0.5, 1.0, device)
    alone = np.concatenate([folded_images(transform, pupil[None]) for pupil in phase])
    assert np.array_equal(folded_images(transform, phase), alone)


@pytest.mark.parametrize("device", **NAMES)
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_the_sum_adds_image_after_image(device, dtype):
    amplitude, phase = case(24, 2, batch=19)
    weights = np.random.default_rng(3).uniform(0, 1, 19)
    weights[4], phase[4] = 0.0, np.nan
    transform = folded_transform(amplitude, 10, 0.5, 1.0, device, dtype)
    images = folded_images(transform, phase).astype(float)
    start = np.random.default_rng(4).uniform(0, 1, (10, 10))
    total = start.copy()
    for weight, image in zip(weights, images, strict=True):
        total += weight * image if weight else 0.0
    found = folded_sum(transform, phase, weights, start)
    assert found == pytest.approx(total, rel=1e-15)
    parts = folded_sum(
        transform, phase[7:], weights[7:], folded_sum(transform, phase[:7], weights[:7], start)
    )
    assert np.array_equal(found, parts)


@pytest.mark.parametrize("device", **NAMES)
def test_what_is_no_number_counts_only_where_there_is_light(device):
    amplitude, phase = case(24, 6)
    phase[:, amplitude == 0.0] = np.nan
    transform = folded_transform(amplitude, 10, 0.5, 1.0, device)
    images = folded_images(transform, phase)
    assert np.isfinite(images).all()
    lit = np.argwhere(amplitude)[0]
    phase[1, lit[0], lit[1]] = np.inf
    broken = folded_images(transform, phase)
    assert np.isnan(broken[1]).all()
    assert np.array_equal(broken[[0, 2]], images[[0, 2]])


@pytest.mark.parametrize("device", **NAMES)
@pytest.mark.parametrize("samples", [24, 33, 9])
def test_phases_of_lit_cells_alone_make_the_same_images(device, samples, monkeypatch):
    random = np.random.default_rng(7)
    across = np.abs(np.arange(samples) - 0.5 * (samples - 1))
    radius = np.hypot(across, across[:, None])
    amplitude = np.where((radius < 0.5 * samples) & (radius > 0.2 * samples), 0.5, 0.0)
    amplitude[samples // 3] = 0.0  # dark rows and half rows, lit ones to the very corners
    amplitude[-2, : samples // 2] = 0.0
    amplitude[[0, -1]] = 1.0
    row, column = np.nonzero(amplitude)
    starts = np.zeros((samples, 2), np.int32)
    for patch in range(row.size):
        for side in (0, 1):
            if (column[patch] < (samples + 1) // 2, column[patch] >= samples // 2)[side]:
                starts[row[patch], side] = patch - column[patch]
    lit = random.normal(0.0, 3.0, (19, row.size))
    lit[4] = np.nan
    full = np.zeros((19, samples, samples))
    full[:, row, column] = lit
    transform = folded_transform(amplitude, 6, 0.5, 1.0, device)
    images = folded_images(transform, LitPhase(lit, starts))
    assert np.array_equal(images, folded_images(transform, full), equal_nan=True)
    monkeypatch.setattr(module, "_KEPT_BYTES", 0)
    assert np.array_equal(images, folded_images(transform, LitPhase(lit, starts)), equal_nan=True)
    assert np.isnan(images).all(axis=(1, 2)).tolist() == [i == 4 for i in range(19)]


@pytest.mark.parametrize("device", **NAMES)
def test_no_light_is_a_dark_image(device):
    transform = folded_transform(np.zeros((24, 24)), 10, 0.5, 1.0, device)
    assert not folded_images(transform, np.ones((2, 24, 24))).any()
    assert folded_images(transform, np.ones((0, 24, 24))).shape == (0, 10, 10)
