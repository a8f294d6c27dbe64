"""The workflow mirror-mor on a coarse mesh, against full-size solutions, exponentials and closed forms."""

import sys

import numpy as np
import pytest
import scipy.linalg
from scipy.sparse.linalg import spsolve
from small_mirrors import MOR, eleven, slope_at_the_vertex, wavefront_of
from typer.testing import CliRunner

import wavequake as wq
from wavequake import cli
from wavequake.campaign.store.store import open_store
from wavequake.cli import app
from wavequake.commands import stores
from wavequake.optics.rays.pupils import sunflower
from wavequake.reduction.reduce import reduce
from wavequake.report.answers.comparison import compare
from wavequake.workflows.mirrors.bench import bench_of, build_model
from wavequake.workflows.mirrors.mor import KIND, exposures
from wavequake.workflows.planning.plan import plan
from wavequake.workflows.run import run_study
from wavequake.workflows.study import load_study

pytestmark = pytest.mark.usefixtures("mirror_models")


@pytest.fixture(scope="module")
def study():
    return load_study("mirror-mor", MOR)


@pytest.fixture(scope="module")
def store(study, tmp_path_factory):
    path = tmp_path_factory.mktemp("mor") / "store"
    run_study(study, path, on="serial")
    return open_store(path).load()


@pytest.fixture(scope="module")
def full(study):
    return build_model(study, "circular")


def _case(store, variant):
    return store.isel(case=int(np.flatnonzero(store["variant"].values == variant)[0]))


def _figures(heights, weights, nodes):
    """Figures (11, ...) along the light in mm of heights (p, ...) along the model's z in m."""
    root = np.sqrt(weights)[:, None]
    return -1e3 * np.linalg.lstsq(root * eleven(*nodes[:, :2].T / 0.5), root * heights, rcond=None)[0]


def _light(figures, pupil):
    """Wavefront coefficients (11, ...) in nm of figures in mm, by hand."""
    opd = wavefront_of(figures.T, *(500.0 * pupil.T), 500.0, 1700.0)
    return 1e6 * np.linalg.lstsq(eleven(*pupil.T), opd.T, rcond=None)[0]


def _heights(motion, nodes):
    """How far nodes (p, 3, ...) displaced in m stand above the parabola, linear."""
    slopes = nodes[:, :2].T / (2 * 1.7)
    return motion[:, 2] - slopes[0][:, None] * motion[:, 0] - slopes[1][:, None] * motion[:, 1]


def _sunflower(count):
    rays = sunflower(0.0, 1.0, count)
    return np.stack([rays.x, rays.y], axis=1)


def test_errors_over_frequency_are_those_of_full_size_solutions(store, full):
    """Receptance and mechanical-optical response, both against one sparse solution per frequency."""
    case, pupil = _case(store, "craigb18"), _sunflower(200)
    inputs, nodes, weights = full.inputs.toarray(), full.nodes[full.surface_nodes], full.surface_weights
    small = reduce(full, "craigb18")
    for place in (3, 12, 20):
        omega = 2 * np.pi * float(store["frequency"][place])
        dynamic = full.stiffness + 1j * omega * full.damping_matrix - omega**2 * full.mass
        whole = spsolve(dynamic.tocsc(), inputs.astype(complex))
        tiny = np.linalg.solve(
            small.stiffness + 1j * omega * small.damping_matrix - omega**2 * small.mass, small.inputs
        )
        exact, found = inputs.T @ whole, small.inputs.T @ tiny
        error = np.linalg.norm(exact - found) / np.linalg.norm(exact)
        assert float(case["eps_mech"][place]) == pytest.approx(error, rel=1e-6)
        assert float(case["frf_mech"][place]) == pytest.approx(np.linalg.norm(found), rel=1e-6)
        light = [
            _light(_figures(_heights(part.reshape(len(nodes), 3, -1), nodes), weights, nodes), pupil)[1:]
            for part in (full.surface @ whole, small.surface @ tiny)
        ]
        error = np.linalg.norm(light[0] - light[1]) / np.linalg.norm(light[0])
        assert float(case["eps_opt"][place]) == pytest.approx(error, rel=1e-6)
        assert float(case["frf_opt"][place]) == pytest.approx(np.linalg.norm(light[1]), rel=1e-7)
        np.testing.assert_allclose(
            case["frf_zernike"][place, :10], np.linalg.norm(light[1], axis=1), rtol=1e-4
        )


