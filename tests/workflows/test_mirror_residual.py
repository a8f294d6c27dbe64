"""What the polynomials miss of a vibrating mirror is traced as a grid, by both methods."""

from dataclasses import replace

import numpy as np
import pytest
from small_mirrors import TRACE

from wavequake.campaign.stopwatch import Stopwatch
from wavequake.campaign.store.store import open_store
from wavequake.kernels.device.devices import NUMPY, choose_device
from wavequake.mechanics.vibration.excitations import drive_of
from wavequake.mechanics.vibration.modal import modal_model
from wavequake.mechanics.vibration.response import displacements, respond
from wavequake.optics.shapes.fit import apply, residual_grid
from wavequake.optics.shapes.motion_fit import motion_fit
from wavequake.optics.systems.kinematics import rest_states
from wavequake.optics.wavefronts.wavefront import trace_light, trace_system
from wavequake.workflows.mirrors.bench import bench_of, variant_of
from wavequake.workflows.mirrors.optics import displacements_mm, with_deformation
from wavequake.workflows.mirrors.residual import (
    coordinates_of,
    deformed_light,
    grid_of,
    left_by,
    residual_of,
    rms_of,
)
from wavequake.workflows.mirrors.trace import KIND, STAGES, modal_method, standard_method
from wavequake.workflows.run import run_study
from wavequake.workflows.study import load_study

FINE = TRACE | {"model.rings": 4, "optics.rays": 300}


pytestmark = pytest.mark.usefixtures("mirror_models")


def _bench(terms, keys=FINE):
    study = load_study("mirror-trace", keys | {"optics.zernike_terms": terms})
    return study, bench_of(study.identity_text(), study.models[0])


def _response(study, bench, excitation=1):
    variant = variant_of(bench, "craigb18")
    drive = drive_of(study.excitation[excitation], 3, study.time.seconds, 0)
    return variant, respond(modal_model(variant, drive.prescribed), [drive], study.time.seconds)


def _wavefront(optics, figure, grid=None):
    """Return the OPD (N,) of one figure in mm, with the grid of heights if there is one, less its plane."""
    opd, prepared = _traced(optics, figure[None], grid if grid is None else grid[None])
    opd = opd[0] * prepared.wavelength
    plane = np.column_stack([np.ones(len(opd)), prepared.pupil])
    return opd - plane @ np.linalg.lstsq(plane, opd)[0]


def _traced(optics, figures, grids):
    """Return OPDs (T, N) of figures, with grids of heights if there are any, given as states of a system."""
    prepared = optics.prepared if grids is None else with_deformation(optics, grid_of(optics))
    rest = rest_states(prepared.system, len(figures))
    given = figures if grids is None else np.hstack([figures, grids.reshape(len(grids), -1)])
    return trace_system(prepared, replace(rest, deformations=(given, None)), choose_device("auto"))[
        0
    ], prepared


def _heights(optics, left):
    """Return the grids of heights per unit coordinate."""
    return residual_grid(optics.surface, left.heights, grid_of(optics))


def test_sums_of_splines_trace_as_the_splines_of_summed_heights():
    """Interpolating the heights of every instant anew shares no spline with them."""
    study, bench = _bench(11)
    optics, device = bench.optics, choose_device("auto")
    variant, response = _response(study, bench)
    left, coordinates = left_by(optics, variant), coordinates_of(response)
    residual = residual_of(optics, left, device)
    heights = np.tensordot(coordinates, _heights(optics, left), 1)
    figures = apply(optics.surface, displacements_mm(displacements(response, variant.surface)[0]), False)
    truth, prepared = _traced(optics, figures, heights)
    light = deformed_light(optics, figures, residual.at(coordinates))
    opd, _, _ = trace_light(prepared, light, device)
    without, _ = _traced(optics, figures, None)
    assert np.abs(opd - without).max() > 1.0  # wave, so the grids matter
    np.testing.assert_allclose(opd, truth, rtol=0, atol=1e-8)


def _arrays(keys):
    text = load_study("mirror-trace", TRACE | keys).identity_text()
    result = KIND.compute(text, np.arange(1), "auto")
    assert list(result.status) == [1], result.messages
    return {name: values[0] for name, values in result.arrays.items()}


def test_few_terms_with_the_grid_come_near_many_terms():
    """Of an elastic coordinate, 11 and 28 polynomials lose much; with the grids all find one wavefront."""
    lost, found = {}, {}
    for terms in (11, 28, 66):
        _, bench = _bench(terms)
        optics, variant = bench.optics, variant_of(bench, "craigb18")
        unit = np.eye(variant.order)[12]
        shape = displacements_mm((variant.surface @ unit)[None])
        amplitude = 1e-4 / np.abs(shape).max()
        figure = apply(optics.surface, shape * amplitude)[0]
        grid = amplitude * unit @ _heights(optics, left_by(optics, variant)).reshape(variant.order, -1)
        lost[terms], found[terms] = _wavefront(optics, figure), _wavefront(optics, figure, grid)
    truth = found[66]
    assert np.std(truth) > 1e-5
    wrong = {
        name: [np.std(waves[terms] - truth) / np.std(truth) for terms in (11, 28)]
        for name, waves in (("lost", lost), ("found", found))
    }
    assert wrong["lost"][0] > 0.5
    assert wrong["lost"][1] > 0.01
    assert wrong["found"][0] < 0.02 * wrong["lost"][0]
    assert wrong["found"][1] < 0.2 * wrong["lost"][1]
    # More polynomials and the grids go to the same limit.
    assert np.std(lost[66] - truth) < 0.2 * np.std(lost[28] - truth)


