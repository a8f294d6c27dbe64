"""The workflow as a whole, on the 18-segment telescope: what is drawn must come out of the optics."""
# ruff: noqa: F811  fixtures are arguments

import numpy as np
import pytest
from small_telescope import DEVICE, chunk, only_pistons, study, text  # noqa: F401

from wavequake.campaign.contract import DONE, RAISED
from wavequake.chain.sampling import slot
from wavequake.errors import UserError
from wavequake.kernels.device.devices import choose_device
from wavequake.mechanics.disturbances.sources.edge_sensors import EdgeSensorNoise
from wavequake.optics.polynomials.zernike import annular_zernike
from wavequake.optics.segments.prepared import trace_states
from wavequake.workflows.segments import disturbance as workflow
from wavequake.workflows.segments.bench import bench_of
from wavequake.workflows.segments.images import energy_scale
from wavequake.workflows.segments.launches import surface_states
from wavequake.workflows.study import study_with


def rows(text, name, count=12):
    return np.flatnonzero(workflow.KIND.case_table(text, 0, count)["disturbance"] == name)


def test_the_pattern_of_populations_is_stable_and_pairs_realizations(study):
    slots = [slot(study.disturbance, case) for case in range(60)]
    names = [population.name for population, _ in slots]
    assert names[:6] == ["pistons", "pistons", "mount", "m2", "figure", "both"]
    for name in set(names):
        realizations = [realization for population, realization in slots if population.name == name]
        assert realizations == list(range(len(realizations)))
    assert names.count("pistons") == 2 * names.count("m2")


def test_every_case_is_done_and_finite_over_its_own_instants(study, chunk):
    assert (chunk.status == DONE).all()
    for case in range(12):
        population, _ = slot(study.disturbance, case)
        for name in ("wfe_rms", "wfe_rms_raw", "strehl", "los", "zernike", "time_s"):
            values = chunk.arrays[name][case]
            assert np.isfinite(values[: population.instants]).all()
            assert np.isnan(values[population.instants :]).all()
    assert np.isfinite(chunk.arrays["exposure"]).all()


@pytest.mark.parametrize("name", ["mount", "m2"])
def test_the_line_of_sight_is_the_one_that_was_drawn(text, chunk, name):
    """The optics know nothing of spectra: f, M2's pose and the fit must give the drawn angle back."""
    bench = bench_of(text)
    for row in rows(text, name):
        motion = workflow.draw(bench, int(row)).motion
        asked = (motion.mount + motion.m2) * 180 / np.pi * 3600e3
        assert np.abs(asked).max() > 1.0
        got = chunk.arrays["los"][row, : len(asked)]
        np.testing.assert_allclose(got, asked, rtol=2e-3, atol=1e-4)


def test_the_image_goes_where_the_line_of_sight_goes(text, chunk):
    """Mean of the exposure's own centroid against the mean line of sight, both on the sky: sign and scale."""
    bench = bench_of(text)
    axis = workflow.KIND.template(text).fixed["x"][1]
    unit = (
        bench.prepared.wavelength / (2 * bench.system.annulus.outer) * 180 / np.pi * 3600e3
    )  # lambda/D in mas
    for row in rows(text, "mount"):
        exposure = chunk.arrays["exposure"][row]
        mean = np.nanmean(chunk.arrays["los"][row], axis=0) / unit
        if np.abs(np.nanmax(np.abs(chunk.arrays["los"][row]))) / unit > 3.0:
            continue  # partly beyond the frame
        centroid = np.array([exposure.sum(axis=0) @ axis, exposure.sum(axis=1) @ axis]) / exposure.sum()
        np.testing.assert_allclose(centroid, mean, rtol=0, atol=0.15)


def test_strehl_of_pistons_and_tilts_is_the_exposures_peak(study, text, chunk):
    """Two codes: ray sums about the best-fit plane, and polygon transforms on a grid of 0.05 lambda/D."""
    fine = study_with(study, {"imaging.sampling": 0.05}).identity_text()
    result = workflow.KIND.compute(fine, rows(text, "pistons"), DEVICE)
    strehl = result.arrays["strehl"][:, 0]
    assert ((strehl > 0.5) & (strehl < 0.95)).all()
    np.testing.assert_allclose(result.arrays["exposure"].max(axis=(1, 2)), strehl, rtol=5e-3)


