"""M2 as a finite-element disc on actuators, in a loop."""

import numpy as np
import pytest
from scipy.sparse.linalg import splu
from small_loops import LIGHT, first_case, written

from wavequake.chain.loops.actuators.m2_body import ElasticM2
from wavequake.mechanics.mirrors.models import CircularMirror, circular_mirror
from wavequake.optics.polynomials.zernike import annular_zernike
from wavequake.workflows.loops.telescope_bench import bench_of

COARSE = {"name": "m", "rings": 2, "divisions": 4, "terms": 15, "reduction": "modal24"}
RADIUS = 0.5 * 3.0244


def actuator_places(rings):
    """Return x and y of a middle and of rings of six, twelve, ..., radius 1."""
    found = [0j]
    for ring in range(1, rings + 1):
        found += list(ring / (rings + 0.5) * np.exp(2j * np.pi * np.arange(6 * ring) / (6 * ring)))
    return np.array([np.real(found), np.imag(found)])


def test_a_disc_on_soft_springs_is_a_plane_through_commands():
    """Linear regression: a rigid plate on equal springs is where they push least; both in closed form."""
    one = ElasticM2(**COARSE | {"rings": 1}, stiffness_n_um=1e-3)
    x, y = actuator_places(1)
    design = np.stack([np.ones(7), x, y], axis=1)
    weights = np.linalg.pinv(design)
    static = one.bending().static
    # Noll tilts are 2 x and 2 y. The six fall on nodes to some percent of a radius.
    np.testing.assert_allclose(static[:, 0], weights[0], rtol=1e-3)
    np.testing.assert_allclose(2 * static[:, 1:3], weights[1:].T, atol=0.02 * np.abs(weights[1:]).max())
    assert np.abs(static[:, 3:]).max() < 1e-3


def test_slow_modes_are_those_of_a_rigid_disc_on_springs():
    stiffness = 7 * 1e3
    mass = 2530.0 * np.pi * RADIUS**2 * 0.04
    inertia = mass * (RADIUS**2 / 4 + 0.04**2 / 12)
    x, _ = actuator_places(1) * RADIUS
    piston, tilt = np.sqrt(stiffness / mass), np.sqrt(1e3 * (x @ x) / inertia)
    hertz = ElasticM2(**COARSE | {"rings": 1}, stiffness_n_um=1e-3).bending().hertz[:6]
    # Piston and both shifts have one frequency; then come both tilts and the turn about z.
    for wanted, count in ((piston, 3), (tilt, 2)):
        assert (np.abs(hertz / (wanted / 2 / np.pi) - 1) < 0.01).sum() >= count


def test_stiff_springs_make_the_surface_follow_and_equal_commands_a_piston():
    one = ElasticM2(**COARSE)
    np.testing.assert_allclose(one.bending().static.sum(axis=0), np.eye(15)[0], atol=1e-9)
    told = annular_zernike(*actuator_places(2), 6) @ np.ones(6)
    reached = annular_zernike(*actuator_places(2), 66)
    off = []
    for stiffness in (1.0, 1e5):
        bent = reached @ (
            told @ ElasticM2(**COARSE | {"terms": 66}, stiffness_n_um=stiffness).bending().static
        )
        off.append(np.linalg.norm(bent - told) / np.linalg.norm(told))
    assert off[1] < 0.05 < 0.4 < off[0]


