import numpy as np
import pytest
import scipy.fft
from hypothesis import given
from hypothesis import strategies as st

from wavequake.errors import UserError
from wavequake.kernels.device.devices import NUMPY, Device, list_devices
from wavequake.kernels.device.program import aligned_empty
from wavequake.kernels.transforms.fourier import choose_fourier, fourier_2d
from wavequake.kernels.transforms.fourier_source import factors, radices, row_lanes

OPENCL = [device for device in list_devices() if device.kind != "numpy"]
CPUS = [device for device in OPENCL if device.kind == "cpu"]
OPENCL += [Device(device.name, "gpu", device.platform, 1) for device in CPUS]
NAMES = {"argvalues": OPENCL, "ids": lambda device: f"{device.kind}-{device.vector_width}"}
TOLERANCE = {np.complex64: 6e-7, np.complex128: 2e-15}
# Powers of 2, 3 and 5, their products, single stages, and rows or columns fewer than lanes. Each is built.
SHAPES = [(64, 64), (45, 60), (27, 25), (2, 3), (96, 16)]
CASES = [(device, np.complex128, shape) for device in CPUS for shape in SHAPES]
CASES += [(device, np.complex64, shape) for device in CPUS for shape in SHAPES[:2]]
CASES += [(device, np.complex128, (45, 60)) for device in OPENCL if device.kind == "gpu"]


def images(shape, batch=2, seed=0, dtype=np.complex128):
    random = np.random.default_rng(seed)
    return (random.normal(size=(batch, *shape)) + 1j * random.normal(size=(batch, *shape))).astype(dtype)


@pytest.mark.parametrize(
    ("device", "dtype", "shape"), CASES, ids=[f"{d.kind}-{t.__name__}-{s[0]}x{s[1]}" for d, t, s in CASES]
)
def test_transforms_agree_with_scipy(device, dtype, shape):
    values = images(shape, dtype=dtype)
    kept = values.copy()
    for inverse, peer in ((False, scipy.fft.fft2), (True, scipy.fft.ifft2)):
        found = fourier_2d(values, inverse, device, "opencl")
        expected = peer(values.astype(np.complex128))
        assert found.dtype == dtype
        assert np.abs(found - expected).max() < TOLERANCE[dtype] * np.abs(expected).max()
    assert np.array_equal(values, kept)


@pytest.mark.parametrize("device", **NAMES)
def test_a_wave_becomes_one_number(device):
    """The definition: the wave of frequency (k, m) gives the size at (k, m) and 0 elsewhere."""
    y, x = np.mgrid[:45, :60]
    for k, m in ((0, 0), (1, 0), (0, 1), (5, 58), (33, 17)):
        wave = np.exp(2j * np.pi * (k * y / 45 + m * x / 60))
        found = fourier_2d(wave, device=device, engine="opencl")
        expected = np.zeros((45, 60))
        expected[k, m] = 45 * 60
        assert np.abs(found - expected).max() < 1e-10


@pytest.mark.parametrize("device", **NAMES)
@given(seed=st.integers(0, 2**32 - 1), rows=st.integers(0, 44), columns=st.integers(0, 59))
def test_linearity_shift_parseval_and_the_way_back(device, seed, rows, columns):
    a, b = images((45, 60), seed=seed)
    ahead = {name: fourier_2d(v, device=device, engine="opencl") for name, v in (("a", a), ("b", b))}
    scale = np.abs(ahead["a"]).max()
    mixed = fourier_2d(2.0 * a - 1j * b, device=device, engine="opencl")
    assert np.abs(mixed - 2.0 * ahead["a"] + 1j * ahead["b"]).max() < 1e-14 * scale
    moved = fourier_2d(np.roll(a, (rows, columns), (0, 1)), device=device, engine="opencl")
    k, m = np.mgrid[:45, :60]
    turn = np.exp(-2j * np.pi * (k * rows / 45 + m * columns / 60))
    assert np.abs(moved - turn * ahead["a"]).max() < 1e-13 * scale
    assert np.sum(np.abs(ahead["a"]) ** 2) == pytest.approx(45 * 60 * np.sum(np.abs(a) ** 2), rel=1e-13)
    back = fourier_2d(ahead["a"], True, device, "opencl")
    assert np.abs(back - a).max() < 1e-14


@pytest.mark.parametrize("device", **NAMES)
def test_an_image_does_not_depend_on_its_batch(device):
    values = images((45, 60), batch=5)
    alone = [fourier_2d(value, device=device, engine="opencl") for value in values]
    assert np.array_equal(fourier_2d(values, device=device, engine="opencl"), alone)
    assert np.array_equal(fourier_2d(values[:, None], device=device, engine="opencl")[:, 0], alone)


