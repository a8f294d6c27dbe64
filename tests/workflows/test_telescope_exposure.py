"""Exposures of a telescope under four controllers: Störkle 2018, section 4.6, and what images are made of."""

import re

import numpy as np
import pytest

from wavequake.campaign.contract import DONE, RAISED
from wavequake.errors import UserError
from wavequake.kernels.device.devices import choose_device
from wavequake.kernels.device.tiles import TILE, from_tiles
from wavequake.optics.polynomials.zernike import annular_zernike
from wavequake.optics.segments.sensitivity import sensitivities
from wavequake.optics.systems.kinematics import rest_states
from wavequake.workflows.exposures import telescope_exposure as workflow
from wavequake.workflows.exposures.telescope_control import (
    CONTROLLERS,
    control_bench_of,
    controlled,
    figure_gains,
    trace,
)
from wavequake.workflows.segments import disturbance as segment_disturbance
from wavequake.workflows.study import load_study

STUDY = """
[study]
name = "small"
workflow = "telescope-exposure"
seed = 20180701
[telescope]
name = "tmt-18"
[optics]
sampling = "sunflower"
rays = 400
[wavefront]
zernike_terms = 15
[imaging]
pixels = 32
[[disturbance]]
name = "history"
model = "segment-history"
duration_s = 0.1
instants = 20
peak_nm = 70.0
[[disturbance]]
name = "mount"
model = "line-of-sight"
act = "mount"
instants = 12
duration_s = 60.0
[campaign]
device = "numpy"
cases = 4
"""
STATIC, DISTURBED, RIGID, ELASTIC = range(4)


@pytest.fixture(scope="module")
def text(tmp_path_factory):
    path = tmp_path_factory.mktemp("study") / "small.toml"
    path.write_text(STUDY)
    return load_study(path).identity_text()


@pytest.fixture(scope="module")
def result(text):
    found = workflow.KIND.compute(text, np.arange(2), "numpy")
    assert (found.status == DONE).all(), found.messages
    return found.arrays


def test_at_rest_all_images_are_the_static_one(result):
    for name in ("exposure_los_only", "exposure_gaussian"):
        np.testing.assert_allclose(result[name][0, STATIC], result["exposure"][0, STATIC], rtol=0, atol=1e-6)
    assert np.abs(result["los"][0, STATIC]).max() < 1e-6
    assert np.ptp(result["wfe_rms"][0, STATIC]) == 0.0


def test_a_rigid_m2_corrects_the_line_of_sight_only(result):
    """Störkle 2018, Fig. 4.43 and 4.44."""
    los, wfe = (np.abs(result[name][0]).max(axis=1) for name in ("los", "wfe_rms"))
    assert los[DISTURBED].max() > 1.0
    assert los[RIGID].max() < 1e-6 * los[DISTURBED].max()
    assert wfe[RIGID] == pytest.approx(wfe[DISTURBED], rel=1e-3)


def test_an_elastic_m2_corrects_line_of_sight_and_wavefront(result):
    los = np.abs(result["los"][0]).max(axis=(1, 2))
    assert los[ELASTIC] < 1e-4 * los[DISTURBED]
    np.testing.assert_allclose(result["wfe_rms"][0, ELASTIC], result["wfe_rms"][0, STATIC], rtol=0, atol=2e-2)
    assert result["wfe_rms"][0, DISTURBED].max() > 100.0


def test_what_the_fitted_terms_show_is_almost_the_static_image(result):
    """Störkle 2018, Fig. 4.45: the elastic M2 leads to a perfect result; segments keep what no term fits."""
    images = result["exposure_fitted"][0]
    off = [np.abs(image - images[STATIC]).max() for image in images]
    assert off[ELASTIC] < 1e-3
    assert min(off[DISTURBED], off[RIGID]) > 0.3
    peak = result["peak"][0]
    assert peak[DISTURBED] < peak[RIGID] < peak[ELASTIC] < 0.95 * peak[STATIC]


def test_m2_turns_as_the_matrix_of_sensitivities_says(text, result):
    """Eq. 4.24: about -a of image per rad about x along y, +a about y along x; 4.25 is its inverse."""
    control = control_bench_of(text)
    mm = result["los"][0, DISTURBED, :20] * control.prepared.focal_length * np.pi / 180 / 3600e3
    tilt = result["m2_tilt"][0, :20]
    gain = -np.linalg.lstsq(tilt, mm, rcond=None)[0].T
    np.testing.assert_allclose(-tilt @ gain.T, mm, rtol=0, atol=1e-9 * np.abs(mm).max())
    (xx, xy), (yx, yy) = gain
    assert np.abs([xx, yy]).max() < 1e-4 * abs(xy)
    assert xy == pytest.approx(-yx, rel=1e-4)
    assert abs(xy) == pytest.approx(85460, rel=0.03)  # that of the larger circular pupil


