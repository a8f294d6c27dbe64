"""Studies that read motions and figures over time: the same numbers as in Python, alone and combined."""

import shutil

import numpy as np
import pytest
import xarray as xr

from wavequake.campaign.contract import DONE, RAISED
from wavequake.campaign.schema import study_from_identity
from wavequake.errors import UserError
from wavequake.kernels.device.devices import NUMPY
from wavequake.mechanics.disturbances.layout import NO_SEGMENTS
from wavequake.mechanics.disturbances.motion import RAD_PER_MAS
from wavequake.mechanics.disturbances.registry import draw_case, instants_of, parts
from wavequake.optics.catalog.names import optical_system
from wavequake.optics.derivatives.sensitivity import figure_sensitivity, rigid_sensitivity
from wavequake.optics.rays.pupils import sunflower
from wavequake.optics.systems.bodies import rigid_body, with_bodies
from wavequake.optics.systems.kinematics import rest_states
from wavequake.optics.systems.system import States
from wavequake.optics.wavefronts.wavefront import measure_system, prepare_system
from wavequake.report.exports.rerun import rerun_stored
from wavequake.workflows.budgets.budget import summed
from wavequake.workflows.budgets.elements import Factors, variants
from wavequake.workflows.budgets.systems import experiment
from wavequake.workflows.planning.plan import plan
from wavequake.workflows.run import notices, run, run_study
from wavequake.workflows.study import load_study, study_with
from wavequake.workflows.systems import measure as system_measure
from wavequake.workflows.systems.bench import deformable, system_bench
from wavequake.workflows.systems.disturbance import KIND, draw
from wavequake.workflows.systems.study import SystemStudy

HEAD = """
[study]
name = "relay"
workflow = "system-disturbance"
[system]
name = "six-lens"
[campaign]
device = "numpy"
cases = 6
[optics]
rays = 40
[wavefront]
zernike_terms = 6
[[body]]
name = "lens 3"
surfaces = ["L3 front", "L3 back"]
[[disturbance]]
name = "shake"
model = "surface-history"
file = "my history.csv"
"""
RANDOM = """
[[disturbance]]
name = "askew"
model = "surface-random"
of = ["lens 3", "L1 front"]
rms = { dx_um = 5.0, ry_urad = 20.0 }
share = 0
[[disturbance]]
name = "figure"
model = "surface-deformation"
of = ["L1 front"]
rms_nm = { 8 = 20.0 }
share = 0
[[disturbance]]
name = "both"
model = "combine"
of = ["askew", "shake", "figure"]
"""
TIME = np.array([-0.5, 0.0, 0.001, 0.0015, 0.7, 3.0, 3.5])
MOTION = {
    "L1 front.dx_um": 3.0 * np.sin(TIME),
    "lens 3.ry_urad": 30.0 * np.cos(TIME),
    "L1 front.z5_nm": 30.0 * TIME,
    "L4 back.z2_nm": -50.0 * TIME**2,
    "L1 front.rz_urad": 100.0 * TIME,
    "line_of_sight.x_mas": 800.0 * TIME,
}


def written(folder, text=HEAD, time=TIME, motion=MOTION, *overrides):
    """Return the study of `text` and its history, both written to `folder`."""
    table = np.column_stack([time, *motion.values()])
    header = ",".join(["time_s", *motion])
    np.savetxt(folder / "my history.csv", table, delimiter=",", header=header, comments="", fmt="%.17g")
    (folder / "study.toml").write_text(text)
    return load_study(folder / "study.toml", overrides)


def states_of(motion, count):
    """Return six-lens and its states, filled in by hand."""
    system = optical_system("six-lens")
    names = [surface.name for surface in system.surfaces]
    system = deformable(system, {names.index("L1 front"): 5, names.index("L4 back"): 2})
    states = rest_states(system, count)
    states.surface_motion[:, names.index("L1 front"), 0] = 1e-3 * motion["L1 front.dx_um"]
    states.surface_motion[:, names.index("L1 front"), 5] = 1e-6 * motion["L1 front.rz_urad"]
    states.deformations[names.index("L1 front")][:, 4] = 1e-6 * motion["L1 front.z5_nm"]
    states.deformations[names.index("L4 back")][:, 1] = 1e-6 * motion["L4 back.z2_nm"]
    states.line_of_sight[:, 0] = RAD_PER_MAS * motion["line_of_sight.x_mas"]
    turn = np.zeros((count, 6))
    turn[:, 4] = 1e-6 * motion["lens 3.ry_urad"]
    body = rigid_body(system, "lens 3", ["L3 front", "L3 back"])
    moved = with_bodies(system, states.surface_motion, [(body, turn)])
    return system, States(moved, states.deformations, states.line_of_sight)