def test_small_aberrations_follow_marechal(text, chunk):
    """Strehl = exp(-(2 pi sigma/lambda)^2) for small sigma, sigma about the best-fit plane."""
    for row in rows(text, "figure"):
        sigma = chunk.arrays["wfe_rms_raw"][row, 0]
        assert chunk.arrays["strehl"][row, 0] == pytest.approx(
            np.exp(-((2 * np.pi * sigma / 550.0) ** 2)), abs=0.02
        )


def test_verdicts_are_those_of_the_stored_peak_to_valley_and_of_the_opds_themselves(study, text):
    """Enough instants for two launches; the rms is that of the residuals of a least-squares plane."""
    many = study_with(study, {"disturbance.mount.instants": 600, "disturbance.pistons.piston_nm": 12.0})
    many = many.identity_text()
    bench, cases = bench_of(many), np.arange(4)
    arrays = workflow.KIND.compute(many, cases, DEVICE).arrays
    rays, weight = bench.prepared.rays, bench.prepared.weight
    design = np.stack([np.ones_like(rays.x), rays.x / 1e4, rays.y / 1e4], axis=1)
    for case in (0, 1, 2):
        meets = arrays["wfe_pv"][case] <= 550.0 / 4
        instants = np.count_nonzero(np.isfinite(arrays["time_s"][case]))
        assert arrays["rayleigh"][case] == np.count_nonzero(meets) / instants
    for case in (0, 1):
        states = surface_states(bench, workflow.draw(bench, case), 0, 3)
        opd = trace_states(bench.prepared, states, choose_device("numpy")).opd[0, :, :3]
        root = np.sqrt(weight)[:, None]
        left = opd - design @ np.linalg.lstsq(root * design, root * opd, rcond=None)[0]
        rms = np.sqrt(weight @ left**2) / bench.prepared.wavelength
        assert (np.abs(rms * 14 - 1) > 1e-3).all()
        assert arrays["marechal"][case] == np.mean(rms <= 1 / 14)
    assert arrays["marechal"][2] == arrays["rayleigh"][2] == 1.0  # a telescope that only points elsewhere


def test_spots_are_those_of_the_rays_on_the_sky(study):
    """Segments that tilt by 50 nrad turn their rays by twice that, against 1 mas of aberration at rest."""
    tilted = study_with(study, {"disturbance.pistons.tip_nrad": 50.0, "disturbance.pistons.tilt_nrad": 50.0})
    text, row = tilted.identity_text(), 0
    motion = workflow.draw(bench_of(text), row).motion.segment_motion[0]
    tilts = 2.0 * (motion[:, 3:5] - motion[:, 3:5].mean(axis=0)) * 180 / np.pi * 3600e3
    expected = np.sqrt(np.mean(np.sum(tilts**2, axis=1)))
    chunk = workflow.KIND.compute(text, np.array([row]), DEVICE)
    assert chunk.arrays["spot_rms"][0, 0] == pytest.approx(expected, rel=0.05)


@pytest.mark.parametrize("name", ["mount", "m2"])
def test_slopes_and_path_lengths_give_the_same_results_where_no_segment_moves(study, text, chunk, name):
    """Measured: 2e-3 nm of coefficients and 2e-4 mas; piston alone is unknown to slopes."""
    slopes = study_with(study, {"wavefront.method": "slopes", "wavefront.zernike_terms": 66})
    paths = study_with(study, {"wavefront.zernike_terms": 66})
    assert slopes.identity() != paths.identity()
    cases = rows(text, name)[:1]
    one, other = (
        workflow.KIND.compute(each.identity_text(), cases, DEVICE).arrays for each in (slopes, paths)
    )
    count = np.count_nonzero(np.isfinite(other["time_s"][0]))
    assert np.isnan(one["zernike"][0, :, 0]).all()
    kept = [workflow.KIND.template(each.identity_text()).per_case["zernike"] for each in (slopes, paths)]
    assert [each.unknown for each in kept] == [1, 0]  # else each case would count as diverged
    assert np.abs(other["los"][0, :count]).max() > 1.0
    np.testing.assert_allclose(
        one["zernike"][0, :count, 1:], other["zernike"][0, :count, 1:], rtol=0, atol=0.02
    )
    np.testing.assert_allclose(one["los"][0, :count], other["los"][0, :count], rtol=0, atol=2e-3)
    # M2's drawn tilt is that of the line of sight, so it is not the same to the last bit.
    np.testing.assert_allclose(one["wfe_rms_raw"], other["wfe_rms_raw"], rtol=1e-6)