def test_gains_of_m2s_figure_are_the_sensitivities(text):
    """Those of `wavequake sensitivity`, which differ in step, batch and code; Störkle 2018, Eq. 4.26."""
    control = control_bench_of(text)
    mirrors = sensitivities(control.prepared, choose_device("numpy")).mirrors
    factor = control.prepared.numerical_aperture / (2 * control.prepared.wavelength)
    tilt = mirrors.los[0, 1:] * factor * np.hypot(1, control.prepared.system.pupil.obscuration)
    wanted = np.hstack([tilt, mirrors.zernike[0, 1:, 3:]]).T
    np.testing.assert_allclose(figure_gains(control), wanted, rtol=0, atol=1e-6 * np.abs(wanted).max())


def test_the_exposure_is_the_mean_of_sums_over_rays(text, result):
    """Fields of all rays at the detector's points, the motion of the image in their phases."""
    control = control_bench_of(text)
    drawn = workflow.scaled_draw(control, 0)
    device, prepared = choose_device("numpy"), control.prepared
    axis = (np.arange(32) - 16) * 0.25
    at = 2 * np.pi * axis / control.diameter
    along_x, along_y = (np.exp(-1j * np.outer(at, values)) for values in (prepared.rays.x, prepared.rays.y))
    static = control.static.los[0]
    for place, name in ((DISTURBED, "disturbed"), (ELASTIC, "elastic")):
        images = []
        for count, states, measured in workflow._disturbed(control, drawn, device):
            traced, wave = trace(prepared, controlled(control, name, states, measured), device)
            tilt = (
                (wave.chief - static) / prepared.focal_length @ np.stack([prepared.rays.x, prepared.rays.y])
            )
            phase = 2 * np.pi / prepared.wavelength * (tilt - from_tiles(traced.opd))
            field = np.einsum(
                "yr,xr,tr->tyx", along_y, along_x, prepared.weight * np.exp(1j * phase), optimize=True
            )
            images.append(np.abs(field[:count]) ** 2)
        np.testing.assert_allclose(
            result["exposure"][0, place], np.concatenate(images).mean(axis=0), rtol=0, atol=2e-4
        )


def test_a_moving_mount_does_what_the_shortcut_says(result):
    """Only the pointing moves, so that convolution with the trajectory is right; a Gaussian is not."""
    error = result["image_error"][1, DISTURBED]
    assert error[0] < 1e-3
    assert error[1] > 20 * error[0]


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ([], None),
        (
            ["imaging.pixels=64"],
            "400 rays stand 23 across the pupil, but its phase and images of 32 lambda/D",
        ),
        (["exposure.scale=500"], "or fewer imaging.pixels or a smaller exposure.scale"),
    ],
)
def test_too_few_rays_for_an_image_are_named_with_the_number_needed(tmp_path, keys, words):
    path = tmp_path / "few.toml"
    path.write_text(STUDY)
    said = list(workflow.KIND.notices(load_study(path, ["imaging.pixels=16", *keys]).identity_text()))
    assert bool(said) == (words is not None)
    if words is not None:
        assert words in said[0]
        enough = re.search(r"take (\d+) rays", said[0]).group(1)
        if int(enough) < 4000:
            mended = load_study(path, ["imaging.pixels=16", *keys, f"optics.rays={int(1.05 * int(enough))}"])
            assert not list(workflow.KIND.notices(mended.identity_text()))


def test_a_case_does_not_depend_on_its_chunk(text, result):
    alone = workflow.KIND.compute(text, np.array([1]), "numpy").arrays
    for name, values in alone.items():
        np.testing.assert_array_equal(values[0], result[name][1], err_msg=name)


def test_times_beyond_a_population_are_unknown(result):
    assert np.isnan(result["time_s"][1, 12:]).all()
    assert np.isnan(result["los"][1, :, 12:]).all()
    assert np.isfinite(result["los"][1, :, :12]).all()


def test_template_describes_what_is_computed(text, result):
    template = workflow.KIND.template(text)
    assert {name: values.shape[1:] for name, values in result.items()} == {
        name: variable.shape for name, variable in template.per_case.items()
    }
    assert tuple(template.fixed["controller"][1]) == CONTROLLERS