def test_a_history_gives_what_the_same_states_give_in_python(tmp_path):
    study = written(tmp_path)
    assert study.disturbance[0].instants == len(TIME)
    found = KIND.compute(study.identity_text(), np.array([0]), "numpy").arrays
    system, states = states_of(MOTION, len(TIME))
    rays = sunflower(0.0, 1.0, 40)
    np.testing.assert_array_equal(found["time_s"][0], TIME)
    for field in range(len(system.fields)):
        prepared = prepare_system(system, rays.x, rays.y, rays.weight, 6, field)
        expected, rest = (measure_system(prepared, one, NUMPY) for one in (states, rest_states(system)))
        to_nm = 1e6 * prepared.wavelength
        scale = np.abs(expected.zernike).max() * to_nm
        assert scale > 3.0
        zernike, sight = found["zernike"][0, :, field, 0], found["los_mm"][0, :, field, 0]
        np.testing.assert_allclose(zernike, expected.zernike * to_nm, rtol=0, atol=1e-12 * scale)
        np.testing.assert_allclose(sight, expected.los - rest.los, rtol=1e-12, atol=1e-14)
        np.testing.assert_allclose(found["strehl"][0, :, field, 0], expected.strehl, rtol=1e-12)


def test_small_motions_act_by_the_sensitivities(tmp_path):
    """Line of sight and coefficients are matrices times what moves: of a lens, a surface and a figure.

    The light of a case follows the stop as a whole, that of a matrix ray by ray: 1.9e-4 in this lens.
    """
    time = np.arange(1, 30) / 1000.0
    motion = {
        "L1 front.dx_um": 0.03 * np.sin(400 * time),
        "lens 3.ry_urad": 0.3 * np.cos(300 * time),
        "L1 front.z5_nm": 0.3 * np.sin(200 * time),
        "L4 back.z2_nm": 0.3 * np.cos(100 * time),
        "L1 front.rz_urad": 0.0 * time,
        "line_of_sight.x_mas": 0.0 * time,
    }
    study = written(tmp_path, HEAD, time, motion)
    bench = system_bench(study.identity_text())
    names = [surface.name for surface in bench.system.surfaces]
    found = KIND.compute(study.identity_text(), np.array([0]), "numpy").arrays
    for field, (prepared, *_) in enumerate(bench.prepared):
        rigid = rigid_sensitivity(prepared, bench.bodies, NUMPY)
        figures = [figure_sensitivity(prepared, [names.index(one)], terms, NUMPY) for one, terms in DEFORMED]
        expected = (
            1e-3 * motion["L1 front.dx_um"][:, None] * rigid.los[names.index("L1 front"), 0]
            + 1e-6 * motion["lens 3.ry_urad"][:, None] * rigid.los[-1, 4]
            + 1e-6 * motion["L1 front.z5_nm"][:, None] * figures[0].los[0, 4]
            + 1e-6 * motion["L4 back.z2_nm"][:, None] * figures[1].los[0, 1]
        )
        size = np.abs(expected).max()
        assert size > 1e-5
        np.testing.assert_allclose(found["los_mm"][0, :, field, 0], expected, rtol=0, atol=3e-4 * size)


DEFORMED = (("L1 front", 5), ("L4 back", 2))


def test_a_detector_that_moves_sees_the_image_move_against_it(tmp_path):
    motion = {"image.dx_um": 7.0 * np.sin(TIME), "image.dy_um": -3.0 * TIME}
    found = KIND.compute(written(tmp_path, HEAD, TIME, motion).identity_text(), np.array([0]), "numpy").arrays
    expected = -1e-3 * np.stack(list(motion.values()), axis=1)
    for name in ("los_mm", "centroid_mm"):
        for field in (0, 1):
            np.testing.assert_allclose(found[name][0, :, field, 0], expected, rtol=0, atol=1e-12)
    np.testing.assert_allclose(found["wfe_change"], 0.0, rtol=0, atol=1e-4)


