"""The camera of loops: centroids of images of the imaging code on pixels, and the noise of drawn frames."""

from dataclasses import replace

import numpy as np
import pytest
from small_loops import LIGHT, written

from wavequake.chain.loops.light import RayLight
from wavequake.chain.loops.sensors.camera import Camera
from wavequake.errors import UserError
from wavequake.imaging.engines.choice import point_spread, prepare_psf
from wavequake.imaging.exposures.detector import read_out
from wavequake.imaging.pupils.pupil_function import annular_pupil
from wavequake.imaging.pupils.wavefront_phase import zernike_phase
from wavequake.kernels.device.devices import choose_device
from wavequake.mechanics.disturbances.motion import RAD_PER_MAS
from wavequake.optics.polynomials.zernike import annular_zernike
from wavequake.workflows.exposures.telescope_control import measured_opd, ray_phase, trace
from wavequake.workflows.loops.telescope_bench import bench_of
from wavequake.workflows.loops.telescope_light import drawn, seen_of
from wavequake.workflows.loops.telescope_loop import positions_of, states_of
from wavequake.workflows.segments.images import images_of_rays

SEEN = replace(LIGHT, wavelength_nm=1000.0)
AIRY = 1e-3 / 30000.0 / RAD_PER_MAS  # mas
CAMERA = Camera(name="c", pixel_mas=0.5 * AIRY, pixels=12)


def images(noll_nm, pixels=12, pixel=0.5, cells=400):
    """Return images (b, pixels, pixels) on pixels of so many wavelengths / diameter, by the imaging code."""
    pupil = annular_pupil(cells, 0.3)
    # The origin is a point, half a point to the right of the window's middle: the image goes there.
    fine = int(np.ceil(48 * pixel))
    points, sampling = pixels * fine, pixel / fine
    engine = prepare_psf(pupil, points, sampling, engine="matrix")
    half = np.zeros((1, SEEN.terms - 1))
    half[0, :2] = -0.5 * sampling * AIRY * SEEN.tilt
    # In images an optical path that rises moves to the right; in loops one that falls.
    waves = -(np.atleast_2d(noll_nm) + half) / SEEN.wavelength_nm
    coefficients = np.hstack([np.zeros((len(waves), 1)), waves])
    found = point_spread(engine, zernike_phase(pupil, coefficients, 0.3))
    return sampling**2 * found.reshape(len(found), pixels, fine, pixels, fine).sum(axis=(2, 4))


def centroids(frames, pixel=0.5):
    """Return centres of gravity (b, 2) in mas along x and y."""
    count = frames.shape[-1]
    at = (np.arange(count) - (count - 1) / 2) * pixel * AIRY
    total = frames.sum(axis=(1, 2))
    return np.stack([frames.sum(axis=1) @ at, frames.sum(axis=2) @ at], axis=1) / total[:, None]


@pytest.mark.parametrize(("pixels", "pixel"), [(12, 0.5), (2, 3.0), (9, 1.1)])
def test_it_reads_the_centroid_of_images_of_the_imaging_code(pixels, pixel):
    """Central differences of the images' centroids by every coefficient; quad cells and odd windows, too.

    Its pupil has 256 cells across or more: it is no farther off images of 400 than these off images of 200.
    """
    camera = Camera(name="c", pixel_mas=pixel * AIRY, pixels=pixels)
    steps = 1.0 * np.eye(SEEN.terms - 1)
    coarse, fine = (
        centroids(images(np.vstack([steps, -steps]), pixels, pixel, cells), pixel) for cells in (200, 400)
    )
    rough, wanted = ((each[: len(steps)] - each[len(steps) :]).T / 2.0 for each in (coarse, fine))
    noll = camera.matrix(SEEN) @ np.linalg.inv(SEEN.noll)
    known = np.abs(wanted - rough).max()
    assert known < 2e-3 * np.abs(wanted).max()
    np.testing.assert_allclose(noll, wanted, rtol=0, atol=known)


def test_what_it_leaves_out_is_of_third_order():
    """Coma, tilt and trefoil of 30 nm at 1000 nm: what is left is the phase's square of that, and cubic.

    Odd aberrations turn the image round where their sign changes, so that centroids have the orders 1, 3, 5
    and so on of their size, each smaller by the phase's square. c(a) - 2 c(a / 2) has no first order.
    """
    aberrations = np.zeros((3, SEEN.terms - 1))
    aberrations[0, 0], aberrations[1, 6], aberrations[2, [0, 6, 8]] = 30.0, 30.0, (10.0, -20.0, 25.0)
    seen = np.linalg.solve(SEEN.noll, aberrations.T)
    reads = (CAMERA.matrix(SEEN) @ seen).T
    next_order = (2 * np.pi / SEEN.wavelength_nm) ** 2 * (aberrations**2).sum(axis=1).max()
    one, half, quarter = (centroids(images(share * aberrations)) for share in (1.0, 0.5, 0.25))
    assert np.abs(one - reads).max() < next_order * np.abs(reads).max()
    whole, less = one - 2 * half, half - 2 * quarter
    place = np.unravel_index(np.abs(whole).argmax(), whole.shape)
    assert less[place] / whole[place] == pytest.approx(1 / 8, rel=next_order)