@pytest.mark.parametrize("reduction", ["modal24", "krylov114(0)"])
def test_statics_and_modes_together_are_the_full_disc(reduction):
    """The harmonic response of all degrees of freedom by a sparse solution, undamped."""
    one = ElasticM2(**COARSE | {"reduction": reduction}, radius_m=-6.2)
    found = one.bending()
    disc = circular_mirror(
        CircularMirror(3.0244, 0.04, -3.1, one._body().disc.material, 3.0244 / 3, core=4, rings=4)
    )
    rear = disc.nodes[:, 2] + np.sum(disc.nodes[:, :2] ** 2, axis=1) / (4 * 3.1)
    lowest = np.flatnonzero(rear < rear.min() + 1e-6)
    x, y = actuator_places(2) * RADIUS
    places = [
        lowest[np.argmin((disc.nodes[lowest, 0] - a) ** 2 + (disc.nodes[lowest, 1] - b) ** 2)]
        for a, b in zip(x, y, strict=True)
    ]
    stiffness = disc.stiffness.tolil()
    for place in places:
        for direction in range(3):
            stiffness[3 * place + direction, 3 * place + direction] += 1e7
    force = np.zeros((disc.order, len(places)))
    force[[3 * place + 2 for place in places], range(len(places))] = 1e7
    front = disc.surface_nodes
    polynomials = annular_zernike(*(disc.nodes[front, :2].T / RADIUS), 15)
    root = np.sqrt(disc.surface_weights)[:, None]
    first = found.hertz[0]
    for share, agreed in ((0.0, 1e-9), (0.6, 2e-4), (1.3, 3e-4)):
        w = 2 * np.pi * share * first
        moved = splu((stiffness - w**2 * disc.mass).tocsc()).solve(force)[3 * front + 2]
        wanted = np.linalg.lstsq(root * polynomials, root * moved, rcond=None)[0].T
        squared = (2 * np.pi * found.hertz) ** 2
        answer = squared / (squared - w**2) - 1
        got = found.static + found.drives.T @ (answer[:, None] * found.shapes)
        assert np.abs(got - wanted).max() < agreed * np.abs(wanted).max()


BODY = """
[[actuator]]
name = "disc"
model = "m2-body"
rings = 3
divisions = 4
terms = 15
stiffness_n_um = 300.0
reduction = "modal24"
zeta = 0.05
bandwidth_hz = 1000.0
[[controller]]
name = "disc-perfect"
model = "perfect"
sensor = "wavefront"
actuator = "disc"
modes = 14
[[controller]]
name = "disc"
model = "integrator"
sensor = "wavefront"
actuator = "disc"
modes = 14
vary = { bandwidth_hz = [60], latency_frames = [0.5] }
"""


def test_a_loop_by_the_disc_leaves_what_the_figure_leaves(tmp_path):
    """Slow against its modes it is the mirror of Zernike terms; traced light says what linear light does."""
    bench, block, los, wfe = first_case(written(tmp_path, BODY))
    assert wfe["disc-perfect"] == pytest.approx(wfe["elastic-perfect"], rel=1e-6)
    assert los["disc-perfect"] < 1e-6
    added = {name: np.sqrt(wfe[name] ** 2 - wfe["elastic-perfect"] ** 2) for name in wfe if "/" in name}
    assert added["disc/60/0.5"] == pytest.approx(added["elastic/60/0.5"], rel=0.1)
    assert added["disc/60/0.5"] != pytest.approx(added["elastic/60/0.5"], rel=1e-3)
    assert block.result["light_error_wfe_rms"].max() < 2e-3
    loop = bench.linear["disc/60/0.5"]
    assert len(loop.structure) == 24
    assert not bench.linear["elastic/60/0.5"].structure


def test_names_of_actuators_are_ring_and_place():
    names = ElasticM2(**COARSE).channels(LIGHT)
    assert len(names) == 19
    assert (names[0], names[-1]) == ("r0a1", "r2a12")


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("rings = 3", "rings = 12", "two actuators of 'disc' fall on one node of the mesh; lower rings"),
        ('"modal24"', '"modal24000"', "actuator.disc: .*modal24000"),
        ('"modal24"', '"fastest"', "actuator.disc: .*fastest"),
        ("terms = 15", "terms = 66", "actuator.disc.terms is 66, more than wavefront.zernike_terms 15"),
        ("= 300.0", "= 1e-8", "actuators of 1e-08 N/um are too soft to hold a disc"),
        ("zeta = 0.05", "radius_m = 0.3", "the actuator 'disc': the focal length"),
        ("zeta = 0.05", "zeta = 1e-5", "controller.disc/60/0.5 is unstable: .* by the mode 'disc "),
    ],
)
def test_discs_that_cannot_be_are_said_in_a_sentence(old, new, words, tmp_path):
    with pytest.raises(Exception, match=words):
        bench_of(written(tmp_path, BODY.replace(old, new)))