def test_slopes_do_not_see_the_pistons_of_segments(study, text):
    flat = {"disturbance.pistons.tip_nrad": 0.0, "disturbance.pistons.tilt_nrad": 0.0}
    moved = study_with(study, {"wavefront.method": "slopes", **flat}).identity_text()
    arrays = workflow.KIND.compute(moved, np.array([0]), DEVICE).arrays
    still = bench_of(moved).static.rms[0] * 550.0
    # Along a segment's normal is not along the axis: 20 nm sideways turn the parabola's normal a little.
    np.testing.assert_allclose(arrays["wfe_rms"][0, :3], still, rtol=0, atol=0.2)
    assert arrays["wfe_rms_raw"][0, 0] > still + 10.0


def test_circular_coefficients_are_those_of_a_direct_fit_of_circular_polynomials(study, text, chunk):
    circular = study_with(study, {"wavefront.basis": "circular"})
    row = rows(text, "figure")[0]
    found = workflow.KIND.compute(circular.identity_text(), np.array([row]), DEVICE).arrays
    bench = bench_of(text)
    states = surface_states(bench, workflow.draw(bench, int(row)), 0, 1)
    opd = trace_states(bench.prepared, states, choose_device("numpy")).opd[0, :, 0]
    rays, root = bench.prepared.rays, np.sqrt(bench.prepared.weight)
    outer = bench.system.annulus.outer
    polynomials = annular_zernike(rays.x / outer, rays.y / outer, 45, 0.0)
    expected = np.linalg.lstsq(root[:, None] * polynomials, root * opd * 1e6, rcond=None)[0]
    np.testing.assert_allclose(found["zernike"][0, 0], expected, rtol=0, atol=1e-6 * np.abs(expected).max())
    assert np.abs(found["zernike"] - chunk.arrays["zernike"][row])[0, 0].max() > 1.0
    for name in ("wfe_rms", "los", "strehl"):
        np.testing.assert_array_equal(found[name][0], chunk.arrays[name][row], err_msg=name)


def test_the_fitted_reference_moves_the_tilt_into_the_image_point(study, text, chunk):
    """The line of sight is that of Eq. 3.39 but for the polynomials' tilt, which a ragged pupil mixes."""
    fitted = study_with(study, {"wavefront.reference": "fitted"}).identity_text()
    row = rows(text, "m2")[0]
    found = workflow.KIND.compute(fitted, np.array([row]), DEVICE).arrays
    count = np.count_nonzero(np.isfinite(found["time_s"][0]))
    los = chunk.arrays["los"][row, :count]
    np.testing.assert_allclose(found["los"][0, :count], los, rtol=0, atol=2e-3 * np.abs(los).max())
    np.testing.assert_allclose(found["strehl"][0], chunk.arrays["strehl"][row], rtol=1e-6)
    np.testing.assert_allclose(found["exposure"][0], chunk.arrays["exposure"][row], rtol=0, atol=1e-4)


def test_slopes_about_a_fitted_sphere_are_refused(study):
    with pytest.raises(UserError, match="reference = 'fitted' needs path lengths"):
        study_with(study, {"wavefront.method": "slopes", "wavefront.reference": "fitted"})


def test_a_figure_dims_the_image_as_it_lowers_the_strehl_ratio(study, text):
    """Strehl by the rays' OPD; the image by another sum, on a grid fine enough to hold the peak."""
    keys = {"imaging.sampling": 0.05, "disturbance.figure.figure_nm": {4: 25.0}}
    result = workflow.KIND.compute(study_with(study, keys).identity_text(), rows(text, "figure"), DEVICE)
    assert (result.arrays["strehl"][:, 0] < 0.9).all()
    np.testing.assert_allclose(
        result.arrays["exposure"].max(axis=(1, 2)), result.arrays["strehl"][:, 0], rtol=5e-3
    )


def test_images_by_rays_and_by_polygons_agree(study, text):
    """Pistons and tilts of the same draws: sums over 72 rays per segment against exact polygon transforms."""
    figured = study_with(study, {"optics.rays_per_segment": 72})
    polygons = only_pistons(figured)
    cases = rows(text, "pistons")
    exact = workflow.KIND.compute(polygons.identity_text(), np.array([0, 1]), DEVICE).arrays["exposure"]
    rays = workflow.KIND.compute(figured.identity_text(), cases[:2], DEVICE).arrays["exposure"]
    np.testing.assert_allclose(rays, exact, rtol=0, atol=1e-3)