def test_a_wide_window_reads_the_mean_slope():
    """The centroid of a whole image is the mean slope of its wavefront: of coma more than of its tilt.

    Without obscuration mean slopes of Noll's Z2 and Z8 are 2 and sqrt(8) per radius. What a window of half
    width h loses falls as 1 / h, and what is next as the square of that less.
    """
    open_ = replace(SEEN, obscuration=0.0)
    off = []
    for pixels in (16, 32):
        reads = Camera(name="c", pixel_mas=AIRY, pixels=pixels).matrix(open_) @ np.linalg.inv(open_.noll)
        off.append(1.0 - reads[0, 6] / reads[0, 0] / np.sqrt(2.0))
    assert abs(2 * off[1] - off[0]) < off[0] / 16**2


def test_its_noise_is_that_of_drawn_frames():
    """Poisson photons and normal read noise on the pixels of an image; the mean square of 20,000 frames."""
    photons, read_noise = 2e4, 3.0
    camera = Camera(name="c", pixel_mas=0.5 * AIRY, pixels=12, photons=photons, read_noise=read_noise)
    image = images(np.zeros(SEEN.terms - 1))[0]
    # All light is diameter² / area, in the unit of the peak and (wavelengths / diameter)².
    share = image.sum() * np.pi / 4 * (1 - 0.3**2)
    random = np.random.default_rng(3)
    expected = np.broadcast_to(photons * share * image / image.sum(), (20000, 12, 12))
    found = centroids(read_out(expected, read_noise, random))
    rms = np.sqrt(np.mean(found**2))
    # Of 40,000 numbers the rms is known to 0.35 %; the closed form is of first order in 1 / N.
    assert camera.noise_rms(SEEN) == pytest.approx(rms, rel=0.015)
    quiet = camera.model_copy(update={"read_noise": 0.0}).noise_rms(SEEN)
    assert quiet < 0.9 * rms


def test_it_says_where_there_is_no_image():
    with pytest.raises(UserError, match=r"sensor\.c: nothing here has a wavelength, .*take line-of-sight"):
        CAMERA.matrix(LIGHT)
    wide = Camera(name="c", pixel_mas=100 * AIRY, pixels=64)
    with pytest.raises(UserError, match=r"64 pixels of .* mas are too many .* take pixel_mas"):
        wide.matrix(SEEN)


