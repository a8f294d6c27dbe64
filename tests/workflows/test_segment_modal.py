"""Studies by the modal model against the same studies by full traces, on the 18-segment telescope."""

from dataclasses import replace

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

import wavequake as wq
from wavequake.campaign.contract import DONE, RAISED
from wavequake.campaign.store.retention import STATISTICS, kept_result
from wavequake.errors import UserError
from wavequake.kernels.device.devices import list_devices
from wavequake.workflows import kinds
from wavequake.workflows.planning import plan as planning
from wavequake.workflows.segments import disturbance as workflow
from wavequake.workflows.segments import modal as segment_modal
from wavequake.workflows.segments.modal import CERTIFIED, MODAL, TRACED, sampled
from wavequake.workflows.study import load_study, study_with

OPENCL = [device.name for device in list_devices() if device.kind != "numpy"]
DEVICE = OPENCL[0] if OPENCL else "numpy"
ROUNDING_NM = 2e-5  # of full traces over 1e5 mm, seven digits below the motions

STUDY = """
[study]
name = "small"
workflow = "segment-disturbance"
seed = 7
[telescope]
name = "tmt-18"
gap_mm = 20.0
[optics]
light = "modal"
rays_per_segment = 6
modal_sample = 0.02
[wavefront]
zernike_terms = 21
[imaging]
enabled = false
[[disturbance]]
name = "swing"
model = "common-history"
instants = 10
share = 3
[[disturbance]]
name = "aligned"
model = "static-random"
piston_nm = 20.0
tip_nrad = 5.0
tilt_nrad = 5.0
figure_nm = { 4 = 5.0 }
instants = 3
[[disturbance]]
name = "quake"
model = "segment-history"
instants = 7
[[disturbance]]
name = "shake"
model = "line-of-sight"
act = "m2"
instants = 20
[[disturbance]]
name = "all"
model = "combine"
of = ["aligned", "quake", "shake"]
instants = 5
"""
SHARES = 7  # cases of one pattern
SERIES = ("wfe_rms", "wfe_rms_raw", "zernike", "los", "centroid")


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    path = tmp_path_factory.mktemp("study") / "small.toml"
    path.write_text(STUDY)
    return load_study(path)


@pytest.fixture
def uncertified(monkeypatch):
    """No case is traced only because it is one of the first."""
    monkeypatch.setattr(segment_modal, "ALWAYS_CERTIFIED", 0)


def computed(study, cases, **keys):
    text = study_with(study, {key.replace("__", "."): value for key, value in keys.items()}).identity_text()
    return kept_result(
        text, workflow.KIND.template(text), workflow.KIND.compute(text, np.asarray(cases), DEVICE)
    )


def names(study, count):
    return workflow.KIND.case_table(study.identity_text(), 0, count)["disturbance"]


def test_modal_numbers_are_those_of_full_traces(study):
    """Pistons to rounding, small tilts and figures to the second order that is left out."""
    modal, standard = computed(study, range(14)), computed(study, range(14), optics__light="traced")
    assert (modal.status == DONE).all()
    assert (modal.arrays["traced"] == CERTIFIED).all()
    for name in (*SERIES, "segment_piston_rms"):
        assert (np.isnan(modal.arrays[name]) == np.isnan(standard.arrays[name])).all(), name
        error = np.abs(modal.arrays[name] - standard.arrays[name]).reshape(14, -1)
        size = np.nanmax(np.abs(standard.arrays[name]).reshape(14, -1), axis=1)
        for population in ("swing", "aligned", "quake", "shake", "all"):
            mine = names(study, 14) == population
            allowed = ROUNDING_NM if population == "swing" else ROUNDING_NM + 3e-4 * size[mine].max()
            assert np.nanmax(error[mine]) < allowed, (name, population)
            assert size[mine].max() > 1e-3 or name == "segment_piston_rms", (name, population)
    np.testing.assert_array_equal(modal.arrays["marechal"], standard.arrays["marechal"])
    np.testing.assert_array_equal(modal.arrays["time_s"], standard.arrays["time_s"])


