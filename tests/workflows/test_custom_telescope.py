"""Telescopes of one's own: mirrors from files, edges that vignette, one glass instead of segments."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from small_telescope import STUDY

from wavequake.campaign.contract import DONE
from wavequake.errors import UserError
from wavequake.kernels.device.devices import list_devices
from wavequake.optics.catalog.names import optical_system, system_names
from wavequake.optics.polynomials.zernike import annular_zernike
from wavequake.optics.segments.telescope import rim_aberration
from wavequake.optics.shapes.polygons import edge_lines
from wavequake.optics.systems.file import SystemSection
from wavequake.optics.zemax.export import zmx_text
from wavequake.workflows.early_notices import early_notices
from wavequake.workflows.segments import disturbance as workflow
from wavequake.workflows.segments.bench import bench_of, build_telescope
from wavequake.workflows.study import load_study, study_with
from wavequake.workflows.systems.out_of_focus import out_of_focus, waves_of_defocus

DEVICE = list_devices()[0].name

CUSTOM = """
[study]
name = "newton"
workflow = "segment-disturbance"
[telescope]
name = "custom"
polygons = "polygons.csv"
primary_radius_mm = -20000.0
surfaces = [
    { name = "fold", distance_mm = 5000.0, tilt_deg = 0.0, semi_diameter_mm = 230.0 },
    { name = "image", distance_mm = 5000.0 },
]
[wavefront]
zernike_terms = 6
[imaging]
pixels = 16
[[disturbance]]
name = "pistons"
model = "static-random"
piston_nm = 10.0
figure_nm = { 4 = 1.0 }
"""
SQUARES = "id,x1_m,y1_m,x2_m,y2_m,x3_m,y3_m,x4_m,y4_m\n" + "\n".join(
    f"{name},{x},{y},{x + 0.4},{y},{x + 0.4},{y + 0.4},{x},{y + 0.4}"
    for name, x, y in [("a", 0.01, 0.01), ("b", -0.41, 0.01), ("c", -0.41, -0.41), ("d", 0.01, -0.41)]
)


@pytest.fixture
def newton(tmp_path):
    (tmp_path / "polygons.csv").write_text(SQUARES)
    path = tmp_path / "newton.toml"
    path.write_text(CUSTOM)
    return load_study(path)


def with_edge(study, semi_diameter):
    fold, image = (surface.model_dump() for surface in study.telescope.surfaces)
    return study_with(study, {"telescope.surfaces": [fold | {"semi_diameter_mm": semi_diameter}, image]})


@pytest.mark.parametrize("edge", [150.0, 300.0])
def test_vignetted_rays_are_counted(newton, edge):
    """Half way to the focus the beam is half as wide, to the order of sag over focal length."""
    text = with_edge(newton, edge).identity_text()
    rays = bench_of(text).prepared.rays
    expected = np.count_nonzero(np.hypot(rays.x, rays.y) > 2.0 * edge)
    assert (expected > 0) == (edge < 200.0)
    if not expected:
        assert workflow.KIND.compute(text, np.array([0]), DEVICE).arrays["vignetted"] == [0.0]
        return
    static = bench_of(text).static
    assert static.vignetted[0] == static.lost[0] == expected


def test_a_mirror_that_lets_nothing_pass_is_refused(newton):
    with pytest.raises(UserError, match=r"No ray of segment a .* reaches the image"):
        workflow.KIND.check(with_edge(newton, 1.0).identity_text())


def test_distorted_corners_come_from_a_file_and_belong_to_the_study(tmp_path):
    """A corner 15 mm farther out: more glass, another identity, and rays where the new glass is."""
    path = tmp_path / "small.toml"
    path.write_text(STUDY)
    (tmp_path / "corners.csv").write_text("segment,corner,dx_mm,dy_mm\n18,1,7.5,-12.99\n")
    plain, bent = load_study(path), load_study(path, {"telescope.corners": "corners.csv"})
    assert plain.identity() != bent.identity()
    (tmp_path / "corners.csv").unlink()
    change = bench_of(bent.identity_text()).layout.areas_m2 - bench_of(plain.identity_text()).layout.areas_m2
    assert np.flatnonzero(change).tolist() == [17]
    result = workflow.KIND.compute(bent.identity_text(), np.array([0]), DEVICE)
    assert (result.status == DONE).all()
    monolith = {"telescope.name": "tmt-thesis", "telescope.gap_mm": None, "telescope.corners_csv": "x"}
    with pytest.raises(UserError, match="corners_csv belongs to the telescope tmt or tmt-18 or jwst"):
        study_with(plain, monolith)
    with pytest.raises(UserError, match="primary_conic belongs to the telescope custom, not to tmt-18"):
        study_with(plain, {"telescope.primary_conic": -2.0})


def test_a_number_of_rays_of_another_sampling_is_named(newton):
    given = {"optics.rays": 50, "optics.rays_per_segment": 72}
    for sampling, unused in (("segments", "rays"), ("sunflower", "rays_per_segment")):
        study = study_with(newton, {**given, "optics.sampling": sampling})
        said = f"optics.{unused} has no effect, as optics.sampling is {sampling!r}"
        assert list(study.unused_keys(one_piece=False)) == [said]
        assert list(study.unused_keys(one_piece=True)) == [
            "optics.rays_per_segment has no effect, as M1 is of one piece"
        ]
    given["optics.sampling"] = "segments"
    assert "optics.rays has no effect" in next(
        workflow.KIND.notices(study_with(newton, given).identity_text())
    )
    assert not list(study_with(newton, {"optics.rays": 2000}).unused_keys(one_piece=False))


def test_a_monolithic_mirror_runs_and_is_perfect_at_rest(tmp_path):
    path = tmp_path / "one.toml"
    path.write_text(
        STUDY.replace('"tmt-18"\ngap_mm = 20.0', '"tmt-thesis"').replace(
            "[imaging]", "[optics]\nrays = 500\n[imaging]"
        )
    )
    text = load_study(path).identity_text()
    result = workflow.KIND.compute(text, np.array([2]), DEVICE)
    assert result.status[0] == DONE
    # Table 4.2 has 0.0368 waves of static defocus (rounded radii).
    assert result.arrays["wfe_rms"][0, 0] == pytest.approx(0.0368 * 550, rel=0.01)
    light = result.arrays["exposure"][0].sum() * 0.25**2 * np.pi / 4 * (1 - 0.10081333**2)
    assert 0.3 < light < 1.0


def test_motions_that_edge_sensors_do_not_see_are_counted(newton, tmp_path):
    """Eight readings of four squares around a corner leave one of twelve unknowns, and three of the whole."""
    text = CUSTOM[: CUSTOM.index("model =")] + 'model = "edge-sensor-noise"\n'
    (tmp_path / "sensed.toml").write_text(text)
    said = [*workflow.KIND.notices(load_study(tmp_path / "sensed.toml").identity_text())]
    assert said[1] == (
        "Besides piston, tip and tilt of the whole mirror, the sensors of pistons do not see 1 motion of its "
        "segments, which are not in its numbers"
    )
    assert not any("sensors" in one for one in workflow.KIND.notices(newton.identity_text()))


@pytest.mark.parametrize(
    ("rays", "term", "remedy"),
    [
        (18, 4, ""),
        (18, 7, "optics.rays_per_segment = 36"),
        (36, 7, ""),
        (36, 11, "optics.rays_per_segment = 72"),
        (72, 11, ""),
        (72, 22, "optics.sampling = 'sunflower'"),
    ],
)
def test_rays_that_are_too_few_for_a_figure_are_named(tmp_path, rays, term, remedy):
    """Where nothing is said the rms of the figure over a hexagon is right within 5 %, by a fine grid."""
    path = tmp_path / "figured.toml"
    text = STUDY[: STUDY.index("[[disturbance]]")] + f"[optics]\nrays_per_segment = {rays}\n"
    text += f'[[disturbance]]\nname = "figures"\nmodel = "static-random"\nfigure_nm = {{ {term} = 1.0 }}\n'
    path.write_text(text)
    bench = bench_of(load_study(path).identity_text())
    said = [one for one in workflow.KIND.notices(bench.text) if "too few for its figure" in one]
    assert [one.partition("; take ")[2] for one in said] == [remedy] * bool(remedy)
    segments, pupil = bench.system.segments, bench.prepared.rays
    corners = segments.corners[0] - segments.centers[0, :2]
    radius = np.hypot(*corners.T).max()
    x, y = (one.ravel() for one in np.meshgrid(*2 * [np.linspace(-radius, radius, 801)]))
    inside = (np.column_stack([x, y, -np.ones_like(x)]) @ edge_lines(corners[None])[0].T <= 0.0).all(axis=1)
    fine = annular_zernike(x[inside] / radius, y[inside] / radius, term, 0.0)[:, -1].std()
    own = pupil.segment == 0
    place = (np.stack([pupil.x, pupil.y])[:, own] - segments.centers[0, :2, None]) / radius
    share = pupil.weight[own] / pupil.weight[own].sum()
    values = annular_zernike(*place, term, 0.0)[:, -1]
    found = np.sqrt(share @ (values - share @ values) ** 2)
    assert (abs(found / fine - 1.0) > 0.05) == bool(remedy)


def test_an_image_off_the_focus_is_told_with_its_place(newton, tmp_path):
    (tmp_path / "newton.toml").write_text(
        CUSTOM.replace("distance_mm = 5000.0 },\n]", "distance_mm = 5050.0 },\n]").replace(
            "figure_nm", "# figure_nm"
        )
    )
    words = r"image stands 50 mm beyond the paraxial focus, which is 5000 mm behind fold; mend a distance_mm"
    with pytest.raises(UserError, match=words):
        workflow.KIND.check(load_study(tmp_path / "newton.toml").identity_text())


def with_image(study, distance):
    fold, image = (surface.model_dump() for surface in study.telescope.surfaces)
    return study_with(study, {"telescope.surfaces": [fold, image | {"distance_mm": distance}]})


def test_a_telescope_far_from_focus_is_refused_before_anything_is_prepared(newton, monkeypatch):
    monkeypatch.setattr(workflow, "bench_of", lambda text: pytest.fail("it prepared the rays"))
    words = (
        r"by 4\d\d waves rms.: image stands 500 mm beyond the paraxial focus, which is 5000 mm behind fold"
    )
    with pytest.raises(UserError, match=words):
        workflow.KIND.check(with_image(newton, 5500.0).identity_text())


def test_a_wrong_conic_is_told_from_a_wrong_distance(newton, monkeypatch, tmp_path):
    (tmp_path / "newton.toml").write_text(CUSTOM.replace("figure_nm", "# figure_nm"))
    still = load_study(tmp_path / "newton.toml")
    for conic, early in ((100.0, True), (20.0, False)):
        study = study_with(still, {"telescope.primary_conic": conic})
        words = (
            r"waves rms.: axial rays of M1's rim meet image .* beside those of its center; mend a conic"
            if early
            else r"waves rms.: light along the axis has no common focus; mend a conic"
        )
        with pytest.raises(UserError, match=words):
            workflow.KIND.check(study.identity_text())


def test_a_sphere_has_the_aberration_of_the_textbook(newton):
    """The rim passes the paraxial focus a^3 / (2 R^2) beside the axis; the rms is 0.298 a^4 / (4 R^3)."""
    study = study_with(newton, {"telescope.primary_conic": 0.0})
    system = build_telescope(study)
    a, radius = system.annulus.outer, 20000.0
    assert rim_aberration(system) == pytest.approx(a**3 / (2.0 * radius**2), rel=3e-3)
    (said,) = out_of_focus(study_with(newton, {"telescope.primary_conic": 9.0}))
    rms = 2.0 / (3.0 * np.sqrt(5.0)) * 10.0 * a**4 / (4.0 * radius**3) / 550e-6
    assert f"({rms:.2g}" in said or f"({rms:.3g} waves rms)" in said


def test_a_plan_notes_how_far_from_focus_the_image_stands(newton):
    study = with_image(newton, 5050.0)
    (said,) = out_of_focus(study)
    assert "image stands 50 mm beyond the paraxial focus, which is 5000 mm behind fold; mend a dist" in said
    assert said.endswith("(44 waves rms).")
    assert said in early_notices(study)
    assert not list(out_of_focus(newton))


def test_waves_of_defocus_are_the_rms_of_the_ways_to_another_plane():
    """A plane wave d behind the focus is d (1 - cos) early, over a pupil of equal areas in the sine."""
    sine = 0.05 * np.sqrt((np.arange(10_000) + 0.5) / 10_000)
    ways = 50.0 * (1.0 - np.sqrt(1.0 - sine**2))
    assert waves_of_defocus(50.0, 0.05, 550e-6) == pytest.approx(np.std(ways) / 550e-6, rel=2e-3)


@pytest.mark.parametrize(("back", "said"), [(0.0, ""), (5.0, "mm beyond"), (-5.0, "mm before")])
def test_a_system_far_from_focus_is_noted_as_well(back, said):
    system = optical_system("double-gauss")
    *others, image = system.surfaces
    moved = replace(
        system, surfaces=(*others, replace(image, position=image.position + np.array([0.0, 0.0, back])))
    )
    section = SystemSection(file="lens.zmx", file_text=zmx_text(moved))
    found = list(out_of_focus(SimpleNamespace(system=section)))
    assert [said in one for one in found] == [True] * bool(back)


@pytest.mark.parametrize("name", system_names())
def test_no_bundled_system_is_called_out_of_focus(name):
    assert not list(out_of_focus(SimpleNamespace(system=SystemSection(name=name))))
