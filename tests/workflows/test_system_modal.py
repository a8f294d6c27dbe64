"""The modal model of systems against full traces, whose code it shares only for its derivatives."""

from dataclasses import replace

import numpy as np
import pytest

import wavequake as wq
from wavequake.campaign.contract import DONE
from wavequake.campaign.stopwatch import Stopwatch
from wavequake.errors import UserError
from wavequake.kernels.device.devices import choose_device
from wavequake.mechanics.disturbances.registry import instants_of
from wavequake.optics.wavefronts.wavefront import measure_system
from wavequake.report.exports.rerun import rerun_stored
from wavequake.workflows.segments.modal import CERTIFIED, MODAL, TRACED
from wavequake.workflows.study import load_study
from wavequake.workflows.systems.bench import system_bench, system_states
from wavequake.workflows.systems.disturbance import KIND, draw
from wavequake.workflows.systems.measure import measured_cases
from wavequake.workflows.systems.modal import model_of

DEVICE = choose_device("auto").name
SHAKEN = """
[study]
name = "shaken"
workflow = "system-disturbance"
[system]
{system}
[[disturbance]]
name = "apart"
model = "surface-random"
of = ["{one}", "{other}"]
rms = {{ dx_um = {um}, dy_um = {um}, dz_um = {um}, rx_urad = {urad}, ry_urad = {urad} }}
[[disturbance]]
name = "figure"
model = "surface-deformation"
of = ["{one}"]
rms_nm = {{ 5 = {nm}, 8 = {nm} }}
[[disturbance]]
name = "sway"
model = "surface-vibration"
of = ["{other}"]
duration_s = 0.1
instants = 5
lines = [{{ frequency_hz = 20.0, amplitude = {{ dx_um = {um}, ry_urad = {urad} }} }}]
[optics]
rays = 100
light = "modal"
[wavefront]
zernike_terms = 11
"""
SYSTEMS = {
    "double-gauss": {
        "system": 'name = "double-gauss"\nf_number = 8.0',
        "one": "surface 3",
        "other": "surface 7",
    },
    "gregorian": {"system": 'name = "gregorian"', "one": "M1", "other": "M2"},
    "euv": {"system": 'name = "euv"', "one": "M1", "other": "M3"},
    "zmx": {"system": 'file = "{lens}"', "one": "front", "other": "surface 3"},
}
ROUNDING_NM, TOLERANCE_NM = 1e-6, 3e-4
CAMERA = """
[imaging]
pixels = 24
pupil_samples = 64
focus_um = [50.0]
resolution = true
[object]
slit = 1.5
"""
HISTORY = """
[[disturbance]]
name = "measured"
model = "surface-history"
file = "{folder}/grid.npz"
"""
SIZES = {"double-gauss": (1.0, 20.0, 10.0), "gregorian": (1.0, 2.0, 10.0), "euv": (0.5, 1.0, 3.0)}


@pytest.fixture(scope="module")
def study_of(tmp_path_factory, request):
    lens = request.config.rootpath / "tests" / "data" / "cooke_triplet.zmx"

    def make(name, more="", **keys):
        um, urad, nm = SIZES.get(name, (1.0, 20.0, 10.0))
        words = {key: value.replace("{lens}", str(lens)) for key, value in SYSTEMS[name].items()}
        path = tmp_path_factory.mktemp(name) / "shaken.toml"
        path.write_text(SHAKEN.format(um=um, urad=urad, nm=nm, **words) + more)
        return load_study(path, {key.replace("__", "."): value for key, value in keys.items()})

    return make


def seen(study, cases, factor=1.0):
    """Return the numbers of scaled motions by full traces and by the model, and its bounds."""
    bench, model = system_bench(study.identity_text()), model_of(study.identity_text(), DEVICE)
    motions = []
    for case in cases:
        population, drawn = draw(bench, case)
        scaled = replace(
            drawn,
            rigid={name: factor * one for name, one in drawn.rigid.items()},
            figure={name: factor * one for name, one in drawn.figure.items()},
            mount=factor * drawn.mount,
        )
        motions.append((instants_of(study.disturbance, population), scaled))
    full, modal = (
        measured_cases(bench, motions, choose_device(DEVICE), Stopwatch(), see=see)
        for see in (None, model.see)
    )
    assert not any(message for _, message in full)
    return [one for one, _ in full], [one for one, _ in modal], [model.bound(drawn) for _, drawn in motions]


