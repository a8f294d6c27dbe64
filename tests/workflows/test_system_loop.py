"""Loops of any optical system: what is left, against closed forms and the same study without loops."""

import numpy as np
import pytest
from tests.workflows.small_system import IMAGES, INTEGRATOR, LOOP, PERFECT, SHAKEN, SYSTEM

import wavequake as wq
from wavequake.errors import UserError
from wavequake.mechanics.disturbances.motion import RAD_PER_MAS
from wavequake.optics.systems.paraxial import paraxial
from wavequake.workflows.loops.loop_margins import loops_of
from wavequake.workflows.loops.system_light import optics_of
from wavequake.workflows.sensitivity import stored_sensitivity
from wavequake.workflows.study import load_study


def written(folder, *parts, workflow="system-loop"):
    path = folder / f"{workflow}.toml"
    path.write_text(f'[study]\nname = "small"\nworkflow = "{workflow}"\n' + "\n".join(parts))
    return path


def stored(folder, *parts, workflow="system-loop", **keys):
    path = written(folder, *parts, workflow=workflow)
    wq.run(path, store=folder / f"{workflow}.store", on="serial", **keys)
    return wq.open_store(folder / f"{workflow}.store").load()


@pytest.fixture(scope="module")
def left(tmp_path_factory):
    folder = tmp_path_factory.mktemp("left")
    return stored(folder, SYSTEM, SHAKEN, IMAGES, LOOP, INTEGRATOR, PERFECT)


def test_without_a_controller_numbers_are_those_of_the_study_without_loops(left, tmp_path):
    plain = stored(tmp_path, SYSTEM, SHAKEN, IMAGES, workflow="system-disturbance")
    off = left.sel(controller="off")
    shared = [one for one in plain.data_vars if plain[one].dims[:1] == ("case",) and one in off]
    assert {"zernike", "los_mm", "wfe_rms", "exposure", "peak", "ee80"} <= set(shared)
    for name in shared:
        np.testing.assert_array_equal(plain[name].to_numpy(), off[name].to_numpy(), err_msg=name)


def test_a_perfect_controller_leaves_no_motion_of_the_image(left):
    size = np.abs(left["los_mm"].sel(controller="off")).max()
    assert np.abs(left["los_mm"].sel(controller="perfect")).max() < 1e-6 * size
    assert (left["peak"].sel(controller="perfect") > left["peak"].sel(controller="off") + 0.1).all()


def test_an_integrator_leaves_what_its_sensitivity_says(tmp_path):
    """y = d / (1 + g z^-2 / (1 - z^-1)): frames of 1 ms, a command acts a frame after that which it is of."""
    slow = SHAKEN.replace("instants = 16", "instants = 256")
    found = stored(tmp_path, SYSTEM, slow, LOOP, INTEGRATOR)
    late = found["los_mm"].isel(time=slice(128, None), field=0, wavelength=0)
    rms = np.sqrt((late**2).sum("axis").mean("time")).mean("case")
    back = np.exp(-2j * np.pi * 20.0 * 1e-3)
    share = abs(1.0 / (1.0 + 0.3 * back**2 / (1.0 - back)))
    assert float(rms.sel(controller="integrator") / rms.sel(controller="off")) == pytest.approx(
        share, rel=0.02
    )
    assert float(found["light_error_los"].max()) < 1e-5 * float(np.abs(late).max())


def test_the_image_between_instants_follows_the_loop(left):
    """Exposures are streaks of what is left: between off and perfect, and wider than 16 dots would be."""
    peak = {
        name: float(left["peak"].sel(controller=name).mean()) for name in ("off", "integrator", "perfect")
    }
    assert peak["off"] < peak["integrator"] < peak["perfect"]


@pytest.mark.parametrize("name", ["far", "near"])
def test_a_detector_that_moves_sees_the_image_move_against_it(tmp_path, name):
    """In mas on the sky, or where the object is near in nm at the image."""
    near = '[system]\nname = "euv"\n[optics]\nrays = 60\n[wavefront]\nzernike_terms = 11\n'
    system, image = (SYSTEM, "image") if name == "far" else (near, "wafer image")
    shaken = SHAKEN.replace("M1", image).replace("dx_um = 1.0, ry_urad = 0.2", "dx_um = 0.001")
    moves = LOOP.replace('"M2"', f'"{image}"').replace('"rx", "ry"', '"dx", "dy"')
    optics = optics_of(load_study(written(tmp_path, system, shaken, moves)))
    unit = 1.0
    if name == "far":
        unit = 1.0 / (1e6 * paraxial(optics.bench.system).focal_length * RAD_PER_MAS)
    np.testing.assert_allclose(optics.sights["stage"][:2], -unit * np.eye(2), atol=1e-6 * abs(unit))


