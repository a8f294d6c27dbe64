"""The optical maps of mirror studies against closed forms and independent fits."""

from dataclasses import replace

import numpy as np
import pytest
from small_mirrors import TRACE, eleven, wavefront_of

from wavequake.errors import UserError
from wavequake.optics.wavefronts.wavefront import prepare_system
from wavequake.reduction.two_stage import reference
from wavequake.workflows.mirrors import optics as mirror_optics
from wavequake.workflows.mirrors.bench import bench_of, build_model, study_of, variant_of
from wavequake.workflows.mirrors.optics import (
    deformation_sensitivity,
    displacements_mm,
    mirror_system,
    mode_residuals,
    optical_rows,
    optics_of,
)
from wavequake.workflows.study import load_study

pytestmark = pytest.mark.usefixtures("mirror_models")


@pytest.fixture(scope="module")
def study():
    return load_study("mirror-trace", TRACE)


@pytest.fixture(scope="module")
def bench(study):
    return bench_of(study.identity_text(), "circular")


def test_sensitivities_are_those_of_a_parabola_in_closed_form(bench):
    """All eleven wavefront coefficients (nm) per mm of each figure, signs and comatic shift included."""
    optics, prepared = bench.optics, bench.optics.prepared
    x, y = optics.radius * prepared.pupil.T
    opd = wavefront_of(np.eye(11), x, y, optics.radius, 1700.0)
    expected = np.linalg.lstsq(eleven(*prepared.pupil.T), opd.T, rcond=None)[0] * 1e6
    np.testing.assert_allclose(optics.sensitivity[2:], expected, rtol=0, atol=3e-8 * np.abs(expected).max())
    assert expected[3, 3] < -1e6  # a rim that moves along the light lengthens its path


def test_without_opencl_numpy_traces_the_sensitivities(bench, monkeypatch):
    def none(request):
        raise UserError("no OpenCL device was found")

    monkeypatch.setattr(mirror_optics, "choose_device", none)
    found = deformation_sensitivity(bench.optics.prepared, 11)
    np.testing.assert_allclose(found, bench.optics.sensitivity, rtol=0, atol=1e-8 * np.abs(found).max())


def test_a_tilt_of_the_figure_turns_the_line_of_sight_by_twice_its_slope(bench):
    """For a slow mirror, where the best-fit plane of the wavefront is that of the surface."""
    slow = mirror_system(1e5, 500.0, 0.0, 11)
    prepared = bench.optics.prepared
    x, y = prepared.pupil.T
    found = deformation_sensitivity(prepare_system(slow, x, y, np.ones(len(x)), 11, wavelength=550e-6), 11)
    expected = np.zeros((2, 11))
    expected[0, 1] = expected[1, 2] = 2 * 1e5 * 2 / 500.0
    np.testing.assert_allclose(found[:2], expected, rtol=0, atol=1e-4 * expected.max())


def test_rows_are_an_independent_fit_of_the_nodes_times_the_sensitivities(study, bench):
    model = build_model(study, "circular")
    stage = bench.stage
    nodes = model.nodes[model.surface_nodes]
    motion = reference(stage).surface.reshape(len(nodes), 3, -1)[:, :, 6:20]
    x, y = nodes[:, 0], nodes[:, 1]
    height = motion[:, 2] - (x[:, None] * motion[:, 0] + y[:, None] * motion[:, 1]) / (2 * 1.7)
    root = np.sqrt(model.surface_weights)[:, None]
    figures = np.linalg.lstsq(root * eleven(x / 0.5, y / 0.5), root * height, rcond=None)[0]
    expected = bench.optics.sensitivity @ (-1e3 * figures)
    found = optical_rows(bench.optics, reference(stage))[:, 6:20]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-11 * np.abs(expected).max())
    left = height - eleven(x / 0.5, y / 0.5) @ figures
    weights = model.surface_weights
    share = np.sqrt(weights @ left**2 / (weights @ height**2))
    np.testing.assert_allclose(mode_residuals(bench.optics, reference(stage))[6:20], share, rtol=1e-8)


def test_the_last_modes_of_a_reduced_model_fit_badly():
    """Störkle 2018, Fig. 4.36: the correction modes, and those of Krylov most."""
    keys = {"model.shapes": ["circular"], "model.rings": 3, "optics.rays": 200, "optics.zernike_terms": 105}
    study = load_study("mirror-trace", keys)
    bench = bench_of(study.identity_text(), "circular")
    left = {
        name: mode_residuals(bench.optics, variant_of(bench, name)) for name in ("craigb36", "krylov36(150)")
    }
    for values in left.values():
        assert values[:6].max() < 1e-9  # rigid motions, turns by the linear fit too
        assert np.median(values[27:]) > 10 * np.median(values[6:27])
    assert left["krylov36(150)"][27:].max() > left["craigb36"][27:].max()


def test_displacements_cross_over_once():
    turned = displacements_mm(np.array([[1e-3, 2e-3, 3e-3, 0.0, 0.0, -1e-6]]))
    np.testing.assert_array_equal(turned, [[[1.0, 2.0, -3.0], [0.0, 0.0, 1e-3]]])


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"optics.zernike_terms": 231}, "121 nodes, which do not determine 231 Zernike terms"),
        ({"optics.zernike_terms": 66, "optics.rays": 60}, "optics.rays is 60, which do not determine 66"),
    ],
)
def test_too_few_nodes_or_rays_are_refused(keys, words):
    study = load_study("mirror-trace", TRACE | keys)
    with pytest.raises(UserError, match=words):
        bench_of(study.identity_text(), "circular")


def _moved(bench, change):
    """An intermediate model whose nodes stand elsewhere."""
    return replace(bench.stage, nodes=change(bench.stage.nodes.copy()))


def test_an_imported_parabola_is_found_in_its_nodes(study, bench):
    found = optics_of(study, "file", bench.stage)
    assert found.radius == pytest.approx(500.0)
    assert found.obscuration == 0.0
    assert found.surface.shape.radius == pytest.approx(-3400.0, rel=1e-9)
    np.testing.assert_allclose(found.sensitivity, bench.optics.sensitivity, rtol=0, atol=1.0)


def test_an_imported_ring_is_a_ring(study):
    keys = TRACE | {"model.shapes": ["annular"], "model.rings": 3}
    annular = load_study("mirror-trace", keys)
    bench = bench_of(annular.identity_text(), "annular")
    assert optics_of(annular, "file", bench.stage).obscuration == pytest.approx(0.4, abs=1e-3)


def _bulging(nodes):
    nodes[:, 2] *= -1
    return nodes


def _flat(nodes):
    nodes[:, 2] = 0.02
    return nodes


def _aside(nodes):
    nodes[:, 0] += 0.1
    return nodes


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (_bulging, r"bulges towards \+z"),
        (_flat, "is flat, so it has no focus; say with optics.focal_length_m"),
        (_aside, "is centered 100 mm off the z axis"),
    ],
)
def test_imported_surfaces_that_are_no_mirror_on_the_axis_are_refused(study, bench, change, words):
    with pytest.raises(UserError, match=words):
        optics_of(study_of(study.identity_text()), "file", _moved(bench, change))
