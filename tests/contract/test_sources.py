"""What every registered source owes, and one that a file outside adds, in both kinds of optics."""

import pickle

import creaking_source
import numpy as np
import pytest
from creaking_source import Creaking
from small_bodies import SPRINGS

import wavequake as wq
from wavequake.campaign import plugins
from wavequake.campaign.contract import DONE
from wavequake.errors import UserError
from wavequake.kernels.device.devices import NUMPY
from wavequake.mechanics.disturbances.registry import draw, randoms_of
from wavequake.mechanics.disturbances.source import SOURCES, time_axis_of
from wavequake.mechanics.disturbances.streams import Coordinates
from wavequake.optics.rays.pupils import on_glass, sunflower
from wavequake.optics.segments.catalog import telescope
from wavequake.optics.segments.parent import parent_system
from wavequake.optics.segments.prepared import chief_rays, prepare
from wavequake.optics.systems.kinematics import rest_states
from wavequake.optics.wavefronts.wavefront import measure_system, prepare_system
from wavequake.workflows.budgets.budget import budget
from wavequake.workflows.segments import disturbance as segments
from wavequake.workflows.segments.bench import bench_of
from wavequake.workflows.segments.disturbance import draw as draw_segments
from wavequake.workflows.segments.draws import sampling_plan as segment_plan
from wavequake.workflows.study import load_study
from wavequake.workflows.systems.bench import system_bench
from wavequake.workflows.systems.disturbance import draw as draw_system
from wavequake.workflows.systems.disturbance import sampling_plan as system_plan

STAND = """
[[body]]
name = "stand"
surfaces = ["CARRIED"]
[body.rigid]
mass_kg = 1.0
inertia_kg_m2 = [1e-3, 1e-3, 1e-3]
""" + SPRINGS.replace("BODY", "stand")
SEGMENTS = """
[study]
name = "creaking"
workflow = "segment-disturbance"
seed = 3
[campaign]
cases = 8
device = "numpy"
[telescope]
name = "tmt-18"
[optics]
rays_per_segment = 6
[imaging]
enabled = false
[wavefront]
zernike_terms = 11
"""
SEGMENTS += STAND.replace("CARRIED", "M3")
SYSTEM = """
[study]
name = "creaking"
workflow = "system-disturbance"
seed = 3
[campaign]
cases = 8
device = "numpy"
[optics]
rays = 60
[wavefront]
zernike_terms = 11
[system]
name = "double-gauss"
fields_deg = [[0.0, 0.0]]
wavelengths_nm = [587.6]
"""
SYSTEM += STAND.replace("CARRIED", "surface 10")
HISTORY = "time_s,NAME.dz_um,NAME.rx_urad,line_of_sight.x_mas\n0.0,0.0,0.0,0.0\n0.1,1.0,2.0,3.0\n"
# Keys of an example of each, for elements called NAME.
GIVEN = '[[disturbance]]\nname = "given"\nmodel = "surface-history"\nfile = "given.csv"'
EXAMPLES = {
    "static-random": "piston_nm = 10.0\nfigure_nm = { 5 = 3.0 }",
    "line-of-sight": 'spectrum = "tmt-vibration"',
    "vibration-lines": 'set = "keck"',
    "segment-history": "peak_nm = 10.0",
    "common-history": "piston_nm = 10.0",
    "segment-wind": "",
    "edge-sensor-noise": "",
    "surface-random": 'of = ["NAME"]\nrms = { dz_um = 1.0 }',
    "surface-vibration": 'of = ["NAME"]\nlines = [{ frequency_hz = 20.0, amplitude = { rx_urad = 1.0 } }]',
    "surface-history": 'file = "history.csv"',
    "nodal-displacements": 'file = "nodes.csv"\nsurface = "NAME"\nterms = 6',
    "surface-deformation": 'of = ["NAME"]\nrms_nm = { 5 = 10.0 }',
    "base-motion": "spectrum = { rms = 1e-3 }",
    "body-force": 'at = ["stand"]\nlines = [{ frequency_hz = 20.0, force_n = 1.0 }]',
    "reaction-wheel": 'at = "stand"\nspeed_rpm = [600.0, 1200.0]\n'
    "harmonics = [{ number = 1.0, axial_g_mm = 1.0 }]",
    "gravity": "",
    "segment-shaking": "spectrum = { rms = 1e-3 }\n[segment]\nthickness_m = 0.5\ndivisions = 3",
    "body-wind": "areas_m2 = { stand = 0.1 }",
    "load-history": 'file = "loads.csv"',
    "temperature-table": 'temperature_c = [10.0, 20.0]\naligned_c = 15.0\nspread_c = 2.0\nfile = "hot.csv"',
    "pattern-vibration": 'pattern = { "NAME.dx_um" = 1.0 }\nlines = [{ frequency_hz = 20.0, fwhm_hz = 0.2 }]',
    "creaking": 'of = ["NAME"]\nstep_nm = 20.0',
}
OPTICS = {"segments": (SEGMENTS, "M2"), "surfaces": (SYSTEM, "surface 3")}


