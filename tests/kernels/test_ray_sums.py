"""Sums over rays on every device against sums written out, and against those of spots and wavefronts."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from wavequake.errors import UserError
from wavequake.kernels.device import first_batch
from wavequake.kernels.device.devices import NUMPY, Device, list_devices
from wavequake.kernels.device.tiles import TILE
from wavequake.kernels.sums import ray_sums
from wavequake.kernels.sums.ray_sums import ray_coefficients, ray_moments, tile_moments
from wavequake.optics.wavefronts.quality import peak_to_valley, spot

OPENCL = [device for device in list_devices() if device.kind != "numpy"]
OPENCL += [Device(device.name, "gpu", device.platform, 1) for device in OPENCL if device.kind == "cpu"]
NAMES = {"argvalues": [NUMPY, *OPENCL], "ids": lambda device: f"{device.kind}-{device.vector_width}"}


def light(seed, instants, rays):
    random = np.random.default_rng(seed)
    opd, x, y = random.normal(0.0, 0.3, (3, instants, rays)) + np.array([[[0.1]], [[5.0]], [[-3.0]]])
    return opd, x, y, random.uniform(0.1, 1.0, rays), random.normal(size=(2, rays))


@pytest.mark.parametrize("device", **NAMES)
@given(
    seed=st.integers(0, 2**32 - 1),
    instants=st.integers(1, 20),
    rays=st.sampled_from([1, 2, 7, 128, 129, 300]),
    terms=st.sampled_from([1, 3, 31, 32, 33, 70]),
)
def test_coefficients_are_sums_of_products(device, seed, instants, rays, terms):
    random = np.random.default_rng(seed)
    matrix, values = random.normal(size=(terms, rays)), random.normal(size=(instants, rays))
    gone = random.random((instants, rays)) < random.choice([0.0, 0.005, 0.2])
    values[gone] = random.choice([np.nan, np.inf, -np.inf], gone.sum())
    sums, lost = ray_coefficients(matrix, values, device)
    assert np.array_equal(lost, gone.sum(axis=1))
    known = np.where(gone, 0.0, values).astype(np.longdouble)
    expected = known @ matrix.T.astype(np.longdouble)
    assert sums.shape == (instants, terms)
    assert np.abs(sums - expected).max() < 1e-15 * rays * 5


@pytest.mark.parametrize("device", **NAMES)
def test_a_matrix_that_is_kept_on_the_device_is_still_the_callers(device):
    """One that cannot be written is laid out once: also if another comes to lie in its place."""
    random = np.random.default_rng(8)
    values, before = random.normal(size=(3, 50)), set(ray_sums._FUNCTIONS)
    for _ in range(20):
        matrix = random.normal(size=(4, 50))
        matrix.flags.writeable = False
        for _ in range(2):
            np.testing.assert_allclose(
                ray_coefficients(matrix, values, device)[0], values @ matrix.T, rtol=0, atol=1e-13
            )
        del matrix
    assert set(ray_sums._FUNCTIONS) == before
    matrix = np.ones((4, 50))
    matrix.flags.writeable = False
    ray_coefficients(matrix, values, device)
    matrix.resize((2, 100))
    assert ray_coefficients(matrix, np.ones((1, 100)), device)[0].tolist() == [[100.0, 100.0]]
    # One that can, or that shows another's numbers, is looked at each time.
    writable = random.normal(size=(4, 50))
    shown = writable[:]
    shown.flags.writeable = False
    for matrix in (writable, shown):
        ray_coefficients(matrix, values, device)
        writable *= 2.0
        np.testing.assert_allclose(
            ray_coefficients(matrix, values, device)[0], values @ matrix.T, rtol=0, atol=1e-13
        )


@pytest.mark.parametrize("device", **NAMES)
@given(seed=st.integers(0, 2**32 - 1), rays=st.sampled_from([1, 5, 8, 13, 400]))
def test_moments_are_those_of_the_rays_that_arrive(device, seed, rays):
    opd, x, y, weight, slopes = light(seed, 9, rays)
    random = np.random.default_rng(seed)
    planes = random.normal(0.0, 0.2, (9, 2))
    gone = random.random((9, rays)) < np.array([0.0, 0.3, 1.0])[random.integers(0, 3, 9)][:, None]
    for values in (opd, x, y):  # whichever of the three says so
        here = gone & (random.random((9, rays)) < 0.5)
        values[here] = np.nan
    gone = ~(np.isfinite(opd) & np.isfinite(x) & np.isfinite(y))
    found = ray_moments(opd, x, y, weight, slopes, planes, device)
    assert np.array_equal(found.arrived, rays - gone.sum(axis=1))
    flat = np.where(gone, np.nan, opd - planes @ slopes)
    expected = spot(np.where(gone, np.nan, x), y, weight)
    np.testing.assert_allclose(found.centroid, expected.centroid, rtol=0, atol=1e-14)
    np.testing.assert_allclose(found.spot_rms, expected.rms, rtol=0, atol=1e-14)
    np.testing.assert_allclose(found.pv, peak_to_valley(flat), rtol=0, atol=1e-14)
    for i in range(9):
        kept = ~gone[i]
        names = (found.rms_raw, found.rms_flat, found.strehl)
        if not kept.any():
            assert all(np.isnan(values[i]) for values in names)
            continue
        for values, of in zip(names[:2], (opd, flat), strict=True):
            mean = np.average(of[i, kept], weights=weight[kept])
            variance = np.average((of[i, kept] - mean) ** 2, weights=weight[kept])
            assert values[i] == pytest.approx(np.sqrt(variance), abs=1e-14)
        wave = np.average(np.exp(2j * np.pi * flat[i, kept]), weights=weight[kept])
        assert names[2][i] == pytest.approx(abs(wave) ** 2, abs=2e-14)


def in_tiles(values):
    """Rows of instants (16 T, ...) as tiles (T, ..., 16)."""
    return np.ascontiguousarray(np.moveaxis(values.reshape(-1, TILE, values.shape[1]), 1, 2))


@pytest.mark.parametrize("device", **NAMES)
@given(seed=st.integers(0, 2**32 - 1), rays=st.sampled_from([1, 5, 400]), tiles=st.integers(1, 3))
def test_instants_in_tiles_have_the_same_moments(device, seed, rays, tiles):
    opd, x, y, weight, slopes = light(seed, tiles * TILE, rays)
    random = np.random.default_rng(seed)
    gone = random.random(opd.shape) < random.choice([0.0, 0.3, 1.0], size=(len(opd), 1))
    for values in (opd, x, y):
        values[gone & (random.random(opd.shape) < 0.5)] = np.nan
    planes = random.normal(0.0, 0.2, (len(opd), 2))
    planes[0] = np.nan
    expected = ray_moments(opd, x, y, weight, slopes, planes)
    given_tiles = [in_tiles(values) for values in (opd, x, y)]
    found = tile_moments(*given_tiles, weight, slopes, in_tiles(planes), device)
    assert np.array_equal(found.arrived, expected.arrived)
    for name in ("rms_raw", "rms_flat", "pv", "strehl", "centroid", "spot_rms"):
        one, other = getattr(found, name), getattr(expected, name)
        np.testing.assert_allclose(one, other, rtol=0.0, atol=2e-14 * max(1, rays / 20), err_msg=name)
    last = [values[-1:] for values in given_tiles]
    alone = tile_moments(*last, weight, slopes, in_tiles(planes)[-1:], device)
    for name, values in vars(alone).items():
        np.testing.assert_array_equal(values, getattr(found, name)[-TILE:])


@pytest.mark.parametrize("device", OPENCL, ids=lambda device: device.kind)
def test_a_device_that_sums_tiles_wrong_is_refused(device, monkeypatch):
    text = ray_sums._text().replace("arrived += LIT", "arrived -= LIT")
    monkeypatch.setattr(ray_sums, "_text", lambda: text)
    monkeypatch.setattr(first_batch, "_TRUSTED", set())
    opd, x, y, weight, slopes = light(3, TILE, 50)
    with pytest.raises(UserError, match="computes wrong numbers: of 16 wavefronts"):
        tile_moments(*map(in_tiles, (opd, x, y)), weight, slopes, np.zeros((1, 2, TILE)), device)


@pytest.mark.parametrize("device", **NAMES)
def test_tiles_that_do_not_fit_together_are_refused(device):
    fitting = {"opd": (2, 30, TILE), "x": (2, 30, TILE), "y": (2, 30, TILE), "weight": (30,)}
    fitting |= {"slopes": (2, 30), "planes": (2, 2, TILE)}
    none = tile_moments(**{k: np.zeros((0, *v[1:]) if len(v) == 3 else v) for k, v in fitting.items()})
    assert none.rms_raw.shape == (0,)
    for name, wrong in (
        ("opd", (2, 30, 8)),
        ("x", (2, 29, TILE)),
        ("slopes", (30, 2)),
        ("planes", (2, TILE, 2)),
    ):
        arrays = {key: np.ones(shape) for key, shape in (fitting | {name: wrong}).items()}
        with pytest.raises(UserError, match="must be"):
            tile_moments(**arrays, device=device)


@pytest.mark.parametrize("device", **NAMES)
def test_an_instant_does_not_depend_on_its_batch(device):
    opd, x, y, weight, slopes = light(1, 23, 150)
    opd[3, 7] = np.nan
    matrix, planes = np.random.default_rng(2).normal(size=(28, 150)), np.full((23, 2), 0.1)
    together = ray_moments(opd, x, y, weight, slopes, planes, device)
    sums, _ = ray_coefficients(matrix, opd, device)
    for i in range(23):
        one = slice(i, i + 1)
        alone = ray_moments(opd[one], x[one], y[one], weight, slopes, planes[one], device)
        assert all(np.array_equal(getattr(together, name)[one], value) for name, value in vars(alone).items())
        single = ray_coefficients(matrix, opd[one], device)[0]
        assert np.array_equal(single, sums[one])
        few = ray_coefficients(matrix, opd[i // 5 * 5 :][:5], device)[0]  # their norms depend on strides
        assert np.array_equal(np.sum(few**2, axis=1)[i % 5], np.sum(sums**2, axis=1)[i])


@pytest.mark.parametrize("device", **NAMES)
def test_a_plane_that_is_not_known_leaves_what_needs_none(device):
    opd, x, y, weight, slopes = light(3, 2, 40)
    planes = np.array([[0.0, 0.0], [np.nan, np.nan]])
    found = ray_moments(opd, x, y, weight, slopes, planes, device)
    assert np.isnan([found.rms_flat[1], found.pv[1], found.strehl[1]]).all()
    known = (found.rms_raw, found.centroid, found.spot_rms, found.arrived)
    assert all(np.isfinite(values).all() for values in known)
    assert np.isfinite([found.rms_flat[0], found.pv[0], found.strehl[0]]).all()


@pytest.mark.parametrize("device", **NAMES)
def test_nothing_has_no_sums(device):
    none, weight = np.zeros((0, 30)), np.ones(30)
    assert ray_coefficients(np.ones((4, 30)), none, device)[0].shape == (0, 4)
    found = ray_moments(none, none, none, weight, np.ones((2, 30)), np.zeros((0, 2)), device)
    assert found.centroid.shape == (0, 2)


@pytest.mark.parametrize("device", OPENCL, ids=lambda device: device.kind)
def test_a_device_that_sums_wrong_is_refused(device, monkeypatch):
    monkeypatch.setattr("wavequake.kernels.device.first_batch._TRUSTED", set())
    real = ray_sums.run_steps

    def wrong(device, steps, inputs, outputs, scratch):
        real(device, steps, inputs, outputs, scratch)
        next(iter(outputs.values()))[:] += 1e-6

    monkeypatch.setattr(ray_sums, "run_steps", wrong)
    device = replace(device)
    opd, x, y, weight, slopes = light(4, 30, 50)
    with pytest.raises(UserError, match="of 16 wavefronts of the first batch 16 differ"):
        ray_coefficients(np.ones((4, 50)), opd, device)
    with pytest.raises(UserError, match="computes wrong numbers"):
        ray_moments(opd, x, y, weight, slopes, np.zeros((30, 2)), device)
    monkeypatch.setattr(ray_sums, "run_steps", real)
    ray_moments(opd, x, y, weight, slopes, np.zeros((30, 2)), device)
    monkeypatch.setattr(ray_sums, "run_steps", wrong)
    if device.kind == "cpu":  # a ray alone is another program than vectors of them
        with pytest.raises(UserError, match="computes wrong numbers"):
            ray_moments(opd[:, :1], x[:, :1], y[:, :1], weight[:1], slopes[:, :1], np.zeros((30, 2)), device)


@pytest.mark.parametrize("device", **NAMES)
def test_numbers_of_any_kind_and_order_are_taken(device):
    opd, x, y, weight, slopes = light(5, 3, 20)
    matrix, planes = np.ones((4, 20)), np.zeros((3, 2))
    rounded = np.round(10 * opd)
    expected = ray_coefficients(matrix, rounded)[0]
    forms = (rounded.astype(np.float32), rounded.astype(int), np.asfortranarray(rounded), rounded.tolist())
    for values in forms:
        np.testing.assert_allclose(ray_coefficients(matrix, values, device)[0], expected, rtol=0, atol=1e-12)
        found = ray_moments(values, x, y, weight, slopes, planes, device)
        np.testing.assert_allclose(found.rms_raw, ray_moments(rounded, x, y, weight, slopes, planes).rms_raw)


@pytest.mark.parametrize("device", **NAMES)
def test_arrays_that_do_not_fit_together_are_refused(device):
    opd, x, y, weight, slopes = light(6, 3, 20)
    planes = np.zeros((3, 2))
    for values in (opd[:, :10], opd[0], np.zeros((0, 0)), np.zeros((3, 0))):
        with pytest.raises(UserError, match="values of the rays have the shape"):
            ray_coefficients(np.ones((4, 20)), values, device)
        with pytest.raises(UserError, match="wavefronts of the rays have the shape"):
            ray_moments(values, x, y, weight, slopes, planes, device)
        with pytest.raises(UserError, match="places y of the rays have the shape"):
            ray_moments(opd, x, values, weight, slopes, planes, device)
    with pytest.raises(UserError, match="planes"):
        ray_moments(opd, x, y, weight, slopes, planes[:2], device)
    with pytest.raises(UserError, match="the device is 'cpu'"):
        ray_coefficients(np.ones((4, 20)), opd, "cpu")