def test_wavefront_over_time_is_that_of_an_exponential_and_a_closed_form(store, study, full):
    """10 um at 300 Hz, begun abruptly at one of three mounts, all nine directions prescribed: tilt, too."""
    small, omega = reduce(full, "craigb18"), 2 * np.pi * 300.0
    static = np.linalg.pinv(small.inputs.T)  # any motion that obeys the constraint
    free = scipy.linalg.null_space(small.inputs.T)
    push = static @ np.array([*np.zeros(5), 10e-6, *np.zeros(3)])
    mass, damping, stiffness = (
        free.T @ matrix @ free for matrix in (small.mass, small.damping_matrix, small.stiffness)
    )
    load = [free.T @ matrix @ push for matrix in (small.mass, small.damping_matrix, small.stiffness)]
    # States y, y', sin, cos; u = sin. u'' = -omega^2 sin, and the jump of u' at 0 jerks y'.
    count = len(mass)
    system = np.zeros((2 * count + 2, 2 * count + 2))
    system[:count, count : 2 * count] = np.eye(count)
    system[count : 2 * count, :count] = -np.linalg.solve(mass, stiffness)
    system[count : 2 * count, count : 2 * count] = -np.linalg.solve(mass, damping)
    system[count : 2 * count, -2] = -np.linalg.solve(mass, load[2] - omega**2 * load[0])
    system[count : 2 * count, -1] = -np.linalg.solve(mass, omega * load[1])
    system[-2, -1], system[-1, -2] = omega, -omega
    state = np.zeros(2 * count + 2)
    state[count : 2 * count] = -omega * np.linalg.solve(mass, load[0])
    state[-1] = 1.0
    step = scipy.linalg.expm(system * 1e-4)
    history = []
    for _ in range(study.time.instants):
        history.append(free @ state[:count] + push * state[-2])
        state = step @ state
    nodes = full.nodes[full.surface_nodes]
    motion = (small.surface @ np.array(history).T).reshape(len(nodes), 3, -1)
    figures = _figures(_heights(motion, nodes), full.surface_weights, nodes)
    light = _light(figures, _sunflower(200))
    expected = np.sqrt(np.sum(light[3:] ** 2, axis=0))
    case = _case(store, "craigb18").sel(excitation="sine300")
    assert expected.max() > 1000.0
    np.testing.assert_allclose(case["wfe_rms"], expected, rtol=0, atol=1e-8 * expected.max())
    # Where the chief ray lands, and the best-fit plane of the wavefront about it over the rim's sine: light
    # that is focused at e beyond the chief ray has the OPD k_out . e, which is -sine e at the rim.
    sine = 500.0 / (1700.0 + 500.0**2 / (4 * 1700.0))
    line = 2 * 1700.0 * slope_at_the_vertex(500.0) @ figures - 2e-6 * light[1:3] / sine
    assert np.abs(line).max() > 0.01
    np.testing.assert_allclose(case["los_mm"].T, line, rtol=0, atol=1e-7 * np.abs(line).max())


@pytest.mark.parametrize("term", [2, 3, 4, 8, 9])
def test_an_exposure_is_the_diffraction_integral_of_the_moved_surface(term):
    """Tilts move the image, coma flares to its side: rays summed at fixed points, without any chief ray."""
    keys = {"model.focal_length_m": 20.0, "imaging.pixels": 16, "imaging.sampling": 0.5}
    section = {"imaging.scale": 1.0, "imaging.pupil_samples": 64}
    slow = load_study("mirror-mor", MOR | keys | section)
    optics = bench_of(slow.identity_text(), "circular").optics
    figure = np.zeros(11)
    figure[term - 1] = 60e-6
    found = exposures(slow, optics, (optics.sensitivity @ figure)[None, None])[0]
    x, y = 500.0 * (pupil := sunflower(0.0, 1.0, 6000)).x, 500.0 * pupil.y
    away = 20e3 + (x * x + y * y) / 80e3
    longer = 2 * 20e3 / away * (eleven(x / 500.0, y / 500.0) @ figure)
    axis = (np.arange(16) - 8) * 0.5 * 550e-6 * 20e3 / 1000.0
    turn_x, turn_y = (np.exp(-2j * np.pi / 550e-6 * axis[:, None] * one / away) for one in (x, y))
    field = (turn_y * np.exp(2j * np.pi / 550e-6 * longer)) @ turn_x.T / len(x)
    np.testing.assert_allclose(found, np.abs(field) ** 2, rtol=0, atol=4e-3)
    assert np.abs(found - found.T[::-1, ::-1]).max() > 0.1 or term == 4