def entry(model, keys, name="one", instants=4):
    own = "" if model == "surface-history" else f"instants = {instants}\n"
    return f'[[disturbance]]\nname = "{name}"\nmodel = "{model}"\n{own}{keys}\n'


def loaded(folder, text, element, *entries, **keys):
    (folder / "history.csv").write_text(HISTORY.replace("NAME", element))
    (folder / "nodes.csv").write_text(nodes_of_lens())
    (folder / "loads.csv").write_text("time_s,stand.fz_n\n0,0\n1,3\n")
    (folder / "hot.csv").write_text(f"temperature_c,{element}.dz_um\n0,0\n30,5\n")
    path = folder / "study.toml"
    path.write_text((text + "".join(entries)).replace("NAME", element))
    return load_study(path, keys)


def nodes_of_lens():
    """Nodes on the third surface of the double-Gauss, which go up along its axis."""
    (surface,) = (one for one in wq.load_system("double-gauss").surfaces if one.name == "surface 3")
    x, y = (part.ravel() for part in np.meshgrid(*[np.linspace(-8.0, 8.0, 9)] * 2))
    rows = [f"{a},{b},{c!r},0,0,3" for a, b, c in zip(x, y, surface.shape.sag(x, y)[0].tolist(), strict=True)]
    return "\n".join(["x_mm,y_mm,z_mm,dx_um,dy_um,dz_um", *rows, ""])


def own_sources():
    return {
        name: source
        for name, source in SOURCES.entries().items()
        if source.__module__.startswith("wavequake.") or source is Creaking
    }


def test_every_registered_source_has_an_example():
    assert set(own_sources()) == set(EXAMPLES)


@pytest.mark.parametrize("model", EXAMPLES)
def test_a_source_keeps_its_word(tmp_path, model):
    """It fits the optics that it names, keeps its keys, and takes as many numbers as it says."""
    source = SOURCES.entries()[model]
    assert source.independent in ("element", "whole")
    for optics, (text, element) in OPTICS.items():
        if optics not in source.fits:
            with pytest.raises(UserError, match=f"there is no model '{model}'; choose one of"):
                loaded(tmp_path, text, element, entry(model, EXAMPLES[model]))
            continue
        study = loaded(tmp_path, text, element, entry(model, EXAMPLES[model]))
        (one,) = study.disturbance
        assert type(one) is source
        assert (
            type(study).model_validate_json(study.identity_text(), strict=False).identity()
            == study.identity()
        )
        assert pickle.loads(pickle.dumps(one)) == one
        bench = (bench_of if optics == "segments" else system_bench)(study.identity_text())
        time = time_axis_of(one)
        taken = {}

        def randoms(name, taken=taken):
            return taken.setdefault(name, Coordinates())

        motion = draw(one, bench.layout, time, randoms)
        assert motion.mount.shape == (len(time), 2)
        assert motion.segment_motion.shape == (len(time), len(bench.layout), 6)
        assert all(np.isfinite(part).all() for part in (motion.segment_motion, *motion.rigid.values()))
        assert sum(one.taken for one in taken.values()) == one.dimensions(bench.layout)
        assert {name.partition("/")[0] for name in taken} <= {"one"}
        again, same = (
            draw(one, bench.layout, time, randoms_of(one, len(bench.layout), 1, number)) for number in (4, 4)
        )
        for name in ("segment_motion", "segment_figure", "mount", "m2"):
            np.testing.assert_array_equal(getattr(again, name), getattr(same, name))


@pytest.mark.parametrize("optics", OPTICS)
def test_what_an_element_does_depends_on_no_other_one(tmp_path, optics):
    text, element = OPTICS[optics]
    other = {"segments": "7", "surfaces": "surface 5"}[optics]
    models = [name for name, one in own_sources().items() if "of" in one.model_fields and optics in one.fits]
    assert "creaking" in models
    for model in models:
        alone = loaded(tmp_path, text, element, entry(model, EXAMPLES[model])).disturbance[0]
        both = alone.model_copy(update={"of": (other, element)})
        study = loaded(tmp_path, text, element, entry(model, EXAMPLES[model]))
        layout = (bench_of if optics == "segments" else system_bench)(study.identity_text()).layout
        first, second = (
            draw(one, layout, time_axis_of(one), randoms_of(one, len(layout), 2, 5)) for one in (alone, both)
        )
        for part in ("rigid", "figure"):
            for name, values in getattr(first, part).items():
                np.testing.assert_array_equal(getattr(second, part)[name], values)


