"""Images of segments by OpenCL equal those by NumPy."""

import numpy as np
import pytest

from wavequake.errors import UserError
from wavequake.imaging.engines import segment_psf
from wavequake.imaging.engines.segment_basis import ray_basis, segment_basis
from wavequake.imaging.engines.segment_psf import psf
from wavequake.kernels.device import first_batch
from wavequake.kernels.device.devices import Device, list_devices
from wavequake.kernels.transforms import segment_images

# Processors are themselves, and pose as GPUs.
OWN = [device for device in list_devices() if device.kind != "numpy"]
GPUS = [Device(device.name, "gpu", device.platform, 1) for device in OWN]
ALL = [*GPUS, *(device for device in OWN if device.kind == "cpu")]
pytestmark = pytest.mark.parametrize("device", ALL, ids=lambda device: f"{device.kind}-{device.name}")
RANDOM = np.random.default_rng(4)


def phases(pupil, batch, slope):
    reach = np.hypot(*np.moveaxis(pupil.corners - pupil.centers[:, None], -1, 0)).max()
    phase = RANDOM.normal(0.0, 0.08, (batch, len(pupil.centers), 3))
    phase[..., 1:] *= 10.0 * slope / (2.0 * np.pi * reach)
    return phase


@pytest.mark.parametrize(("dtype", "off"), [(np.complex128, 4e-15), (np.complex64, 2e-6)])
@pytest.mark.parametrize(
    ("mirrored", "moments", "batch", "pixels"),
    [(True, 1, 3, 16), (True, 15, 17, 16), (True, 45, 1, 9), (False, 28, 2, 16)],
)
def test_images_equal_those_by_numpy(tmt, flower, device, dtype, off, mirrored, moments, batch, pixels):
    pupil = tmt if mirrored else flower
    corners = pupil.corners if mirrored else pupil.corners @ np.array([[0.8, 0.6], [-0.6, 0.8]])
    centers = pupil.centers if mirrored else pupil.centers @ np.array([[0.8, 0.6], [-0.6, 0.8]])
    basis = segment_basis(corners, centers, pixels, 0.25, pupil.diameter, moments, dtype)
    assert bool(basis.shares[1:].any()) == mirrored
    phase = phases(pupil, batch, 0.5)
    expected = psf(basis, phase, 10.0 if moments > 1 else 1e99)
    found = psf(basis, phase, 10.0 if moments > 1 else 1e99, device)
    assert found.dtype == expected.dtype
    np.testing.assert_allclose(found, expected, rtol=0, atol=off)


def test_tiles_take_moments_of_their_own_and_keep_their_bits(tmt, device):
    basis = segment_basis(tmt.corners, tmt.centers, 16, 0.25, tmt.diameter, 28)
    phase = phases(tmt, 20, 0.3)
    phase[:16, :, 1:] *= 0.01
    together = psf(basis, phase, 1e-2, device)
    np.testing.assert_allclose(together, psf(basis, phase, 1e-2), rtol=0, atol=2e-6)
    np.testing.assert_array_equal(psf(basis, phase[16:], 1e-2, device), together[16:])
    np.testing.assert_array_equal(psf(basis, phase[:5], 1e-2, device), together[:5])
    np.testing.assert_array_equal(psf(basis, phase[:1], 1e-2, device), together[:1])


@pytest.mark.parametrize("width", [1, 8])
def test_processors_of_narrow_vectors_make_the_same_images(tmt, device, width, monkeypatch):
    """Some drivers say that they calculate with one number at a time."""
    basis = segment_basis(tmt.corners, tmt.centers, 21, 0.25, tmt.diameter, 6)
    phase = phases(tmt, 3, 0.05)
    expected = psf(basis, phase, 10.0, device)
    monkeypatch.setattr(segment_images, "vector_width", lambda *_, **__: width)
    np.testing.assert_allclose(psf(basis, phase, 10.0, device), expected, rtol=0, atol=1e-6)


def test_rays_have_pistons_alone(device):
    x, y = RANDOM.uniform(-1.0, 1.0, (2, 300))
    basis = ray_basis(x, y, RANDOM.uniform(0.5, 1.0, 300), 12, 0.3, 2.0, np.complex128)
    pistons = RANDOM.normal(0.0, 0.1, (2, 300))
    np.testing.assert_allclose(psf(basis, pistons, device=device), psf(basis, pistons), rtol=0, atol=1e-14)


def test_lanes_compute_alone(tmt, device):
    basis = segment_basis(tmt.corners, tmt.centers, 21, 0.25, tmt.diameter, 15)
    phase = phases(tmt, 5, 0.3)
    together = psf(basis, phase, 10.0, device)
    alone = [psf(basis, one[None], 10.0, device)[0] for one in phase]
    np.testing.assert_array_equal(together, alone)


def test_thousands_of_rays_keep_single_precision(device):
    x, y = RANDOM.uniform(-1.0, 1.0, (2, 5000))
    lit = np.hypot(x, y) < 1.0
    pistons = (
        RANDOM.normal(0.0, 0.05, (2, lit.sum())) + 1e3
    )  # whole waves are left out before they are rounded
    one, exact = (
        ray_basis(x[lit], y[lit], np.ones(lit.sum()), 24, 0.3, 2.0, kind)
        for kind in (np.complex64, np.complex128)
    )
    np.testing.assert_allclose(psf(one, pistons, device=device), psf(exact, pistons), rtol=0, atol=1e-6)


def test_an_instant_without_numbers_spoils_no_other(flower, device):
    basis = segment_basis(flower.corners, flower.centers, 12, 0.3, flower.diameter, 6)
    phase = phases(flower, 4, 0.01)
    whole = psf(basis, phase, device=device)
    phase[1, 2, 0] = np.nan
    broken = psf(basis, phase, device=device)
    assert np.isnan(broken[1]).all()
    np.testing.assert_array_equal(broken[[0, 2, 3]], whole[[0, 2, 3]])


def test_a_device_that_images_wrong_is_refused(flower, device, monkeypatch):
    monkeypatch.setattr(first_batch, "_TRUSTED", set())
    basis = segment_basis(flower.corners, flower.centers, 12, 0.3, flower.diameter, 6)
    right = segment_psf._numpy_images
    monkeypatch.setattr(segment_psf, "_numpy_images", lambda *given: right(*given) + 1e-4)
    with pytest.raises(UserError, match="pixels"):
        psf(basis, phases(flower, 2, 0.01), device=device)