@pytest.mark.parametrize("name", SYSTEMS)
def test_what_is_left_out_is_of_second_order_and_below_its_bound(name, study_of):
    study = study_of(name)
    worst = {"zernike": [], "los_mm": [], "centroid_mm": [], "spot_rms": []}
    for factor in (4.0, 8.0):
        full, modal, bounds = seen(study, range(6), factor)
        for one, other, bound in zip(full, modal, bounds, strict=True):
            assert np.abs(one["zernike"] - other["zernike"])[..., 3:].max() < bound + ROUNDING_NM
            assert np.abs(one["wfe_rms_raw"] - other["wfe_rms_raw"]).max() < 1.05 * bound + ROUNDING_NM
        for key, sizes in worst.items():
            sizes.append(
                max(np.abs(one[key] - other[key]).max() for one, other in zip(full, modal, strict=True))
            )
        assert worst["zernike"][-1] < 0.1 * max(one["wfe_change"].max() for one in full)
    for key, (small, large) in worst.items():
        assert large / small == pytest.approx(4.0, rel=0.25), key


def test_every_number_that_it_knows_is_that_of_a_trace(study_of):
    study = study_of("double-gauss")
    bench, model = system_bench(study.identity_text()), model_of(study.identity_text(), DEVICE)
    _, drawn = draw(bench, 0)
    states = system_states(bench, drawn)
    for field, wavelength in ((1, 0), (2, 1)):
        traced = measure_system(bench.prepared[field][wavelength], states, choose_device(DEVICE))
        found, rest = model.see(field, wavelength, drawn), bench.static[field][wavelength]
        for name in ("rms", "rms_raw", "rms_flat", "spot_rms", "zernike", "chief", "los", "centroid"):
            one, other, still = (getattr(seen, name) for seen in (traced, found, rest))
            assert np.abs(other - one).max() < 0.02 * np.abs(one - still).max(), name
        assert np.isnan(found.pv).all()
        assert np.isnan(found.strehl).all()


def test_images_are_those_of_traces(study_of):
    study = study_of("double-gauss", CAMERA, campaign__cases=3, optics__modal_tolerance_nm=1.0)
    found = KIND.compute(study.identity_text(), np.arange(3), DEVICE)
    assert (found.status == DONE).all()
    traced = KIND.compute(standard(study).identity_text(), np.arange(3), DEVICE)
    for name in ("exposure", "exposure_focus", "object_image"):
        np.testing.assert_allclose(found.arrays[name], traced.arrays[name], atol=1e-4)
        assert np.abs(found.arrays[name] - traced.arrays[name]).max() > 0.0
    np.testing.assert_allclose(found.arrays["fwhm"], traced.arrays["fwhm"], rtol=2e-2)
    apart = np.abs(found.arrays["peak"] - traced.arrays["peak"]).max(axis=1)
    np.testing.assert_array_equal(found.arrays["modal_error_peak"], apart)


def test_the_certificate_is_what_traces_say_and_large_motions_are_traced(study_of):
    study = study_of("gregorian", campaign__cases=6, optics__modal_tolerance_nm=TOLERANCE_NM)
    found = KIND.compute(study.identity_text(), np.arange(6), DEVICE).arrays
    traced = KIND.compute(standard(study).identity_text(), np.arange(6), DEVICE).arrays
    how, bound = found["traced"], found["modal_bound"]
    assert set(how.tolist()) == {CERTIFIED, TRACED}  # the first hundred cases are always certified
    np.testing.assert_array_equal(how == TRACED, bound > TOLERANCE_NM)
    for name in ("wfe_rms", "wfe_rms_raw", "zernike", "los_mm", "centroid_mm"):
        apart = found[name] - traced[name]
        errors = np.linalg.norm(apart, axis=-1) if name.endswith("_mm") else np.abs(apart)
        largest = np.nanmax(errors.reshape(6, -1), axis=1)
        np.testing.assert_array_equal(found[f"modal_error_{name}"], np.where(how == TRACED, np.nan, largest))
        np.testing.assert_array_equal(found[name][how == TRACED], traced[name][how == TRACED])
    assert not {"strehl", "wfe_pv", "rayleigh"} & found.keys()
    assert not {"traced", "modal_bound"} & traced.keys()


