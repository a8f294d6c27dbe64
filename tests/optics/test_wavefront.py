from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from wavefront_cases import TERMS, WAVELENGTH, each_device, states_of

from wavequake.errors import UserError
from wavequake.kernels.device.devices import NUMPY, list_devices
from wavequake.kernels.device.tiles import TILE, to_tiles
from wavequake.kernels.trace.train import Traced
from wavequake.optics.polynomials.zernike import annular_zernike
from wavequake.optics.rays.pupils import PupilRays
from wavequake.optics.segments.catalog import telescope
from wavequake.optics.segments.prepared import chief_rays, prepare, trace_states
from wavequake.optics.segments.wavefront import analyse, measure
from wavequake.optics.systems.kinematics import rest_states


def arrays_of(wavefront):
    return {name: values for name, values in vars(wavefront).items() if name != "device"}


def synthetic(prepared, waves, tiles=1):
    """Traced rays with an OPD (N,) or (N, 16) in waves and image points at the origin, and the chief ray."""
    waves = np.broadcast_to(
        np.reshape(waves, (len(prepared.rays.x), -1)), (tiles, len(prepared.rays.x), TILE)
    )
    nothing = np.zeros_like(waves)
    return Traced(waves * WAVELENGTH, nothing, nothing.copy(), nothing.astype(np.int8)), np.zeros(
        (tiles, 3, TILE)
    )


@given(st.floats(-3.0, 3.0), st.floats(-3.0, 3.0), st.integers(0, 2**32 - 1))
def test_strehl_and_rms_do_not_depend_on_piston_and_tilt(tmt18, tilt_x, tilt_y, seed):
    rays, system = tmt18.rays, tmt18.system
    x, y = rays.x / system.annulus.outer, rays.y / system.annulus.outer
    shape = 0.1 * np.random.default_rng(seed).normal(size=18)[rays.segment]
    flat, tilted = (
        analyse(tmt18, *synthetic(tmt18, shape + plane)) for plane in (0.0, 0.4 + tilt_x * x + tilt_y * y)
    )
    np.testing.assert_allclose(tilted.strehl, flat.strehl, rtol=1e-12)
    np.testing.assert_allclose(tilted.rms, flat.rms, rtol=1e-10)
    design = np.stack([np.ones_like(x), x, y], axis=1)
    residual = shape - design @ np.linalg.lstsq(design, shape, rcond=None)[0]
    assert flat.strehl[0] == pytest.approx(np.abs(np.mean(np.exp(2j * np.pi * residual))) ** 2, rel=1e-12)
    assert flat.rms_raw[0] == pytest.approx(shape.std(), rel=1e-12)


def test_eq_339_with_the_annular_factor_is_the_direction_of_a_plane_wavefront(thesis):
    """An OPD of a rho cos(theta) tilts the wavefront by a / R: the image moves by -a lambda / NA."""
    x, y = thesis.rays.x / thesis.system.annulus.outer, thesis.rays.y / thesis.system.annulus.outer
    wavefront = analyse(thesis, *synthetic(thesis, 0.3 * x - 0.2 * y))
    expected = np.array([-0.3, 0.2]) * WAVELENGTH / thesis.numerical_aperture
    np.testing.assert_allclose(wavefront.los[0], expected, rtol=1e-12)
    np.testing.assert_allclose(wavefront.strehl, 1.0, rtol=1e-12)


def test_segment_phases_are_pistons_at_the_centers_and_slopes(tmt18):
    phase = np.random.default_rng(5).normal(size=(18, 3)) * [1.0, 1e-3, 1e-3]
    rays, centers = tmt18.rays, tmt18.system.segments.centers
    piston, slope_x, slope_y = phase[rays.segment].T
    dx, dy = rays.x - centers[rays.segment, 0], rays.y - centers[rays.segment, 1]
    wavefront = analyse(tmt18, *synthetic(tmt18, piston + slope_x * dx + slope_y * dy))
    np.testing.assert_allclose(wavefront.segment_phase[3], phase, rtol=0, atol=1e-11)
    assert not wavefront.lost_segments.any()


