import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import j1

from wavequake.errors import UserError
from wavequake.imaging.engines.matrix_fourier import (
    amplitude_images,
    matrix_fourier,
    psf,
    psf_sum,
    samples_needed,
)
from wavequake.imaging.pupils.outlines import annulus, blocked, segments, vane
from wavequake.imaging.pupils.pupil_function import annular_pupil, apodized, pupil_function, sampled_pupil
from wavequake.kernels.device.devices import NUMPY, list_devices

GRIDS = {eps: annular_pupil(256, eps) for eps in (0.0, 0.4)}


def airy(radius, eps):
    """Closed form of the annular aperture's diffraction pattern, peak 1, radius in wavelengths / diameter."""
    t = np.pi * radius
    with np.errstate(invalid="ignore", divide="ignore"):
        amplitude = np.where(t == 0, 1 - eps**2, 2 * (j1(t) - eps * j1(eps * t)) / t)
    return (amplitude / (1 - eps**2)) ** 2


@pytest.mark.parametrize("eps", [0.0, 0.4])
def test_a_perfect_pupil_gives_the_airy_pattern(eps):
    transform = matrix_fourier(GRIDS[eps], 64, 0.25)
    image = psf(transform, np.zeros((1, len(GRIDS[eps].cells))))[0]
    radius = np.hypot(transform.axis[:, None], transform.axis)
    assert np.abs(image - airy(radius, eps)).max() < 1e-4


@pytest.mark.parametrize("eps", [0.0, 0.4])
def test_rim_cells_hold_the_area(eps):
    grid = GRIDS[eps]
    area = grid.amplitude.sum() * (2 / 256) ** 2
    assert area == pytest.approx(np.pi * (1 - eps**2), rel=1e-4)
    assert grid.x.max() < 1
    assert np.hypot(grid.x, grid.y).min() >= eps - 2 / 256


def test_energy_is_conserved_over_a_whole_period():
    grid = annular_pupil(32)
    phase = np.random.default_rng(1).normal(size=(2, len(grid.cells)))
    transform = matrix_fourier(grid, 64, 0.5)  # one period of the sampled pupil's transform
    total = psf(transform, phase).sum(axis=(1, 2)) * transform.peak
    light = np.sum(grid.amplitude**2)
    assert total == pytest.approx(np.full(2, light * 64**2), rel=1e-12)


@settings(deadline=None, max_examples=20)
@given(st.integers(-8, 8), st.integers(-8, 8))
def test_a_tilt_moves_the_image_by_whole_pixels(nx, ny):
    grid = annular_pupil(64)
    transform = matrix_fourier(grid, 40, 0.5)
    bumps = 0.3 * np.sin(3 * grid.x) * grid.y
    # An OPD that grows by s waves across the diameter moves the image by s wavelengths / diameter.
    at_middles = np.meshgrid(grid.axis, grid.axis)
    x, y = (middle.ravel()[grid.cells] for middle in at_middles)
    tilt = np.pi * 0.5 * (nx * x + ny * y)
    still, moved = psf(transform, np.stack([bumps, bumps + tilt]))
    expected = np.roll(still, (ny, nx), axis=(0, 1))[8:32, 8:32]
    assert moved[8:32, 8:32] == pytest.approx(expected, abs=1e-12)


def test_defocus_on_the_axis_follows_the_closed_form():
    """Peak of a circular pupil with a phase a rho^2: (sin(a/2) / (a/2))^2."""
    grid = GRIDS[0.0]
    a = np.array([[1.0], [3.0], [6.0]])
    images = psf(matrix_fourier(grid, 8, 0.25), a * (grid.x**2 + grid.y**2))
    assert images[:, 4, 4] == pytest.approx(np.sinc(a[:, 0] / 2 / np.pi) ** 2, abs=1e-4)


def test_an_image_does_not_depend_on_its_batch():
    grid = annular_pupil(32)
    phase = np.random.default_rng(2).normal(size=(70, len(grid.cells)))
    transform = matrix_fourier(grid, 16, 0.5)
    alone = np.concatenate([psf(transform, row[None]) for row in phase])
    assert np.array_equal(psf(transform, phase), alone)


def test_sampling_that_is_called_enough_is_enough():
    slope = 60.0  # rad per radius: the image moves by slope / pi wavelengths / diameter
    samples = samples_needed(slope, 60.0)
    images = []
    for n in (samples, 4 * samples):
        grid = annular_pupil(n)
        images.append(psf(matrix_fourier(grid, 60, 1.0), slope * grid.x[None])[0])
    assert np.unravel_index(images[0].argmax(), (60, 60)) == (30, 30 + round(slope / np.pi))
    assert images[0].max() == pytest.approx(images[1].max(), rel=0.1)


