"""Bodies with mass in loops of telescopes: against tables of modes, momenta, the study without loops."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from small_carried import CELL, M2_ELASTIC, SPIDER, TOP
from study_text import controller, force, part, steered

import wavequake as wq
from wavequake.errors import UserError
from wavequake.kernels.device.devices import NUMPY
from wavequake.optics.segments.telescope import M2
from wavequake.workflows.exposures.telescope_control import trace
from wavequake.workflows.loops import telescope_loop
from wavequake.workflows.loops.loop_margins import loops_of
from wavequake.workflows.loops.telescope_bench import bench_of
from wavequake.workflows.loops.telescope_light import drawn, optics_of, seen_of, seen_units
from wavequake.workflows.loops.telescope_loop import chosen_instants, positions_of, states_of
from wavequake.workflows.study import load_study

HEAD = """
[study]
name = "carried"
workflow = "telescope-loop"
seed = 3
[telescope]
name = "tmt-18"
[campaign]
cases = 1
[optics]
rays_per_segment = 6
sampling = "segments"
[imaging]
pixels = 16
[wavefront]
zernike_terms = 11
"""
DAMPED = "[structure]\ndamping_ratio = 0.01\n"
NODES = part("sensor", name="felt", model="displacement", rate_hz=500.0, nodes=["top.*", "cell.dz"])


def pump(at, **keys):
    keys |= {"duration_s": 0.4, "instants": 100, "direction": [1.0, 0.3, 0.2]}
    return force(at, 6.0, 0.5, name="pump", **keys)


def loop(**mass):
    perfect = controller("perfect", "perfect", "sight", "stage")
    integrator = controller("loop", "integrator", "sight", "stage", bandwidth_hz=4)
    return steered("M2", ["dx", "dy"], 500.0, resonance_hz=150.0, **mass) + perfect + integrator


HEAVY = loop(mass_kg=100.0)


def study_of(folder, *parts):
    path = folder / "carried.toml"
    path.write_text("".join([HEAD, *parts]))
    return load_study(path)


def answer_of(answer, s):
    """Return what is seen of modes (K, p) per position of a stage that moves as exp(s t)."""
    each = [one.c @ np.linalg.solve(s * np.eye(2) - one.a, one.b + 0j) + one.d for one in answer.dynamics]
    (drives,) = answer.drives.values()
    return (answer.shown * each) @ drives


def test_a_mirror_on_springs_answers_as_an_oscillator(tmp_path):
    """3000 kg on 4 springs of 20 and 30 N/um: -(100/3000) s^2 / (s^2 + 2 zeta w s + w^2) along x and y."""
    optics = optics_of(study_of(tmp_path, TOP, SPIDER, DAMPED, pump("top"), HEAVY))
    (answer,) = optics.answers
    for s in (1j, 163j, 199j + 1.0, 3e4j):
        found = answer_of(answer, s)[optics.light.optical + 54 :]
        w = np.sqrt(4 * np.array([2e7, 3e7]) / 3000.0)
        wanted = -(s**2) / (s**2 + 0.02 * w * s + w**2) * 100.0 / 3000.0
        assert_allclose(found[:2], np.diag(wanted), rtol=1e-8, atol=1e-9 * np.abs(wanted).max())
        light = optics.moved[M2] @ found[:6]
        assert_allclose(answer_of(answer, s)[: optics.light.optical], light, atol=1e-9 * np.abs(light).max())


def test_bodies_and_a_table_of_modes_are_one_loop(tmp_path):
    """But for damping: tables damp against what moves, bodies against the ground, a difference of 2 zeta."""
    damped = DAMPED.replace("0.01", "1e-3")
    load = 2.0
    stage = loop(mass_kg=load)
    (bodies,) = loops_of(study_of(tmp_path, TOP, SPIDER, damped, pump("top"), stage))
    modes = "".join(
        f'[[mode]]\nname = "{dof}"\nhz = {float(np.sqrt(4 * k / 3000.0) / (2 * np.pi))!r}\nzeta = 1e-3\n'
        f"m2 = {{ {dof} = 1.0 }}\npushed = {{ {dof} = {load / 3000.0!r} }}\n"
        for dof, k in (("dx", 2e7), ("dy", 3e7))
    )
    history = '[[disturbance]]\nname = "h"\nmodel = "segment-history"\n'
    (table,) = loops_of(study_of(tmp_path, modes, history, loop()))
    (alone,) = loops_of(study_of(tmp_path, history, loop()))
    for name in ("peak", "gain_up", "growth", "growth_hz"):
        assert getattr(bodies, name) == pytest.approx(getattr(table, name), rel=2e-4)
    assert bodies.peak > 1.05 * alone.peak
    assert bodies.growth_hz == pytest.approx(25.99, abs=0.01)


def test_a_telescope_in_space_keeps_its_momentum(tmp_path):
    """Cell and mirror float on springs between them; what the stage moves, the rest moves back."""
    legs = SPIDER.replace('"ground"', '"cell"')
    stage = HEAVY.replace('"dx", "dy"', '"dx", "dz"')
    optics = optics_of(
        study_of(tmp_path, CELL.partition("[[link]]")[0], TOP, legs, NODES, pump("top"), stage)
    )
    (answer,) = optics.answers
    first = len(optics.light) - len(optics.light.nodes)
    for s in (0.3j, 40j, 160j + 2.0, 1e5j):
        found = answer_of(answer, s)
        cell, top = (found[first + optics.light.nodes.index(f"{name}.dz")] for name in ("cell", "top"))
        assert_allclose(1e5 * cell + 3000.0 * top + [0.0, 100.0], 0.0, atol=1e-7)


def test_segments_push_their_cell_along_their_normals(tmp_path):
    """Faster than its feet can hold it, 1e5 kg go the other way: normals of segments look to the sky."""
    pistons = (
        '[[actuator]]\nname = "pistons"\nmodel = "segments"\nstiffness_n_um = 50.0\nsegment_kg = 150.0\n'
    )
    only = HEAVY[: HEAVY.index("[[actuator]]")] + pistons + '[[controller]]\nname = "off"\nmodel = "off"\n'
    optics = optics_of(study_of(tmp_path, CELL, TOP, SPIDER, NODES, pump("top"), only))
    (answer,) = optics.answers
    found = answer_of(answer, 1e5j)[len(optics.light) - len(optics.light.nodes) :]
    normals = optics.light.layout.axes[:, 2, 2]
    assert_allclose(found[optics.light.nodes.index("cell.dz")], 150.0 * normals / 1e5, rtol=1e-4)
    assert_allclose(found[optics.light.nodes.index("top.dx")], 0.0, atol=1e-9)


FLOOR = """
[[disturbance]]
name = "floor"
share = 0
model = "base-motion"
lines = [{ frequency_hz = 9.0, amplitude = { dx_um = 0.2, rx_urad = 0.1 } }]
[[disturbance]]
name = "both"
model = "combine"
of = ["pump", "floor"]
duration_s = 0.4
instants = 100
"""


@pytest.mark.parametrize("elastic", [False, True])
def test_what_no_loop_moves_is_that_of_the_study_without_loops(elastic, tmp_path):
    """Traced instants have the numbers of segment-disturbance, and so has linear light, of figures, too."""
    carriers, at = (M2_ELASTIC, "secondary.1") if elastic else (TOP + SPIDER + DAMPED, "top.a")
    push = pump(at, share=0)
    study = study_of(tmp_path, CELL, carriers, push, FLOOR, loop())
    wq.run(study, store=tmp_path / "loop", on="serial")
    plain = HEAD.replace("telescope-loop", "segment-disturbance").replace("pixels = 16", "enabled = false")
    (tmp_path / "plain.toml").write_text("".join([plain, CELL, carriers, push, FLOOR]))
    wq.run(tmp_path / "plain.toml", store=tmp_path / "plain", on="serial")
    closed, found = (wq.open_store(tmp_path / name).load().isel(case=0) for name in ("loop", "plain"))
    off = closed.sel(controller="off")
    at = chosen_instants(closed.sizes["time"], closed.sizes["traced"])
    assert_allclose(found["time_s"], closed["time_s"])
    assert np.abs(found["los"]).max() > 0.01
    for name in ("los", "wfe_rms"):
        alone = found[name].to_numpy()
        # nm and mas: rounding of paths of tens of meters.
        assert_allclose(off[f"traced_{name}"], alone[at], rtol=0, atol=1e-5)
        # What is quadratic in motions of half a micrometer.
        assert_allclose(off[name], alone, rtol=0, atol=1e-2 * np.ptp(alone))
    ideal = closed.sel(controller="perfect")
    assert np.abs(ideal["traced_los"]).max() < 1e-3 * np.abs(off["traced_los"]).max()


def test_traced_light_knows_how_bodies_swing_when_they_are_pushed(tmp_path):
    """Linear and traced light agree under a loop that pushes, and disagree if the push is not traced."""
    bench = bench_of(study_of(tmp_path, CELL, TOP, SPIDER, DAMPED, pump("top"), HEAVY))
    (pushed,) = (one for one in bench.controllers if one.name == "loop")
    case = drawn(bench.study, bench.optics, 0, 0)
    seen = seen_of(bench.study, bench.optics, case)
    positions = positions_of(bench, pushed, 0, [case], [seen], NUMPY)[0][0]
    chosen = np.array([40, 60, 99])
    linear = (seen[1:] + positions @ pushed.sight.T)[chosen, :2]
    still = replace(pushed, answers=())
    for one, agrees in ((pushed, True), (still, False)):
        moved = positions if agrees else positions[:, : pushed.channels(bench.optics.light)]
        states = states_of(bench, one, case, moved, chosen)
        control = bench.optics.control
        los = trace(control.prepared, states, NUMPY)[1].los[: len(chosen)] - control.static.los[0]
        off = np.abs(los * seen_units(control, 550.0)[0] - linear).max() / np.abs(linear).max()
        assert (off < 1e-4) == agrees


def test_a_node_moves_with_its_body(tmp_path):
    """By u + r x arm of what it is a part of; slow and fast, on the ground."""
    study = study_of(tmp_path, CELL, TOP, SPIDER, DAMPED, NODES, pump("top.a"), HEAVY)
    optics = optics_of(study)
    seen = seen_of(study, optics, drawn(study, optics, 0, 0))
    light = optics.light
    columns = {name: seen[:, len(light) - len(light.nodes) + k] for k, name in enumerate(light.nodes)}
    m2 = seen[:, light.optical + 3 * len(light.layout) :][:, :6]
    assert np.abs(m2[:, 5]).max() == 0.0 or np.abs(m2[:, 3:]).max() > 0.0
    arm = np.array([1.5, 0.0, 0.0])
    moved = m2[:, :3] + np.cross(m2[:, 3:], arm)
    for k, dof in enumerate(("dx", "dy", "dz")):
        assert_allclose(columns[f"top.a.{dof}"], moved[:, k], atol=1e-6 * np.abs(moved).max())


def test_a_stage_moves_the_nodes_of_the_body_that_it_moves(tmp_path):
    """As a rigid body about the vertex of M2, along the axes of the telescope; its cell stands still."""
    stage = HEAVY.replace('of = "M2"\ndofs = ["dx", "dy"]', 'of = "top"\ndofs = ["dx", "rz"]')
    optics = optics_of(study_of(tmp_path, CELL, TOP, SPIDER, NODES, pump("top"), stage))
    nodes = optics.sights["stage"][len(optics.light) - len(optics.light.nodes) :]
    found = dict(zip(optics.light.nodes, nodes, strict=True))
    assert_allclose([found["top.a.dx"], found["top.a.dy"]], [[1.0, 0.0], [0.0, 1.5]], atol=1e-9)
    assert_allclose([found["top.c.dx"], found["cell.dz"]], [[1.0, -1.5], [0.0, 0.0]], atol=1e-9)
    mirror = optics.sights["stage"][optics.light.optical + 54 :][:6]
    assert_allclose(mirror, [[1, 0], [0, 0], [0, 0], [0, 0], [0, 0], [0, 1]], atol=1e-9)


@pytest.mark.parametrize(
    ("parts", "words"),
    [
        ([TOP, SPIDER, NODES.replace("top.*", "tip.*")], "there is no node 'tip.*'; there are top.dx"),
        ([], "the disturbance 'pump' acts on bodies with mass, but this study has none"),
        ([TOP, SPIDER, HEAVY.replace('of = "M2"', 'of = "image"')], "no body with mass carries 'image'"),
    ],
)
def test_what_is_not_there_is_refused(parts, words, tmp_path):
    more = parts if any("[[controller]]" in one for one in parts) else [*parts, loop()]
    with pytest.raises(UserError) as told:
        wq.plan(study_of(tmp_path, *more, pump("top")))
    assert words.lower() in str(told.value).lower()


def test_a_loop_that_swings_its_bodies_out_of_bounds_names_the_mode(tmp_path):
    heavy = HEAVY.replace("100.0", "3000.0").replace("= 4", "= 20")
    with pytest.raises(UserError, match=r"by the mode 'mode .* of the bodies' \(31.83 Hz\); were all stiff"):
        wq.plan(study_of(tmp_path, CELL, TOP, SPIDER, DAMPED, pump("top"), heavy))


def test_what_a_user_should_know_is_said_before_a_run(tmp_path):
    """Which stage pushes nothing, and where straight lines between instants do not follow bodies."""
    few = pump("top").replace("instants = 100", "instants = 16")
    pushes, lines = telescope_loop.notices(study_of(tmp_path, TOP, SPIDER, DAMPED, few, loop()))
    assert pushes.startswith("actuator.stage: the body 'top' carries 'M2', but how much of its mass")
    assert lines.startswith("disturbance.pump: between its instants")
    assert lines.endswith("give more instants than 16.")
    assert not list(telescope_loop.notices(study_of(tmp_path, TOP, SPIDER, DAMPED, pump("top"), HEAVY)))


def test_mirrors_behind_m2_may_be_shaken(tmp_path):
    """What is linear of M3 is known to loops: light of all rays agrees with it."""
    hum = """
[[disturbance]]
name = "hum"
model = "surface-vibration"
of = ["M3"]
duration_s = 0.4
instants = 50
lines = [{ frequency_hz = 5.0, amplitude = { rx_urad = 0.1, dz_um = 1.0 } }]
"""
    wq.run(study_of(tmp_path, hum, loop()), store=tmp_path / "hum", on="serial")
    found = wq.open_store(tmp_path / "hum").load().isel(case=0)
    most = np.abs(found["los"].sel(controller="off")).max()
    assert most > 1.0
    assert found["light_error_los"].max() < 1e-4 * most
    assert np.abs(found["los"].sel(controller="perfect")).max() < 1e-9 * most