@pytest.mark.parametrize("device", list_devices(), ids=lambda device: device.kind)
def test_lost_rays_are_left_out_of_their_instant_only(tmt18, device):
    rng, rays = np.random.default_rng(7), tmt18.rays
    waves = rng.normal(size=(len(rays.x), TILE))
    traced, chief = synthetic(tmt18, waves)
    traced = replace(traced, x=to_tiles(rng.normal(size=(TILE, len(rays.x)))))
    whole = analyse(tmt18, traced, chief, device)
    gone = (rng.random(len(rays.x)) < 0.1) | (rays.segment == 4)
    gone[np.flatnonzero(rays.segment == 6)[2:]] = True  # two rays are left: no plane
    holed = replace(traced, opd=traced.opd.copy(), x=traced.x.copy(), status=traced.status.copy())
    for array, value in ((holed.opd, 1e3), (holed.x, np.nan), (holed.status, 1)):
        array[0, gone, 9] = value
    wavefront = analyse(tmt18, holed, chief, device)
    others = np.arange(TILE) != 9
    for name, values in arrays_of(whole).items():
        np.testing.assert_array_equal(getattr(wavefront, name)[others], values[others], err_msg=name)
    kept, w = ~gone, waves[~gone, 9]
    system = tmt18.system
    x, y = rays.x[kept] / system.annulus.outer, rays.y[kept] / system.annulus.outer
    basis = annular_zernike(x, y, TERMS, system.annulus.inner / system.annulus.outer)
    np.testing.assert_allclose(
        wavefront.zernike[9], np.linalg.lstsq(basis, w, rcond=None)[0], rtol=0, atol=1e-10
    )
    design = np.stack([np.ones_like(x), x, y], axis=1)
    residual = w - design @ np.linalg.lstsq(design, w, rcond=None)[0]
    assert wavefront.strehl[9] == pytest.approx(
        np.abs(np.mean(np.exp(2j * np.pi * residual))) ** 2, rel=1e-10
    )
    assert wavefront.rms_raw[9] == pytest.approx(w.std(), rel=1e-12)
    assert wavefront.centroid[9, 0] == pytest.approx(traced.x[0, kept, 9].mean(), rel=1e-12)
    assert wavefront.lost.tolist() == [np.count_nonzero(gone) if k == 9 else 0 for k in range(TILE)]
    assert np.argwhere(wavefront.lost_segments).tolist() == [[9, 4], [9, 6]]
    own = rays.segment[kept] == 0
    local = np.stack([np.ones(own.sum()), *(rays_xy[kept][own] for rays_xy in (rays.x, rays.y))], axis=1)
    local[:, 1:] -= system.segments.centers[0, :2]
    np.testing.assert_allclose(
        wavefront.segment_phase[9, 0], np.linalg.lstsq(local, w[own], rcond=None)[0], rtol=1e-9, atol=1e-12
    )
    assert np.isnan(wavefront.segment_phase[9, 4]).all()


@each_device
@pytest.mark.parametrize("motion", [30e3, np.nan], ids=["out of the beam", "NaN"])
def test_a_segment_out_of_the_beam_is_reported(tmt18, device, motion):
    states = states_of(tmt18)
    states.segment_motion[5, 11, 0] = motion
    wavefront, still = measure(tmt18, states, device), measure(tmt18, states_of(tmt18), device)
    assert np.argwhere(wavefront.lost_segments).tolist() == [[5, 11]]
    assert wavefront.lost[5] == np.count_nonzero(tmt18.rays.segment == 11)
    assert np.isfinite(wavefront.zernike).all()
    assert np.isfinite(wavefront.strehl).all()
    np.testing.assert_array_equal(np.delete(wavefront.zernike, 5, 0), np.delete(still.zernike, 5, 0))