def test_a_phase_that_no_pupil_samples_needs_a_number_all_the_same():
    assert samples_needed(np.inf, 60.0) == samples_needed(1e300, 60.0) == 10**9


def test_bad_input():
    grid = annular_pupil(16)
    with pytest.raises(UserError, match="repeats every 16 lambda/D"):
        matrix_fourier(grid, 64, 0.5)
    with pytest.raises(UserError, match="at least 8"):
        annular_pupil(4)
    with pytest.raises(UserError, match="obscuration is 1"):
        annular_pupil(16, 1.0)
    with pytest.raises(UserError, match="must be"):
        psf(matrix_fourier(grid, 8, 0.5), np.zeros((1, 3)))


def test_nan_phases_give_nan_images_alone():
    grid = annular_pupil(16)
    phase = np.zeros((2, len(grid.cells)))
    phase[1, 5] = np.nan
    images = psf(matrix_fourier(grid, 8, 0.5), phase)
    assert np.isfinite(images[0]).all()
    assert np.isnan(images[1]).all()
    assert pupil_function(grid, phase).shape == (2, 16, 16)


OPENCL = [device for device in list_devices() if device.kind != "numpy"]


@pytest.fixture(scope="module")
def halves(flower):
    """Cells with two segments."""
    return sampled_pupil(segments(flower.corners), 128, 2700.0)


@pytest.fixture(scope="module", params=[64, 33])
def known(request, halves):
    """Grids with phases, their images, and a sum of these, all by the twin."""
    # Half rows in pieces, and whole ones that are dark: the shadow of a vane that reaches over the rim.
    pieces = sampled_pupil(blocked(annulus(1.0, 0.3), vane([0.2, -2.0], [1.2, 2.0], 0.2)), 64, 2.0)
    beam = sampled_pupil(blocked(annulus(1.0), vane([0.0, 0.1], [2.0, 0.1], 0.2)), 65, 2.0)
    found = []
    for grid in (GRIDS[0.4], halves, pieces, beam):
        phase = np.random.default_rng(3).normal(0, 1.0, (5, grid.cells.size))
        transform = matrix_fourier(grid, request.param, 0.3, NUMPY)
        images = psf(transform, phase)
        total = np.einsum("b,bij", WEIGHTS, images)
        np.testing.assert_allclose(psf_sum(transform, phase, WEIGHTS), total, atol=1e-14)
        found.append((grid, phase, images, total))
    return request.param, found


WEIGHTS = np.array([0.1, 0.0, 0.4, 0.3, 0.2])


@pytest.mark.parametrize("device", OPENCL, ids=lambda device: device.kind)
def test_devices_agree_with_numpy(known, device):
    """In either precision for images of one size: each grid takes a program of its own for each of both."""
    (pixels, grids), kinds = known, []
    dtype, tolerance = {64: ("float64", 1e-14), 33: ("float32", 2e-6)}[pixels]
    for grid, phase, images, total in grids:
        folded = matrix_fourier(grid, pixels, 0.3, device, dtype)
        kinds.append((folded.starts is not None, folded.gather is not None))
        assert np.abs(psf(folded, phase) - images).max() < tolerance
        assert psf_sum(folded, phase, WEIGHTS) == pytest.approx(total, abs=tolerance)
    assert kinds == [(True, False), (False, False), (False, True), (True, False)]


@pytest.mark.parametrize("device", [NUMPY, *OPENCL], ids=lambda device: device.kind)
def test_amplitudes_image_as_an_apodized_pupil_does(halves, device):
    for grid in (GRIDS[0.4], halves):
        rng = np.random.default_rng(4)
        transmission, phase = rng.random(grid.cells.size), rng.normal(size=(9, grid.cells.size))
        found = amplitude_images(matrix_fourier(grid, 33, 0.3, device), transmission * np.exp(1j * phase))
        weak = apodized(grid, transmission)
        share = (weak.amplitude.sum() / grid.amplitude.sum()) ** 2
        expected = share * psf(matrix_fourier(weak, 33, 0.3), phase)
        assert np.abs(found - expected).max() < 1e-14
    with pytest.raises(UserError, match="must be"):
        amplitude_images(matrix_fourier(grid, 33, 0.3, device), np.ones((2, 3), complex))


def test_weights_are_checked():
    transform = matrix_fourier(annular_pupil(16), 8, 0.5)
    phase = np.zeros((2, len(transform.pupil.cells)))
    with pytest.raises(UserError, match="2 instants need as many finite weights"):
        psf_sum(transform, phase, np.array([1.0, np.nan]))
    with pytest.raises(UserError, match="sampling above 0"):
        matrix_fourier(transform.pupil, 8, np.nan)
