"""The OpenCL images of segments on a lattice against their NumPy twin, and the twin against closed forms."""

from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from wavequake.kernels.device.devices import list_devices
from wavequake.kernels.transforms.lattice import lattice_images, lattice_kernel
from wavequake.kernels.transforms.lattice_numpy import lattice_images_numpy, moment_waves

CPUS = [device for device in list_devices() if device.kind == "cpu"]
TOLERANCE = {"float64": 5e-15, "float32": 2e-6}
SEEDS = st.integers(0, 2**32 - 1)
SCALE = 400.0

# Columns, rows, segments, pixels and moments: one segment, fewer than lanes, one line, holes in the lattice,
# more in one place than it has, even and odd images and the smallest one. Each is a kernel.
SIZES = [
    (1, 1, 1, 2, 6),
    (3, 1, 3, 9, 1),
    (1, 4, 4, 5, 15),
    (5, 5, 19, 16, 1),
    (6, 4, 13, 13, 6),
    (7, 13, 37, 21, 1),
    (2, 3, 20, 8, 3),
]


@cache
def arrangement(columns, rows, segments, pixels, moments):
    """Places and moments of no symmetry: numbers (2, S), lines, and transforms (J, pixels, pixels)."""
    random = np.random.default_rng([columns, rows, segments, pixels, moments])
    free = segments <= columns * rows
    place = random.choice(columns * rows, segments, replace=not free)
    lines = [(np.arange(n) - 0.5 * (n - 1)) * pitch for n, pitch in ((columns, 600.0), (rows, 350.0))]
    parts = random.normal(size=(2, moments, pixels, pixels)) / segments
    return (place % columns, place // columns), tuple(lines), parts[0] + 1j * parts[1]


def motion_of(seed, segments, steepness):
    """Three instants: pistons of several waves, and slopes that turn a segment's rim by `steepness` waves."""
    random = np.random.default_rng(seed)
    return random.normal(size=(3, segments, 3)) * [3.0, *([steepness / SCALE] * 2)]


def both(device, dtype, sizes, motion, step=1.3e-4):
    """Images of the device and the twin, and the largest irradiance that could add up (batch,)."""
    numbers, lines, moments = arrangement(*sizes)
    kernel = lattice_kernel(numbers, lines, moments, SCALE, step, device, dtype)
    found = lattice_images(kernel, motion)
    assert found.dtype == dtype
    places = np.stack([line[number] for line, number in zip(lines, numbers, strict=True)])
    known = np.nan_to_num(motion, posinf=0.0, neginf=0.0)
    waves = np.array([np.abs(moment_waves(one, len(moments), SCALE)).sum(axis=1) for one in known])
    most = waves @ np.abs(moments).max(axis=(1, 2))
    return found, lattice_images_numpy(places, moments, SCALE, step, motion), most**2


@pytest.mark.parametrize("device", CPUS, ids=lambda device: device.name[:20])
@pytest.mark.parametrize("dtype", TOLERANCE)
@pytest.mark.parametrize("sizes", SIZES, ids=str)
@given(seed=SEEDS, steepness=st.floats(0.0, 0.2), step=st.floats(1e-6, 1e-3))
def test_images_are_those_of_the_twin(device, dtype, sizes, seed, steepness, step):
    motion = motion_of(seed, sizes[2], steepness)
    found, twin, most = both(device, dtype, sizes, motion, step)
    assert (np.abs(found - twin).max(axis=(1, 2)) <= TOLERANCE[dtype] * most).all()


@pytest.mark.parametrize("device", CPUS, ids=lambda device: device.name[:20])
@settings(max_examples=5)  # each is built
@given(
    st.tuples(st.integers(1, 9), st.integers(1, 9), st.integers(1, 40), st.integers(2, 24)),
    st.sampled_from([1, 6, 15]),
    st.sampled_from(sorted(TOLERANCE)),
    SEEDS,
)
def test_images_of_any_lattice_are_those_of_the_twin(device, sizes, moments, dtype, seed):
    found, twin, most = both(device, dtype, (*sizes, moments), motion_of(seed, sizes[2], 0.1))
    assert (np.abs(found - twin).max(axis=(1, 2)) <= TOLERANCE[dtype] * most).all()


@pytest.mark.parametrize("device", CPUS, ids=lambda device: device.name[:20])
@pytest.mark.parametrize("sizes", [SIZES[3], SIZES[4]], ids=str)
@given(
    seed=SEEDS,
    where=st.integers(0, 12),
    what=st.sampled_from([np.nan, np.inf, -np.inf]),
    axis=st.integers(0, 2),
)
def test_what_is_no_number_darkens_its_own_image_alone(device, sizes, seed, where, what, axis):
    motion = motion_of(seed, sizes[2], 0.1)
    healthy, _, _ = both(device, "float64", sizes, motion)
    motion[1, where, axis] = what
    found, twin, _ = both(device, "float64", sizes, motion)
    counts = axis == 0 or sizes[4] > 1
    assert np.isnan(found[1]).all() == np.isnan(twin[1]).all() == counts
    np.testing.assert_array_equal(found[[0, 2]], healthy[[0, 2]])


@given(SEEDS)
def test_the_twin_is_the_sum_written_out(seed):
    """Exact phases over a segment of two points at (+-d, 0), whose moments are sums of two waves."""
    random = np.random.default_rng(seed)
    places, step, pixels, degree = random.normal(0.0, 500.0, (2, 4)), 2e-4, 5, 8
    motion = random.normal(size=(1, 4, 3)) * [1.0, 2e-4, 2e-4]
    d = 150.0
    frequency = (np.arange(pixels) - pixels // 2) * step
    v, u = np.meshgrid(frequency, frequency, indexing="ij")
    exponents = [(n - b, b) for n in range(degree + 1) for b in range(n + 1)]
    moments = np.array(
        [
            sum((x / SCALE) ** a * np.exp(-2j * np.pi * u * x) for x in (-d, d)) * (b == 0)
            for a, b in exponents
        ]
    )
    field = sum(
        np.exp(2j * np.pi * (p + gx * dx - u * (x + dx) - v * y))
        for (x, y), (p, gx, _) in zip(places.T, motion[0], strict=True)
        for dx in (-d, d)
    )
    found = lattice_images_numpy(places, moments, SCALE, step, motion)[0]
    # The series ends where (2 pi g d)^9 / 9! is left.
    left = (2.0 * np.pi * d * np.abs(motion[0, :, 1]).max()) ** (degree + 1) / 362880.0
    np.testing.assert_allclose(found, np.abs(field) ** 2, rtol=0, atol=64.0 * 2.0 * left + 1e-11)