@pytest.mark.parametrize("optics", OPTICS)
def test_a_source_from_outside_runs_in_a_study_in_sampling_and_in_a_budget(tmp_path, optics):
    text, element = OPTICS[optics]
    creak = entry("creaking", EXAMPLES["creaking"], "creak", 2)
    tremble = entry("surface-random", EXAMPLES["surface-random"], "tremble", 1).replace(
        "dz_um = 1.0", "dx_um = 1.0"
    )
    study = loaded(tmp_path, text, element, creak, tremble)
    done = wq.run(study, store=tmp_path / "store")
    assert (done["status"] == DONE).all()
    # It moves what it says: another case of the same realization gives the same, another element none.
    bench, drawing = (bench_of, draw_segments) if optics == "segments" else (system_bench, draw_system)
    drawn = drawing(bench(study.identity_text()), 0)
    motion = drawn.motion if optics == "segments" else drawn[1]
    assert list(motion.rigid) == [element]
    even = loaded(tmp_path, text, element, creak, tremble, **{"campaign.sampling": "sobol"})
    plan = (segment_plan if optics == "segments" else system_plan)(even.identity_text())
    assert dict(plan.streams) == {f"creak/{element}": 2, f"tremble/{element}": 6}
    pieces = budget(loaded(tmp_path, text, element, creak, tremble), 16)
    assert pieces["factor"].to_numpy().tolist()[:2] == ["creak", "tremble"]
    assert float(pieces["share"].sel(factor="tremble").max()) > 0.9
    assert np.isfinite(pieces["first"].sel(factor="creak")).all()


def test_a_moved_image_plane_moves_the_image_by_as_much(tmp_path):
    """The image of a shifted detector stands at minus the shift; a turn about its vertex does nothing."""
    focal = 450e3  # mm
    text = SEGMENTS + entry("surface-random", 'of = ["image"]\nrms = { dx_um = 50.0, dy_um = 30.0 }')
    study = loaded(tmp_path, text, "")
    bench = bench_of(study.identity_text())
    shift = draw_segments(bench, 0).motion.rigid["image"][0, :2] * 1e3
    found = segments.KIND.compute(study.identity_text(), np.arange(1), "numpy")
    assert found.status[0] == DONE, found.messages
    moved = found.arrays["los"][0, 0] / (180 / np.pi * 3600e3) * bench.first_order.focal_length
    assert abs(bench.first_order.focal_length) == pytest.approx(focal, rel=1e-3)
    np.testing.assert_allclose(moved, -shift, rtol=1e-4)


@pytest.mark.parametrize("name", ["tmt-thesis", "tmt"])
def test_surfaces_of_a_telescope_move_in_their_own_frames_as_those_of_a_system(name):
    """M3 of a telescope folds the light by 90 degrees: its frame is turned by 45."""
    segmented = telescope(name)
    system = parent_system(segmented)
    own = np.random.default_rng(2).normal(size=(16, len(segmented.surfaces), 6))
    own *= np.repeat([1e-2, 1e-5], 3)
    still = rest_states(segmented, 16)
    still.surface_motion[:, 2:] = own[:, 2:]
    rays = sunflower(segmented.annulus.inner, segmented.annulus.outer, 4000)

    prepared = prepare(segmented, on_glass(segmented, rays), 550e-6, 4)
    chief = chief_rays(prepared, still)[0, :2].T
    states = rest_states(system, 16)
    states.surface_motion[:, 2:] = own[:, 2:]
    pupil = sunflower(system.pupil.obscuration, 1.0, 60)
    found = measure_system(prepare_system(system, pupil.x, pupil.y, pupil.weight, 4), states, NUMPY)
    np.testing.assert_allclose(chief, found.chief, rtol=0, atol=1e-8)