@pytest.mark.parametrize("offset", [0, 1])
@pytest.mark.parametrize("device", CPUS, ids=lambda device: device.kind)
def test_images_beyond_the_caches_do_not_depend_on_their_batch(device, offset):
    """They are transformed one after the other, and stored past the caches where they begin with a vector."""
    values = images((256, 240), batch=5)
    memory = aligned_empty((values.size + 1,), np.complex128)
    out = memory[offset : offset + values.size].reshape(values.shape)
    for inverse in (False, True):
        alone = [fourier_2d(value, inverse, device, "opencl") for value in values]
        assert np.array_equal(fourier_2d(values, inverse, device, "opencl", out=out), alone)


@pytest.mark.parametrize("device", **NAMES)
def test_a_nan_spoils_its_own_image_alone(device):
    values = images((45, 60), batch=3)
    values[1, 3, 4] = np.nan
    found = fourier_2d(values, device=device, engine="opencl")
    assert np.isnan(found[1]).all()
    assert np.isfinite(found[[0, 2]]).all()


@pytest.mark.parametrize("device", CPUS, ids=lambda device: device.kind)
def test_a_long_transform_agrees_with_scipy(device):
    values = images((1024, 1024), batch=1)
    expected = scipy.fft.fft2(values)
    found = fourier_2d(values, device=device, engine="opencl")
    assert np.abs(found - expected).max() < 2e-15 * np.abs(expected).max()


@pytest.mark.parametrize("device", CPUS, ids=lambda device: device.kind)
def test_the_chooser_says_why(device):
    chosen = choose_fourier((8, 512, 512), np.complex128, device)
    assert (chosen.engine, "fills" in chosen.reason) == ("opencl", True)
    for shape, words in {
        (8, 512, 509): "509 has a prime factor above 5",
        (1, 128, 128): "too few for a launch",
        (64, 64, 243): "lanes busy",
        (1, 1 << 17, 64): "does not fit into local memory",
    }.items():
        chosen = choose_fourier(shape, np.complex128, device)
        assert chosen.engine == "scipy"
        assert words in chosen.reason
    assert choose_fourier((64, 64), np.complex64, NUMPY).reason == "the device is NumPy"


def test_the_chooser_is_obeyed():
    values = images((7, 11))
    assert np.array_equal(fourier_2d(values), scipy.fft.fft2(values))
    assert np.array_equal(fourier_2d(values, inverse=True), scipy.fft.ifft2(values))
    assert fourier_2d(np.zeros((0, 8, 8), complex), device=OPENCL[0], engine="opencl").shape == (0, 8, 8)


@pytest.mark.parametrize("width", [4, 8])
def test_stages_multiply_to_the_length(width):
    for length in range(1, 400):
        stages = radices(length, width)
        rest = length
        for prime in (2, 3, 5):
            while rest % prime == 0:
                rest //= prime
        assert bool(stages) == (rest == 1)
        if stages:
            assert np.prod(stages) == length
            assert len(stages) >= 2
            assert stages[0] % row_lanes(length, width) == 0
            assert factors(length, False, width).size == factors(length, True, width).size
            assert max(stages) <= max(width, 5)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: fourier_2d(np.ones((4, 4))), "not float64"),
        (lambda: fourier_2d(np.ones(4, complex)), "shape \\(4,\\)"),
        (lambda: fourier_2d(np.ones((4, 0), complex)), "shape \\(4, 0\\)"),
        (lambda: fourier_2d(np.ones((4, 4), complex), engine="fftw"), "not 'fftw'"),
        (lambda: fourier_2d(np.ones((7, 4), complex), device=OPENCL[0], engine="opencl"), "7 has a prime"),
        (lambda: fourier_2d(np.ones((8, 8), complex), engine="opencl"), "the device is NumPy"),
    ],
)
def test_bad_input_is_refused(call, message):
    with pytest.raises(UserError, match=message):
        call()


@pytest.mark.parametrize("engine", ["scipy", "opencl"])
def test_results_go_where_they_are_wanted(engine):
    device = next((d for d in list_devices() if d.kind == "cpu"), None)
    if device is None and engine == "opencl":
        pytest.skip("there is no OpenCL processor (pip install pocl-binary-distribution)")
    values = np.random.default_rng(5).normal(size=(2, 16, 32)) + 0j
    out = np.empty_like(values)
    assert fourier_2d(values, device=device or NUMPY, engine=engine, out=out) is out
    assert np.array_equal(out, fourier_2d(values, device=device or NUMPY, engine=engine))
    for bad in (out[:1], out.astype(np.complex64), np.empty((2, 32, 16), complex).swapaxes(1, 2)):
        with pytest.raises(ValueError, match="contiguous complex128 array of shape"):
            fourier_2d(values, engine="scipy", out=bad)
    with pytest.raises(ValueError, match="must not share memory"):
        fourier_2d(values, engine="scipy", out=values)