VIBRATION = """
[[disturbance]]
name = "hum"
model = "surface-vibration"
of = ["lens 3", "L1 front"]
duration_s = 0.05
instants = 5
lines = [{ frequency_hz = 85.0, amplitude = { dx_um = 3.0, rz_urad = 5.0 } }]
share = 0
"""


def test_a_vibration_that_is_written_down_gives_the_same_case(tmp_path):
    """Both are traced in one study: what is random once is read again, with the same wavefronts."""
    text = HEAD[: HEAD.index("[[disturbance]]")] + VIBRATION.replace("share = 0", "")
    study = written(tmp_path, text)
    (hum,) = study.disturbance
    drawn = draw_case((hum,), hum, NO_SEGMENTS, study.study.seed, 4).rigid
    dofs = ("dx_um", "dy_um", "dz_um", "rx_urad", "ry_urad", "rz_urad")
    motion = {
        f"{name}.{dof}": 1e6 * moved[:, place]
        for name, moved in drawn.items()
        for place, dof in enumerate(dofs)
    }
    again = written(tmp_path, HEAD, instants_of((hum,), hum), motion)
    one = KIND.compute(study.identity_text(), np.array([4]), "numpy").arrays
    other = KIND.compute(again.identity_text(), np.array([0]), "numpy").arrays
    for name, values in one.items():
        np.testing.assert_allclose(other[name], values, rtol=0, atol=1e-14, err_msg=name)


def test_a_combination_adds_what_is_random_to_every_instant(tmp_path):
    text = (HEAD + "share = 0\n" + RANDOM).replace('"shake",', '"shake", "hum",') + VIBRATION
    bench = system_bench(written(tmp_path, text).identity_text())
    both = next(one for one in bench.study.disturbance if one.name == "both")
    assert (both.instants, both.duration_s) == (len(TIME), TIME[-1])
    population, first = draw(bench, 0)
    _, second = draw(bench, 1)
    assert population == both
    alone = {
        one.name: draw_case(bench.study.disturbance, one, NO_SEGMENTS, 20180701, 0)
        for one in bench.study.disturbance
    }
    vibrated = bench.study.disturbance[-1]
    hum = draw_case((vibrated,), vibrated, NO_SEGMENTS, 20180701, 0, time=TIME)
    for name in ("lens 3", "L1 front"):
        given = alone["shake"].rigid[name] + alone["askew"].rigid[name][0] + hum.rigid[name]
        np.testing.assert_allclose(first.rigid[name], given, rtol=0, atol=1e-20)
    np.testing.assert_allclose(
        first.figure["L1 front"] - second.figure["L1 front"],
        np.tile(first.figure["L1 front"][0] - second.figure["L1 front"][0], (len(TIME), 1)),
        rtol=0,
        atol=1e-22,
    )
    np.testing.assert_allclose(first.figure["L1 front"][:, 4], 30e-9 * TIME, rtol=1e-14)
    stored = run(bench.study, store=tmp_path / "s", cases=3)
    np.testing.assert_array_equal(stored["time_s"], np.tile(TIME, (3, 1)))
    assert (stored["status"] == DONE).all()


@pytest.mark.parametrize("device", ["numpy", "auto"])
def test_bits_depend_on_no_other_case_or_piece(tmp_path, monkeypatch, device):
    """A history of 97 instants is traced in pieces of 16, of which the last has one, or at once."""
    time = np.arange(97) / 1000.0
    motion = {"L1 front.dx_um": np.sin(300 * time), "L1 front.z9_nm": 20 * np.cos(time)}
    text = written(tmp_path, HEAD + RANDOM, time, motion).identity_text()
    together = KIND.compute(text, np.arange(4), device)
    monkeypatch.setattr(system_measure, "_RAYS", 40 * 16)
    pieces = KIND.compute(text, np.array([2, 3]), device).arrays
    for name, values in pieces.items():
        assert values.tobytes() == together.arrays[name][2:].tobytes(), name


def test_five_thousand_instants_are_traced(tmp_path):
    time = np.arange(5000) / 2000.0
    motion = {"L1 front.dx_um": np.sin(300 * time), "L3 back.z4_nm": 20 * np.cos(20 * time)}
    study = written(tmp_path, HEAD, time, motion, "optics.rays=12", "wavefront.zernike_terms=4")
    found = run(study, store=tmp_path / "s", campaign__device="auto")
    assert found.sizes["time"] == 5000
    sight = found["los_mm"].isel(case=0, field=0, wavelength=0, axis=0)
    assert abs(np.corrcoef(sight, motion["L1 front.dx_um"])[0, 1]) > 1.0 - 1e-6