def test_stored_errors_are_the_differences_to_full_traces(study):
    modal, standard = computed(study, range(14)), computed(study, range(14), optics__light="traced")
    for name in SERIES:
        error = np.abs(modal.arrays[name] - standard.arrays[name])
        if name in ("los", "centroid"):
            error = np.linalg.norm(error, axis=2)
        largest = np.nanmax(error.reshape(14, -1), axis=1)
        np.testing.assert_array_equal(modal.arrays[f"modal_error_{name}"], largest)
    bound = modal.arrays["modal_bound"]
    assert (modal.arrays["modal_error_wfe_rms_raw"] < bound + ROUNDING_NM).all()


def test_cases_beyond_the_range_are_traced_in_full(study):
    """Tilts of 3 urad err by nanometers: such a case has the bits of the standard method."""
    far = {"disturbance__aligned__tip_nrad": 3000.0}
    cases = np.flatnonzero(names(study, 14) == "aligned")
    modal, standard = (
        computed(study, range(14), **far),
        computed(study, cases, optics__light="traced", **far),
    )
    assert (modal.arrays["traced"][cases] == TRACED).all()
    assert (modal.arrays["modal_bound"][cases] > 0.1).all()
    for name in SERIES:
        np.testing.assert_array_equal(modal.arrays[name][cases], standard.arrays[name])
        assert np.isnan(modal.arrays[f"modal_error_{name}"][cases]).all()
    assert (modal.arrays["traced"][names(study, 14) == "swing"] == CERTIFIED).all()


def test_certification_catches_a_model_that_is_used_too_far(study):
    """Told to tolerate anything, the model is wrong by nanometers, and the store says so."""
    far = {"disturbance__aligned__tip_nrad": 10_000.0, "optics__modal_tolerance_nm": 1e6}
    cases = np.flatnonzero(names(study, 14) == "aligned")
    found = computed(study, cases, **far).arrays
    assert (found["traced"] == CERTIFIED).all()
    assert (found["modal_error_zernike"] > 1.0).all()
    assert (found["modal_bound"] > found["modal_error_wfe_rms_raw"]).all()


def test_motions_that_the_model_does_not_know_are_traced(study, uncertified, monkeypatch):
    known = segment_modal.draw_realizations

    def turned(bench, population, realizations):
        for realization, motion in zip(realizations, known(bench, population, realizations), strict=True):
            motion.segment_motion[..., 5] += 1e-12 * (realization == 1)
            yield motion

    monkeypatch.setattr(segment_modal, "draw_realizations", turned)
    only = study.model_copy(update={"disturbance": study.disturbance[2:3]})
    traced = workflow.KIND.compute(only.identity_text(), np.arange(2), DEVICE).arrays["traced"]
    assert traced.tolist() == [MODAL, TRACED]


def test_a_failure_of_a_traced_case_is_the_failure_of_the_case(study):
    """Glass moved by meters: no ray is left, and the modal model must not say otherwise."""
    found = computed(study, range(7), disturbance__aligned__in_plane_um=4e6)
    row = int(np.flatnonzero(names(study, 7) == "aligned")[0])
    assert found.status[row] == RAISED
    assert "lost all its rays" in found.messages[row]
    assert np.isnan(found.arrays["wfe_rms"][row]).all()
    assert found.status[0] == DONE


@pytest.mark.parametrize("reduce", ["none", "summary"])
def test_each_case_alone_has_the_bits_that_it_has_in_any_chunk(study, uncertified, reduce):
    whole = computed(study, range(150), store__reduce=reduce).arrays
    assert set(whole["traced"].tolist()) >= {MODAL, CERTIFIED}
    pieces = [computed(study, range(a, b), store__reduce=reduce).arrays for a, b in ((0, 63), (63, 150))]
    for name, values in whole.items():
        np.testing.assert_array_equal(np.concatenate([piece[name] for piece in pieces]), values, err_msg=name)
    for case in (0, 1, 64, 74, *range(140, 147)):
        with threadpool_limits(1 + case % 2):
            alone = computed(study, [case], store__reduce=reduce).arrays
        for name, values in whole.items():
            np.testing.assert_array_equal(alone[name][0], values[case], err_msg=f"{name} of case {case}")