def test_errors_over_time_are_differences_from_the_reference(store):
    reference, case = _case(store, "full"), _case(store, "rubin18")
    for name in ("eps_mech", "eps_opt", "wfe_error", "los_error", "image_error"):
        assert float(np.abs(reference[name]).max()) == 0.0
        assert float(np.abs(case[name]).max()) > 0.0
    apart = np.abs(case["wfe_rms"] - reference["wfe_rms"])
    assert (apart <= case["wfe_error"] + 1e-9).all()  # the rms of a difference bounds that of the rms values
    line = np.linalg.norm(case["los_mm"] - reference["los_mm"], axis=-1)
    np.testing.assert_allclose(case["los_error"], line, rtol=0, atol=1e-15)


def test_labels_shapes_and_the_check_of_the_sweep(store, study):
    assert list(store["variant"].values) == ["full", *study.reduction.variants]
    assert list(store["method"].values) == ["full", "craigb", "rubin", "krylov"]
    assert set(store["model"].values) == {"circular"}
    assert (store["status"] == 1).all()
    assert list(store["order"].values[1:]) == [18, 18, 36]
    residual = store["fit_residual"].values
    assert (np.isfinite(residual).sum(axis=1)[1:] == [18, 18, 36]).all()
    assert (np.nanmax(residual[:, :6], axis=1) < 1e-9).all()  # rigid motions are fitted
    assert store["spot_error"].shape == (1, 3)
    assert float(store["spot_error"].max()) < 1e-6
    assert store["spot_frequency"].attrs["units"] == "Hz"


def test_pairs_of_aberrations_respond_alike_and_the_two_trefoils_do_not(store):
    """Three mounts 120 degrees apart: cos and sin of one or two angles are a pair, of three angles not."""
    response = _case(store, "full")["frf_zernike"]
    terms = {int(j): float(response.sel(noll=j).max()) for j in store["noll"].values}
    for first, second in ((2, 3), (5, 6), (7, 8)):
        assert terms[first] == pytest.approx(terms[second], rel=1e-3)  # of few nodes; 1e-7 of many
    assert terms[10] > 5 * terms[9]


def test_krylov_is_best_below_250_hz_and_useless_above_400_in_the_light_too(tmp_path):
    """Störkle 2018, Section 4.4.2: krylov36 against craigb36; defocus near 300 Hz."""
    keys = MOR | {"model.rings": 3, "reduction.variants": ["craigb36", "krylov36(150)"]}
    study = load_study("mirror-mor", keys | {"reduction.frequencies": 300, "optics.zernike_terms": 22})
    run_study(study, tmp_path / "s", on="serial")
    store = open_store(tmp_path / "s").load()
    frequency = store["frequency"].values
    eps = {name: _case(store, name)["eps_opt"].values for name in ("craigb36", "krylov36(150)")}
    low, high = frequency < 250, frequency > 400
    assert eps["krylov36(150)"][low].max() < 0.01 * eps["craigb36"][low].max()
    assert eps["krylov36(150)"][high].max() > 0.5
    response = _case(store, "full")["frf_zernike"]
    tilt, defocus = (np.where(frequency > 50, response.sel(noll=j).values, 0.0) for j in (2, 4))
    peak = int(np.argmax(defocus))
    assert frequency[peak] == pytest.approx(300, abs=15)
    assert defocus[peak] > 3 * tilt[peak]


def test_a_case_alone_has_the_bits_it_has_in_a_chunk(study):
    text = study.identity_text()
    together = KIND.compute(text, np.arange(4), "auto")
    for case in (3, 1):
        alone = KIND.compute(text, np.array([case]), "auto")
        for name, values in alone.arrays.items():
            if name != "reduce_seconds":
                np.testing.assert_array_equal(values[0], together.arrays[name][case], err_msg=name)


