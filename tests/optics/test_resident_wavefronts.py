"""Wavefronts of rays that stay on a device with memory of its own, against those of a processor."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from wavefront_cases import states_of

from wavequake.kernels.device import resident
from wavequake.kernels.device.devices import NUMPY, Device, list_devices
from wavequake.kernels.device.launches import kernel_launches, launches_since
from wavequake.kernels.device.resident import device_of
from wavequake.kernels.device.tiles import TILE
from wavequake.kernels.trace import segmented, sequential
from wavequake.optics.catalog.names import optical_system
from wavequake.optics.rays.pupils import sunflower
from wavequake.optics.segments.slopes import slope_fit
from wavequake.optics.segments.wavefront import measure
from wavequake.optics.shapes.shapes import Opening
from wavequake.optics.systems.kinematics import rest_states
from wavequake.optics.wavefronts.sphere_fit import reference_fit
from wavequake.optics.wavefronts.wavefront import (
    measure_system,
    prepare_system,
    trace_system,
    with_fitted_sphere,
    with_slopes,
)

CPU = next((device for device in list_devices() if device.kind == "cpu"), None)
pytestmark = pytest.mark.skipif(CPU is None, reason="needs an OpenCL processor, which poses as a GPU")
GPU = Device(CPU.name, "gpu", CPU.platform, 1) if CPU else NUMPY
METHODS = {"path": lambda one: one, "sphere": with_fitted_sphere, "slopes": with_slopes}
METHODS["both"] = lambda one: with_slopes(with_fitted_sphere(one))
TERMS = 15
# By motions of as many mm they lose some of their rays, and all.
LARGE = {"stopped": 8.0, "tmt-thesis": 300.0, "euv": 30.0}


@cache
def prepared(name, method, rays, terms=TERMS, field=-1):
    """A bundled system, or a lens of which spider arms stop some rays, with a sunflower of rays."""
    system = optical_system("double-gauss" if name == "stopped" else name)
    if name == "stopped":
        first = replace(system.surfaces[0], opening=Opening(outer=60.0, arms=((0.3, 4.0),)))
        system = replace(system, surfaces=(first, *system.surfaces[1:]))
    pupil = sunflower(system.pupil.obscuration, 1.0, rays)
    field %= len(system.fields)
    one = METHODS[method](prepare_system(system, pupil.x, pupil.y, np.ones(rays), terms, field))
    return replace(one, sequence=replace(one.sequence, turning=True))  # one program, whatever turns


def moved(system, instants, seed, size):
    """Random motions: displacements (mm) and angles of some surfaces at some instants, none at the first."""
    random, still = np.random.default_rng(seed), rest_states(system, instants)
    motion = size * random.normal(size=still.surface_motion.shape)
    motion[..., 3:] *= 1e-3
    motion *= random.random(motion.shape[:2])[..., None] < 0.5
    motion[0] = 0.0
    return replace(still, surface_motion=motion)


def copied(before):
    """Bytes to and from the device since then."""
    counted = launches_since(before)
    return [counted.get(f"bytes {way} device", 0) for way in ("to", "from")]


def arrays_of(wavefront):
    return {name: values for name, values in vars(wavefront).items() if name != "device"}


def assert_alike(found, expected):
    """Rays of 1e5 mm are rounded to 1e-15 of that, which are 1e-7 waves in the end, and phases as waves."""
    for name, values in arrays_of(expected).items():
        if np.issubdtype(values.dtype, np.integer):
            assert getattr(found, name).dtype == values.dtype
            np.testing.assert_array_equal(getattr(found, name), values, err_msg=name)
        else:
            largest = expected.pv if name == "strehl" else values
            scale = 1.0 + np.nanmax(np.abs(largest), initial=0.0)
            np.testing.assert_allclose(
                getattr(found, name), values, rtol=0.0, atol=1e-7 * scale, err_msg=name
            )


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("name", LARGE)
@given(
    seed=st.integers(0, 2**32 - 1),
    instants=st.integers(1, 20),
    size=st.sampled_from([0.0, 1e-6, 1e-3, 0.1, 1.0]),
)
def test_wavefronts_are_those_of_a_processor(name, method, seed, instants, size):
    one = prepared(name, method, 90)
    states = moved(one.system, instants, seed, size * LARGE[name])
    assert_alike(measure_system(one, states, GPU), measure_system(one, states, CPU))


def test_the_motions_above_lose_some_rays_and_all():
    for name, size in LARGE.items():
        one = prepared(name, "path", 90)
        found = measure_system(one, moved(one.system, 40, 1, size), CPU)
        known = np.isfinite(found.zernike[:, 0])
        assert np.sum(known & (found.lost > 0)) > 5
        assert np.sum(found.lost == 90) > 1
        assert np.sum(found.lost == 0) > 5 or name == "stopped"
        assert (found.vignetted > 0).any() == (name in ("stopped", "tmt-thesis"))


@pytest.mark.parametrize("method", ["path", "sphere"])
def test_no_more_than_the_numbers_come_from_the_device(method):
    one, instants, rays = prepared("double-gauss", method, 2000, terms=45, field=0), 100, 2000
    states = moved(one.system, instants, 5, 1e-4)
    assert not measure_system(one, states, GPU).lost.any()  # and the first batch is compared
    before = kernel_launches()
    measure_system(one, states, GPU)
    to, back = copied(before)
    surfaces = states.surface_motion.shape[1]
    fits = 8 * 45 + 4 + (8 * one.sphere.basis.shape[1] + 4 if one.sphere else 0)  # and how many are lost
    moments, stopped, poses = 8 * 8, 4, 8 * 12 * surfaces
    assert back == instants * (fits + moments + stopped + poses)
    assert back < 0.04 * instants * rays * 26  # of which three quarters are poses
    # Where rays start, once, and what belongs to them; motions, poses and the like of the instants.
    start = 8 * rays * (3 + 3 + 1 + 1 + 2 + (2 if one.sphere else 0))
    assert to < start + 8 * instants * (6 + 12 + 2) * surfaces


def test_rows_of_instants_that_lost_rays_come_alone():
    one, rays = prepared("double-gauss", "path", 2000, field=0), 2000
    states = moved(one.system, 100, 5, 1e-4)
    states.surface_motion[[7, 8, 60], 6, 0] = 20.0
    expected = measure_system(one, states, CPU)
    assert np.flatnonzero((expected.lost > 0) & (expected.lost < rays)).tolist() == [7, 8, 60]
    measure_system(one, states, GPU)
    before = kernel_launches()
    assert_alike(measure_system(one, states, GPU), expected)
    back = copied(before)[1]
    assert (
        3 * 8 * rays
        < back
        < 3 * 8 * rays + 100 * (8 * 15 + 4 + 64 + 4 + 96 * states.surface_motion.shape[1]) + 1
    )


def test_rays_come_when_they_are_asked_for_once():
    one = prepared("double-gauss", "path", 300, field=0)
    states = moved(one.system, 30, 2, 1e-3)
    trace_system(one, states, GPU)
    before = kernel_launches()
    opd, traced, _ = trace_system(one, states, GPU)
    arrays = [opd, traced.path, traced.x, traced.y, traced.status, traced.surface]
    assert all(device_of(array) == GPU for array in arrays)
    poses = copied(before)[1]
    expected = trace_system(one, states, CPU)
    for _ in range(2):
        np.testing.assert_allclose(opd, expected[0], atol=1e-8)
        np.testing.assert_allclose(np.stack([traced.x, traced.y]), [expected[1].x, expected[1].y], atol=1e-9)
        assert traced.vignetted.tolist() == expected[1].vignetted.tolist()
    assert copied(before)[1] - poses == 30 * 300 * (3 * 8 + 2)
    assert device_of(traced.path) == GPU


@pytest.mark.parametrize("method", METHODS)
def test_bits_do_not_depend_on_the_memory_that_is_left(method, monkeypatch):
    one = prepared("stopped", method, 90)
    states = moved(one.system, 20, 3, 2.0)
    expected = measure_system(one, states, GPU)
    for size in (1, 20 * 90 * 8, 50 * 90 * 8):
        monkeypatch.setattr(resident, "_KEPT_BYTES", size)
        found = measure_system(one, states, GPU)
        for name, values in arrays_of(expected).items():
            np.testing.assert_array_equal(getattr(found, name), values, err_msg=name)


def test_what_one_launch_does_not_trace_is_measured_in_parts(monkeypatch):
    one = prepared("tmt-thesis", "sphere", 90)
    states = moved(one.system, 20, 3, 1e-2)
    whole = {device: measure_system(one, states, device) for device in (GPU, CPU, NUMPY)}
    monkeypatch.setattr(sequential, "_LAUNCH_BYTES", 7 * 90 * 26)
    for device, expected in whole.items():
        before = kernel_launches()
        found = measure_system(one, states, device)
        for name, values in arrays_of(expected).items():
            np.testing.assert_array_equal(getattr(found, name), values, err_msg=name)
        if device is not NUMPY:
            assert launches_since(before)["launches sequential"] == 3
        if device is GPU:  # and every part stays there
            assert copied(before)[1] < 20 * 90 * 8
    # A trace that takes more than one launch does not stay.
    opd, traced, _ = trace_system(one, states, GPU)
    assert type(traced.x) is np.ndarray
    np.testing.assert_array_equal(opd, trace_system(one, states, GPU)[0])
    monkeypatch.setattr(sequential, "_LAUNCH_BYTES", 1)
    np.testing.assert_array_equal(measure_system(one, states, GPU).zernike, whole[GPU].zernike)
    assert measure_system(one, rest_states(one.system, 0), GPU).zernike.shape == (0, TERMS)


@pytest.mark.parametrize("method", ["path", "sphere", "slopes"])
@pytest.mark.parametrize("tiles", [1, 3])
def test_segmented_telescopes_leave_image_points_there(tmt18, method, tiles):
    one, rays = tmt18, len(tmt18.rays)
    if method == "sphere":
        one = replace(one, sphere=reference_fit(one))
    if method == "slopes":
        one = replace(one, slopes=slope_fit(one))
    random, states = np.random.default_rng(tiles), states_of(one, tiles * TILE)
    states.segment_motion[..., :3] = random.normal(0.0, 1e-3, states.segment_motion[..., :3].shape)
    states.segment_motion[3, 5, 0] = np.nan
    measure(one, states, GPU)
    before = kernel_launches()
    found = measure(one, states, GPU)
    to, back = copied(before)
    points = 0 if method != "slopes" else 2 * 8
    assert back == tiles * TILE * (rays * (8 + 1 + points) + 8 * 8)
    assert to < tiles * TILE * rays * 8 + 400_000 * tiles  # the wavefronts, and poses
    expected = measure(one, states, CPU)
    assert 0 < expected.lost[3] < rays
    assert_alike(found, expected)
    # Also where one launch does not trace all.
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(segmented, "_LAUNCH_BYTES", 25 * TILE * rays)
        parts = measure(one, states, GPU)
    for name, values in arrays_of(found).items():
        np.testing.assert_array_equal(getattr(parts, name), values, err_msg=name)