def test_chosen_segments_move_as_they_do_among_all(tmp_path):
    everyone = loaded(tmp_path, SEGMENTS, "", entry("static-random", "piston_nm = 10.0"))
    some = loaded(tmp_path, SEGMENTS, "", entry("static-random", 'piston_nm = 10.0\nsegments = ["6", "1?"]'))
    bench, few = bench_of(everyone.identity_text()), bench_of(some.identity_text())
    names = np.array(bench.layout.names)
    chosen = np.array([name == "6" or (len(name) == 2 and name[0] == "1") for name in names])
    assert 1 < chosen.sum() < len(names)
    whole, part = (draw_segments(one, 0).motion.segment_motion for one in (bench, few))
    np.testing.assert_array_equal(part[:, chosen], whole[:, chosen])
    assert not part[:, ~chosen].any()
    assert "segments" not in everyone.identity_text().split('"disturbance"')[1].split("]")[0]
    modal = {"optics.light": "modal", "imaging.enabled": False}
    swings = entry("common-history", 'piston_nm = 10.0\nsegments = ["6"]')
    full, fast = (
        segments.KIND.compute(one.identity_text(), np.arange(2), "numpy")
        for one in (loaded(tmp_path, SEGMENTS, "", swings, **keys) for keys in ({}, modal))
    )
    np.testing.assert_allclose(
        fast.arrays["segment_piston_rms"], full.arrays["segment_piston_rms"], rtol=1e-9
    )
    np.testing.assert_allclose(fast.arrays["wfe_rms"], full.arrays["wfe_rms"], rtol=1e-3)


def test_segments_and_mirrors_follow_a_history_of_their_own(tmp_path):
    rows = ["time_s,6.dz_um,M2.dx_um,line_of_sight.y_mas", "0.0,0.0,0.0,0.0", "0.5,0.02,3.0,1.0"]
    (tmp_path / "given.csv").write_text("\n".join(rows))
    path = tmp_path / "study.toml"
    path.write_text(
        SEGMENTS + '[[disturbance]]\nname = "given"\nmodel = "surface-history"\nfile = "given.csv"'
    )
    study = load_study(path)
    bench = bench_of(study.identity_text())
    drawn = draw_segments(bench, 0)
    np.testing.assert_array_equal(drawn.time, [0.0, 0.5])
    expected = np.zeros((2, len(bench.layout), 6))
    expected[1, bench.layout.names.index("6"), 2] = 0.02e-6
    np.testing.assert_allclose(drawn.motion.segment_motion, expected, rtol=1e-15)
    assert drawn.motion.rigid["M2"][1, 0] == pytest.approx(3e-6)
    found = segments.KIND.compute(study.identity_text(), np.arange(1), "numpy")
    assert found.status[0] == DONE, found.messages
    assert found.arrays["segment_piston_rms"][0, 1] == pytest.approx(20.0 / np.sqrt(len(bench.layout)))


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        (
            'of = ["M22"]',
            r"acts on 'M22', but the telescope .* has no such segment or surface; did you mean 'M2'",
        ),
        ('of = ["x*"]', r"acts on 'x\*', but the telescope .* has no such segment or surface; there are"),
        ('of = ["M2", "M2"]', "names 'M2' twice"),
    ],
)
def test_elements_that_there_are_not_are_named(tmp_path, keys, message):
    one = entry("surface-random", keys + "\nrms = { dz_um = 1.0 }")
    with pytest.raises(UserError, match=message):
        bench_of(loaded(tmp_path, SEGMENTS, "", one).identity_text())


def test_a_figure_that_no_mirror_of_a_telescope_takes_is_refused(tmp_path):
    (tmp_path / "given.csv").write_text("time_s,image.z5_nm\n0.0,1.0\n0.1,2.0\n")
    path = tmp_path / "study.toml"
    path.write_text(
        SEGMENTS + '[[disturbance]]\nname = "given"\nmodel = "surface-history"\nfile = "given.csv"'
    )
    with pytest.raises(UserError, match=r"'given' deforms 'image' of the telescope .*, where the image is"):
        bench_of(load_study(path).identity_text())


@pytest.mark.parametrize("optics", OPTICS)
def test_a_plugin_adds_a_source_to_workers_too(tmp_path, optics, wavequake, monkeypatch):
    text, element = OPTICS[optics]
    known = dict(SOURCES.entries())
    del known["creaking"]
    monkeypatch.setattr(SOURCES, "_entries", known)
    monkeypatch.setattr(plugins, "_loaded", {})
    path = tmp_path / "creaking.toml"
    path.write_text((text + entry("creaking", EXAMPLES["creaking"], "creak", 2)).replace("NAME", element))
    store, plugin = tmp_path / "store", ("--plugin", creaking_source.__file__)
    code, out, err = wavequake("run", path, "--store", store, "--workers", 2, *plugin)
    assert (code, err) == (0, ""), (out, err)
    assert (wq.open_store(store)["status"] == DONE).all()
    for words in (("report", store), ("rerun", store, "--case", 1), ("verify", store)):
        code, out, err = wavequake(*words, *plugin)
        assert code == 0, (words, out, err)
    known.pop("creaking")
    monkeypatch.setattr(plugins, "_loaded", {})
    code, _, err = wavequake("run", path, "--store", tmp_path / "other")
    assert code == 2
    assert "disturbance.creak.model: there is no model 'creaking'" in " ".join(err.split())
