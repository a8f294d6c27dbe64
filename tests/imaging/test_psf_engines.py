import warnings

import numpy as np
import pytest
from scipy.special import j1

from wavequake.errors import UserError
from wavequake.imaging.engines.choice import (
    ENGINES,
    SegmentedPupil,
    point_spread,
    prepare_psf,
)
from wavequake.imaging.pupils.nyquist import samples_for
from wavequake.imaging.pupils.outlines import annulus, blocked, vane
from wavequake.imaging.pupils.pupil_function import annular_pupil, sampled_pupil
from wavequake.kernels.device.devices import NUMPY, list_devices

DEVICES = list_devices()
RNG = np.random.default_rng(7)


def motions(flower, batch=2, slope=1e-4):
    motion = RNG.normal(0, 0.1, (batch, 7, 3))
    motion[..., 1:] *= 10 * slope
    return motion


@pytest.fixture
def petals(flower):
    return SegmentedPupil(flower.corners, flower.centers, 2700.0)


@pytest.mark.parametrize("device", DEVICES, ids=lambda device: device.kind)
def test_engines_agree_on_segments(flower, petals, device):
    motion = motions(flower)
    images = {}
    for name in ENGINES:
        engine = prepare_psf(petals, 32, 0.25, name, device, corner_phase=1.0, samples=256)
        assert (engine.name, engine.reason) == (name, "asked for")
        images[name] = point_spread(engine, motion)
    # The sampled pupils differ by what a transform adds beyond their grid's period, the same for both.
    assert np.abs(images["fft"] - images["matrix"]).max() < 1e-12
    assert np.abs(images["segments"] - images["matrix"]).max() < 1e-4
    assert np.abs(images["segments"] - images["matrix"]).max() > 1e-9


@pytest.mark.parametrize("device", DEVICES, ids=lambda device: device.kind)
@pytest.mark.parametrize("pixels", [24, 31])
def test_engines_agree_on_a_ring_with_a_vane(device, pixels):
    grid = sampled_pupil(blocked(annulus(1.0, 0.3), vane([0.0, 0.0], [1.0, 0.2], 0.05)), 64, 2.0)
    phase = RNG.normal(0, 0.5, (3, grid.cells.size))
    ways = [prepare_psf(grid, pixels, 0.5, name, device) for name in ("fft", "matrix")]
    padded, direct = (point_spread(way, phase, check=False) for way in ways)
    assert np.abs(padded - direct).max() < 1e-13


@pytest.mark.parametrize("name", ["fft", "matrix"])
def test_an_engine_makes_the_airy_pattern(name):
    grid = annular_pupil(256)
    image = point_spread(prepare_psf(grid, 24, 0.5, name), np.zeros((1, grid.cells.size)))[0]
    t = np.pi * np.hypot(0.5, 0.5 * (np.arange(24) - 12))
    assert image[13] == pytest.approx((2 * j1(t) / t) ** 2, abs=1e-4)


def test_the_cheapest_engine_is_chosen_and_says_why(tmt, flower, petals):
    glass = SegmentedPupil(tmt.corners, tmt.centers, tmt.diameter)
    engine = prepare_psf(glass, 16, 0.25, samples=256)
    assert engine.name == "segments"
    assert "the least of fft" in engine.reason
    ring = prepare_psf(annular_pupil(128), 32, 0.25)
    assert ring.name == "matrix"
    assert "the pupil is no sum of segments" in ring.reason
    assert set(ring.seconds) == {"fft", "matrix"}
    whole = prepare_psf(annular_pupil(64), 256, 0.25)  # all pixels of the padded transform
    assert whole.name == "fft"
    steep = prepare_psf(petals, 32, 0.25, corner_phase=20.0, samples=128)
    assert steep.name != "segments"
    assert "45 moments" in steep.reason
    assert "fft" not in prepare_psf(annular_pupil(64), 32, 0.3).seconds  # 64 / 0.3 is no whole number


def test_a_single_image_is_not_worth_a_large_basis(tmt):
    glass = SegmentedPupil(tmt.corners, tmt.centers, tmt.diameter)
    assert prepare_psf(glass, 64, 0.25, instants=1, corner_phase=1.0).name == "matrix"


def test_steep_instants_alone_are_sampled(flower, petals):
    motion = motions(flower, 3, 2e-5)
    motion[1, :, 1:] = 1e-3  # a tilt of the whole image by 2.7 wavelengths / diameter
    engine = prepare_psf(petals, 32, 0.25, "segments", corner_phase=0.3, samples=256)
    sampled = prepare_psf(petals, 32, 0.25, "matrix", samples=256)
    found, coarse = (point_spread(way, motion) for way in (engine, sampled))
    assert np.array_equal(found[1], coarse[1])
    assert not np.array_equal(found[[0, 2]], coarse[[0, 2]])
    assert np.abs(found - coarse).max() < 2e-4


@pytest.mark.parametrize("name", ENGINES)
def test_an_instant_without_numbers_spoils_no_other(flower, petals, name):
    motion = motions(flower, 3)
    engine = prepare_psf(petals, 16, 0.25, name, corner_phase=1.0, samples=64)
    healthy = point_spread(engine, motion)
    motion[1, 3] = np.nan
    broken = point_spread(engine, motion)
    assert np.isnan(broken[1]).all()
    assert np.array_equal(broken[[0, 2]], healthy[[0, 2]])


def test_a_phase_too_steep_for_its_samples_is_warned_of():
    grid = annular_pupil(32)
    engine = prepare_psf(grid, 16, 0.5)
    slope = 60.0  # rad per radius: 19 periods across, for which 32 samples leave no room
    tilt = slope * grid.x[None]
    needed = samples_for(grid, tilt, 8.0)
    assert needed == pytest.approx(2 * (slope / np.pi + 4.0), abs=3)
    with pytest.warns(UserWarning, match=f"has 32 samples across, .* need {needed}"):
        point_spread(engine, tilt)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        point_spread(engine, tilt, check=False)
        point_spread(engine, 0.3 * tilt)
        point_spread(engine, np.full_like(tilt, np.nan))
        fine = annular_pupil(needed + 1)
        point_spread(prepare_psf(fine, 16, 0.5), slope * fine.x[None])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"engine": "zoom"}, "not 'zoom'"),
        ({"engine": "segments"}, "cannot make this image: the pupil is no sum of segments"),
        ({"engine": "fft", "sampling": 0.3}, "16 samples / 0.3 is no whole number"),
        ({"pixels": 64}, "repeats every 16 lambda/D"),
        ({"pixels": 0}, "sampling above 0"),
        ({"sampling": -1.0}, "sampling above 0"),
    ],
)
def test_bad_images_are_refused(change, message):
    with pytest.raises(UserError, match=message):
        prepare_psf(**{"pupil": annular_pupil(16), "pixels": 8, "sampling": 0.5} | change)


def test_bad_wavefronts_are_refused(petals):
    grid = annular_pupil(16)
    for name in ("fft", "matrix"):
        with pytest.raises(UserError, match="the phase has the shape"):
            point_spread(prepare_psf(grid, 8, 0.5, name), np.zeros((1, 3)))
    with pytest.raises(UserError, match="7 segments of 3 terms need motions of shape"):
        point_spread(prepare_psf(petals, 8, 0.5, "matrix", NUMPY, samples=64), np.zeros((1, 7)))