def test_a_store_needs_the_file_no_more(tmp_path):
    """A run that was stopped goes on by what the store knows; chunks change no bit."""
    study = written(tmp_path, HEAD + "share = 0\n" + RANDOM)
    text = study.identity_text()

    def stop(done, cases, quarantined):
        if done >= 2:
            raise KeyboardInterrupt

    parts = study_with(study, {"store.chunk_cases": 2})
    with pytest.raises(KeyboardInterrupt):
        run_study(parts, tmp_path / "s", on="serial", progress=stop)
    whole = run(study, store=tmp_path / "whole", store__chunk_cases=6)
    shutil.move(tmp_path / "my history.csv", tmp_path / "gone")
    left = study_with(
        study_from_identity(SystemStudy, text), {"campaign.cases": 6, "campaign.device": "numpy"}
    )
    assert left.identity() == study.identity()
    summary = run_study(left, tmp_path / "s", on="serial")
    assert 0 < summary.computed < 6
    with (
        xr.open_zarr(tmp_path / "s" / "data.zarr") as one,
        xr.open_zarr(tmp_path / "whole/data.zarr") as other,
    ):
        assert one.sizes["time"] == len(TIME)
        xr.testing.assert_identical(one.drop_attrs().load(), other.drop_attrs().load())
    assert whole.sizes["case"] == 6


def test_another_file_needs_the_study_to_be_loaded_with_it(tmp_path):
    study = written(tmp_path)
    with pytest.raises(
        UserError, match=r"'disturbance.shake.file' changes nothing in it; load it with this key"
    ):
        run(study, store=tmp_path / "s", disturbance__shake__file="other.csv")
    (tmp_path / "other.csv").write_text("time_s,L1 front.dx_um\n0,1\n")
    other = load_study(tmp_path / "study.toml", {"disturbance.shake.file": "other.csv"})
    assert other.disturbance[0].instants == 1


def test_what_is_not_random_has_one_case(tmp_path):
    alone = written(tmp_path, HEAD)
    assert (alone.cases, alone.campaign.cases) == (1, 6)
    assert list(notices(alone)) == ["Nothing in this study is random: it has 1 case."]
    assert run(alone, store=tmp_path / "s").sizes["case"] == 1
    assert plan(alone)["cases"].startswith("1 in 1 chunk ")
    mixed = written(tmp_path, HEAD + RANDOM)
    assert mixed.cases == 6
    (notice,) = notices(mixed)
    assert "Nothing in shake is random" in notice
    assert "share = 0" in notice
    never = written(tmp_path, HEAD + "share = 0\n" + RANDOM)
    assert list(notices(never)) == []
    assert KIND.work(never.identity_text(), 2) == {"trace": (2 * len(TIME) * 2 * 40 * 14, "ray-surfaces")}


def test_without_its_history_a_combination_keeps_the_instants(tmp_path):
    text = (HEAD + "share = 0\n" + RANDOM).replace('"shake",', '"shake", "hum",') + VIBRATION
    study = written(tmp_path, text)
    sources = parts(study.disturbance, summed(study, None))
    assert [part.name for part in sources] == ["askew", "shake", "hum", "figure"]
    factors = Factors(tuple(sources))
    whole, _, _, unshaken, *_ = variants(summed(study, None), factors, NO_SEGMENTS, 20180701, 2)
    assert unshaken.rigid["lens 3"].shape == (len(TIME), 6)
    moved = whole.rigid["lens 3"] - unshaken.rigid["lens 3"]
    np.testing.assert_allclose(moved[:, 4], 1e-6 * MOTION["lens 3.ry_urad"], rtol=0, atol=1e-18)
    np.testing.assert_allclose(moved[:, [0, 1, 2, 3, 5]], 0.0, rtol=0, atol=1e-20)
    assert np.ptp(unshaken.rigid["lens 3"][:, 0]) > 1e-6
    assert not unshaken.mount.any()


