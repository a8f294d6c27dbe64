"""A camera with a window and a field lens behind four segments, as a study."""

from math import sqrt

import numpy as np
import pytest
from test_custom_telescope import SQUARES
from test_senseless_keys import said

from wavequake.campaign.contract import DONE
from wavequake.errors import UserError
from wavequake.optics.media.glasses import glass, refractive_index
from wavequake.workflows.segments import disturbance as workflow
from wavequake.workflows.segments.bench import benches_of
from wavequake.workflows.study import load_study, study_with

CAMERA = """
[study]
name = "camera"
workflow = "segment-disturbance"
[telescope]
name = "custom"
polygons = "polygons.csv"
primary_radius_mm = -20000.0
surfaces = [
    { name = "M2", distance_mm = 8000.0, radius_mm = -5000.0, conic = -2.25 },
    { name = "window", distance_mm = 9500.0, glass = "SILICA", body = "cryostat" },
    { name = "window's back", distance_mm = 20.0, glass = "air", body = "cryostat" },
    { name = "front", distance_mm = 100.0, radius_mm = 400.0, glass = "N-BK7", body = "lens" },
    { name = "back", distance_mm = 10.0, radius_mm = -400.0, glass = "air", body = "lens" },
    { name = "image", distance_mm = 189.27665 },
]
[optics]
wavelengths_nm = [550.0, 560.0]
[wavefront]
zernike_terms = 6
[imaging]
pixels = 16
[[disturbance]]
name = "lens"
model = "surface-random"
of = ["lens"]
rms = { dx_um = 100.0 }
"""
COLORS = (550.0, 560.0)


@pytest.fixture
def camera(tmp_path):
    (tmp_path / "polygons.csv").write_text(SQUARES)
    (tmp_path / "camera.toml").write_text(CAMERA)
    return load_study(tmp_path / "camera.toml")


def through(nm):
    """Paraxial matrices up to the lens, and from there to the image; slopes times indices."""
    silica, crown = (refractive_index(glass(name), 1e-6 * nm) for name in ("SILICA", "N-BK7"))

    def way(length):
        return np.array([[1.0, length], [0.0, 1.0]])

    def bend(power):
        return np.array([[1.0, 0.0], [-power, 1.0]])

    before = way(9500.0 + 20.0 / silica + 100.0) @ bend(-2.0 / 5000.0) @ way(8000.0) @ bend(2.0 / 20000.0)
    power = (crown - 1.0) / 400.0
    return before, way(189.27665) @ bend(power) @ way(10.0 / crown) @ bend(power)


def test_each_color_has_its_own_focus(camera):
    """Defocus of dz at the aperture NA is c4 = dz NA^2 / (4 sqrt 3); the annulus begins at 2.4 %."""
    found, expected = [], []
    for bench, nm in zip(benches_of(camera.identity_text()), COLORS, strict=True):
        before, behind = through(nm)
        height, slope = (behind @ before)[:, 0]
        expected.append(height / slope * (slope * bench.system.annulus.outer) ** 2 / (4.0 * sqrt(3.0)) * 1e6)
        found.append(bench.static.zernike[0, 3] * nm)
        assert bench.first_order.focal_length == pytest.approx(-1.0 / slope, rel=1e-9)
    change = expected[1] - expected[0]
    assert abs(change) > 5.0  # nm
    assert abs(found[1] - found[0]) == pytest.approx(abs(change), rel=0.02)


def test_a_lens_that_shifts_moves_the_image(camera):
    """By its shift times 1 - A, where A is how the height at the lens goes into that at the image."""
    bench = benches_of(camera.identity_text())[0]
    result = workflow.KIND.compute(camera.identity_text(), np.arange(3), "numpy")
    assert (result.status == DONE).all()
    share = 1.0 - through(550.0)[1][0, 0]
    for case in range(3):
        shift = workflow.draw(bench, case).motion.rigid["lens"][0, 0] * 1e3
        angle = shift * share / bench.first_order.focal_length * 180.0 / np.pi * 3600.0 * 1e3
        los = result.arrays["los"][case].reshape(-1, 2, 2)[0]
        np.testing.assert_allclose(np.abs(los[:, 0]), abs(angle), rtol=0.01)
        np.testing.assert_allclose(los[:, 1], 0.0, atol=1e-3 * abs(angle))