def test_fewer_cases_are_the_same_study_and_more_go_on(tmp_path, study, store):
    keys = MOR | {"store.chunk_cases": 2}
    few = load_study("mirror-mor", keys | {"campaign.cases": 2})
    assert few.identity() == study.identity()
    assert run_study(few, tmp_path / "s", on="serial").computed == 2
    again = run_study(load_study("mirror-mor", keys), tmp_path / "s", on="serial")
    assert (again.done_before, again.computed) == (2, 2)
    np.testing.assert_array_equal(open_store(tmp_path / "s")["eps_opt"].values, store["eps_opt"].values)


def test_two_meshes_are_compared_variant_by_variant(tmp_path, store):
    other = wq.run("mirror-mor", store=tmp_path / "s", **_double(MOR | {"model.rings": 3}))
    found = compare(store, other, "coarse", "fine")
    frequencies = [one for one in found if one.measure == "pseudo_frequency_max"]
    assert sum(one.cases for one in frequencies) == 4
    apart = np.concatenate([one.differences for one in frequencies])
    assert (np.abs(apart) > 1.0).all()


def _double(keys):
    return {key.replace(".", "__"): value for key, value in keys.items()}


def _arguments(keys):
    return [f"{key}={value}".replace("'", '"') for key, value in keys.items()]


def _words(tmp_path, keys):
    return ["run", "mirror-mor", *_arguments(keys), "--store", str(tmp_path / "s"), "--on", "serial"]


def _run(tmp_path, keys):
    return CliRunner().invoke(app, _words(tmp_path, keys))


def test_variants_that_do_not_suit_are_quarantined_with_the_reason(tmp_path, monkeypatch):
    """Six rigid motions and three bending modes do not strain the mounts within their plane."""
    monkeypatch.setattr(stores, "write_report", lambda *_, **__: None)
    variants = ["modal9", "craigb18"]
    result = _run(tmp_path, MOR | {"reduction.variants": variants})
    assert result.exit_code == 3
    found = open_store(tmp_path / "s")
    messages = found["message"].values
    assert list(found["status"].values) == [1, 2, 1]
    assert "prescribe" in messages[1]


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"reduction.variants": ["craigb18", "foo36"]}, "foo"),
        ({"reduction.variants": ["craigb18", "craigb18"]}, "listed twice"),
        ({"reduction.reference": "craigb5000"}, "craigb5000"),
        ({"reduction.variants": ["craigb18", "craigb900"]}, "craigb900 is above the 855 degrees of freedom"),
        ({"reduction.variants": ["rubin14"]}, "rubin14 is below the 15 rigid motions and attachment modes"),
        ({"reduction.variants": ["craigb18", "modal8"]}, "modal8 has fewer coordinates than the 9 interface"),
        ({"reduction.variants": ["guyan12"]}, "exactly the order 9, not that of guyan12"),
        ({"reduction.variants": ["modal500"]}, "modal500 asks for 494 modes, too many for the 855"),
        ({"reduction.variants": ["bt36"], "model.damping_beta": 0.0}, "need positive damping"),
        ({"reduction.variants": ["krylov36(-5)"]}, "'-5' must be finite and not negative"),
        ({"model.damping_beta": -1e-6}, "damping_beta"),
        ({"model.mount_angles_deg": [0.0, 180.0]}, "line"),
        ({"model.mount_radius_m": 0.7}, "outside the mirror"),
        ({"optics.zernike_terms": 231}, "do not determine 231 Zernike terms"),
        ({"reduction.first_hz": 1300.0}, "must be below last_hz"),
        ({"criterion.excitations": ["sine"]}, "criterion.excitations names 'sine'"),
        ({"time.step_s": 1.0}, "instants"),
        ({"model.units": "m,kg,s,N"}, "belongs to a model file"),
        ({"model.shapes": []}, "shapes is empty"),
        ({"model.file": "nowhere.sti"}, "model.units: is missing"),
        ({"reduction.variant": ["craigb18"]}, "nearest valid key is 'variants'"),
    ],
)
def test_bad_input_is_one_sentence_and_exit_code_2(keys, words, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["wavequake", *_words(tmp_path, MOR | keys)])
    with pytest.raises(SystemExit) as end:
        cli.main()
    assert end.value.code == 2
    message = capsys.readouterr().err.strip()
    assert words in message
    assert message.count("\n") == message.count(". ") == 0
    assert not (tmp_path / "s").exists()


def test_the_plan_shows_the_check_of_the_basis(study):
    (line,) = (value for key, value in plan(study).items() if key == "model circular")
    assert "855 degrees of freedom" in line
    assert "off the full model at" in line
