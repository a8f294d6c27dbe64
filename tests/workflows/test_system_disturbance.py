from dataclasses import replace

import numpy as np
import pytest
from small_system import PARABOLA

import wavequake as wq
from wavequake.campaign.contract import DONE, RAISED
from wavequake.errors import UserError
from wavequake.kernels.device.devices import NUMPY
from wavequake.optics.systems.kinematics import rest_states
from wavequake.optics.wavefronts.wavefront import measure_system
from wavequake.workflows.study import load_study
from wavequake.workflows.systems.bench import failure, system_bench
from wavequake.workflows.systems.disturbance import KIND, draw

# A parabola of 1 m focal length and 50 mm radius: f/10, so that slopes are small.
STUDY = (
    PARABOLA.replace("stop", "semi_diameter_mm = 55.0\nstop")
    + """[[body]]
name = "all"
surfaces = ["mirror", "image"]
[optics]
rays = 60
[wavefront]
zernike_terms = 11
[[disturbance]]
name = "askew"
model = "surface-random"
of = ["mirror"]
rms = { dx_um = 10.0, rx_urad = 20.0 }
[[disturbance]]
name = "hum"
model = "surface-vibration"
of = ["image"]
share = 2
instants = 3
lines = [{ frequency_hz = 10.0, amplitude = { dy_um = 7.0 } }]
[[disturbance]]
name = "figure"
model = "surface-deformation"
of = ["mirror"]
rms_nm = { 5 = 10.0, 11 = 3.0 }
[[disturbance]]
name = "sight"
model = "line-of-sight"
rms_mas = 50.0
instants = 3
"""
)

# Coma of a field angle w is W = w a (a / f)^2 / 4 rho^3 cos(theta); a plane fits it best with 2/3 of that.
TILT_OF_COMA = (50.0 / 1000.0) ** 2 / 4 * 2 / 3


def study_of(tmp_path, text=STUDY, *overrides):
    path = tmp_path / "study.toml"
    path.write_text(text)
    return load_study(path, overrides)


@pytest.fixture(scope="module")
def text(tmp_path_factory):
    return study_of(tmp_path_factory.mktemp("study")).identity_text()


@pytest.fixture(scope="module")
def found(text):
    result = KIND.compute(text, np.arange(5), "numpy")
    assert (result.status == DONE).all(), result.messages
    return result.arrays


def test_cases_repeat_the_pattern_of_shares(text):
    table = KIND.case_table(text, 3, 8)
    assert table["disturbance"].tolist() == ["figure", "sight", "askew", "hum", "hum"]
    assert table["realization"].tolist() == [0, 0, 1, 2, 3]


def test_a_parabola_that_shifts_and_tilts_moves_its_image(text, found):
    """The focus stays with the mirror; a turn by rx moves the image by 2 f rx, and by its coma."""
    _, drawn = draw(system_bench(text), 0)
    dx, rx = drawn.rigid["mirror"][0, [0, 3]]
    los = found["los_mm"][0, 0]
    # The mirror sees the star off axis by rx alone, whose coma adds a / f squared over 6 (see below).
    assert los[0, 0, 0] == pytest.approx(1e3 * dx, abs=1e-7)
    assert abs(los[0, 0, 1]) == pytest.approx(2000.0 * abs(rx) * (1 + TILT_OF_COMA / 2), rel=1e-6)
    np.testing.assert_allclose(los[0, 0], los[0, 1], rtol=0, atol=2e-7)  # in each wavelength


def test_a_detector_that_shakes_sees_the_image_move_against_it(text, found):
    for case in (1, 2):
        _, drawn = draw(system_bench(text), case)
        expected = -1e3 * drawn.rigid["image"][:, 1]
        assert np.abs(expected).max() > 1e-3
        for name in ("los_mm", "centroid_mm"):
            moved = found[name][case, ..., 1]
            np.testing.assert_allclose(
                moved, np.broadcast_to(expected[:, None, None], moved.shape), rtol=0, atol=1e-9
            )
        np.testing.assert_allclose(found["wfe_change"][case], 0.0, rtol=0, atol=1e-3)