def test_a_case_without_light_is_quarantined(tmp_path):
    path = tmp_path / "wild.toml"
    path.write_text(STUDY)
    study = load_study(path, ["exposure.scale=1e6", "disturbance.history.peak_nm=1e8"])
    found = workflow.KIND.compute(study.identity_text(), np.array([0, 1]), "numpy")
    assert found.status[0] == RAISED
    assert "rays are lost" in found.messages[0]
    assert np.isnan(found.arrays["exposure"][0]).all()


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("exposure.figure_terms=20", "more than wavefront.zernike_terms"),
        ("wavefront.method='slopes'", "need wavefront.method"),
        ("exposure.scale=0.0", "exposure.scale"),
    ],
)
def test_studies_that_cannot_work(tmp_path, override, words):
    path = tmp_path / "bad.toml"
    path.write_text(STUDY)
    with pytest.raises(UserError, match=words):
        load_study(path, [override])


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({}, None),
        ({"imaging.pixels": 256}, r"1296 rays stand 46 across .* images of 128 lambda/D .* need 128"),
        ({"imaging.pixels": 256, "imaging.enabled": False}, None),
    ],
)
def test_sums_over_rays_of_figured_segments_name_the_rays_they_need(keys, words):
    """18 segments of 72 rays each fill 0.61 of the squared diameter: 1296 / 0.61 = 46²."""
    said = list(segment_disturbance.KIND.notices(load_study("jwst-segments", keys).identity_text()))
    assert len(said) == (words is not None)
    for sentence in said:
        assert re.search(words, sentence)
        enough = int(re.search(r"take (\d+) rays .*, or fewer imaging.pixels$", sentence).group(1))
        assert enough == pytest.approx(128**2 * 1296 / 46.0574**2, rel=1e-3)


FINER = ["exposure.scale=1.0", "optics.rays=1200", "wavefront.zernike_terms=66"]


@pytest.fixture(scope="module")
def figured(tmp_path_factory):
    """The same telescope, whose segments may deform; unscaled."""
    path = tmp_path_factory.mktemp("figured") / "figured.toml"
    path.write_text(STUDY + '[[disturbance]]\nname="bent"\nmodel="static-random"\nfigure_nm={4 = 1.0}\n')
    return control_bench_of(load_study(path, FINER).identity_text())


def test_m2_takes_the_fitted_terms_of_a_deformed_segment_away_but_not_its_edges(figured):
    """Störkle 2018, Fig. 4.46, where all of it is eliminated: a few terms of M2 are too smooth for that."""
    device, prepared = choose_device("numpy"), figured.prepared
    states = _at_rest(figured)
    flat = from_tiles(trace(prepared, states, device)[0].opd)[0]
    states.segment_figure[:, 5, 3] = 35e-6  # mm rms of defocus
    bent, measured = trace(prepared, states, device)
    mended, left = trace(prepared, controlled(figured, "elastic", states, measured), device)
    change = [np.abs(one.zernike[0, 3:] - figured.static.zernike[0, 3:]).max() for one in (measured, left)]
    assert change[0] > 0.003  # waves
    assert change[1] < 1e-3 * change[0]
    rays, root = prepared.rays, np.sqrt(prepared.weight / prepared.weight.sum())
    plane = np.column_stack([np.ones_like(rays.x), rays.x / 15e3, rays.y / 15e3]) * root[:, None]
    over_rays = [
        np.sqrt(np.linalg.lstsq(plane, root * (from_tiles(one.opd)[0] - flat))[1][0])
        for one in (bent, mended)
    ]
    assert 12e-6 < over_rays[0] < 20e-6  # mm
    assert 0.5 < over_rays[1] / over_rays[0] < 1.0


def test_m2_is_bent_contrary_to_the_segments_by_as_much(figured):
    """Störkle 2018, Fig. 4.42."""
    states = _at_rest(figured)
    pistons = np.random.default_rng(1).uniform(-70e-6, 70e-6, len(figured.bench.system.segments))
    states.segment_motion[:, :, 2] = pistons
    measured = trace(figured.prepared, states, choose_device("numpy"))[1]
    figure = controlled(figured, "elastic", states, measured).deformations[2][0]
    rays, outer = figured.prepared.rays, figured.bench.system.annulus.outer
    shape = annular_zernike(rays.x / outer, rays.y / outer, len(figure), 0.0) @ figure
    assert np.corrcoef(shape, pistons[rays.segment])[0, 1] < -0.7
    assert 0.5 < np.std(shape) / np.std(pistons[rays.segment]) < 2.0


def _at_rest(control):
    return rest_states(control.prepared.system, TILE)
