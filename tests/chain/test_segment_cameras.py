"""Colors, planes through focus, detectors and sharpness of segmented telescopes."""

import numpy as np
import pytest

import wavequake as wq
from wavequake.errors import UserError
from wavequake.kernels.device.devices import NUMPY
from wavequake.optics.segments.prepared import chief_rays, trace_states
from wavequake.optics.segments.wavefront import analyse
from wavequake.report.segments.fields import base_name, by_field
from wavequake.workflows.budgets.budget import summed
from wavequake.workflows.budgets.segments import experiment
from wavequake.workflows.kinds import find_kind
from wavequake.workflows.rare import rare_study
from wavequake.workflows.segments.bench import bench_of
from wavequake.workflows.segments.control import modal_numbers, modal_partner
from wavequake.workflows.segments.disturbance import draw
from wavequake.workflows.segments.images import summed_images
from wavequake.workflows.segments.launches import surface_states
from wavequake.workflows.study import load_study

KIND = find_kind("segment-disturbance")
STUDY = """
[study]
name = "cameras"
workflow = "segment-disturbance"
[telescope]
name = "tmt-18"
[[disturbance]]
name = "alignment"
model = "static-random"
piston_nm = 60.0
tip_nrad = 20.0
tilt_nrad = 20.0
[optics]
wavelength_nm = 1000.0
[imaging]
pixels = 24
sampling = 0.2
[campaign]
cases = 2
"""


@pytest.fixture
def study_of(tmp_path):
    def load(**keys):
        file = tmp_path / "study.toml"
        file.write_text(STUDY)
        return load_study(file, {name.replace("__", "."): value for name, value in keys.items()})

    return load


def fourier_sum(bench, case, wavelength_nm, axis, plane_um=0.0):
    """Image as a sum of the plane waves of rays, about the line of sight at rest; the phase is -OPD."""
    drawn = draw(bench, case)
    traced = trace_states(bench.prepared, surface_states(bench, drawn, 0, 1), NUMPY)
    wavefront = analyse(
        bench.prepared, traced, chief_rays(bench.prepared, surface_states(bench, drawn, 0, 1))
    )
    prepared = bench.prepared
    opd = np.asarray(traced.opd)[0, :, 0]  # mm
    x, y, weight = prepared.rays.x, prepared.rays.y, prepared.weight
    slope = (wavefront.chief[0] - bench.static.chief[0]) / prepared.focal_length
    opd = opd - slope[0] * x - slope[1] * y
    defocus = plane_um * 1e-3 * (np.sqrt(1.0 - (x**2 + y**2) / prepared.focal_length**2) - 1.0)
    k = 2.0 * np.pi / (wavelength_nm * 1e-6)
    # lambda/D of the study's wavelength in rad on the sky
    unit = bench.study.optics.wavelength_nm * 1e-6 / (2.0 * bench.system.annulus.outer)
    ahead = weight * np.exp(1j * k * (defocus - opd))
    field = (np.exp(-1j * k * unit * np.outer(axis, y)) * ahead) @ np.exp(-1j * k * unit * np.outer(x, axis))
    return np.abs(field) ** 2 / weight.sum() ** 2


def test_colors_add_as_in_a_fourier_sum(study_of):
    colors, light = (1000.0, 800.0, 1300.0), np.array([1.0, 0.5, 2.0])
    study = study_of(
        imaging__wavelengths_nm=list(colors),
        imaging__weights=light.tolist(),
        imaging__focus_um=[800.0],
        optics__rays_per_segment=72,
    )
    text = study.identity_text()
    arrays = KIND.compute(text, np.array([0]), "numpy").arrays
    found, behind = arrays["exposure"][0], arrays["exposure_focus"][0, 0]
    axis, bright = (np.arange(24) - 12) * 0.2, light / np.array(colors) ** 2
    bench = bench_of(text)
    each = [fourier_sum(bench, 0, color, axis) for color in colors]
    expected = np.tensordot(bright / bright.sum(), each, 1)
    assert np.abs(found - expected).max() < 3e-3 * expected.max()
    assert np.abs(each[0] - expected).max() > 0.02 * expected.max()
    each = [fourier_sum(bench, 0, color, axis, 800.0) for color in colors]
    expected = np.tensordot(bright / bright.sum(), each, 1)
    assert np.abs(behind - expected).max() < 1e-4
    assert np.abs(each[0] - expected).max() > 0.02 * expected.max()