def test_a_budget_takes_a_history_apart(tmp_path):
    """With and without a combination: there, without the history, the other parts keep its instants."""
    both = written(tmp_path, (HEAD + "share = 0\n" + RANDOM).replace('"askew", "shake"', '"shake", "askew"'))
    free = written(tmp_path, HEAD + RANDOM[: RANDOM.index('[[disturbance]]\nname = "both"')])
    one, other = (experiment(study, summed(study, None), "numpy") for study in (both, free))
    assert [factor.name for factor in one.factors] == [factor.name for factor in other.factors]
    assert [factor.name for factor in one.factors][:3] == ["shake", "askew", "figure"]
    values = one.values(0, 2)
    np.testing.assert_array_equal(other.values(0, 2), values)
    # One case of all, all drawn again, and then without each factor: the history is the same in both.
    assert np.isfinite(values).all()
    assert not values[..., 3].any()  # no ray is lost
    values = values[..., :3]
    assert (values[:, 2] != values[:, 0]).all()
    redrawn = values[:, 2 + len(one.factors)]
    np.testing.assert_array_equal(redrawn, values[:, 0])
    assert (values[:, 1] != values[:, 0]).all()


@pytest.mark.parametrize(
    ("motion", "keys", "sentence"),
    [
        ({"L1 frnt.dx_um": TIME}, [], "'shake' acts on 'L1 frnt', but six-lens has no such .*'L1 front'"),
        ({"lens 3.z5_nm": TIME}, [], "'shake' deforms the body 'lens 3'; only a surface deforms"),
        ({"lens 3.dx_mm": TIME}, [], "study.toml: disturbance.shake: the history my history.csv: the column"),
        ({"lens 3.dx_um": TIME}, ["disturbance.both.instants=16"], "'both' holds a history of 7 rows"),
        ({"lens 3.dx_um": TIME}, ["disturbance.shake.instants=16"], "the history has 7 rows"),
        ({"lens 3.dx_um": TIME}, ["disturbance.shake.file=none.csv"], "none.csv cannot be read"),
    ],
)
def test_what_does_not_fit_is_refused(tmp_path, motion, keys, sentence):
    with pytest.raises(UserError, match=sentence):
        KIND.check(written(tmp_path, HEAD + "share = 0\n" + RANDOM, TIME, motion, *keys).identity_text())


def test_light_that_is_lost_at_an_instant_says_when(tmp_path):
    study = written(tmp_path, HEAD, TIME, {"L1 front.dx_um": np.where(TIME > 3.0, 2e6, 0.0)})
    result = KIND.compute(study.identity_text(), np.array([0]), "numpy")
    assert result.status.tolist() == [RAISED]
    assert "at t = 3.5 s " in result.messages[0]
    assert np.isnan(result.arrays["wfe_rms"]).all()
    assert KIND.template(study.identity_text()).per_case["wfe_rms"].shape[0] == len(TIME)


def test_a_report_shows_the_beginning_of_a_long_table(tmp_path, wavequake):
    long = HEAD.replace("rays = 40", "rays = 12").replace("zernike_terms = 6", "zernike_terms = 4")
    time = np.arange(2500) / 1e4
    written(tmp_path, long, time, {f"L1 front.d{axis}_um": np.sin(90 * time) for axis in "xyz"})
    code, _, _ = wavequake("run", tmp_path / "study.toml", "--store", tmp_path / "s", "--on", "serial")
    page = (tmp_path / "s" / "report.html").read_text()
    table = (tmp_path / "my history.csv").read_text()
    assert code == 0
    assert len(table) > 100_000
    assert f"({len(table)} characters, which the store" in page
    assert table.splitlines()[1] in page
    assert table.splitlines()[-1] not in page


def test_a_case_in_full_detail_has_figures_over_time(tmp_path):
    study = written(tmp_path, HEAD + "share = 0\n" + RANDOM)
    run(study, store=tmp_path / "s", cases=2)
    found = rerun_stored(tmp_path / "s", 1, tmp_path / "case.nc")
    assert (found.status, found.differing) == (DONE, ())
    _, drawn = draw(system_bench(study.identity_text()), 1)
    with xr.open_dataset(tmp_path / "case.nc") as detail:
        figure = detail["drawn_figure"].sel(deformed="L1 front")
        assert figure.dims == ("instant", "term")
        np.testing.assert_array_equal(figure, 1e9 * drawn.figure["L1 front"])
        tilt = detail["drawn_figure"].sel(deformed="L4 back").isel(term=1)
        np.testing.assert_allclose(tilt, MOTION["L4 back.z2_nm"], rtol=1e-15)
        np.testing.assert_array_equal(detail["sight"], drawn.mount)