def test_a_case_has_the_same_bits_alone_and_cases_beyond_the_first_are_sampled(study_of):
    study = study_of("zmx", campaign__cases=400, optics__modal_sample=0.3)
    cases = np.arange(97, 121)
    whole = KIND.compute(study.identity_text(), cases, DEVICE).arrays
    assert {MODAL, CERTIFIED} <= set(whole["traced"].tolist())
    for row in (0, 5, 23):
        alone = KIND.compute(study.identity_text(), cases[row : row + 1], DEVICE).arrays
        for name, values in alone.items():
            np.testing.assert_array_equal(values[0], whole[name][row], err_msg=name)


def test_an_imported_lens_runs_and_its_report_certifies_it(study_of, tmp_path):
    study = study_of("zmx", campaign__cases=4)
    wq.run(study, store=tmp_path / "store", workers=1)
    dataset = wq.open_store(tmp_path / "store")
    assert float(dataset["modal_error_zernike"].max()) < 0.1
    again = rerun_stored(tmp_path / "store", 2)
    assert (again.differing, again.trouble, again.status) == ((), "", DONE)
    page = (wq.report(tmp_path / "store")).read_text()
    assert "traced in full to measure its error" in page
    assert "Strehl P50" not in page


@pytest.mark.parametrize(
    ("more", "keys", "words"),
    [
        ("", {"wavefront__method": "slopes"}, "needs wavefront.method = 'opd'"),
        ("", {"wavefront__reference": "fitted"}, "and wavefront.reference = 'chief'"),
        ("", {"optics__modal_tolerance_nm": 0.0}, "modal_tolerance_nm"),
        (HISTORY, {}, "deforms 'surface 3' on a grid"),
    ],
)
def test_what_the_model_cannot_know_is_refused_in_a_sentence(more, keys, words, study_of, tmp_path):
    np.savez(
        tmp_path / "grid.npz",
        time_s=np.array([0.0, 0.1]),
        **{"surface 3.grid_nm": np.ones((2, 9, 9)), "surface 3.grid_spacing_mm": np.array([20.0, 20.0])},
    )

    def check():
        KIND.check(study_of("double-gauss", more.replace("{folder}", str(tmp_path)), **keys).identity_text())

    with pytest.raises(UserError, match=words):
        check()


STILL = """
[study]
name = "still"
workflow = "system-disturbance"
[system]
name = "double-gauss"
[[disturbance]]
name = "apart"
model = "surface-random"
of = ["surface 4"]
rms = {{ dx_um = {um}, dy_um = {um} }}
[optics]
rays = 50
light = "modal"
"""


def test_a_plane_that_slides_in_itself_changes_nothing(tmp_path):
    (tmp_path / "plane.toml").write_text(STILL.format(um=1.0))
    study = load_study(tmp_path / "plane.toml", {"campaign.cases": 2})
    found = KIND.compute(study.identity_text(), np.arange(2), DEVICE).arrays
    assert set(found["traced"].tolist()) == {CERTIFIED}
    assert np.abs(found["wfe_change"]).max() < 1e-4
    assert found["modal_error_wfe_rms_raw"].max() < 1e-4


def test_what_does_not_move_is_refused_in_a_sentence(tmp_path):
    (tmp_path / "still.toml").write_text(STILL.format(um=0.0))
    with pytest.raises(UserError, match="No disturbance moves anything"):
        KIND.check(load_study(tmp_path / "still.toml", {}).identity_text())


def test_the_check_of_a_study_builds_the_model_that_its_cases_use(study_of):
    study = study_of("zmx", campaign__cases=3)
    model_of.cache_clear()
    KIND.check(study.identity_text())
    KIND.compute(study.identity_text(), np.arange(1), choose_device(study.campaign.device).name)
    assert model_of.cache_info().misses == 1


def test_studies_that_trace_keep_the_identity_that_they_had(study_of):
    record = standard(study_of("euv")).model_dump(mode="json")
    assert record["optics"] == {"rays": 100}


def standard(study):
    return study.model_copy(update={"optics": study.optics.model_copy(update={"light": "traced"})})
