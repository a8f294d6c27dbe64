"""One sign: every function images exp(+2 pi i OPD) by exp(-2 pi i f x), so a rising OPD moves light to +x."""

import numpy as np
import pytest

from wavequake.chain.images.coherent import lit_by_cells, lit_object, mean_image
from wavequake.chain.images.extended import ObjectSection
from wavequake.imaging.engines import matrix_fourier, segment_psf
from wavequake.imaging.engines.choice import SegmentedPupil, point_spread, prepare_psf
from wavequake.imaging.engines.segment_basis import ray_basis, segment_basis
from wavequake.imaging.engines.segment_figure import figure_psf, segment_figure, terms_of_motion
from wavequake.imaging.engines.segment_lattice import lattice_psf, segment_lattice
from wavequake.imaging.engines.zernike_psf import zernike_imager, zernike_images, zernike_sum
from wavequake.imaging.exposures.mtf import optical_transfer_function
from wavequake.imaging.exposures.through_focus import through_focus
from wavequake.imaging.objects.formation import (
    Source,
    coherent_image,
    disk_source,
    incoherent_image,
    partially_coherent_image,
)
from wavequake.imaging.pupils.pupil_function import annular_pupil
from wavequake.imaging.pupils.pupil_shape import PupilShape
from wavequake.imaging.pupils.wavefront_phase import ray_phase, segment_phase, zernike_phase
from wavequake.kernels.device.devices import list_devices
from wavequake.optics.polynomials.zernike import annular_zernike