def test_an_instant_that_loses_all_rays_says_so(tmt18):
    states = states_of(tmt18)
    states.surface_motion[2, 2, 0] = np.nan
    wavefront = measure(tmt18, states, NUMPY)
    assert wavefront.lost.tolist() == [len(tmt18.rays.x) if k == 2 else 0 for k in range(TILE)]
    assert wavefront.lost_segments[2].all()
    assert np.isnan(wavefront.zernike[2]).all()
    assert np.isfinite(np.delete(wavefront.los, 2, 0)).all()


@pytest.mark.parametrize("cause", ["shift", "clocking", "field", "shift beside NaN"])
def test_results_do_not_depend_on_the_margin(tmt18, cause):
    """Rays wander some 20 mm; with candidates for 0.5 mm only, those near an edge would be lost."""
    states = states_of(tmt18)
    if cause == "field":
        states.line_of_sight[:] = [1e-2, -0.5e-2]
    else:
        dof, size = (5, 2e-2) if cause == "clocking" else (0, 20.0)
        states.segment_motion[:, :, dof] = size
    if cause == "shift beside NaN":
        states.segment_motion[0, 0] = np.nan
    wide, narrow = (
        measure(prepare(tmt18.system, tmt18.rays, WAVELENGTH, TERMS, margin=margin), states, NUMPY)
        for margin in (500.0, 0.5)
    )
    for name, values in vars(wide).items():
        np.testing.assert_array_equal(getattr(narrow, name), values, err_msg=name)


@each_device
def test_results_do_not_depend_on_the_batch(tmt18, device):
    rng = np.random.default_rng(11)
    states = states_of(tmt18, 3 * TILE)
    states.segment_motion[:] = rng.normal(size=states.segment_motion.shape) * [20, 20, 1e-4, 1e-7, 1e-7, 1e-2]
    states.surface_motion[:, 2:] = rng.normal(size=(len(states), 3, 6)) * 1e-6
    states.line_of_sight[:] = rng.normal(size=states.line_of_sight.shape) * 1e-3
    parts = {name: values[TILE : 2 * TILE] for name, values in vars(states).items() if values is not None}
    one = replace(states, **parts)
    batch, alone = measure(tmt18, states, device), measure(tmt18, one, device)
    assert alone.lost.min() > 0
    for name, values in arrays_of(alone).items():
        np.testing.assert_array_equal(getattr(batch, name)[TILE : 2 * TILE], values, err_msg=name)


@each_device
def test_a_figure_acts_as_the_rigid_motion_that_it_equals(device):
    """Piston is dz, a tilt along local x (y) is a rotation about local y (x), near the segment's center."""
    system = telescope("tmt")
    centers, corners = system.segments.centers, system.segments.corners
    offset = np.array([[0.0, 0], [60, 0], [-60, 0], [0, 60], [0, -60]])
    x, y = (centers[:, None, :2] + offset).reshape(-1, 2).T
    rays = PupilRays(x, y, np.ones(len(x)), np.repeat(np.arange(492), 5))
    prepared = prepare(system, rays, WAVELENGTH, 11, figure_terms=3)
    radius = np.linalg.norm(corners - centers[:, None, :2], axis=2).max(axis=1)
    height = 1e-4
    states = states_of(prepared)
    states.segment_motion[1, :, 2] = height
    states.segment_figure[2, :, 0] = height
    states.segment_motion[3, :, 4] = -2 * height / radius
    states.segment_figure[4, :, 1] = height
    states.segment_motion[5, :, 3] = 2 * height / radius
    states.segment_figure[6, :, 2] = height
    phase = measure(prepared, states, device).segment_phase
    change = phase - phase[0]
    assert change[1, :, 0].min() > 1.9 * height / WAVELENGTH  # towards the sky shortens the path twice
    np.testing.assert_allclose(change[2, :, 0], change[1, :, 0], rtol=1e-5)
    for rigid, figure in ((3, 4), (5, 6)):
        size = np.hypot(*change[rigid, :, 1:].T)
        error = np.hypot(*(change[figure] - change[rigid])[:, 1:].T)
        assert (
            error / size
        ).max() < 0.07  # the figure lives in projected coordinates, 1 / cos(14 deg) at the rim