def test_cases_that_are_in_memory_together_do_not_change_bits(study, uncertified, monkeypatch):
    whole = computed(study, range(80)).arrays
    monkeypatch.setattr(segment_modal, "_INSTANTS", 30)
    monkeypatch.setattr(segment_modal, "_TRACED_AT_ONCE", 2)
    for name, values in computed(study, range(80)).arrays.items():
        np.testing.assert_array_equal(values, whole[name], err_msg=name)


def test_sampled_cases_are_the_first_hundred_and_a_random_share():
    cases = np.arange(1_000_000)
    chosen = sampled(3, cases, 0.001)
    assert chosen[:100].all()
    later = np.flatnonzero(chosen[100:])
    assert abs(len(later) - 1000) < 5 * np.sqrt(1000)
    assert np.abs(np.histogram(later, bins=10)[0] - 100).max() < 5 * np.sqrt(100)
    assert not np.array_equal(chosen, sampled(4, cases, 0.001))
    np.testing.assert_array_equal(sampled(3, cases[5000:6000], 0.001), chosen[5000:6000])
    assert sampled(2**62, cases[:3], 1.0).all()
    assert sampled(3, cases, 0.0).sum() == 100


@pytest.mark.parametrize("method", ["traced", "modal"])
def test_summaries_are_the_statistics_of_the_arrays(study, method):
    whole = computed(study, range(14), optics__light=method).arrays
    short = computed(study, range(14), optics__light=method, store__reduce="summary").arrays
    assert not any(name in short for name in ("time_s", "zernike"))
    order = {name: k for k, name in enumerate(STATISTICS)}
    for row in range(14):
        there = np.isfinite(whole["time_s"][row])
        series = {name: whole[name][row][there] for name in ("wfe_rms_raw", "segment_piston_rms")}
        series["los"] = np.hypot(*whole["los"][row][there].T)
        for name, values in series.items():
            found = {key: short[name][row, place] for key, place in order.items()}
            expected = {
                "mean": np.mean(values),
                "rms": np.sqrt(np.mean(values**2)),
                "min": min(values),
                "max": max(values),
                "p95": np.percentile(values, 95),
                "last": values[-1],
            }
            for key, value in expected.items():
                assert found[key] == pytest.approx(value, rel=1e-12), (name, key)
        zernike = np.sqrt(np.mean(whole["zernike"][row][there] ** 2, axis=0))
        np.testing.assert_allclose(short["zernike_rms"][row], zernike, rtol=1e-12)
    np.testing.assert_array_equal(short["marechal"], whole["marechal"])


def test_files_and_stores_that_call_light_the_method_are_read(study, tmp_path):
    """Their identity is that of now, so that their stores go on; of both keys the later one counts."""
    path = tmp_path / "small.toml"
    path.write_text(STUDY.replace('light = "modal"', 'method = "modal"'))
    before = load_study(path)
    assert before.optics.light == "modal"
    assert before.identity_text() == study.identity_text()
    assert '"method":"modal"' in study.identity_text()
    for keys, light in (
        ({"optics.light": "traced"}, "traced"),
        ({"optics.method": "standard"}, "traced"),
        ({"optics.method": "standard", "optics.light": "modal"}, "modal"),
    ):
        assert load_study(path, keys).optics.light == light
    with pytest.raises(UserError, match=r"optics\.light: input should be 'traced' or 'modal'"):
        load_study(path, {"optics.light": "standard"})


def test_every_other_instant_is_kept(study):
    whole = computed(study, range(7)).arrays
    short = computed(study, range(7), store__every=2).arrays
    for name in ("time_s", "wfe_rms", "los", "zernike"):
        np.testing.assert_array_equal(short[name], whole[name][:, 1::2])


def test_without_images_the_other_numbers_stay(study):
    only = study.model_copy(update={"disturbance": study.disturbance[:1]})
    with_images = computed(only, range(2), imaging__enabled=True, imaging__pixels=16, optics__light="traced")
    without = computed(only, range(2), optics__light="traced")
    assert with_images.arrays.keys() - without.arrays.keys() == {"exposure", "peak", "ee50", "ee80"}
    for name, values in without.arrays.items():
        np.testing.assert_array_equal(values, with_images.arrays[name])