PIXELS, SAMPLING = 64, 0.25
GRID = annular_pupil(96)
# Tilts that move light by 4 c = (+0.80, +0.52) lambda / D, and what has no symmetry.
NOLL = np.array([[0.0, 0.2, 0.13, 0.0, 0.06, 0.0, 0.0, 0.05, 0.04]])
OPD = annular_zernike(GRID.x, GRID.y, NOLL.shape[1]) @ NOLL[0]
SHAPE = PupilShape(0.0, lambda x, y: annular_zernike(x, y, NOLL.shape[1]) @ NOLL[0])
TRANSFORM = matrix_fourier.matrix_fourier(GRID, PIXELS, SAMPLING)
POINT = np.zeros((PIXELS, PIXELS))
POINT[PIXELS // 2, PIXELS // 2] = 1.0
DEVICES = list_devices()
HERE = (np.arange(PIXELS) - PIXELS // 2) * SAMPLING


def by_transfer_function():
    frequency = np.fft.fftfreq(PIXELS, SAMPLING)
    spectrum = optical_transfer_function(SHAPE, frequency, frequency)
    waves = np.exp(2j * np.pi * np.outer(HERE, frequency))
    return (waves @ spectrum @ waves.T).real


def on_device(device):
    phase = zernike_phase(GRID, NOLL)
    there = matrix_fourier.matrix_fourier(GRID, PIXELS, SAMPLING, device)
    imager = zernike_imager(GRID, PIXELS, SAMPLING, NOLL.shape[1], device=device)
    yield matrix_fourier.psf(there, phase)[0]
    yield matrix_fourier.psf_sum(there, phase, np.ones(1))
    yield matrix_fourier.amplitude_images(there, np.exp(1j * phase))[0]
    yield zernike_images(imager, NOLL)[0]
    yield zernike_sum(imager, NOLL, np.ones(1))
    for engine in ("fft", "matrix"):
        yield point_spread(prepare_psf(GRID, PIXELS, SAMPLING, engine, device), phase)[0]


def elsewhere():
    phase = zernike_phase(GRID, NOLL)
    axis = Source(np.zeros((1, 2)), np.ones(1))
    yield coherent_image(POINT, SAMPLING, SHAPE)
    yield incoherent_image(POINT, SAMPLING, SHAPE)
    yield partially_coherent_image(POINT, SAMPLING, SHAPE, axis)
    yield by_transfer_function()
    yield through_focus(TRANSFORM, phase[0], [0.0])[0]
    rays = ray_basis(GRID.x, GRID.y, GRID.light, PIXELS, SAMPLING, 2.0)
    yield segment_psf.psf(rays, OPD[None]).reshape(PIXELS, PIXELS)
    yield segment_psf.amplitude_images(rays, np.exp(2j * np.pi * OPD[None])).reshape(PIXELS, PIXELS)
    fitted = ray_phase(GRID, GRID.x, GRID.y, OPD[None], NOLL.shape[1]).phase
    yield matrix_fourier.psf(TRANSFORM, fitted)[0]


def assert_same(images):
    wanted = np.abs(direct()) ** 2
    wanted /= wanted.sum()
    for number, image in enumerate(images):
        # A pupil of 16 frequencies across has a coarse rim.
        assert np.abs(image / image.sum() - wanted).max() < 0.08 * wanted.max(), number
        mirrored = np.roll(wanted[::-1, ::-1], 1, axis=(0, 1))
        assert np.abs(image / image.sum() - mirrored).max() > 0.3 * wanted.max(), number


def direct():
    """Return the sum over the pupil as the convention is written."""
    inside = np.hypot(*np.meshgrid(GRID.axis, GRID.axis)) < 1.0
    x, y = (values[inside] for values in np.meshgrid(GRID.axis, GRID.axis))
    pupil = np.exp(2j * np.pi * (annular_zernike(x, y, NOLL.shape[1]) @ NOLL[0]))
    along_x, along_y = (np.exp(-2j * np.pi * np.outer(HERE, 0.5 * axis)) for axis in (x, y))
    return (along_y * pupil) @ along_x.T


@pytest.mark.parametrize("device", DEVICES, ids=lambda device: device.kind)
def test_images_of_sampled_pupils_have_one_sign(device):
    assert_same(on_device(device))


def test_images_of_objects_rays_and_transfer_functions_have_the_same():
    assert_same(elsewhere())


def test_a_tilt_moves_images_by_four_times_its_coefficient():
    tilt = NOLL * [0, 1, 1, 0, 0, 0, 0, 0, 0]
    shape = PupilShape(0.0, lambda x, y: annular_zernike(x, y, 3) @ tilt[0, :3])
    images = [
        zernike_images(zernike_imager(GRID, PIXELS, SAMPLING, 9), tilt)[0],
        coherent_image(POINT, SAMPLING, shape),
        incoherent_image(POINT, SAMPLING, shape),
    ]
    for image in images:
        bright = np.where(image > 0.2 * image.max(), image, 0.0)
        center = np.array([bright.sum(axis=0) @ HERE, bright.sum(axis=1) @ HERE]) / bright.sum()
        np.testing.assert_allclose(center, [0.80, 0.52], rtol=0, atol=0.02)


@pytest.mark.parametrize("device", DEVICES, ids=lambda device: device.kind)
def test_images_of_segments_have_the_same(device):
    """Four squares whose tilts, alike, move the image by slope times diameter; pistons set them apart."""
    half, diameter, pixels = 100.0, 400.0, 16
    square = np.array([[-half, -half], [half, -half], [half, half], [-half, half]])
    centers = half * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    corners = centers[:, None] + square
    move = np.array([0.25, 0.15]) / diameter
    motion = np.concatenate([(centers @ move)[:, None], np.tile(move, (4, 1))], axis=1)[None]
    motion[0, 0, 0] += 0.1
    frame = (pixels, SAMPLING, diameter)
    bent = SegmentedPupil(corners, centers, diameter, figure_terms=6)
    figured = np.concatenate([motion, np.zeros((1, 4, 3))], axis=2)
    grid = prepare_psf(bent, pixels, SAMPLING, "matrix").grid
    images = [
        segment_psf.psf(segment_basis(corners, centers, *frame, moments=15, dtype=np.complex128), motion),
        figure_psf(
            segment_figure(corners, centers, *frame, terms=6, moments=15),
            terms_of_motion(figured, bent.reach),
        ),
        point_spread(prepare_psf(bent, pixels, SAMPLING, "segments", device), figured),
        point_spread(prepare_psf(bent, pixels, SAMPLING, "matrix", device), figured),
        matrix_fourier.psf(
            matrix_fourier.matrix_fourier(grid, pixels, SAMPLING),
            segment_phase(grid, centers, motion, diameter / 2.0),
        ),
    ]
    lattice = segment_lattice(corners, centers, *frame, device=device, moments=15)
    if lattice is not None:
        images.append(lattice_psf(lattice, motion))
    x, y = np.meshgrid(*2 * [np.linspace(-199.0, 199.0, 200)])
    places = np.stack([x.ravel(), y.ravel()], axis=1)
    which = np.argmin(np.linalg.norm(places[:, None] - centers, axis=2), axis=1)
    opd = motion[0, which, 0] + (places - centers[which]) @ move
    along_x, along_y = (
        np.exp(-2j * np.pi * np.outer(HERE[24:40] / diameter, axis.ravel())) for axis in (x, y)
    )
    wanted = np.abs((along_y * np.exp(2j * np.pi * opd)) @ along_x.T) ** 2 / x.size**2
    for number, image in enumerate(images):
        found = np.asarray(image).reshape(pixels, pixels)
        np.testing.assert_allclose(found, wanted, rtol=0, atol=2e-3, err_msg=str(number))
    assert np.abs(wanted[::-1, ::-1] - wanted).max() > 0.1


def test_a_source_beside_the_axis_sends_its_light_to_its_place_in_the_pupil():
    """Its direct light passes at the point; a pupil that is dark there shows none of an even object."""
    even = np.ones((16, 16))
    for x, y in ((0.6, 0.0), (0.0, -0.6)):
        source = Source(np.array([[x, y]]), np.ones(1))
        bright = PupilShape(0.0, lambda a, b, x=x, y=y: 0.25 * ((a - x) ** 2 + (b - y) ** 2 < 0.01))
        field = even + 0.1 * np.cos(2 * np.pi * np.arange(16) / 16)
        turned, plain = (
            partially_coherent_image(field, 0.5, pupil, source) for pupil in (bright, PupilShape())
        )
        # A quarter wave at the direct light alone turns contrast of amplitude into one of phase.
        assert np.ptp(plain) > 0.1
        assert np.ptp(turned) < 0.05 * np.ptp(plain)


def test_rays_and_cells_of_lit_objects_follow_too():
    """A slit in partially coherent light, seen by rays and by cells, is as the transfer function has it."""
    section = ObjectSection(light="partial", sigma=0.3, slit=1.0)
    slit = np.where(np.abs(HERE)[None, :] < 0.5, 1.0, 0.0) * np.ones((PIXELS, 1))
    expected = partially_coherent_image(slit, SAMPLING, SHAPE, disk_source(0.3))
    lit = lit_by_cells(section, TRANSFORM)
    rays = lit_object(section, (GRID.x, GRID.y, GRID.light), PIXELS, SAMPLING, np.pi, 2.0)
    middle = slice(PIXELS // 2 - 8, PIXELS // 2 + 8)
    for one in (lit, rays):
        found = mean_image(one, [OPD[None]])[PIXELS // 2, middle]
        assert np.corrcoef(found, expected[PIXELS // 2, middle])[0, 1] > 0.99
        assert np.corrcoef(found[::-1], expected[PIXELS // 2, middle])[0, 1] < 0.95
