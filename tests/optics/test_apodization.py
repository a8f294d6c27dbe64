"""Light that falls towards the rim of the pupil: against integrals in closed form, and the rays."""

from dataclasses import replace

import numpy as np
import pytest

from wavequake.errors import UserError
from wavequake.kernels.device.devices import NUMPY, list_devices
from wavequake.optics.catalog.names import optical_system
from wavequake.optics.light import trace
from wavequake.optics.rays.pupils import pupil_amplitude
from wavequake.optics.segments.catalog import telescope
from wavequake.optics.shapes.shapes import Conic, ZernikeDeformation
from wavequake.optics.systems.apodization import Apodization
from wavequake.optics.systems.file import SystemSection, build
from wavequake.optics.systems.info import info
from wavequake.optics.systems.kinematics import rest_states
from wavequake.optics.systems.system import OpticalSystem, Pupil, Surface
from wavequake.optics.wavefronts.record import ARRAYS
from wavequake.optics.wavefronts.wavefront import measure_system, prepare_system, with_fitted_sphere
from wavequake.optics.zemax.export import zmx_text
from wavequake.optics.zemax.read import parse_zmx

COSINES = Apodization("cosine_cubed")


def apodized(system, given):
    return replace(system, pupil=replace(system.pupil, apodization=given))


def gaussian(system, factor):
    return apodized(system, Apodization("gaussian", factor))


def parabola(distance=1000.0):
    """A mirror so slow that its wavefronts are its shape and the image's place; its figure can change."""
    mirror = Surface("M1", Conic(-2000.0, -1.0), action="reflect", deformation=ZernikeDeformation(11, 5.0))
    image = Surface("image", position=np.array([0.0, 0.0, -distance]))
    return OpticalSystem("parabola", (mirror, image), 0, Pupil("entrance_diameter", 10.0))


def cubature():
    """Points and weights that integrate over the unit circle what is smooth, to rounding."""
    nodes, weights = np.polynomial.legendre.leggauss(24)
    radius, angle = np.sqrt((nodes + 1.0) / 2.0), 2.0 * np.pi * (np.arange(24) + 0.5) / 24
    shares = np.repeat(weights / 2.0, 24) / 24
    return *(np.outer(radius, part(angle)).ravel() for part in (np.cos, np.sin)), shares


def measured(system, device=NUMPY, **figure):
    prepared = prepare_system(system, *cubature(), 11)
    states = rest_states(system)
    for j, height in figure.items():
        states.deformations[0][:, int(j[1:]) - 1] = height
    return measure_system(prepared, states, device)


def moments(factor):
    """Mean and mean square of t = rho^2 where the light is exp(-2 G t), 0 <= t <= 1."""
    a, rim = 2.0 * factor, np.exp(-2.0 * factor)
    whole = (1.0 - rim) / a
    mean = (1.0 - (1.0 + a) * rim) / a**2 / whole
    square = (2.0 - (2.0 + 2.0 * a + a**2) * rim) / a**3 / whole
    return mean, square


@pytest.mark.parametrize("factor", [0.3, 1.0, 3.0])
def test_a_defocused_gaussian_beam_has_the_strehl_ratio_and_rms_of_its_integrals(factor):
    found = measured(gaussian(parabola(), factor), z4=40e-6)
    focus = 2.0 * np.sqrt(3.0) * found.zernike[0, 3]  # waves from center to rim: W = focus rho^2
    assert abs(focus) == pytest.approx(4.0 * np.sqrt(3.0) * 40e-6 / 550e-6, rel=1e-4)  # met twice
    slope = factor - 2j * np.pi * focus
    amplitude = (1.0 - np.exp(-slope)) / slope / ((1.0 - np.exp(-factor)) / factor)
    assert found.strehl[0] == pytest.approx(abs(amplitude) ** 2, abs=2e-5)
    mean, square = moments(factor)
    assert found.rms_raw[0] == pytest.approx(abs(focus) * np.sqrt(square - mean**2), rel=2e-5)
    assert found.rms[0] == pytest.approx(abs(focus) / np.sqrt(12.0), rel=1e-4)  # over the area


@pytest.mark.parametrize("factor", [0.3, 1.0, 3.0])
def test_a_spot_weighs_rays_by_their_light(factor):
    found = measured(gaussian(parabola(1002.0), factor))
    mean, _ = moments(factor)
    assert found.spot_rms[0] == pytest.approx(2.0 * 5.0 / 1000.0 * np.sqrt(mean), rel=1e-4)


@pytest.mark.parametrize("given", [Apodization("gaussian", 0.0), COSINES])
def test_light_that_is_uniform_gives_the_bits_of_none(given):
    """A Gaussian without decrease, and a point source that is a star."""
    system = optical_system("double-gauss")
    one, other = trace(system, field=1), trace(apodized(system, given), field=1)
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    assert "apodization" in info(apodized(system, given))


