"""Modes on the mirror and in its light, and a node that moves: against the full model, and drawn."""

import numpy as np
import pytest
import scipy.linalg
from small_mirrors import MOR, eleven, wavefront_of

from wavequake.campaign.store.store import open_store
from wavequake.optics.rays.pupils import sunflower
from wavequake.report.mirrors import report as mirrors
from wavequake.report.mirrors import shapes as draw
from wavequake.report.mirrors.deformed_body import bodies
from wavequake.workflows.mirrors.bench import bench_of, build_model, variant_of
from wavequake.workflows.mirrors.mor import KIND
from wavequake.workflows.mirrors.shapes import mode_shapes, rim_node
from wavequake.workflows.run import run_study
from wavequake.workflows.study import load_study

pytestmark = pytest.mark.usefixtures("mirror_models")


@pytest.fixture(scope="module")
def study():
    return load_study("mirror-mor", MOR)


@pytest.fixture(scope="module")
def shapes(study):
    bench = bench_of(study.identity_text(), "circular")
    return mode_shapes(bench.optics, variant_of(bench, "full"))


@pytest.fixture(scope="module")
def store(study, tmp_path_factory):
    path = tmp_path_factory.mktemp("shapes") / "store"
    run_study(study, path, on="serial")
    return open_store(path).load()


@pytest.fixture(scope="module")
def truth(study):
    """Elastic modes of the full model: frequencies, and figures along the light of unit rms heights."""
    full = build_model(study, "circular")
    squared, modes = scipy.linalg.eigh(full.stiffness.toarray(), full.mass.toarray())
    nodes, weights = full.nodes[full.surface_nodes], full.surface_weights
    moved = (full.surface @ modes[:, 6:22]).reshape(len(nodes), 3, -1)
    slopes = nodes[:, :2] / (2 * 1.7)
    heights = moved[:, 2] - slopes[:, :1] * moved[:, 0] - slopes[:, 1:] * moved[:, 1]
    root = np.sqrt(weights)[:, None]
    heights = heights / np.sqrt(weights @ heights**2 / weights.sum())
    figures = -np.linalg.lstsq(root * eleven(*nodes[:, :2].T / 0.5), root * heights, rcond=None)[0].T
    return np.sqrt(squared[6:22]) / (2 * np.pi), figures


def test_modes_are_those_of_the_full_model(shapes, truth):
    """Single modes to their sign, pairs to a rotation, of which the sum of squares knows nothing."""
    figures, (frequencies, expected) = shapes[0], truth
    pairs = [k for k in range(15) if frequencies[k + 1] < 1.001 * frequencies[k]]
    single = [k for k in range(15) if k not in pairs and k - 1 not in pairs]
    assert len(pairs) >= 3
    assert single
    for k in pairs:
        squares = [np.sum(part[k : k + 2] ** 2, axis=0) for part in (figures, expected)]
        np.testing.assert_allclose(*squares, rtol=0, atol=1e-5)
        strong = np.argmax(squares[1] >= 0.9 * squares[1].max())
        assert abs(figures[k + 1, strong]) < 1e-9
    for k in single:
        np.testing.assert_allclose(
            figures[k], expected[k] * np.sign(expected[k] @ figures[k]), rtol=0, atol=1e-5
        )
    largest = np.take_along_axis(figures, np.abs(figures).argmax(axis=1)[:, None], axis=1)
    assert (largest >= 0.0).all()


def test_wavefronts_are_those_that_such_figures_make(shapes):
    figures, wavefronts = shapes
    rays = sunflower(0.0, 1.0, 200)
    opd = wavefront_of(1e-3 * figures, 500.0 * rays.x, 500.0 * rays.y, 500.0, 1700.0)
    expected = 1e6 * np.linalg.lstsq(eleven(rays.x, rays.y), opd.T, rcond=None)[0].T
    np.testing.assert_allclose(wavefronts[:, 3:], expected[:, 3:], rtol=0, atol=1e-3 * np.abs(expected).max())


def test_the_node_is_on_the_rim_between_two_mounts(study):
    full = build_model(study, "circular")
    x, y, _ = full.nodes[full.surface_nodes][rim_node(full)]
    np.testing.assert_allclose([np.hypot(x, y), np.degrees(np.arctan2(y, x))], [0.5, 60.0], rtol=0, atol=0.01)


def test_a_mirror_that_is_moved_slowly_moves_its_rim_alike():
    """A quarter of a second of 1 Hz; the abrupt start adds the share 2 pi 1 Hz / omega of vibration."""
    keys = {"reduction.variants": ["craigb18"], "time.duration_s": 0.25, "time.step_s": 5e-4}
    keys |= {"excitation.sine300.interfaces": [], "excitation.sine300.frequency_hz": 1.0}
    found = load_study("mirror-mor", {key: value for key, value in (MOR | keys).items() if value != []})
    result = KIND.compute(found.identity_text(), np.arange(1), "auto")
    names = [one.name for one in found.excitation]
    motion = result.arrays["node_motion"][0, names.index("sine300")]
    mounts = found.excitation[names.index("sine300")].amplitude * np.sin(
        2 * np.pi * np.arange(len(motion)) * 5e-4
    )
    np.testing.assert_allclose(motion, mounts, rtol=0, atol=0.05 * mounts.max())