def test_what_no_case_can_succeed_in_is_refused_before_a_store_is_made(study):
    off_axis = only_pistons(study_with(study, {"optics.field_arcmin": [3.0, 0.0]}))
    with pytest.raises(UserError, match=r"tmt-18 at rest is too far from focus .* optics.field_arcmin"):
        workflow.KIND.check(off_axis.identity_text())
    workflow.KIND.check(study.identity_text())
    one_piece = study_with(
        study, {"telescope.name": "tmt-thesis", "telescope.gap_mm": None, "optics.rays": 500}
    )
    noisy = one_piece.model_copy(update={"disturbance": (EdgeSensorNoise(name="noise"),)})
    with pytest.raises(UserError, match="edge"):
        workflow.KIND.check(noisy.identity_text())


def test_more_zernike_terms_than_the_glass_can_tell_apart_are_refused(study):
    with pytest.raises(
        UserError, match=r"231 Zernike terms are too many for the glass .* wavefront.zernike_terms"
    ):
        bench_of(study_with(study, {"wavefront.zernike_terms": 231}).identity_text())


def test_figure_is_seen_twice_on_reflection(text, chunk):
    """A surface of rms s makes a wavefront of rms 2 s; figures are over circumscribed circles."""
    row = rows(text, "figure")[0]
    figure = workflow.draw(bench_of(text), int(row)).motion.segment_figure * 1e9
    raw = chunk.arrays["wfe_rms_raw"][row, 0]
    assert 0.5 < raw / (2 * np.sqrt(np.mean(np.sum(figure**2, axis=1)))) < 1.2


def test_a_combination_is_the_sum_of_its_parts(text):
    bench = bench_of(text)
    both, pistons, figure = (
        workflow.draw(bench, int(rows(text, name)[0])).motion for name in ("both", "pistons", "figure")
    )
    np.testing.assert_array_equal(both.segment_motion[0], pistons.segment_motion[0])
    np.testing.assert_array_equal(both.segment_figure, figure.segment_figure)


def test_exposure_holds_the_light(text, chunk):
    """Parseval: what the frame holds of the light through the pupil is most of it and never more than all."""
    scale = energy_scale(bench_of(text))
    total = (
        chunk.arrays["exposure"].sum(axis=(1, 2))
        * scale["sampling"] ** 2
        * scale["area"]
        / scale["diameter"] ** 2
    )
    assert (total < 1.0).all()
    assert (total[rows(text, "pistons")] > 0.7).all()


def test_a_segment_that_leaves_the_beam_quarantines_its_case_with_the_reason(study):
    far = study_with(study, {"disturbance.pistons.in_plane_um": 4e6}).identity_text()
    result = workflow.KIND.compute(far, np.array([0, 2]), DEVICE)
    assert list(result.status) == [RAISED, DONE]
    assert "lost all its rays at instant 0" in result.messages[0]
    assert result.messages[1] == ""
    assert np.isnan(result.arrays["wfe_rms"][0]).all()
    assert np.isfinite(result.arrays["wfe_rms"][1]).any()


def test_tilts_beyond_imaging_quarantine_their_case_alone(study):
    steep = only_pistons(study_with(study, {"disturbance.pistons.tip_nrad": 3e3, "imaging.moments": 1}))
    result = workflow.KIND.compute(steep.identity_text(), np.array([0, 1]), DEVICE)
    assert result.status[0] == RAISED
    assert "moments" in result.messages[0]


def test_kept_motion_is_the_motion_that_was_drawn(study):
    text = study_with(study, {"store.keep": ["segment_motion"]}).identity_text()
    result = workflow.KIND.compute(text, np.array([0]), DEVICE)
    drawn = workflow.draw(bench_of(text), 0).motion.segment_motion
    np.testing.assert_array_equal(result.arrays["segment_motion"][0, : len(drawn)], drawn)
    assert "dof" in workflow.KIND.template(text).fixed
    rms = np.sqrt(np.mean(result.arrays["segment_motion"][0, : len(drawn), :, 2] ** 2, axis=1))
    np.testing.assert_allclose(result.arrays["segment_piston_rms"][0, : len(drawn)], rms * 1e9, rtol=1e-12)


@pytest.mark.parametrize(("arcmin", "looks"), [(0.0, False), (0.05, False), (2.0, True), (5.0, True)])
def test_edges_are_looked_at_where_the_beam_may_reach_them(study, arcmin, looks):
    """On the axis M2 of the TMT is 3.6 % wider than the beam of 1459.6 mm; 10 arcmin reach its edge."""
    aside = study_with(study, {"optics.field_arcmin": [arcmin, 0.0]})
    bench = bench_of(aside.identity_text())
    assert (bench.prepared.train.semi_diameters is not None) == looks
    assert bench.static.vignetted[0] == 0