def test_a_store_of_summaries_is_whole_and_says_how_good_the_model_is(study, tmp_path):
    found = wq.run(study, cases=130, store=tmp_path / "store", store__reduce="summary", store__chunk_cases=64)
    assert (found.status == 1).all()
    assert found.wfe_rms_raw.sel(statistic="max").dims == ("case",)
    assert found.wfe_rms_raw.attrs["units"] == "nm"
    assert (found.traced[:100] == CERTIFIED).all()
    assert float(found.modal_error_wfe_rms_raw.max()) < 0.01
    assert found.sizes["noll"] == 21


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"imaging.enabled": True}, r"'modal' makes no images; set imaging.enabled = false"),
        ({"wavefront.method": "slopes"}, r"needs wavefront.method = 'opd'"),
        ({"wavefront.reference": "fitted"}, r"needs wavefront.method = 'opd' and wavefront.reference"),
        ({"store.reduce": "summary", "store.every": 2}, r"leave store.every out"),
        ({"store.every": 4}, r"store.every is 4, but there are cases of 3 instants"),
        ({"study.workflow": "telescope-exposure"}, r"decides which sections a study has"),
        ({"optics.modal_tolerance_nm": 0.0}, r"modal_tolerance_nm"),
    ],
)
def test_what_does_not_fit_is_refused(study, keys, message):
    with pytest.raises(UserError, match=message):
        study_with(study, keys)


def test_exposures_do_not_sum_modes(study):
    record = study.model_dump(mode="json")
    record["study"]["workflow"] = "telescope-exposure"
    with pytest.raises(ValueError, match="belong to the workflow segment-disturbance"):
        type(study).model_validate(record)


def test_nothing_moves_but_the_mount(study):
    only = study.model_copy(update={"disturbance": study.disturbance[3:4]})
    modal, standard = computed(only, range(2)), computed(only, range(2), optics__light="traced")
    np.testing.assert_allclose(modal.arrays["los"], standard.arrays["los"], rtol=0, atol=1e-4)
    assert np.abs(standard.arrays["los"]).max() > 0.1


def test_a_plan_does_not_take_the_first_cases_for_the_others(study, monkeypatch):
    """The first hundred are traced besides; the pilot is of the last ones."""
    asked = []

    def compute(text, cases, device):
        asked.append(cases)
        return workflow.KIND.compute(text, cases, device)

    chosen = study_with(study, {"campaign.cases": 100_000, "store.chunk_cases": 1000})
    monkeypatch.setitem(kinds._registered, "segment-disturbance", replace(workflow.KIND, compute=compute))
    planning.plan(chosen)
    assert len(asked[0]) == 1 < len(asked[-1])
    assert all(cases[-1] == 99_999 for cases in asked)
    del asked[:]
    planning.plan(study_with(chosen, {"campaign.cases": 5}))
    assert [cases.tolist() for cases in asked] == [[4], [0, 1, 2, 3, 4]]
    del asked[:]
    monkeypatch.setattr(planning, "_LONG_S", 1e-9)  # a case that takes long is the whole pilot
    assert "(pilot of 1 case, " in planning.plan(chosen)["one case"]
    assert [len(cases) for cases in asked] == [1]


def test_a_campaign_of_summaries_stops_when_a_quantile_is_known(study, tmp_path):
    only = study.model_copy(update={"disturbance": study.disturbance[:1]})
    keys = {"store__reduce": "summary", "store__chunk_cases": 100, "optics__modal_sample": 0.0}
    until = "wfe_rms_raw.p50 ci<=5%"
    found = wq.run(only, cases=100_000, store=tmp_path / "store", campaign__until=until, **keys)
    done = int((found.status == DONE).sum())
    assert done < 10_000
    rms = np.sort(found.wfe_rms_raw.sel(statistic="rms").to_numpy()[:done])
    half = 0.98 * np.sqrt(done)  # ranks of the interval of a median
    low, high = rms[int(done / 2 - half)], rms[int(done / 2 + half) + 1]
    assert (high - low) / 2 < 0.06 * np.median(rms)