def test_rays_and_first_order_data_do_not_change():
    system = optical_system("double-gauss")
    points = cubature()
    one, other = (prepare_system(one, *points, 11, 1) for one in (system, gaussian(system, 2.0)))
    for name in ("position", "direction", "path"):
        np.testing.assert_array_equal(getattr(one.rays, name), getattr(other.rays, name))
    assert (one.sphere_radius, one.wavelength) == (other.sphere_radius, other.wavelength)
    np.testing.assert_array_equal(one.cosines, other.cosines)
    assert "Gaussian, factor 2: 0.01832 of the central light at the rim" in info(other.system)


def test_a_point_source_lights_a_plane_by_the_cube_of_the_cosine():
    """The stop is the first surface: its rays' own directions say how much light reaches it."""
    lens = Surface("lens", Conic(60.0), action="refract", position=np.zeros(3))
    image = Surface("image", position=np.array([0.0, 0.0, 400.0]))
    system = OpticalSystem("near", (lens, image), 0, Pupil("stop", 8.0), object_distance=20.0)
    system = apodized(replace(system, surfaces=(replace(lens, shape=Conic(), action="pass"), image)), COSINES)
    x, y = np.array([0.0, 0.5, -0.3, 1.0]), np.array([0.0, 0.2, -0.6, 0.0])
    away = np.array([8.0 * x, 8.0 * y, np.full(4, 20.0)])
    cosine = away[2] / np.linalg.norm(away, axis=0)
    np.testing.assert_allclose(pupil_amplitude(system, x, y) ** 2, cosine**3, rtol=1e-12)


def test_the_fitted_sphere_keeps_the_line_of_sight():
    system = gaussian(optical_system("double-gauss"), 1.0)
    prepared = prepare_system(system, *cubature(), 11, 1)
    rest = rest_states(system)
    one, other = (measure_system(one, rest, NUMPY) for one in (prepared, with_fitted_sphere(prepared)))
    np.testing.assert_allclose(other.los, one.los, atol=1e-6)


def test_devices_agree():
    found = [one.name for one in list_devices() if one.kind == "cpu"]
    if not found:
        pytest.skip("no OpenCL processor")
    system = gaussian(optical_system("double-gauss"), 1.5)
    here, there = (trace(system, field=1, device=name) for name in ("numpy", found[0]))
    for name in ("zernike", "rms_raw", "rms_flat", "strehl", "los", "centroid", "spot_rms"):
        np.testing.assert_allclose(getattr(there, name), getattr(here, name), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("given", [None, Apodization("gaussian", 0.7), COSINES])
def test_lens_files_hold_it(given):
    system = apodized(optical_system("double-gauss"), given)
    again = parse_zmx(zmx_text(system), "again.zmx")
    assert again.pupil == system.pupil
    assert again.note == ""


def test_study_files_say_it():
    def of(**keys):
        return build(SystemSection(name="double-gauss", f_number=4.0, **keys)).pupil

    given = Apodization("gaussian", 0.7)
    assert of(pupil_apodization="gaussian", apodization_factor=0.7).apodization == given
    assert of(pupil_apodization="cosine_cubed").apodization == COSINES
    assert of(pupil_apodization="uniform").apodization is None
    assert "apodization" not in SystemSection(name="double-gauss").model_dump_json()
    text = zmx_text(gaussian(optical_system("double-gauss"), 0.7))
    assert build(SystemSection(file_text=text, f_number=4.0)).pupil.apodization == given
    assert build(SystemSection(file_text=text, pupil_apodization="uniform")).pupil.apodization is None


@pytest.mark.parametrize(
    "keys",
    [
        {"pupil_apodization": "gaussian"},
        {"apodization_factor": 1.0},
        {"pupil_apodization": "cosine_cubed", "apodization_factor": 1.0},
        {"pupil_apodization": "gaussian", "apodization_factor": -1.0},
        {"pupil_apodization": "gaussian", "apodization_factor": float("nan")},
        {"pupil_apodization": "bell"},
    ],
)
def test_bad_keys_are_refused(keys):
    with pytest.raises(ValueError, match="apodization"):
        SystemSection(name="double-gauss", **keys)


@pytest.mark.parametrize(
    ("given", "match"),
    [
        (Apodization("gaussian", -1.0), "the factor -1; it must be from 0 to 20"),
        (Apodization("gaussian", float("nan")), "the factor nan"),
        (Apodization("bell"), "'bell'; it can be 'gaussian' or 'cosine_cubed'"),
    ],
)
def test_bad_apodizations_are_refused(given, match):
    with pytest.raises(UserError, match=match):
        trace(apodized(optical_system("double-gauss"), given), rays=100)


def test_segments_are_of_uniform_light():
    system = telescope("tmt-18")
    with pytest.raises(UserError, match="the images of segments are of uniform light"):
        trace(gaussian(system, 1.0), rays=100)


def test_a_rim_without_light_is_told():
    with pytest.raises(UserError, match="apodization"):
        trace(gaussian(optical_system("double-gauss"), 20.0), terms=66)