def test_several_wavelengths_have_numbers_and_images_of_their_own(study_of):
    """Each image is a sum of plane waves at its wavelength; lambda/D is that of the first one."""
    colors = (1000.0, 800.0, 1300.0)
    keys = {"optics__rays_per_segment": 72, "imaging__focus_um": [800.0], "wavefront__zernike_terms": 15}
    study = study_of(optics__wavelengths_nm=list(colors), **keys)
    text = study.identity_text()
    assert '"wavelength_nm"' not in text
    template, found = KIND.template(text), KIND.compute(text, np.array([0]), "numpy").arrays
    assert template.per_case["zernike"].dims == ("time", "wavelength", "noll")
    assert template.per_case["exposure"].dims == ("wavelength", "y", "x")
    np.testing.assert_array_equal(template.fixed["wavelength"][1], colors)
    bench, axis = bench_of(text), (np.arange(24) - 12) * 0.2
    for place, color in enumerate(colors):
        for name, plane, most in (("exposure", 0.0, 3e-3), ("exposure_focus", 800.0, 1e-4)):
            expected = fourier_sum(bench, 0, color, axis, plane)
            image = found[name][0, place] if not plane else found[name][0, place, 0]
            assert np.abs(image - expected).max() < most * (1.0 if plane else expected.max())
        alone = study_of(optics__wavelength_nm=color, imaging__sampling=0.2 * 1000.0 / color, **keys)
        own = KIND.compute(alone.identity_text(), np.array([0]), "numpy").arrays
        for name in ("wfe_rms", "zernike", "los", "strehl", "rayleigh"):
            axis_of = template.per_case[name].dims.index("wavelength") + 1
            np.testing.assert_array_equal(np.take(found[name], place, axis_of), own[name], err_msg=name)
        np.testing.assert_allclose(found["peak"][0, place], own["peak"][0], rtol=2e-6)
        # Radii are read off a table in units of their own.
        np.testing.assert_allclose(found["ee50"][0, place], own["ee50"][0] * color / 1000.0, rtol=1e-3)
    assert np.ptp(found["wfe_rms"]) < 1e-9 * found["wfe_rms"].max()  # mirrors have no colors
    assert found["strehl"][0, 0, 1] < found["strehl"][0, 0, 0] - 0.05 < found["strehl"][0, 0, 2] - 0.1


def test_streaks_detectors_and_objects_share_the_frame_of_all_wavelengths(study_of):
    """What a second wavelength shows is what it shows as the one color of the study of the first."""
    keys = {
        "detector__pixel_um": 6.0,
        "detector__photons": 1e6,
        "object__slit": 1.0,
        "disturbance.alignment.instants": 2,
    }
    both = study_of(optics__wavelengths_nm=[1000.0, 800.0], **keys)
    one = study_of(optics__wavelength_nm=1000.0, imaging__wavelengths_nm=[800.0], **keys)
    found, expected = (
        KIND.compute(each.identity_text(), np.array([1]), "numpy").arrays for each in (both, one)
    )
    np.testing.assert_allclose(found["exposure"][:, 1], expected["exposure"], atol=2e-6)
    np.testing.assert_allclose(found["object_image"][:, 1], expected["object_image"], atol=2e-6)
    np.testing.assert_allclose(found["ee80"][:, 1], expected["ee80"], rtol=1e-4)
    assert found["counts"].shape == (1, 2, *expected["counts"].shape[1:])
    assert (found["counts"][0, 1] != expected["counts"][0]).any()  # each place has noise of its own
    assert found["counts"][0, 1].sum() == pytest.approx(expected["counts"][0].sum(), rel=0.01)


