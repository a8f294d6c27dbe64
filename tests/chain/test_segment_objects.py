"""Objects that segmented telescopes image, against sums over rays, Hopkins' double sum and closed forms."""

import numpy as np
import pytest
from scipy.signal import fftconvolve
from scipy.special import j0, j1

import wavequake as wq
from wavequake.chain.images.coherent import source_of
from wavequake.errors import UserError
from wavequake.kernels.device.devices import NUMPY
from wavequake.optics.segments.prepared import chief_rays, trace_states
from wavequake.optics.segments.wavefront import analyse
from wavequake.workflows.kinds import find_kind
from wavequake.workflows.segments.bench import bench_of
from wavequake.workflows.segments.disturbance import draw
from wavequake.workflows.segments.launches import surface_states
from wavequake.workflows.study import load_study

KIND = find_kind("segment-disturbance")
STUDY = """
[study]
name = "objects"
workflow = "segment-disturbance"
[telescope]
name = "tmt-18"
[[disturbance]]
name = "alignment"
model = "static-random"
piston_nm = 60.0
tip_nrad = 20.0
tilt_nrad = 20.0
[optics]
wavelength_nm = 1000.0
rays_per_segment = 72
[wavefront]
zernike_terms = 15
[imaging]
pixels = 24
[campaign]
cases = 2
"""
SHAKEN = """
[[disturbance]]
name = "pump"
model = "vibration-lines"
lines = [{ frequency_hz = 50.0, fwhm_hz = 1e-3, rms_mas = 8.0 }]
duration_s = 0.02
instants = 4
direction_deg = 0.0
"""
PIXELS, SAMPLING = 24, 0.25


@pytest.fixture
def study_of(tmp_path):
    def load(text=STUDY, **keys):
        file = tmp_path / "study.toml"
        file.write_text(text)
        return load_study(file, {name.replace("__", "."): value for name, value in keys.items()})

    return load


def rays_of(bench, case):
    """Where rays pass the pupil in diameters, and what they carry, about the line of sight at rest."""
    states = surface_states(bench, draw(bench, case), 0, 1)
    traced = trace_states(bench.prepared, states, NUMPY)
    prepared, chief = bench.prepared, chief_rays(bench.prepared, states)
    wavefront, rays = analyse(prepared, traced, chief), prepared.rays
    slope = (wavefront.chief[0] - bench.static.chief[0]) / prepared.focal_length
    opd = np.array(traced.opd)[0, :, 0] - slope[0] * rays.x - slope[1] * rays.y
    ahead = prepared.weight * np.exp(-2j * np.pi * opd / prepared.wavelength) / prepared.weight.sum()
    return np.stack([rays.x, rays.y]) / (2.0 * bench.system.annulus.outer), ahead


def amplitude(rays, x, y):
    """Amplitude (y, x) of a point's image as a sum of plane waves; 1 at the perfect peak."""
    (u, v), ahead = rays
    return (np.exp(-2j * np.pi * np.outer(y, v)) * ahead) @ np.exp(-2j * np.pi * np.outer(u, x))


def fill(bench):
    """Area of the glass over that of the square about the pupil: a plane wave's share of an even plane."""
    return float(bench.layout.areas_m2.sum()) * 1e6 / (2.0 * bench.system.annulus.outer) ** 2


def convolved(spread, picture, parts):
    """Sum of what all fine points of a picture's pixels make at the middles of the pixels.

    ``spread`` is about [n // 2, n // 2]; the middle of pixel i is its fine point parts * i + parts // 2.
    """
    fine = np.kron(picture, np.ones((parts, parts))) * (SAMPLING / parts) ** 2
    full = fftconvolve(fine, spread)
    middle = len(spread) // 2
    at = middle + parts * np.arange(PIXELS) + parts // 2
    return full[np.ix_(at, at)]