def test_the_wavefront_of_the_worst_instant_has_its_rms(store):
    """Of every variant at the instant that is worst for the reference, which is the first case."""
    worst = store["wfe_rms"].isel(case=0).values.argmax(axis=1)
    rms = np.sqrt((store["peak_wavefront"].values[..., 3:] ** 2).sum(axis=2))
    for row, instant in enumerate(worst):
        np.testing.assert_allclose(rms[:, row], store["wfe_rms"].values[:, row, instant], rtol=1e-12)


def test_figures_show_what_is_stored(store):
    (model,), _ = mirrors.results_of(store)
    names = [one.id for one in draw.pictures(store, model)]
    assert len(names) == 4 + store.sizes["excitation"]
    drawn = next(one for one in model.variants if one.variant == "krylov36(150)")
    figure = draw.node_history(store, "sine300", [drawn], model.reference)
    motion = store["node_motion"].sel(excitation="sine300")
    moved, truth = (motion.sel(case=one.case).values for one in (drawn, model.reference))
    off = np.abs(moved - truth) / np.abs(truth).max()
    np.testing.assert_allclose(figure.axes[1].lines[0].get_ydata(), np.maximum(off, 1e-9))
    canvas = draw.modes(store, model.reference).axes[0].images[0].get_array()
    # Upper right tile's neighbor: the second distinct mode, the value at a pixel by Noll's own formulas.
    tile = canvas[-18 - 72 : -18, 99 : 99 + 72]
    along = (np.array([40, 20]) + 0.5) / 72 * 2 - 1
    chosen = draw.distinct(draw.elastic_frequencies(store.isel(case=0)))[1]
    polynomials = eleven(along[:1], along[1:])[0]
    value = polynomials @ store["mode_figure"].values[0, chosen]
    assert tile[20, 40] * np.nanmax(np.abs(store_tile(store, chosen))) == pytest.approx(value)


def store_tile(store, mode):
    x, y = np.meshgrid(*[(np.arange(72) + 0.5) / 72 * 2 - 1] * 2)
    inside = np.hypot(x, y) <= 1
    return eleven(x[inside], y[inside]) @ store["mode_figure"].values[0, mode]


def test_the_figure_of_the_worst_instant_makes_its_wavefront(store, study):
    """Along the light, so that a mirror which is 1 um nearer to it has -1 um of piston."""
    optics = bench_of(study.identity_text(), "circular").optics
    made = 1e-3 * store["peak_figure"].values @ optics.sensitivity[2:].T
    np.testing.assert_allclose(made, store["peak_wavefront"].values, rtol=1e-9, atol=1e-6)
    worst = store["wfe_rms"].isel(case=0).values.argmax(axis=1)
    row = list(store["excitation"].values).index("sine100")
    rim = store["node_motion"].values[0, row, worst[row]]
    angle = np.radians(store["node_angle"].values[0])
    assert np.degrees(angle) == pytest.approx(60.0, abs=0.01)
    height = -eleven(np.cos([angle]), np.sin([angle]))[0] @ store["peak_figure"].values[0, row]
    # Heights are across the surface, of slope 0.15 there, which also moves in its plane.
    assert height == pytest.approx(1e6 * rim, rel=0.1)


def test_the_body_is_drawn_as_high_as_it_stands(store):
    (model,), _ = mirrors.results_of(store)
    figure = bodies(store, model.reference)
    assert len(figure.axes) == store.sizes["excitation"]
    for row, axes in enumerate(figure.axes):
        (drawn,) = axes.collections
        corners = np.array([path.vertices[:4] for path in drawn.get_paths()])
        assert len(corners) == 17 * 96
        # At the middle of the disc the picture shows the height alone: by Noll's own formulas there.
        numbers = store["peak_figure"].values[0, row]
        x, y = np.meshgrid(np.linspace(-1, 1, 201), np.linspace(-1, 1, 201))
        inside = np.hypot(x, y) <= 1
        scale = 0.15 / np.abs(eleven(x[inside], y[inside]) @ numbers).max()
        height = -scale * (eleven(np.zeros(1), np.zeros(1))[0] @ numbers)
        center = np.array([0.0, np.cos(np.radians(35.0)) * height])
        assert np.hypot(*(corners - center).reshape(-1, 2).T).min() < 2e-3
        assert f"{np.abs(eleven(x[inside], y[inside]) @ numbers).max():.3g}"[:3] in axes.get_title(loc="left")


def test_a_mirror_at_rest_and_a_store_from_before_are_drawn(store):
    (model,), _ = mirrors.results_of(store)
    assert bodies(store.assign(peak_figure=0.0 * store["peak_figure"]), model.reference).axes
    before = store.drop_vars(["peak_figure", "node_angle"])
    assert len(list(draw.pictures(before, model))) == 3 + store.sizes["excitation"]


def test_of_pairs_one_is_drawn():
    assert draw.distinct(np.array([10.0, 10.001, 20.0, 20.5, 30.0, 30.0])) == [0, 2, 3, 4]
    assert draw.distinct(np.zeros(0)) == []