def test_it_holds_the_image_of_a_telescope_where_the_line_of_sight_does_not(tmp_path):
    """Traced images of 18 segments on its pixels: with the line of sight at rest coma moves their centroids.

    Of rays it reads what closed integrals of pairs of them over pixels give. Without rays it knows Zernike
    terms, but for the square of the phase. Images of the imaging code have eight points across a pixel, which
    weigh the finest fringes too much by (pi / 4)² / 6.
    """
    more = """
[[sensor]]
name = "camera"
model = "camera"
pixel_mas = 9.1428
pixels = 8

[[controller]]
name = "seen"
model = "perfect"
sensor = "camera"
actuator = "tilt"
"""
    size = {"imaging.pixels": 64, "imaging.sampling": 0.25, "disturbance.history.instants": 40}
    size |= {"wavefront.zernike_terms": 36, "optics.rays": 800}
    bench = bench_of(written(tmp_path, more, size))
    control, chosen = bench.optics.control, np.arange(0, 40, 4)
    pixel = 9.1428 * RAD_PER_MAS * control.diameter / control.prepared.wavelength
    assert pixel == pytest.approx(2.0, rel=1e-4)  # wavelengths / diameter
    draw = drawn(bench.study, bench.optics, 0, 0)
    seen = seen_of(bench.study, bench.optics, draw)
    camera = bench.study.part("sensor", "camera")
    reads = camera.readings(bench.optics.light)
    found, told, by_rays, by_pairs, lights = {}, {}, {}, {}, {}
    wavelength = control.prepared.wavelength
    for name in ("seen", "rigid-perfect"):
        one = next(each for each in bench.controllers if each.name == name)
        positions = positions_of(bench, one, 0, [draw], [seen], choose_device("numpy"))[0][0]
        states = states_of(bench, one, draw, positions, chosen)
        rays, wavefront = trace(control.prepared, states, choose_device("numpy"))
        phase = ray_phase(control, measured_opd(control, rays), wavefront, control.static.los[:1])
        across, entry = control.basis.pixels, control.prepared.rays
        # To the middle of the window, half a point to the left of an image's origin.
        to_middle = -0.5 * 0.25 / control.diameter * (entry.x + entry.y)
        frames = np.asarray(images_of_rays(control.basis, phase[: len(chosen)] + to_middle, wavefront.device))
        window = slice(across // 2 - 32, across // 2 + 32)
        frames = frames.reshape(-1, across, across)[:, window, window]
        at = (np.arange(8) - 3.5) * 9.1428
        pixels = frames.reshape(-1, 8, 8, 8, 8).sum(axis=(2, 4))
        total = pixels.sum(axis=(1, 2))[:, None]
        light = lights[name] = RayLight(entry.x, entry.y, control.prepared.weight, phase)
        by_rays[name] = camera.of_rays(bench.optics.light, light)[:, : len(chosen)].T
        by_pairs[name] = by_pairs_of_rays(light, len(chosen), 9.1428, wavelength)
        found[name] = np.stack([pixels.sum(axis=1) @ at, pixels.sum(axis=2) @ at], axis=1) / total
        told[name] = (reads @ (seen[1:][chosen] + positions[chosen] @ one.sight.T).T).T
    apart = found["rigid-perfect"] - found["seen"]
    predicted = told["rigid-perfect"] - told["seen"]
    size = np.abs(predicted).max()
    assert np.abs(told["seen"]).max() < 1e-9 * size
    spread = (2 * np.pi) ** 2 * max(one.phase[: len(chosen)].var(axis=1).max() for one in lights.values())
    np.testing.assert_allclose(apart, predicted, rtol=0, atol=spread * size)
    # Of a quarter of the Zernike terms, without the steps between segments: a sixteenth of that.
    basis = annular_zernike(
        *(one / bench.optics.light.radius_mm for one in (entry.x, entry.y)),
        36,
        bench.optics.light.obscuration,
    )
    quarter = {}
    for name, light in lights.items():
        phase = 0.25 * np.linalg.lstsq(basis, light.phase.T)[0].T @ basis.T
        quarter[name] = by_pairs_of_rays(replace(light, phase=phase), len(chosen), 9.1428, wavelength)
    known = 4 * (quarter["rigid-perfect"] - quarter["seen"])
    np.testing.assert_allclose(known, predicted, rtol=0, atol=spread / 16 * size)
    assert (np.ptp(found["seen"], axis=0) < np.ptp(found["rigid-perfect"], axis=0)).all()
    for name, values in by_rays.items():
        # Of ten nodes of Gauss in a pixel, for the finest fringe.
        np.testing.assert_allclose(values, by_pairs[name], rtol=0, atol=1.1e-8 * 4 * 9.1428)
        np.testing.assert_allclose(values, found[name], rtol=0, atol=(np.pi / 4) ** 2 / 6 * size)


def by_pairs_of_rays(light, count, pixel, wavelength):
    """Return centroids (count, 2), mas, of 8 x 8 pixels: pairs of rays are fringes, integrated over them."""
    middles = (np.arange(8) - 3.5) * pixel
    turn = 2 * np.pi / wavelength * RAD_PER_MAS

    def over_pixels(at):
        apart = turn * (at[:, None] - at)
        mean = np.sinc(apart * pixel / (2 * np.pi))
        fringe = np.exp(-1j * apart[..., None] * middles) * mean[..., None]
        return fringe.sum(axis=-1), fringe @ middles

    (plain_x, moment_x), (plain_y, moment_y) = over_pixels(light.x), over_pixels(light.y)
    found = np.empty((count, 2))
    for k, phase in enumerate(light.phase[:count]):
        field = light.weight * np.exp(2j * np.pi * phase)
        pairs = np.outer(field, field.conj())
        total = (pairs * plain_x * plain_y).sum().real
        along = (pairs * moment_x * plain_y).sum().real, (pairs * plain_x * moment_y).sum().real
        found[k] = np.array(along) / total
    return found


SHORT = {"disturbance.history.duration_s": 0.02, "look.traced": 0}


def test_where_sensors_see_rays_a_camera_does_not_know_the_linear_light(tmp_path):
    """Sensitivities, what is seen and what it reads of it are 10 % too small: positions are the same."""
    more = """
[[sensor]]
name = "camera"
model = "camera"

[[controller]]
name = "seen"
model = "integrator"
sensor = "camera"
actuator = "tilt"
gain = 0.3
"""
    study = written(tmp_path, more, {"look.sensors": "traced", "disturbance.history.instants": 10, **SHORT})
    bench = bench_of(study)
    right = next(one for one in bench.controllers if one.name == "seen")
    draws = [drawn(study, bench.optics, 0, 0)]
    seen = [seen_of(study, bench.optics, draws[0])]
    dimmed = tuple(tuple(0.9 * matrix for matrix in each) for each in right.readings)
    loops = tuple(replace(loop, sees=0.81 * loop.sees) for loop in right.loops)
    wrong = replace(right, sight=0.9 * right.sight, loops=loops, readings=dimmed)
    numpy = choose_device("numpy")
    expected = positions_of(bench, right, 0, draws, seen, numpy)[0][0]
    found = positions_of(bench, wrong, 0, draws, [0.9 * seen[0]], numpy)[0][0]
    assert np.ptp(expected) > 0.1
    np.testing.assert_allclose(found, expected, atol=1e-9 * np.abs(expected).max())