@pytest.mark.parametrize("wavelength", [0.0, -1.0, np.nan, np.inf])
def test_a_wavelength_must_be_positive(tmt18, wavelength):
    with pytest.raises(UserError, match="wavelength"):
        prepare(tmt18.system, tmt18.rays, wavelength, TERMS)


def test_rays_that_cannot_determine_the_wavefront_are_refused(tmt18):
    rays, system = tmt18.rays, tmt18.system

    def some(chosen):
        return PupilRays(rays.x[chosen], rays.y[chosen], rays.weight[chosen], rays.segment[chosen])

    with pytest.raises(UserError, match="no wavefront"):
        prepare(system, replace(rays, segment=np.full(len(rays.x), -1)), WAVELENGTH, TERMS)
    with pytest.raises(UserError, match="no wavefront"):
        prepare(system, some(slice(0, 0)), WAVELENGTH, TERMS)
    with pytest.raises(UserError, match="too few rays"):
        prepare(system, some(rays.segment != 3), WAVELENGTH, TERMS)
    with pytest.raises(UserError, match="at least 3"):
        prepare(system, rays, WAVELENGTH, 2)
    few = np.concatenate([np.flatnonzero(rays.segment == k)[:4] for k in range(18)])
    with pytest.raises(UserError, match="do not determine 91"):
        prepare(system, some(few), WAVELENGTH, 91)


def test_figures_must_fit(tmt18):
    with pytest.raises(UserError, match="segment figures"):
        trace_states(tmt18, replace(states_of(tmt18), segment_figure=np.zeros((TILE, 18, 4))), NUMPY)


@pytest.mark.parametrize("batch", [0, 5])
def test_a_batch_is_of_whole_tiles(tmt18, batch):
    with pytest.raises(UserError, match=r"it must be \(whole number of tiles of 16, 2\)"):
        measure(tmt18, rest_states(tmt18.system, batch), NUMPY)


def test_rms_and_peak_to_valley_about_the_plane_and_the_spot_against_a_direct_evaluation(tmt18):
    """Lane 3 loses every 7th ray, lane 5 all of them; planes by NumPy's least squares, ray by ray."""
    random = np.random.default_rng(20)
    states = rest_states(tmt18.system, TILE)
    states.segment_motion[..., 2:5] = random.normal(size=(TILE, 18, 3)) * np.array([5e-5, 2e-8, 2e-8])
    states.segment_motion[5] = np.nan
    traced = trace_states(tmt18, states, NUMPY)
    for values in (traced.opd, traced.x, traced.y):
        values[0, ::7, 3] = np.nan
    traced.status[0, ::7, 3] = 1
    wavefront = analyse(tmt18, traced, chief_rays(tmt18, states))
    design = np.stack([np.ones_like(tmt18.rays.x), tmt18.rays.x, tmt18.rays.y], axis=1)
    for lane in (0, 3, 9):
        kept = np.isfinite(traced.opd[0, :, lane])
        weight = tmt18.weight[kept] / tmt18.weight[kept].sum()
        root, waves = np.sqrt(weight)[:, None], traced.opd[0, kept, lane] / tmt18.wavelength
        plane = np.linalg.lstsq(root * design[kept], root[:, 0] * waves, rcond=1e-16)[0]
        flat = waves - design[kept] @ plane
        assert wavefront.pv[lane] == pytest.approx(np.ptp(flat), rel=1e-9)
        assert wavefront.rms_flat[lane] == pytest.approx(np.sqrt(weight @ flat**2), rel=1e-9)
        places = np.stack([traced.x[0, kept, lane], traced.y[0, kept, lane]])
        distance = places - (places @ weight)[:, None]
        assert wavefront.spot_rms[lane] == pytest.approx(
            np.sqrt(weight @ np.sum(distance**2, axis=0)), rel=1e-9
        )
    for values in (wavefront.pv, wavefront.rms_flat, wavefront.spot_rms):
        assert np.isnan(values[5])
