"""Images of apodized pupils against Gaussian beams, integrals along a radius, and conservation of light."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import j0

from wavequake.errors import UserError
from wavequake.kernels.device.devices import list_devices
from wavequake.workflows.kinds import find_kind
from wavequake.workflows.study import load_study
from wavequake.workflows.systems.bench import system_bench

KIND = find_kind("system-disturbance")
STILL = """
[study]
name = "still"
workflow = "system-disturbance"
[system]
name = "parabola"
wavelengths_nm = [500.0]
entrance_diameter_mm = 100.0
{apodization}
surface = [
  {{ name = "M1", radius_mm = -2000.0, conic = -1.0, glass = "mirror", stop = true }},
  {{ name = "image", distance_mm = {distance} }},
]
[[disturbance]]
name = "shake"
model = "surface-vibration"
of = ["M1"]
duration_s = 0.01
instants = 4
lines = [ {{ frequency_hz = 100.0, amplitude = {{ dx_um = 1e-6 }} }} ]
[optics]
rays = 500
[imaging]
pixels = 96
pupil_samples = 256
{imaging}
[campaign]
cases = 1
"""
# The frame is 24 lambda/D wide.
AXIS = (np.arange(96) - 48) * 0.25


def gaussian(factor):
    return f'pupil_apodization = "gaussian"\napodization_factor = {factor}'


def text_of(tmp_path, apodization, imaging="", distance=1000.0):
    file = tmp_path / "study.toml"
    file.write_text(STILL.format(apodization=apodization, imaging=imaging, distance=distance))
    return load_study(file).identity_text()


def at_rest(text):
    return {name: values for name, (_, values, _) in KIND.template(text).fixed.items()}


def test_a_gaussian_beam_that_is_hardly_cut_has_a_gaussian_far_field(tmp_path):
    """exp(-2 r^2 / w^2) with w = lambda f / (pi w0): G = (a / w0)^2, and lambda/D is lambda f / (2 a)."""
    factor = 9.0
    text = text_of(tmp_path, gaussian(factor), "[wavefront]\nzernike_terms = 4\n")
    found, result = at_rest(text)["exposure_static"][0], KIND.compute(text, np.array([0]), "numpy").arrays
    width = 2.0 * np.sqrt(factor) / np.pi
    np.testing.assert_allclose(found, np.exp(-2.0 * (AXIS**2 + AXIS[:, None] ** 2) / width**2), atol=5e-4)
    assert result["ee50"][0, 0] == pytest.approx(width * np.sqrt(0.5 * np.log(2.0)), rel=2e-3)
    assert result["ee80"][0, 0] == pytest.approx(width * np.sqrt(0.5 * np.log(5.0)), rel=2e-3)
    assert result["peak"][0, 0] == pytest.approx(1.0, abs=1e-6)


def test_a_cut_gaussian_beam_is_imaged_as_its_radial_integral_says(tmp_path):
    factor = 1.0
    text = text_of(tmp_path, gaussian(factor))
    found = at_rest(text)["exposure_static"][0, 48, 48::7]
    whole = quad(lambda r: r * np.exp(-factor * r**2), 0, 1)[0]
    fields = [
        quad(lambda r, v=v: r * np.exp(-factor * r**2) * j0(np.pi * v * r), 0, 1)[0] for v in AXIS[48::7]
    ]
    np.testing.assert_allclose(found, (np.array(fields) / whole) ** 2, atol=2e-5)


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_light_is_conserved(tmp_path, factor):
    """The area that would shine as brightly is (sum A)^2 / sum A^2; all light under the image is 1."""
    text = text_of(tmp_path, gaussian(factor))
    imager, found = system_bench(text).imager, at_rest(text)["exposure_static"][0]
    amplitude, square = ((1.0 - np.exp(-k * factor)) / (k * factor) for k in (1.0, 2.0))
    assert imager.area[0] == pytest.approx(np.pi * amplitude**2 / square, rel=1e-4)
    assert 0.96 < found.sum() * 0.25**2 * imager.area[0] / 4.0 < 1.0  # the rest falls beside the frame


def test_the_peak_of_a_defocused_beam_is_its_strehl_ratio(tmp_path):
    text = text_of(tmp_path, gaussian(1.5), distance=1000.15)
    fixed = at_rest(text)
    bench = system_bench(text)
    focus = 2.0 * np.sqrt(3.0) * bench.static[0][0].zernike[0, 3]
    slope = 1.5 - 2j * np.pi * focus
    expected = abs((1.0 - np.exp(-slope)) / slope / ((1.0 - np.exp(-1.5)) / 1.5)) ** 2
    assert expected < 0.9
    assert fixed["exposure_static"][0, 48, 48] == pytest.approx(expected, abs=1e-4)
    assert bench.static[0][0].strehl[0] == pytest.approx(expected, abs=2e-3)  # 500 rays


def test_no_decrease_gives_the_bits_of_none(tmp_path):
    one, other = (
        KIND.compute(text_of(tmp_path, given), np.array([0]), "numpy").arrays for given in ("", gaussian(0.0))
    )
    for name, values in one.items():
        np.testing.assert_array_equal(values, other[name], err_msg=name)


def test_devices_agree(tmp_path):
    found = [one.name for one in list_devices() if one.kind == "cpu"]
    if not found:
        pytest.skip("no OpenCL processor")
    text = text_of(tmp_path, gaussian(1.0))
    here, there = (KIND.compute(text, np.array([0]), name).arrays for name in ("numpy", found[0]))
    for name in ("exposure", "peak", "ee80", "strehl"):
        np.testing.assert_allclose(there[name], here[name], rtol=1e-7, atol=1e-9)


def test_an_evenly_lit_plane_stays_as_bright(tmp_path):
    """A picture that is 1 all over, in its middle: in incoherent light all points add up to 1."""
    np.save(tmp_path / "plane.npy", np.ones((96, 96)))
    objects = f'[object]\npicture = "{tmp_path / "plane.npy"}"\n'
    even = at_rest(text_of(tmp_path, gaussian(2.0), objects))["object_static"][0, 48, 48]
    assert even == pytest.approx(1.0, abs=0.02)


def test_a_coherent_grating_loses_the_contrast_of_its_orders(tmp_path):
    """Order 1 of period p passes at 2 / p of the radius, weaker by exp(-G (2 / p)^2); order 3 does not."""
    factor, period = 1.5, 3.0
    objects = f'[object]\ngrating = {period}\nlight = "coherent"\n'
    middle = np.sqrt(at_rest(text_of(tmp_path, gaussian(factor), objects))["object_static"][0, 48, 36:60])
    contrast = np.abs(np.fft.rfft(middle))[2] / middle.sum()  # of two periods; order 1 over order 0
    assert contrast == pytest.approx(2.0 / np.pi * np.exp(-factor * (2.0 / period) ** 2), rel=0.04)


@pytest.mark.parametrize(
    ("apodization", "match"),
    [
        ('pupil_apodization = "gaussian"', "apodization_factor belongs to"),
        (gaussian(-1.0), "apodization_factor"),
        (gaussian("nan"), "apodization_factor"),
        ('pupil_apodization = "bell"', "pupil_apodization"),
    ],
)
def test_studies_with_bad_apodizations_are_refused_in_a_sentence(tmp_path, apodization, match):
    with pytest.raises(UserError, match=match):
        text_of(tmp_path, apodization)