def test_a_figure_appears_twice_in_the_wavefront(text, found):
    """Over the semi-diameter, of which the beam fills 50/55: Z5 shrinks by the square, Z11 leaks to Z4."""
    _, drawn = draw(system_bench(text), 3)
    figure = drawn.figure["mirror"] * 1e9
    change = found["zernike"][3, 0, 0, 0] - KIND.template(text).fixed["zernike_static"][1][0, 0]
    ratio = (50 / 55) ** 2
    assert abs(change[4]) == pytest.approx(2 * abs(figure[4]) * ratio, rel=2e-3)
    assert abs(change[10]) == pytest.approx(2 * abs(figure[10]) * ratio**2, rel=2e-3)
    defocus = 2 * figure[10] * np.sqrt(15) * (ratio**2 - ratio)
    assert abs(change[3]) == pytest.approx(abs(defocus), rel=5e-3)
    np.testing.assert_allclose(found["zernike"][3, 0, :, 0, 4], found["zernike"][3, 0, :, 1, 4], rtol=0.2)
    assert found["wfe_change"][3, 0, 0, 0] == pytest.approx(np.linalg.norm(change[3:]), rel=1e-9)
    sigma = 2 * np.pi * found["wfe_rms"][3, 0, 0] / np.array([500.0, 1000.0])
    np.testing.assert_allclose(found["strehl"][3, 0, 0], np.exp(-(sigma**2)), rtol=0.01)


def test_coma_that_is_not_fitted_counts_in_what_the_rays_say(tmp_path):
    """About the chief ray coma is 3 sqrt(8) rho^3 cos(theta), of rms 3; about its plane it has rms 1."""
    coma = STUDY.replace("rms_nm = { 5 = 10.0, 11 = 3.0 }", "rms_nm = { 8 = 4000.0 }")
    identity = study_of(
        tmp_path, coma, "wavefront.zernike_terms=4", "optics.rays=3000", "system.fields_arcmin=[[0.0, 0.0]]"
    ).identity_text()
    _, drawn = draw(system_bench(identity), 3)
    size = 2e9 * abs(drawn.figure["mirror"][7]) * (50 / 55) ** 3
    assert size > 1000.0 / 14
    case = {name: values[0] for name, values in KIND.compute(identity, np.array([3]), "numpy").arrays.items()}
    for wavelength in (0, 1):
        assert case["wfe_rms"][0, 0, wavelength] < 0.02 * size
        assert case["wfe_rms_raw"][0, 0, wavelength] == pytest.approx(3 * size, rel=1e-2)
        assert case["wfe_pv"][0, 0, wavelength] == pytest.approx(2 * np.sqrt(8) * size, rel=2e-2)
        assert case["marechal"][0, wavelength] == case["rayleigh"][0, wavelength] == 0.0


def test_the_line_of_sight_moves_the_image_by_the_focal_length(text, found):
    _, drawn = draw(system_bench(text), 4)
    moved = found["los_mm"][4, :, 0, 0]
    assert np.abs(moved).max() > 1e-5
    expected = 1000.0 * np.abs(drawn.mount) * (1 + TILT_OF_COMA)
    np.testing.assert_allclose(np.abs(moved), expected, rtol=1e-6, atol=1e-9)


def test_instants_that_a_population_lacks_are_missing(text, found):
    shape = (5, 3, 2, 2)
    assert found["wfe_rms"].shape == shape
    assert np.isnan(found["wfe_rms"][0, 1:]).all()
    assert np.isnan(found["time_s"][0, 1:]).all()
    assert np.isfinite(found["wfe_rms"][4]).all()
    assert np.isfinite(found["vignetted"]).all()


@pytest.mark.parametrize("device", ["numpy", "auto"])
def test_a_cases_bits_depend_on_no_other_case(text, device):
    chunk = KIND.compute(text, np.arange(10), device).arrays
    for case in (1, 3, 4, 8):
        alone = KIND.compute(text, np.array([case]), device).arrays
        for name, values in alone.items():
            assert values[0].tobytes() == chunk[name][case].tobytes()


