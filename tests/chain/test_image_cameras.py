"""Planes through focus against moved image planes and closed forms; detectors and sharpness of studies."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import j0, j1

from wavequake.chain.images.system import expose
from wavequake.errors import UserError
from wavequake.kernels.device.devices import NUMPY
from wavequake.optics.systems.kinematics import rest_states
from wavequake.optics.wavefronts.wavefront import measure_system
from wavequake.workflows.kinds import find_kind
from wavequake.workflows.study import load_study
from wavequake.workflows.systems.bench import system_bench

KIND = find_kind("system-disturbance")
SHAKEN = """
[study]
name = "camera"
workflow = "system-disturbance"
[system]
{system}
[[disturbance]]
name = "shake"
model = "surface-vibration"
of = ["{moved}"]
duration_s = 0.01
instants = 6
lines = [ {{ frequency_hz = 100.0, amplitude = {{ dx_um = 2.0 }} }} ]
[optics]
rays = 300
[imaging]
pixels = 40
pupil_samples = 160
{imaging}
{detector}
[campaign]
cases = 3
"""
DOUBLE_GAUSS = 'name = "double-gauss"\nf_number = 11.0\n'
SLOW = """
name = "parabola"
wavelengths_nm = [500.0]
entrance_diameter_mm = 20.0
surface = [
  { name = "M1", radius_mm = -2000.0, conic = -1.0, glass = "mirror", stop = true },
  { name = "image", distance_mm = 1000.0 },
]
"""
DETECTOR = "[detector]\npixel_um = 5.0\nphotons = 1e5\nread_noise = 4.0"


def study_of(tmp_path, system=DOUBLE_GAUSS, moved="surface 3", imaging="", detector=""):
    file = tmp_path / "study.toml"
    file.write_text(SHAKEN.format(system=system, moved=moved, imaging=imaging, detector=detector))
    return load_study(file)


@pytest.mark.parametrize(("field", "most"), [(0, 3e-3), (1, 8e-3)])
def test_planes_behind_the_image_are_those_of_a_moved_image(tmp_path, field, most):
    """The moved plane is traced: its phases come from rays, at an f-number of 11 and 10 degrees off axis.

    There the directions are not quite linear in the pupil's coordinates, which images take them to be.
    """
    planes = (-150.0, 60.0)
    study = study_of(tmp_path, imaging=f"focus_um = {list(planes)}\nweights = [0.0, 1.0, 0.0]")
    bench = system_bench(study.identity_text())
    primary, states = bench.system.primary_wavelength, rest_states(bench.system, 2)
    states.surface_motion[:, -1, 2] = np.array(planes) * 1e-3  # mm; light runs along +z there
    moved = measure_system(bench.prepared[field][primary], states, NUMPY)
    rest = bench.static[field][primary]
    found = expose(bench.imager, field, [rest] * 3)["exposure_focus"]
    for plane in range(2):
        # About where the chief ray meets the plane: what the tilt of the chief ray moves is left out.
        of_plane = {
            name: values[plane : plane + 1]
            for name, values in vars(moved).items()
            if isinstance(values, np.ndarray)
        }
        here = replace(moved, **of_plane | {"los": moved.los[plane] - moved.chief[plane] + rest.chief})
        expected = expose(bench.imager, field, [here] * 3)["exposure"]
        assert np.abs(found[plane] - expected).max() < most * expected.max()
        assert np.abs(found[1 - plane] - expected).max() > 0.05 * expected.max()


def test_the_axis_through_focus_is_a_squared_sinc(tmp_path):
    """Of a slow perfect mirror: sinc(NA^2 s / (2 lambda))^2 at s behind the focus; both sides are alike."""
    planes = np.array([-4000.0, -2500.0, 1000.0, 4000.0, 10000.0])
    study = study_of(tmp_path, SLOW, "M1", f"focus_um = {planes.tolist()}")
    fixed = {name: one[1] for name, one in KIND.template(study.identity_text()).fixed.items()}
    aperture = np.sin(2.0 * np.arctan(10.0 / 2000.0))
    expected = np.sinc(aperture**2 * planes / (2.0 * 0.5)) ** 2
    found = fixed["focus_static"][0, :, 20, 20]
    np.testing.assert_allclose(found, expected, atol=2e-4)
    assert expected[-1] < 1e-6  # the first dark place on the axis, at 2 lambda / NA^2
    np.testing.assert_allclose(fixed["focus_static"][0, 0], fixed["focus_static"][0, 3], atol=1e-6)


def test_studies_count_photons_and_measure_sharpness(tmp_path):
    study = study_of(tmp_path, imaging="resolution = true", detector=DETECTOR)
    text = study.identity_text()
    together = KIND.compute(text, np.arange(3), "numpy").arrays
    alone = KIND.compute(text, np.array([2]), "numpy").arrays
    for name in ("counts", "snr", "fwhm", "two_point", "sparrow", "mtf50"):
        np.testing.assert_array_equal(together[name][2], alone[name][0], err_msg=name)
    assert not np.array_equal(together["counts"][0], together["counts"][1])
    fixed = {name: one[1] for name, one in KIND.template(text).fixed.items()}
    scale = fixed["resolution_mm"] * 1e3
    across = len(fixed["detector_x"])
    assert across == int(40 * 0.25 * scale / 5.0)
    # What the frame holds of 1e5 electrons, to the noise: the mean of the exposure over its whole area.
    bench = system_bench(text)
    share = together["exposure"][..., :].sum(axis=(-2, -1)) * 0.25**2 * np.array(bench.imager.area) / 4.0
    counted = together["counts"].sum(axis=(-2, -1))
    assert (counted < 1e5).all()
    assert (np.abs(counted - 1e5 * share) < 2e3 + 0.02 * counted).all()
    brightest = together["counts"].max(axis=(-2, -1))
    np.testing.assert_allclose(together["snr"], brightest / np.sqrt(brightest + 16.0), rtol=0.1)
    assert (together["fwhm"][:, 0] > 0.9).all()


def test_what_is_not_asked_for_leaves_a_study_what_it_was(tmp_path):
    text = study_of(tmp_path).identity_text()
    assert all(word not in text for word in ("detector", "focus_um", "resolution"))


@pytest.mark.parametrize(
    ("imaging", "detector", "words"),
    [
        (
            "",
            "[detector]\npixel_um = 1e4\nphotons = 1.0",
            "pixel_um = 10000 does not suit the frame",
        ),
        ("", "[detector]\npixel_um = 1e-9\nphotons = 1.0", "should hold 1 to 4096 pixels"),
        ("focus_um = [1e5]", "", "imaging.focus_um and a frame of 40 pixels need"),
    ],
)
def test_impossible_cameras_are_refused(tmp_path, imaging, detector, words):
    with pytest.raises(UserError, match=words):
        KIND.check(study_of(tmp_path, imaging=imaging, detector=detector).identity_text())


def test_a_detector_needs_images(tmp_path):
    file = tmp_path / "study.toml"
    text = SHAKEN.format(system=DOUBLE_GAUSS, moved="surface 3", imaging="", detector=DETECTOR)
    file.write_text(text.replace("[imaging]\npixels = 40\npupil_samples = 160\n", ""))
    with pytest.raises(UserError, match=r"a detector sees images: add the section \[imaging\]"):
        load_study(file)


def test_light_of_several_colors_is_counted_completely(tmp_path):
    """Of a perfect mirror each color has Airy's shares, 1 - J0^2 - J1^2, at radii that grow with it."""
    colors = SLOW.replace("[500.0]", "[500.0, 400.0, 700.0]\nprimary_wavelength = 1")
    text = study_of(tmp_path, colors, "M1", "weights = [1.0, 2.0, 0.5]", DETECTOR).identity_text()
    result = KIND.compute(text, np.array([0]), "numpy").arrays
    still = text.replace('"dx_um":2.0', '"dx_um":1e-9')
    assert still != text
    found = KIND.compute(still, np.array([0]), "numpy").arrays

    def share(radius):
        each = np.pi * radius * 500.0 / np.array([500.0, 400.0, 700.0])
        return (1.0 - j0(each) ** 2 - j1(each) ** 2) @ [1.0, 2.0, 0.5] / 3.5

    assert share(found["ee50"][0, 0]) == pytest.approx(0.5, abs=1e-3)
    assert share(found["ee80"][0, 0]) == pytest.approx(0.8, abs=1e-3)
    assert 0.93e5 < result["counts"].sum() < 1e5