def test_both_methods_agree_about_what_the_polynomials_miss():
    study, bench = _bench(11)
    optics, device = bench.optics, choose_device("auto")
    variant, response = _response(study, bench)
    left = left_by(optics, variant)
    residual = residual_of(optics, left, device)
    motion = motion_fit(optics.surface, displacements_mm(variant.surface.T))
    coordinates = coordinates_of(response)
    traced = standard_method(optics, motion, coordinates, device, Stopwatch(), residual)
    summed = modal_method(optics, variant.surface, response, Stopwatch(), residual)
    size = traced.rms_raw.max()
    np.testing.assert_allclose(summed.rms_raw, traced.rms_raw, rtol=0, atol=1e-3 * size)
    np.testing.assert_allclose(summed.aberrations[:, 5:], traced.aberrations[:, 5:], rtol=0, atol=1e-4 * size)
    # Without it both are off by a percent, alike.
    without = standard_method(optics, motion, coordinates, device, Stopwatch())
    assert np.abs(without.rms_raw - traced.rms_raw).max() > 5e-3 * size


def test_the_share_decides_what_is_traced():
    """The first excitation misses 1.16 % here, the second more; a limit between them traces only that one."""
    always = _arrays({"optics.residual_limit": 0.0})
    share = always["missed_share"]
    assert 0.0 < share[0] < share[1] < 0.5
    assert (always["wfe_rms_residual"][:, 1:] > 0.0).all()
    between = _arrays({"optics.residual_limit": float(share.mean())})
    assert not between["wfe_rms_residual"][0].any()
    np.testing.assert_array_equal(between["missed_share"], share)
    for name in ("wfe_rms_standard", "wfe_rms_residual", "wfe_rms_raw_modal"):
        np.testing.assert_array_equal(between[name][1], always[name][1])
    never = _arrays({"optics.residual_limit": 1.0})
    assert not never["wfe_rms_residual"].any()
    np.testing.assert_array_equal(between["wfe_rms_raw"][0], never["wfe_rms_raw"][0])
    stage = STAGES.index("residual of modes")
    assert (always["seconds"][:, stage] > 0.0).all()
    assert not never["seconds"][:, stage].any()


def test_a_run_that_traces_some_residuals_is_done(tmp_path):
    limit = float(_arrays({"optics.residual_limit": 0.0})["missed_share"].mean())
    run_study(
        load_study("mirror-trace", TRACE | {"optics.residual_limit": limit}), tmp_path / "s", on="serial"
    )
    assert list(open_store(tmp_path / "s")["status"].values) == [1]


def test_eleven_terms_and_the_grid_find_the_wavefront_error_of_45_terms():
    """Shaken at one mount at 300 Hz, the mirror bends so that 11 terms miss half of it."""
    keys = {f"excitation.{name}.interfaces": [1] for name in ("sine100", "sine300")} | {"optics.rays": 300}
    many = _arrays(keys | {"optics.zernike_terms": 45})["wfe_rms_raw"][1].max()
    few = _arrays(keys)
    assert few["missed_share"][1] > 0.4
    for name in ("wfe_rms_raw", "wfe_rms_raw_modal"):
        np.testing.assert_allclose(few[name][1].max(), many, rtol=5e-3)
    assert _arrays(keys | {"optics.residual_limit": 1.0})["wfe_rms_raw"][1].max() < 0.85 * many


def test_what_the_grid_adds_is_twice_what_the_surface_misses():
    """Light meets the mirror nearly upright: the wavefront has twice the rms of the heights."""
    study, bench = _bench(28)
    variant, response = _response(study, bench)
    optics, coordinates = bench.optics, coordinates_of(response)
    left = left_by(optics, variant)
    residual = residual_of(optics, left, NUMPY)
    heights = coordinates @ left.heights
    missed = np.sqrt(np.square(heights) @ optics.surface.weights) * 1e6
    np.testing.assert_allclose(rms_of(left.missed, coordinates) * 1e6, missed, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(rms_of(residual.whole, coordinates).max(), 2 * missed.max(), rtol=0.1)


def test_a_mirror_at_rest_misses_nothing():
    _, bench = _bench(11)
    left = left_by(bench.optics, variant_of(bench, "craigb18"))
    assert left.share(np.zeros((3, len(left.heights)))) == 0.0
