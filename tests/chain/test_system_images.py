"""Images of systems against sums over real rays, closed forms and conservation of light."""

import numpy as np
import pytest
from scipy.special import j1

from wavequake.campaign.store.store import open_store
from wavequake.errors import UserError
from wavequake.kernels.device.devices import NUMPY, list_devices
from wavequake.optics.systems.kinematics import rest_states
from wavequake.optics.wavefronts.wavefront import trace_system, with_slopes
from wavequake.workflows.kinds import find_kind
from wavequake.workflows.run import run_study
from wavequake.workflows.study import load_study
from wavequake.workflows.systems.bench import system_bench

KIND = find_kind("system-disturbance")
STILL = """
[study]
name = "still"
workflow = "system-disturbance"
[system]
{system}
[[disturbance]]
name = "shake"
model = "surface-vibration"
of = ["{moved}"]
duration_s = 0.01
instants = {instants}
lines = [ {{ frequency_hz = 100.0, amplitude = {{ {amplitude} }} }} ]
[optics]
rays = {rays}
[imaging]
pixels = {pixels}
{imaging}
[campaign]
cases = 2
"""
PARABOLA = """
name = "parabola"
wavelengths_nm = [500.0]
entrance_diameter_mm = 100.0
surface = [
  { name = "M1", radius_mm = -2000.0, conic = -1.0, glass = "mirror", stop = true },
  { name = "image", distance_mm = 1000.0 },
]
"""


@pytest.fixture
def device():
    found = [one.name for one in list_devices() if one.kind == "cpu"]
    if not found:
        pytest.skip("no OpenCL processor")
    return found[0]


def study_of(
    tmp_path, system, moved, *, instants=4, amplitude="dx_um = 1e-6", rays=500, pixels=48, imaging=""
):
    file = tmp_path / "study.toml"
    keys = {"instants": instants, "amplitude": amplitude, "rays": rays, "pixels": pixels, "imaging": imaging}
    file.write_text(STILL.format(system=system, moved=moved, **keys))
    return load_study(file)


def at_rest(study):
    template = KIND.template(study.identity_text())
    return {name: values for name, (_, values, _) in template.fixed.items()}


def ray_sum(bench, field, axis):
    """The image of a field at its primary wavelength as a sum of the plane waves of its rays (Debye)."""
    primary = bench.system.primary_wavelength
    prepared = with_slopes(bench.prepared[field][primary])
    opd, traced, chief = trace_system(prepared, rest_states(bench.system), NUMPY)
    known = np.isfinite(opd[0])
    shift = bench.static[field][primary].los[0] - chief[0]
    weight = prepared.fit.weight * known
    opd = np.where(known, opd[0], 0.0)
    u, v = (np.where(known, one[0], 0.0) for one in (traced.u, traced.v))
    # A ray whose path is shorter by OPD is ahead in phase; where it points is where its plane wave grows.
    place = prepared.image_index / prepared.wavelength
    along_x = np.exp(-2j * np.pi * place * np.outer(axis + shift[0], u))
    along_y = np.exp(-2j * np.pi * place * np.outer(axis + shift[1], v))
    field_ = (along_y * (weight * np.exp(2j * np.pi * opd))) @ along_x.T
    return np.abs(field_) ** 2 / weight.sum() ** 2


@pytest.mark.parametrize(("field", "most"), [(0, 2e-3), (1, 2e-3)])
def test_images_are_those_of_the_real_rays(tmp_path, field, most):
    """Off axis the pupil is an ellipse and the image has coma: place, size and orientation must fit."""
    system = 'name = "double-gauss"\nf_number = 11.0\n'
    study = study_of(
        tmp_path, system, "surface 1", rays=12000, pixels=40, imaging="weights = [0.0, 1.0, 0.0]"
    )
    bench, fixed = system_bench(study.identity_text()), at_rest(study)
    assert bench.system.primary_wavelength == 1
    axis = (np.arange(40) - 20) * 0.25 * fixed["resolution_mm"]
    expected = ray_sum(bench, field, axis)
    found = fixed["exposure_static"][field]
    assert np.abs(found - expected).max() < most
    if field:  # it would be wrong upside down
        assert np.abs(found[::-1] - expected).max() > 20 * most


def test_a_parabola_makes_an_airy_pattern_of_the_size_of_its_aperture(tmp_path):
    fixed = at_rest(study_of(tmp_path, PARABOLA, "M1", pixels=64, imaging="pupil_samples = 256"))
    # The rim's rays reach the focus under the sine of the paraboloid's angle: 2 atan(y / 2f).
    aperture = np.sin(2.0 * np.arctan(50.0 / 2000.0))
    assert fixed["resolution_mm"] == pytest.approx(500e-6 / (2.0 * aperture), rel=2e-6)
    axis = (np.arange(64) - 32) * 0.25
    r = np.maximum(np.hypot(axis, axis[:, None]), 1e-12)
    np.testing.assert_allclose(fixed["exposure_static"][0], (2 * j1(np.pi * r) / (np.pi * r)) ** 2, atol=3e-5)


