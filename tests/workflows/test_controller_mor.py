"""Controllers of reduced models on the full one: the published case, a small study from file to report."""

import json

import numpy as np
import pytest
import scipy.linalg
from typer.testing import CliRunner

import wavequake as wq
from wavequake.campaign.stopwatch import Stopwatch
from wavequake.cli import app
from wavequake.control.robustness.residual import open_covariance
from wavequake.errors import UserError
from wavequake.mechanics.mirrors.models import HexagonalSegment, hexagonal_segment, on_springs
from wavequake.mechanics.vibration.full_response import dynamic_response
from wavequake.report.loops.outcomes import answer, levels_of
from wavequake.workflows.loops import controller_bench, controller_mor

SMALL = {
    "model.divisions": 3,
    "model.modes": 60,
    "controller.effort": [0.1],
    "reduction.variants": ["modal10", "craigb18", "rubin15"],
    "reduction.frequencies": 60,
}


@pytest.fixture(scope="module", autouse=True)
def cache(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield


def dense_loop(bench, name, effort):
    """The closed loop with every degree of freedom in SI, from the finite-element matrices alone."""
    model = bench.full()
    mass, damping, stiffness = (
        getattr(model, part).toarray() for part in ("mass", "damping_matrix", "stiffness")
    )
    count = len(mass)
    forces = controller_bench.force_columns(model)
    rows = controller_bench.sensor_rows(model, bench.sensors)
    reduced, _ = controller_bench.reduced_plant(bench, controller_mor.reduced(bench, name))
    own, section, time = controller_mor.lqg(reduced, effort, effort), bench.study.controller, bench.time_unit
    solved = scipy.linalg.solve(mass, np.hstack([-stiffness, -damping, forces]), assume_a="pos")
    unit = np.eye(count)
    upper = np.hstack([np.zeros((count, count)), unit, np.zeros((count, len(own.a)))])
    middle = np.hstack([solved[:, : 2 * count], -solved[:, 2 * count :] @ own.c * section.force_n])
    lower = np.hstack([own.b @ rows / section.length_m / time, np.zeros((len(own.a), count)), own.a / time])
    return np.linalg.eigvals(np.vstack([upper, middle, lower]))


def test_a_model_of_small_error_destabilizes_and_one_of_large_error_does_not():
    """8127 degrees of freedom: craigb18 at +0.1074 +- 313.17i with four poles, rubin15 stable."""
    study = wq.load_study(
        "controller-mor", {"model.modes": 120, "reduction.variants": ["craigb18", "rubin15"]}
    )
    bench = controller_bench.bench_of(study)
    assert bench.full().order == 8127
    places = bench.full().nodes[bench.full().surface_nodes[bench.sensors], :2]
    np.testing.assert_allclose(places, [(0.324, 0.5612), (-0.648, 0), (0.324, -0.5612)], atol=1e-4)
    found = {name: controller_mor.judged(bench, name, 0.1, Stopwatch()) for name in ("craigb18", "rubin15")}
    bad, good = found["craigb18"], found["rubin15"]
    assert bad["unstable_poles"] == 4
    assert bad["growth"] == pytest.approx(0.1074, abs=5e-5)
    assert bad["growth_full"] == pytest.approx(0.1074, abs=5e-5)
    assert 2 * np.pi * bad["growth_hz"] == pytest.approx(313.17, abs=0.01)
    assert 5 * bad["error_median"] < good["error_median"]
    assert bad["error_median"] == pytest.approx(3.7e-3, rel=0.05)
    assert good["error_median"] == pytest.approx(2.4e-2, rel=0.05)
    # The six modes on the springs are off by up to twice their damping.
    assert 2 < bad["spill_shift"] < 3
    assert np.isnan(bad["wavefront"])
    assert good["stable"]
    assert good["growth"] == pytest.approx(-0.2105, abs=5e-5)
    assert good["wavefront"] < 0.1 * good["wavefront_open"]
    assert max(bad["truncation"], good["truncation"]) < 1


def test_a_small_study_agrees_with_all_degrees_of_freedom_dense(tmp_path):
    study = wq.load_study("controller-mor", SMALL)
    dataset = wq.run(study, store=tmp_path / "store").load()
    bench = controller_bench.bench_of(study)
    assert (dataset["truncation"].to_numpy() < 1).all()
    for row, name in enumerate(SMALL["reduction.variants"]):
        poles = dense_loop(bench, name, 0.1)
        assert dataset["unstable_poles"].to_numpy()[row] == (poles.real >= 0).sum()
        # As a share of the pole; rounding of the dense problem, whose largest poles are 1e6 times as large.
        first = poles[poles.real.argmax()]
        assert abs(dataset["growth"].to_numpy()[row] - first.real) < 1e-8 * abs(first)
    # Between what all of the wavefront would cost, and its figure alone; that of the surface drawn at random.
    stable = dataset["stable"].to_numpy() == 1.0
    assert stable.any()
    whole, figure, strehl = (dataset[key].to_numpy()[stable] for key in ("wavefront", "figure", "strehl"))
    square = (2 * np.pi / study.image.wavelength_nm) ** 2
    assert np.all(np.exp(-square * whole**2) < strehl)
    assert np.all(strehl < 1 - 0.9 * square * figure**2)
    opened = dataset["open_exposure"].to_numpy()
    root = np.linalg.cholesky(open_covariance(bench.plant) + 1e-30 * np.eye(len(bench.plant.squared)))
    drawn = bench.heights @ root @ np.random.default_rng(0).standard_normal((root.shape[1], 4000))
    peaks = np.abs(bench.beams.weights @ np.exp(4j * np.pi * drawn / (1e-9 * study.image.wavelength_nm))) ** 2
    assert opened.max() == pytest.approx(peaks.mean(), abs=4 * peaks.std() / np.sqrt(4000))
    assert np.isnan(dataset["exposure"].to_numpy()[~stable]).all()
    levels = levels_of(dataset)
    assert levels[0].enough is not None
    assert "Effort 0.1: " in answer(levels)
    page = tmp_path / "store" / "report.html"
    assert CliRunner().invoke(app, ["report", str(tmp_path / "store")]).exit_code == 0
    text = page.read_text()
    for words in (
        "Poles of the loops with the full model",
        "Margins over the order",
        "is the smallest model",
        "Long exposures of a star",
    ):
        assert words in text


def test_the_response_at_a_complex_frequency_is_that_of_dense_algebra():
    model = on_springs(hexagonal_segment(HexagonalSegment(divisions=2)), (5e6, 5e6, 5e6))
    rng = np.random.default_rng(0)
    inputs, rows = rng.normal(size=(model.order, 2)), rng.normal(size=(3, model.order))

    def dense(s):
        whole = model.stiffness.toarray() + s * model.damping_matrix.toarray() + s * s * model.mass.toarray()
        return rows @ np.linalg.solve(whole, inputs.astype(complex))

    s = 3.0 + 400j
    found, slope = dynamic_response(model, s, inputs, rows)
    np.testing.assert_allclose(found, dense(s), rtol=1e-8)
    step = 1e-2
    np.testing.assert_allclose(slope, (dense(s + step) - dense(s - step)) / (2 * step), rtol=1e-5)


def test_wavefronts_of_rigid_motion_have_no_figure():
    study = wq.load_study("controller-mor", SMALL)
    model = controller_bench.build_model(study)
    x, y = model.nodes[model.surface_nodes, :2].T
    heights = np.stack([np.ones_like(x), x, y, x * x + y * y], axis=1)
    whole, figure = controller_bench.wavefront_grams(model, heights)
    assert whole[0, 0] == pytest.approx(4.0)
    np.testing.assert_allclose(figure[:3, :3], 0.0, atol=1e-15)
    assert 0 < figure[3, 3] < whole[3, 3]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"controller.effort": [0.1, 0.0]}, "an effort is 0; forces must cost something"),
        ({"controller.effort": [0.1, 0.1]}, "0.1 is listed twice"),
        ({"model.spring_n_m": [5e6, 0.0, 5e6]}, "each support needs three positive spring constants"),
        ({"controller.effort": [1e-300]}, "an effort is 1e-300; forces must cost something"),
        ({"controller.force_n": 1e-300}, "controller.force_n: input should be greater than or equal to"),
        ({"sensors.radius_m": 100.0}, "sensors.radius_m is 100, but the mirror ends at 0.7"),
        ({"model.damping_beta": 0.0}, "modes that nobody controls must decay"),
        ({"reduction.variants": ["craigb5000"]}, "5000"),
        ({"model.modes": 3000}, "model.modes is 3000, but the full model has"),
        ({"sensors.angles_deg": [60.0, 60.1]}, "Two sensors of [sensors] fall on one node"),
        ({"reduction.beyond_hz": 100.0}, "first_hz, last_hz and beyond_hz must rise"),
    ],
)
def test_what_cannot_be_judged_is_said_before_the_run(changes, words, tmp_path):
    with pytest.raises(UserError) as caught:
        wq.run(wq.load_study("controller-mor", SMALL | changes), store=tmp_path / "store")
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_variant_without_a_controller_says_why(tmp_path):
    changes = SMALL | {"reduction.variants": ["modalfix10", "modal10"]}
    dataset = wq.run(wq.load_study("controller-mor", changes), store=tmp_path / "store").load()
    assert "modalfix10, effort 0.1: No force moves any mode of the model" in str(
        dataset["message"].to_numpy()[0]
    )
    assert json.loads(dataset.attrs["study"])["study"]["workflow"] == "controller-mor"
    assert levels_of(dataset)[0].outcomes[0].variant == "modal10"


def test_margins_are_told_without_a_run_and_unstable_loops_have_none():
    words = [f"{key}={json.dumps(value)}" for key, value in SMALL.items()]
    done = CliRunner().invoke(app, ["margins", "controller-mor", *words])
    assert done.exit_code == 0, done.output
    bench = controller_bench.bench_of(wq.load_study("controller-mor", SMALL))
    for name in SMALL["reduction.variants"]:
        found = controller_mor.judged(bench, name, 0.1, Stopwatch())
        (line,) = (one for one in done.output.splitlines() if one.strip().startswith(f"{name},"))
        wanted = f"{found['sensitivity_peak']:.3g}" if found["stable"] else "unstable"
        assert wanted in line
    with pytest.raises(UserError, match="mirror-mor has no loops; controller-mor, tip-tilt-vibration, "):
        CliRunner().invoke(app, ["margins", "mirror-mor"], catch_exceptions=False)