def test_a_store_of_fields_and_wavelengths_has_a_row_for_each(study_of, tmp_path):
    study = study_of(
        optics__wavelengths_nm=[1000.0, 800.0],
        optics__fields_arcmin=[[0.0, 0.0], [0.1, 0.0]],
        imaging__pixels=16,
    )
    data = wq.run(study, store=tmp_path / "store", campaign__device="numpy").load()
    assert data.los.dims == ("case", "time", "field", "wavelength", "axis")
    assert data.zernike_static.dims == ("field", "wavelength", "noll")
    np.testing.assert_allclose(data.zernike_static[:, 0], data.zernike_static[:, 1], atol=1e-6)
    names = by_field(data)["disturbance"].to_numpy().tolist()
    assert names[::2] == [
        f"alignment at ({x:g}, 0) arcmin, {color} nm" for x in (0.0, 0.1) for color in (1000, 800)
    ]
    assert {base_name(name) for name in names} == {"alignment"}
    assert base_name("alignment at 800 nm") == base_name("alignment at (0, 0) arcmin") == "alignment"
    page = wq.report(tmp_path / "store").read_text()
    assert all(name in page for name in names)
    wq.compare(tmp_path / "store", tmp_path / "store")
    assert wq.view(tmp_path / "store", file=tmp_path / "view.html").exists()
    table = wq.export(tmp_path / "store", tmp_path / "store.csv").read_text()
    assert "strehl" in table


def test_a_color_alone_is_the_study_at_that_wavelength(study_of):
    alone = study_of(optics__wavelength_nm=800.0, imaging__sampling=0.25)
    one = study_of(imaging__wavelengths_nm=[800.0])
    single, colored = (
        KIND.compute(each.identity_text(), np.array([0]), "numpy").arrays for each in (alone, one)
    )
    np.testing.assert_allclose(colored["exposure"], single["exposure"], atol=2e-6)
    np.testing.assert_allclose(colored["peak"], single["peak"], atol=2e-6)
    np.testing.assert_allclose(colored["ee50"], 0.8 * single["ee50"], rtol=1e-4)
    np.testing.assert_array_equal(colored["wfe_rms"], single["wfe_rms"])


def test_the_engine_can_be_set_and_stands_in_the_store(study_of):
    """Sums over many rays are near the exact images, and not they."""
    images = {}
    for engine, said in (("auto", "segments"), ("segments", "segments"), ("rays", "rays")):
        text = study_of(imaging__engine=engine, optics__rays_per_segment=72).identity_text()
        assert KIND.template(text).per_case["exposure"].attrs["engine"] == said
        images[engine] = KIND.compute(text, np.arange(1), "numpy").arrays["exposure"][0]
    np.testing.assert_array_equal(images["segments"], images["auto"])
    assert 1e-9 < np.abs(images["rays"] - images["auto"]).max() < 3e-3
    assert study_of().identity_text() == study_of(imaging__engine="auto").identity_text()
    study = study_of(imaging__engine="segments", disturbance__alignment__figure_nm={"5": 1.0})
    with pytest.raises(UserError, match="'segments' has no exact images, as segments bend; take 'rays'"):
        KIND.check(study.identity_text())