def test_time_and_work_are_counted_by_kind(text):
    seconds = KIND.compute(text, np.arange(5), "numpy").timings
    work = {"draw", "aim", "trace", "wavefront"}
    assert set(seconds) == work | {f"cpu {name}" for name in work}
    assert min(seconds[name] for name in work) > 0
    # The cases of one turn: 1 + 3 + 3 + 1 + 3 instants, two fields, two colors, 60 rays, two surfaces.
    assert KIND.work(text, 5) == {"trace": (11 * 2 * 2 * 60 * 2, "ray-surfaces")}


def test_arrays_are_those_of_the_template(text, found):
    variables = KIND.template(text).per_case
    assert set(found) == set(variables)
    for name, variable in variables.items():
        assert (
            found[name].shape[1:]
            == variable.shape
            == tuple(
                {"time": 3, "field": 2, "wavelength": 2, "noll": 11, "axis": 2}[dim] for dim in variable.dims
            )
        )


def test_units_of_the_telescopes_store_and_this_one_agree(text, found):
    """Spot of the off-axis field by third-order coma: the blur's extent is 3/16 field / N^2."""
    spot = found["spot_rms"][1, 0, 1, 0]
    assert found["spot_rms"][1, 0, 0, 0] < 1e-3
    tangential = 3 / 16 * np.deg2rad(3 / 60) / 10**2 * 1e6  # um at f = 1 m
    assert tangential / 6 < spot < tangential / 2
    coma = found["zernike"][1, 0, 1, 0, 6:8]
    # W131 = h / (16 f N^2) a, c_8 = W131 / (3 sqrt 8).
    expected = np.deg2rad(3 / 60) * 50e6 / (16 * 10**2) * 2 / (3 * np.sqrt(8)) / 2
    assert np.abs(coma).max() == pytest.approx(expected, rel=0.02)


def test_vignetted_rays_are_counted(tmp_path):
    wide = STUDY.replace("semi_diameter_mm = 55.0", "semi_diameter_mm = 40.0")
    text = study_of(tmp_path, wide).identity_text()
    KIND.check(text)
    beyond = int(np.sum(np.sqrt((np.arange(60) + 0.5) / 60) * 50.0 > 40.0))  # a sunflower's radii
    assert KIND.template(text).fixed["vignetted_static"][1].tolist() == [[beyond] * 2] * 2
    arrays = KIND.compute(text, np.array([1]), "numpy").arrays
    assert arrays["vignetted"][0].tolist() == [[beyond] * 2] * 2
    assert f"{beyond} of 60 rays vignetted" in KIND.describe(text)["field (0, 0) deg"]


def test_rays_that_miss_a_surface_are_counted_as_lost(tmp_path):
    """An oblate mirror of radius R and conic k reaches out to R / sqrt(1 + k)."""
    text = study_of(tmp_path, STUDY.replace("conic = -1.0", "conic = 2e3")).identity_text()
    KIND.check(text)
    beyond = int(np.sum(np.sqrt((np.arange(60) + 0.5) / 60) * 50.0 > 2000.0 / np.sqrt(2001.0)))
    assert beyond > 5
    arrays = KIND.compute(text, np.array([1]), "numpy").arrays
    assert arrays["lost"][0].tolist() == [[beyond] * 2] * 2
    assert arrays["vignetted"][0].tolist() == [[0.0] * 2] * 2
    said = KIND.describe(text)["field (0, 0) deg"]
    assert f"{beyond} of 60 rays" in said
    assert said.endswith("are lost, at mirror: they miss it")


def test_a_case_without_light_is_quarantined_with_the_reason(tmp_path):
    far = STUDY.replace("dx_um = 10.0, rx_urad = 20.0", "dx_um = 500000.0").replace("rays = 60", "rays = 30")
    # Light would follow a mirror that is the stop itself.
    far = far.replace("stop = true\n", "")
    far = far.replace(
        "[[system.surface]]", '[[system.surface]]\nname = "front"\nstop = true\n[[system.surface]]', 1
    )
    text = study_of(tmp_path, far).identity_text()
    result = KIND.compute(text, np.array([0, 1]), "numpy")
    assert result.status.tolist() == [RAISED, DONE]
    assert "mirror: its opening stops them" in result.messages[0]
    assert "field (0, 0) deg" in result.messages[0]
    assert np.isnan(result.arrays["wfe_rms"][0]).all()


