"""Controllers that expect the modes of bodies with mass, as disturbances shake them: closed forms."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from small_carried import SPIDER, TOP
from test_bodies_in_loops import DAMPED, HEAD
from test_stage_reaction import BODIES, FEET, SYSTEM

import wavequake as wq
from wavequake.errors import UserError
from wavequake.optics.segments.telescope import M2
from wavequake.workflows.bodies.shaken import rms_of_modes
from wavequake.workflows.loops import system_loop
from wavequake.workflows.loops.telescope_light import optics_of
from wavequake.workflows.study import load_study

# Two sidewise motions of M2 (3000 kg) on four springs of 20 and 30 N/um, and one along the axis.
HERTZ = np.sqrt(4 * np.array([2e7, 3e7, 4e7]) / 3000.0) / (2 * np.pi)
ZETA, RMS_N, LOW, HIGH = 0.01, 40.0, 2.0, 200.0
HISS = f"""
[[disturbance]]
name = "hiss"
model = "body-force"
at = ["top"]
direction = [1.0, 1.0, 0.0]
duration_s = 2.0
instants = 2000
spectrum = {{ rms = {RMS_N}, low_hz = {LOW}, high_hz = {HIGH} }}
"""
LOOPS = """
[look]
traced = 0
[[sensor]]
name = "sight"
model = "line-of-sight"
rate_hz = 500.0
noise = 1e-3
[[actuator]]
name = "stage"
model = "m2-rigid"
[[controller]]
name = "off"
model = "off"
[[controller]]
name = "sum"
model = "integrator"
sensor = "sight"
actuator = "stage"
bandwidth_hz = 20
[[controller]]
name = "knows"
model = "lqg"
sensor = "sight"
actuator = "stage"
structure = true
[[controller]]
name = "fused"
model = "lqg-fusion"
sensor = "sight"
actuator = "stage"
structure = true
"""


def study_of(folder, *parts):
    path = folder / "expected.toml"
    path.write_text("".join([HEAD, *parts]))
    return load_study(path)


def white(hertz, mass):
    """Return the rms of an oscillator under that force along one axis: S pi f / (4 zeta k^2)."""
    density = 0.5 * RMS_N**2 / (HIGH - LOW)
    return np.sqrt(density * np.pi * hertz / (4 * ZETA)) / (mass * (2 * np.pi * hertz) ** 2)


def test_modes_of_bodies_are_expected_as_white_forces_shake_them(tmp_path):
    """Motion of M2 by the two modes that the force shakes; 16 draws tell it to some percent."""
    optics = optics_of(study_of(tmp_path, TOP, SPIDER, DAMPED, HISS, LOOPS))
    known = optics.shaken
    swings = np.abs(known.seen[optics.light.optical + 54 :][:2]).max(axis=0)
    kept = np.argsort(swings)[-2:]
    kept = kept[np.argsort(known.hertz[kept])]
    assert_allclose(known.hertz[kept], HERTZ[:2], rtol=1e-9)
    assert_allclose(known.zeta[kept], ZETA, rtol=1e-9)
    assert_allclose(swings[kept], 1e9 * white(HERTZ[:2], 3000.0), rtol=0.2)
    others = np.setdiff1d(np.arange(len(swings)), kept)
    assert np.all(swings[others] < 1e-6 * swings[kept].min())
    light = optics.moved[M2] @ known.seen[optics.light.optical + 54 :][:6]
    assert_allclose(known.seen[: optics.light.optical], light, atol=1e-9 * np.abs(light).max())


@pytest.mark.parametrize(("hertz", "share"), [(2.0, 2.0 / HERTZ[0]), (4.0, 4.0 / HERTZ[0])])
def test_forced_vibration_and_sag_are_no_resonance(hertz, share, tmp_path):
    """Far below resonance q is static, and q' / omega smaller by f over its frequency."""
    slow = HISS.replace("spectrum =", "# ").replace("[1.0, 1.0, 0.0]", "[1.0, 0.0, 0.0]")
    slow += f"lines = [{{ frequency_hz = {hertz}, force_n = 7.0 }}]\n"
    study = study_of(tmp_path, TOP, SPIDER, DAMPED, slow, LOOPS)
    optics = optics_of(study)
    plant = optics.light.layout.plant
    rms = rms_of_modes(study.disturbance, plant, 1)
    k = int(np.argmax(rms))
    assert plant.omega[k] / (2 * np.pi) == pytest.approx(HERTZ[0])
    static = 7.0 / np.sqrt(3000.0) / plant.omega[k] ** 2 / np.sqrt(2.0)
    amplified = 1.0 / (1.0 - share**2)
    assert rms[k] == pytest.approx(static * share * amplified, rel=0.05)


def test_to_know_the_bodies_is_worth_as_much_as_to_be_told_their_lines(tmp_path):
    told = "".join(
        f"{{ hz = {hertz!r}, fwhm_hz = {2 * ZETA * hertz!r}, rms = {rms!r} }},"
        for hertz, rms in zip(HERTZ[:2].tolist(), (1e9 * white(HERTZ[:2], 3000.0)).tolist(), strict=True)
    )
    lines = LOOPS + '[[controller]]\nname = "told"\nmodel = "lqg"\nsensor = "sight"\nactuator = "stage"\n'
    lines += f"lines = [{told}]\nnoise = 0.2\n"
    study = study_of(tmp_path, TOP, SPIDER, DAMPED, HISS, lines)
    found = wq.run(study, store=tmp_path / "store", on="serial").load()
    rms = np.sqrt((found["los"] ** 2).sum("axis").mean("time")).isel(case=0)
    left = {str(name): float(rms.sel(controller=name)) for name in rms["controller"].to_numpy()}
    assert left["knows"] < 0.3 * min(left["off"], left["sum"])
    assert left["fused"] < 0.3 * min(left["off"], left["sum"])
    assert left["knows"] == pytest.approx(left["told"], rel=0.2)


def test_loops_of_any_system_expect_their_bodies_too(tmp_path):
    """A Cassegrain telescope whose M2 is shaken on its spider; where nothing shakes bodies it is said."""
    blocks = LOOPS.replace("[look]\ntraced = 0\n", "").replace(
        'model = "m2-rigid"', 'model = "optic"\nof = "M2"\ndofs = ["rx", "ry"]'
    )
    shaken = HISS.replace('"top"', '"secondary"').replace("instants = 2000", "instants = 200")
    head = '[study]\nname = "small"\nworkflow = "system-loop"\n'
    parts = [head, SYSTEM, BODIES, FEET.format(stiffness="3e6", zeta=0.01), blocks]
    path = tmp_path / "system.toml"
    path.write_text("\n".join([*parts, shaken]))
    study = load_study(path)
    found = wq.run(study, store=tmp_path / "store", on="serial").load().isel(case=0)
    rms = np.sqrt((found["los_mm"] ** 2).sum("axis").mean("time")).squeeze()
    left = {str(name): float(rms.sel(controller=name)) for name in rms["controller"].to_numpy()}
    assert left["knows"] < 0.5 * min(left["off"], left["sum"])
    assert all("secondary" in one or "structure" in one for one in system_loop.notices(study))
    tremor = '[[disturbance]]\nname = "tremor"\nmodel = "vibration-lines"\nduration_s = 0.2\n'
    tremor += "lines = [{ frequency_hz = 20.0, fwhm_hz = 4.0, rms_mas = 300.0 }]\n"
    path.write_text("\n".join([*parts, tremor]))
    with pytest.raises(UserError, match=r"knows\.structure: the sensor 'sight' sees no mode of the"):
        wq.plan(load_study(path))