def test_planes_behind_the_image_are_those_of_a_moved_image(study_of):
    """The detector is moved along the light and traced, its wavefront imaged by the same rays."""
    behind = 1500.0
    bench = bench_of(study_of(imaging__focus_um=[behind], optics__rays_per_segment=72).identity_text())
    drawn = draw(bench, 0)
    states = surface_states(bench, drawn, 0, 1)
    focus, last = bench.system.surfaces[-1], bench.system.surfaces[-2]
    along = focus.position - last.position

    def seen(states, plane):
        traced = trace_states(bench.prepared, states, NUMPY)
        wavefront = analyse(bench.prepared, traced, chief_rays(bench.prepared, states))
        return summed_images(bench, traced, wavefront, slice(0, 1), plane)

    found, sharp = seen(states, behind), seen(states, 0.0)
    axis = (np.arange(24) - 12) * 0.2
    summed = fourier_sum(bench, 0, 1000.0, axis, behind)
    assert np.abs(found - summed).max() < 1e-4
    ahead = focus.rotation.T @ along / np.linalg.norm(along)
    states.surface_motion[0, -1, :3] = ahead * behind * 1e-3
    moved = seen(states, 0.0)
    assert np.abs(moved - sharp).max() > 0.1 * sharp.max()
    assert np.abs(found - moved).max() < 0.01 * sharp.max()


def test_cases_have_counts_and_sharpness(study_of):
    keys = {
        "imaging__resolution": True,
        "detector__pixel_um": 6.0,
        "detector__photons": 1e6,
        "detector__read_noise": 3.0,
    }
    text = study_of(**keys).identity_text()
    together = KIND.compute(text, np.arange(2), "numpy").arrays
    alone = KIND.compute(text, np.array([1]), "numpy").arrays
    template = KIND.template(text)
    for name in ("counts", "snr", "fwhm", "two_point", "sparrow", "mtf50"):
        np.testing.assert_array_equal(together[name][1], alone[name][0], err_msg=name)
        assert together[name].shape[1:] == template.per_case[name].shape
    assert 0.5e6 < together["counts"][0].sum() < 1e6
    assert np.abs(together["fwhm"] - 1.0).max() < 0.2


def test_what_needs_no_images_does_without_a_camera(study_of):
    """Rare events, cheap partners and budgets switch images off, with all that a camera makes of them."""
    plain = study_of()
    camera = study_of(
        imaging__focus_um=[1.0], imaging__resolution=True, detector__pixel_um=6.0, detector__photons=1e6
    )
    assert rare_study(camera, limit=300.0).identity_text() == rare_study(plain, limit=300.0).identity_text()
    cases = np.arange(2)
    for name, values in modal_numbers(modal_partner(camera), cases, "numpy").items():
        np.testing.assert_array_equal(
            values, modal_numbers(modal_partner(plain), cases, "numpy")[name], err_msg=name
        )
    values = [experiment(one, summed(one, None), "numpy").values(0, 2) for one in (camera, plain)]
    np.testing.assert_array_equal(*values)


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"optics__wavelengths_nm": [800.0, 800.0]}, "names a wavelength twice"),
        ({"optics__wavelengths_nm": [800.0], "imaging__wavelengths_nm": [800.0]}, "choose one"),
        (
            {"optics__wavelengths_nm": [800.0], "optics__light": "modal", "imaging__enabled": False},
            "give one optics.wavelength_nm",
        ),
        ({"optics__wavelengths_nm": [1000.0, 300.0]}, "imaging.sampling must be at most 0.15 for 300 nm"),
        ({"imaging__weights": [1.0]}, "weights has one number for each of wavelengths_nm"),
        ({"imaging__wavelengths_nm": [300.0]}, "imaging.sampling must be at most 0.15 for 300 nm"),
        ({"imaging__focus_um": [1.0], "imaging__enabled": False}, "imaging.focus_um is of images"),
        ({"imaging__resolution": True, "study__workflow": "telescope-exposure"}, "segment-disturbance"),
        ({"detector__pixel_um": 1e6, "detector__photons": 1.0}, "pixel_um = 1e[+]06 does not suit the frame"),
    ],
)
def test_impossible_cameras_are_refused(study_of, keys, words):
    with pytest.raises(UserError, match=words):
        KIND.check(study_of(**keys).identity_text())