def test_what_is_seen_goes_straight_between_its_instants(tmp_path):
    fast = SHAKEN.replace("20.0", "400.0")
    study = load_study(written(tmp_path, SYSTEM, fast, LOOP, INTEGRATOR))
    (times,) = optics_of(study).times
    step = np.diff(times.seen).max()
    assert (2 * np.pi * 400.0 * step) ** 2 / 8 < 0.01
    assert not set(times.seen[times.looks[times.instants]]) ^ set(np.arange(1, 17) / 16)


def test_margins_are_those_of_the_loop(tmp_path):
    """The gain of this integrator may grow until z^2 - z + g has a root of size 1, g = 1."""
    (found,) = loops_of(load_study(written(tmp_path, SYSTEM, SHAKEN, LOOP, INTEGRATOR)))
    assert found.stable
    assert found.gain_up == pytest.approx(1 / 0.3, rel=1e-3)


def test_a_history_from_a_file_is_taken_at_its_own_instants(tmp_path):
    time = np.arange(1, 33) / 64
    rows = "\n".join(f"{at},{np.sin(30 * at)}" for at in time)
    (tmp_path / "moved.csv").write_text(f"time_s,M1.dx_um\n{rows}\n")
    given = '[[disturbance]]\nname = "given"\nmodel = "surface-history"\nfile = "moved.csv"\n'
    loop = LOOP.replace("1000.0", "64.0")
    found = stored(tmp_path, SYSTEM, given, loop, INTEGRATOR, PERFECT, cases=1)
    size = np.abs(found["los_mm"].sel(controller="off")).max()
    assert np.abs(found["los_mm"].sel(controller="perfect")).max() < 1e-5 * size
    assert found["time_s"].to_numpy()[0, :3] == pytest.approx(time[:3])


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('model = "optic"\nof = "M2"', 'model = "m2-rigid"', "moves a segmented telescope"),
        ('of = "M2"', 'of = "M3"', "there is no surface or body 'M3' to move; there is M1, M2, image"),
        ('model = "line-of-sight"', 'model = "edges"', "reads segments or M2"),
        ("gain = 0.3", "gain = 1.2", "unstable"),
        ('dofs = ["rx", "ry"]', 'dofs = ["dz"]', "does not see 'dz' of the actuator 'stage' at all"),
        ("[optics]", '[optics]\nlight = "modal"', "optics.light must be 'traced'"),
        ("20.0", "90000.0", "too fast for its loops"),
        ("[wavefront]", '[allow]\nmeasure = "wfe_rms.p95"\nlimit = "1 nm"\n[wavefront]', "allow belongs to"),
    ],
)
def test_what_loops_of_a_system_cannot_do_is_a_sentence(tmp_path, old, new, said):
    text = "\n".join([SYSTEM, SHAKEN, LOOP, INTEGRATOR])
    assert old in text
    with pytest.raises(UserError, match=said):
        wq.run(written(tmp_path, text.replace(old, new, 1)), store=tmp_path / "s", on="serial")


@pytest.mark.parametrize("sensor", ["camera", "slopes"])
def test_sensors_that_know_evenly_lit_pupils_refuse_apodized_ones(tmp_path, sensor):
    pupil = 'pupil_apodization = "gaussian"\napodization_factor = 1.0\npupil_obscuration'
    text = "\n".join([SYSTEM.replace("pupil_obscuration", pupil), SHAKEN, LOOP, INTEGRATOR])
    optics_of(load_study(written(tmp_path, text)))
    other = text.replace('model = "line-of-sight"', f'model = "{sensor}"')
    with pytest.raises(UserError, match=rf"sensor\.sight: the pupil of cassegrain .* sensor {sensor}"):
        optics_of(load_study(written(tmp_path, other)))


def test_the_store_of_a_run_keeps_the_sensitivities_of_its_system(tmp_path):
    stored(tmp_path, SYSTEM, SHAKEN, LOOP, PERFECT)
    study, store = load_study(tmp_path / "system-loop.toml"), tmp_path / "system-loop.store"
    made, was_there = stored_sensitivity(study, store, mirror_terms=0)
    again, kept = stored_sensitivity(study, store, mirror_terms=0)
    assert (was_there, kept) == (False, True)
    assert made["surface"].values.size >= 3
    assert again.attrs["study"] == study.identity_text()