def test_a_plane_window_that_shifts_does_nothing(camera):
    study = study_with(camera, {"disturbance.lens.of": ["cryostat"]})
    result = workflow.KIND.compute(study.identity_text(), np.arange(2), "numpy")
    still = benches_of(study.identity_text())[0].static.rms[0] * 550.0
    np.testing.assert_allclose(result.arrays["wfe_rms"].reshape(2, -1, 2)[..., 0], still, rtol=1e-6)
    np.testing.assert_allclose(result.arrays["los"], 0.0, atol=1e-4)


def test_the_modal_model_knows_segments_before_lenses(camera, tmp_path):
    text = CAMERA[: CAMERA.index("[[disturbance]]")]
    text = text.replace("wavelengths_nm = [550.0, 560.0]", 'light = "modal"')
    text = text.replace("[imaging]\npixels", "[imaging]\nenabled = false\npixels")
    text += (
        '[[disturbance]]\nname = "pistons"\nmodel = "static-random"\npiston_nm = 30.0\ntilt_nrad = 100.0\n'
    )
    (tmp_path / "modal.toml").write_text(text)
    result = workflow.KIND.compute(load_study(tmp_path / "modal.toml").identity_text(), np.arange(4), "numpy")
    assert (result.status == DONE).all()
    assert (result.arrays["traced"] == 1).all()
    assert 0.0 < result.arrays["modal_error_wfe_rms"].max() < 0.1


MISSED = "misses a surface of custom, or is totally reflected there"


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('"N-BK7"', "50.0", MISSED),
        ("radius_mm = 400.0", "radius_mm = 1e-320", MISSED),
        ("distance_mm = 9500.0", "distance_mm = 1e300", MISSED),
        ("distance_mm = 189.27665", "distance_mm = 1e300", "too far from focus for an image"),
        ("radius_mm = 400.0", "radius_mm = 400.0, even_asphere = [1e300]", MISSED),
        ("radius_mm = 400.0", "radius_mm = 400.0, even_asphere = [0, 0, 0, 0, 0, 0, 0, 1e-9]", MISSED),
        ("distance_mm = 20.0", "distance_mm = 20.0, tilt_deg = 60.0", MISSED),
        ("distance_mm = 8000.0", "distance_mm = 8000.0, tilt_deg = 45.0", "too far from focus"),
        ("distance_mm = 9500.0", "distance_mm = 9500.0, tilt_deg = 89.999999", MISSED),
        ('"SILICA"', "1e-320", "no real refractive index"),
    ],
)
def test_cameras_that_cannot_be(camera, tmp_path, old, new, words):
    assert words in said(tmp_path, CAMERA.replace(old, new))


def test_sentences(camera, tmp_path):
    mixed = {"imaging.wavelengths_nm": [500.0, 600.0], "optics.wavelengths_nm": None}
    for keys, words in (
        (mixed, "has lenses; give optics.wavelengths_nm"),
        ({"disturbance.lens.of": ["lense"]}, "did you mean 'lens'"),
    ):
        with pytest.raises(UserError, match=words):
            workflow.KIND.check(study_with(camera, keys).identity_text())
    text = CAMERA.replace("surface-random", "surface-deformation").replace("rms = { dx_um", "rms_nm = { 4")
    (tmp_path / "bent.toml").write_text(text)
    with pytest.raises(UserError, match=r"deforms 'lens' .* a body of several surfaces"):
        workflow.KIND.check(load_study(tmp_path / "bent.toml").identity_text())