def test_a_stop_that_blocks_takes_light_and_not_energy_from_nowhere(tmp_path):
    """Of an annulus: the central peak is 1, the rings are stronger, and light is conserved (Parseval)."""
    ring = PARABOLA + "pupil_obscuration = 0.5\n"
    study = study_of(tmp_path, ring, "M1", pixels=64, imaging="pupil_samples = 256")
    found, text = at_rest(study)["exposure_static"][0], study.identity_text()
    axis = (np.arange(64) - 32) * 0.25
    r = np.maximum(np.hypot(axis, axis[:, None]), 1e-12)
    airy = [2 * j1(np.pi * r * eps) / (np.pi * r * eps) for eps in (1.0, 0.5)]
    np.testing.assert_allclose(found, ((airy[0] - 0.25 * airy[1]) / 0.75) ** 2, atol=5e-5)
    assert system_bench(text).imager.area[0] == pytest.approx(np.pi * 0.75, rel=1e-5)


def test_the_image_moves_as_the_line_of_sight_does(tmp_path):
    """A mirror that shifts by 10 um moves the image, and the exposure of the sine is Bessel's smear."""
    study = study_of(
        tmp_path, PARABOLA, "M1", instants=100, amplitude="dx_um = 8.0", pixels=64, imaging="instants = 100"
    )
    result = KIND.compute(study.identity_text(), np.array([0]), "numpy")
    fixed = at_rest(study)
    los = result.arrays["los_mm"][0, :, 0, 0] / fixed["resolution_mm"]
    assert np.abs(los[:, 0]).max() > 1.0
    axis = (np.arange(64) - 32) * 0.25
    r = np.hypot(axis - los[:, 0, None, None], axis[:, None] - los[:, 1, None, None])
    r = np.maximum(r, 1e-12)
    smeared = ((2 * j1(np.pi * r) / (np.pi * r)) ** 2).mean(axis=0)
    found = result.arrays["exposure"][0, 0]
    assert np.abs(found - smeared).max() < 2e-3  # moved mirrors have coma of 1e-3 waves, too
    assert result.arrays["peak"][0, 0] == found.max()


def test_images_do_not_depend_on_device_or_engine(tmp_path, device):
    study = study_of(
        tmp_path, 'name = "double-gauss"\nf_number = 11.0\n', "surface 3", amplitude="dx_um = 20.0"
    )
    text = study.identity_text()
    here, there = (KIND.compute(text, np.array([0, 1]), name).arrays for name in ("numpy", device))
    for name in ("exposure", "peak"):
        np.testing.assert_allclose(there[name], here[name], atol=1e-9)
    np.testing.assert_allclose(there["ee80"], here["ee80"], rtol=1e-7)
    alone = KIND.compute(text, np.array([1]), device).arrays["exposure"]
    np.testing.assert_array_equal(alone[0], there["exposure"][1])


def test_engines_make_the_same_image(tmp_path, device):
    one, other = (
        at_rest(study_of(tmp_path, PARABOLA, "M1", imaging=f'engine = "{engine}"'))["exposure_static"]
        for engine in ("matrix", "fft")
    )
    np.testing.assert_allclose(one, other, atol=1e-12)


def test_lenses_image_objects_in_every_light(tmp_path):
    """Of a slit coherent light rings at its rims, and what does not move is imaged as at rest."""
    system = 'name = "double-gauss"\nf_number = 11.0\n'
    keys = {"pixels": 48, "imaging": "weights = [0.0, 1.0, 0.0]\n[object]\nslit = 6.0\n"}
    study = study_of(tmp_path, system, "surface 1", **keys)
    fixed, found = at_rest(study), KIND.compute(study.identity_text(), np.array([0]), "numpy").arrays
    np.testing.assert_allclose(found["object_image"][0], fixed["object_static"], atol=1e-6)
    middle = fixed["object_static"][0, 24]
    assert 0.6 < middle[24] < 1.0
    assert middle[4] < 0.1
    keys["imaging"] += 'light = "coherent"\n'
    lit = at_rest(study_of(tmp_path, system, "surface 1", **keys))["object_static"][0, 24]
    assert lit.max() > middle.max()


@pytest.mark.parametrize(
    ("imaging", "words"),
    [
        ("weights = [1.0]", "imaging.weights has 1 for the 3 wavelengths of double-gauss"),
        ("weights = [0.0, 0.0, 0.0]", "one is above 0"),
        ("pupil_samples = 16", "needs? .*; set it to at least that"),
        ('engine = "fast"', "imaging.engine"),
        ("[object]\nslit = 1.0\ngrating = 2.0", "exactly one of"),
    ],
)
def test_impossible_images_are_refused_in_a_sentence(tmp_path, imaging, words):
    with pytest.raises(UserError, match=words):
        KIND.check(
            study_of(tmp_path, 'name = "double-gauss"\n', "surface 1", imaging=imaging).identity_text()
        )


def test_objects_need_images(tmp_path):
    study = study_of(tmp_path, PARABOLA, "M1")
    record = study.model_dump(mode="json")
    record["imaging"], record["object"] = None, {"slit": 1.0}
    with pytest.raises(ValueError, match=r"add the section \[imaging\]"):
        type(study).model_validate(record, strict=False)


def test_a_store_has_the_exposures_of_all_fields(tmp_path):
    study = study_of(
        tmp_path, 'name = "double-gauss"\nf_number = 11.0\n', "surface 3", amplitude="dx_um = 20.0"
    )
    run_study(study, tmp_path / "store", on="serial")
    dataset = open_store(tmp_path / "store").load()
    assert dataset["exposure"].dims == ("case", "field", "y", "x")
    assert dataset["exposure"].sizes["field"] == dataset["peak"].sizes["field"] == 3
    assert dataset["exposure_static"].attrs["engine"] == "matrix"
    assert dataset["x"].attrs["units"] == "lambda/D"