def test_a_lost_chief_ray_names_the_surface_and_what_happens_there(tmp_path):
    """A ball 100 m beside its place; light would follow the mirror, which is the stop."""
    ball = 'stop = true\n[[system.surface]]\nname = "ball"\ndistance_mm = 500.0\nradius_mm = 500.0'
    bench = system_bench(study_of(tmp_path, STUDY.replace("stop = true", ball)).identity_text())
    prepared, states = bench.prepared[0][0], rest_states(bench.system, 2)
    states.surface_motion[1, 1, 0] = 1e5
    found = failure(prepared, measure_system(prepared, states, NUMPY), states)
    assert found == (1, "the chief ray of field (0, 0) deg at 500 nm is lost at ball, it misses that surface")


def test_the_radius_of_a_figure_without_an_edge_is_that_of_the_beam(tmp_path):
    open_ = STUDY.replace("semi_diameter_mm = 55.0\n", "")
    bench = system_bench(study_of(tmp_path, open_).identity_text())
    assert bench.system.surfaces[0].deformation.pupil_radius == pytest.approx(50.0, rel=1e-6)
    assert bench.system.surfaces[0].deformation.terms == 11


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ('of = ["image"]', 'of = ["imag"]', "'hum' acts on 'imag'.*did you mean 'image'"),
        ('of = ["mirror"]\nrms_nm', 'of = ["all"]\nrms_nm', "'figure' deforms the body 'all'"),
        ('surfaces = ["mirror", "image"]', 'surfaces = ["miror"]', "body 'all'.*did you mean 'mirror'"),
        ("semi_diameter_mm = 55.0", "semi_diameter_mm = 55.0\ninner_mm = 54.0", "60 of 60 rays.*mirror"),
        ("conic = -1.0", "conic = 1e6", "no ray of .* are lost, at mirror: they miss it; make the pupil"),
        (
            "stop = true",
            'stop = true\n[[system.surface]]\nname = "ball"\ndistance_mm = 500.0\nradius_mm = 2.0\n'
            "glass = 1.5",
            "60 of 60 rays of field .* are lost, at ball: they miss it",
        ),
        (
            "stop = true",
            'stop = true\n[[system.surface]]\nname = "lens"\ndistance_mm = 500.0\nglass = "N-BK8"',
            "lens: .*N-BK",
        ),
    ],
)
def test_what_cannot_work_is_refused_before_a_store_is_made(tmp_path, old, new, sentence):
    assert old in STUDY
    with pytest.raises(UserError, match=sentence):
        KIND.check(study_of(tmp_path, STUDY.replace(old, new)).identity_text())


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ('name = "hum"', 'name = "askew"', "two disturbances are called 'askew'"),
        ('name = "all"', 'name = "mirror"', "two bodies or surfaces are called 'mirror'"),
        ('of = ["image"]', 'of = ["image", "image"]', "names 'image' twice"),
        ("rms_mas = 50.0", 'rms_mas = 50.0\nact = "m2"', "surface-vibration"),
        ("dy_um = 7.0", "dy_mm = 7.0", "dy_um"),
        ("{ 5 = 10.0", "{ 2 = 10.0", "greater than or equal to 4"),
        ("conic = -1.0", "conic = nan", "conic"),
        (
            '[[system.surface]]\nname = "image"',
            '[[system.surface]]\nname = "M3"\nradius_mm = 0.0',
            "surface M3 has",
        ),
    ],
)
def test_keys_that_do_not_fit_are_refused_in_a_sentence(tmp_path, old, new, sentence):
    assert old in STUDY
    with pytest.raises(UserError, match=sentence):
        study_of(tmp_path, STUDY.replace(old, new))