def two_slits():
    axis = (np.arange(PIXELS) - PIXELS // 2) * SAMPLING
    edges = axis[:, None] + np.array([-0.5, 0.5]) * SAMPLING
    line = sum(
        np.clip(np.minimum(edges[:, 1], c + 0.25) - np.maximum(edges[:, 0], c - 0.25), 0.0, None)
        for c in (-1, 1)
    )
    return np.tile(line / SAMPLING, (PIXELS, 1))


@pytest.mark.parametrize("light", ["coherent", "incoherent"])
def test_a_double_slit_is_the_sum_of_what_its_points_make(study_of, light):
    study = study_of(object__double_slit=[0.5, 2.0], object__light=light)
    text = study.identity_text()
    found = KIND.compute(text, np.array([0]), "numpy").arrays["object_image"][0]
    bench, parts = bench_of(text), 5
    axis = (np.arange(2 * PIXELS * parts + 1) - PIXELS * parts) * SAMPLING / parts
    point = amplitude(rays_of(bench, 0), axis, axis) * fill(bench)
    picture = two_slits()
    if light == "coherent":
        expected = np.abs(convolved(point, picture, parts)) ** 2
    else:
        expected = convolved(np.abs(point) ** 2 / fill(bench), picture, parts)
    assert 0.05 < expected.max() < 1.0
    np.testing.assert_allclose(found, expected, rtol=0, atol=5e-3 * expected.max())
    assert np.abs(found[::-1] - expected).max() > 0.05 * expected.max()


def test_a_picture_in_partially_coherent_light_is_hopkins_double_sum(study_of, tmp_path):
    picture, sigma = np.zeros((PIXELS, PIXELS)), 0.6
    picture[12, 9], picture[12, 14], picture[17, 12] = 1.0, 0.7, 0.5
    np.save(tmp_path / "holes.npy", picture)
    study = study_of(object__picture="holes.npy", object__light="partial", object__sigma=sigma)
    text = study.identity_text()
    found = KIND.compute(text, np.array([1]), "numpy").arrays["object_image"][0]
    bench, axis, parts = bench_of(text), (np.arange(PIXELS) - PIXELS // 2) * SAMPLING, 3
    inside = (np.arange(parts) - parts // 2) * SAMPLING / parts
    points, fields, rays = [], [], rays_of(bench, 1)
    for row, column in np.argwhere(picture):
        for up in inside:
            for across in inside:
                x, y = axis[column] + across, axis[row] + up
                points.append((x, y))
                fields.append(amplitude(rays, axis - x, axis - y) * picture[row, column])
    points, fields = np.array(points), np.array(fields) * fill(bench) * (SAMPLING / parts) ** 2
    away = points[:, None] - points[None]
    apart = np.pi * sigma * np.hypot(*away.transpose(2, 0, 1))
    disk = np.where(apart < 1e-9, 1.0, 2.0 * j1(apart) / np.maximum(apart, 1e-9))
    source = source_of(study.object)  # its points stand for the disk
    waves = np.cos(np.pi * np.einsum("kd,pqd->kpq", source.points, away))
    degree = np.tensordot(source.weights, waves, 1)
    np.testing.assert_allclose(degree, disk, rtol=0, atol=0.05)
    expected = np.einsum("pq,pyx,qyx->yx", degree, fields, fields.conj()).real
    np.testing.assert_allclose(found, expected, rtol=0, atol=5e-3 * expected.max())
    alone = np.einsum("pyx,pyx->yx", fields, fields.conj()).real
    assert np.abs(alone / alone.max() - expected / expected.max()).max() > 0.1


@pytest.mark.parametrize("light", ["coherent", "incoherent"])
def test_an_object_that_swings_is_smeared_by_bessels_function(study_of, light):
    """A line of one frequency: its places have the arcsine density, whose transform is J0(2 pi a f)."""
    head, _, tail = STUDY.partition("[[disturbance]]")
    text = head + SHAKEN + tail[tail.index("[optics]") :]
    study = study_of(
        text, object__slit=0.75, object__light=light, optics__rays_per_segment=18, imaging__pixels=48
    )
    identity = study.identity_text()
    result = KIND.compute(identity, np.array([0]), "numpy")
    rest = KIND.template(identity).fixed["object_static"][1]
    per_mas = np.deg2rad(1.0 / 3.6e6) * 2.0 * bench_of(identity).system.annulus.outer / 1e-3
    way = result.arrays["los"][0, :, 0] * per_mas
    reach = np.hypot(way[0], way[1])  # a quarter of a period apart
    assert reach > 0.5
    frequency = np.fft.rfftfreq(96, SAMPLING)
    factor = j0(2.0 * np.pi * reach * frequency)
    expected = np.fft.irfft(np.fft.rfft(np.pad(rest, ((0, 0), (24, 24))), axis=1) * factor, axis=1)[:, 24:-24]
    found = result.arrays["object_image"][0]
    assert np.abs(found - rest).max() > 0.1 * rest.max()
    middle = slice(8, 40)  # beyond, light comes from outside the frame
    np.testing.assert_allclose(found[:, middle], expected[:, middle], rtol=0, atol=0.01 * rest.max())


def test_a_study_stores_compares_and_exports_objects_of_every_field(study_of, tmp_path):
    study = study_of(
        optics__fields_arcmin=[[0.0, 0.0], [0.05, 0.0]],
        optics__rays_per_segment=18,
        object__grating=2.0,
        object__light="coherent",
    )
    found = wq.run(study, store=tmp_path / "store", campaign__device="numpy").load()
    assert found.object_image.dims == ("case", "field", "y", "x")
    assert found.object_static.dims == ("field", "y", "x")
    assert np.isfinite(found.object_image).all()
    page = wq.report(tmp_path / "store")
    assert "The object as case" in page.read_text()
    alone = study_of(
        optics__field_arcmin=[0.05, 0.0],
        optics__rays_per_segment=18,
        object__grating=2.0,
        object__light="coherent",
    )
    other = KIND.compute(alone.identity_text(), np.arange(2), "numpy").arrays["object_image"]
    np.testing.assert_array_equal(found.object_image.isel(field=1), other)


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"object__slit": 1.0, "object__grating": 1.0}, "exactly one"),
        ({"object__slit": 1.0, "imaging__enabled": False}, "object is of images"),
        ({"object__stars": [[9.0, 0.0, 1.0]]}, "beyond the frame"),
        ({"object__slit": 1.0, "object__light": "partial"}, "sigma"),
    ],
)
def test_impossible_objects_are_refused(study_of, keys, words):
    with pytest.raises(UserError, match=words):
        KIND.check(study_of(**keys).identity_text())