def test_a_wavelength_out_of_a_glass_range_is_refused(tmp_path):
    text = STUDY.replace("[500.0, 1000.0]", "[500.0, 5000.0]").replace(
        "stop = true", 'stop = true\n[[system.surface]]\nname = "lens"\ndistance_mm = 500.0\nglass = "N-BK7"'
    )
    with pytest.raises(UserError, match=r"N-BK7 is known from .* not at 5000 nm"):
        KIND.check(study_of(tmp_path, text).identity_text())


def test_a_name_that_two_surfaces_of_a_lens_file_share_is_refused(tmp_path):
    system = wq.load_system("double-gauss")
    twins = [replace(one, name="face") if one.name.startswith("surface") else one for one in system.surfaces]
    wq.write_zmx(replace(system, surfaces=tuple(twins)), tmp_path / "lens.zmx")
    text = """
    [study]
    name = "twins"
    workflow = "system-disturbance"
    [system]
    file = "lens.zmx"
    [[disturbance]]
    name = "askew"
    model = "surface-random"
    of = ["face"]
    rms = { dx_um = 1.0 }
    """
    with pytest.raises(UserError, match="10 surfaces of that name"):
        KIND.check(study_of(tmp_path, text).identity_text())
    body = text + '[[body]]\nname = "lens"\nsurfaces = ["face"]\n'
    with pytest.raises(UserError, match="10 surfaces called 'face'"):
        KIND.check(study_of(tmp_path, body.replace('of = ["face"]', 'of = ["lens"]')).identity_text())


def test_slopes_give_the_results_of_path_lengths(tmp_path, text, found):
    slopes = study_of(tmp_path, STUDY, 'wavefront.method="slopes"').identity_text()
    one = KIND.compute(slopes, np.arange(5), "numpy").arrays
    assert np.isnan(one["zernike"][..., 0]).all()
    known = np.isfinite(found["zernike"])
    known[..., 0] = False
    assert np.abs(found["zernike"][known]).max() > 5.0
    np.testing.assert_allclose(one["zernike"][known], found["zernike"][known], rtol=0, atol=0.05)
    np.testing.assert_allclose(one["los_mm"], found["los_mm"], rtol=0, atol=2e-6)
    for same in ("wfe_rms_raw", "wfe_pv", "strehl", "centroid_mm", "lost"):
        np.testing.assert_array_equal(one[same], found[same])
    stored = [KIND.template(each).per_case["zernike"] for each in (slopes, text)]
    assert ["slopes" in each.attrs["long_name"] for each in stored] == [True, False]
    assert [each.unknown for each in stored] == [1, 0]


def test_the_fitted_reference_moves_the_tilt_into_the_image_point(tmp_path, found):
    """A plane fits coma about the chief ray with a tilt; about the sphere that fits best none is left."""
    fitted = study_of(tmp_path, STUDY, 'wavefront.reference="fitted"').identity_text()
    one = KIND.compute(fitted, np.arange(5), "numpy").arrays
    tilts = [np.nanmax(np.abs(each["zernike"][..., 1:3])) for each in (one, found)]
    assert tilts[0] < 0.05 * tilts[1]  # 60 rays mix tilt and coma by 2 %
    np.testing.assert_allclose(one["los_mm"], found["los_mm"], rtol=0, atol=1e-5)
    np.testing.assert_allclose(1 - one["strehl"], 1 - found["strehl"], rtol=2e-3, atol=1e-9)
    # rho^3 cos(theta) has an rms of 1 / sqrt(8) about the chief ray and of 1 / sqrt(72) about the best plane.
    ratio = one["wfe_rms_raw"][0, 0, 1] / found["wfe_rms_raw"][0, 0, 1]
    np.testing.assert_allclose(ratio, 1 / 3, rtol=0.01)


def test_slopes_about_a_fitted_sphere_are_refused(tmp_path):
    with pytest.raises(UserError, match="reference = 'fitted' needs path lengths"):
        study_of(tmp_path, STUDY, 'wavefront.method="slopes"', 'wavefront.reference="fitted"')
