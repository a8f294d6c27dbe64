"""What the viewer shows of exposures, reduced segments, lenses and loops, against stores and closed forms."""

import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.recorded_studies import EXPOSED as EXPOSED_MIRROR

import wavequake as wq
from wavequake.campaign.store.store import read_manifest
from wavequake.control.bench import SENSITIVITIES
from wavequake.optics.shapes.sag import deformation_sag
from wavequake.optics.systems.system import States
from wavequake.viewer import systems
from wavequake.viewer.exposures import m2_map
from wavequake.viewer.film import displacements, over_pupil, zernike_map
from wavequake.viewer.view import film_of
from wavequake.workflows.systems.bench import system_bench, system_states
from wavequake.workflows.systems.disturbance import draw

EXPOSED = {
    "telescope.name": "tmt-18",
    "optics.rays": 600,
    "wavefront.zernike_terms": 28,
    "imaging.pixels": 16,
    "disturbance.history.instants": 6,
    "campaign.cases": 1,
    "campaign.device": "numpy",
}
SEGMENT = {
    "telescope.name": "tmt-18",
    "segments.name": "6",
    "model.divisions": 3,
    "reduction.variants": ["craigb18"],
    "reduction.frequencies": 10,
    "reduction.spot_checks": 0,
    "time.duration_s": 0.05,
    "time.traced": 16,
    "optics.rays_per_segment": 18,
    "optics.zernike_terms": 11,
    "imaging.pixels": 12,
}


def film(folder, study, keys, cases=()):
    """Run a study and return its store, open, and its film."""
    store = folder / "store"
    wq.run(wq.load_study(study, keys), store=store, on="serial")
    return wq.open_store(store).load(), film_of(store, list(cases))


@pytest.fixture(scope="module")
def telescope(tmp_path_factory):
    return film(tmp_path_factory.mktemp("telescope"), "tmt-exposure", EXPOSED)


def taken(found, of):
    return next(take for take in found.takes if take.of == of)


def shown(one):
    """Return the numbers of a map at every instant."""
    return one.weights @ one.shapes


def test_exposures_are_the_means_of_the_instants_that_are_shown(telescope):
    stored, found = telescope
    assert [take.of for take in found.takes] == ["disturbed", "rigid", "elastic"]
    for take in found.takes:
        one = stored.sel(case=0, controller=take.of)
        np.testing.assert_allclose(take.images.mean(axis=0), one.exposure, rtol=0, atol=5e-5)
        np.testing.assert_allclose(take.series["line of sight, x and y"][1], one.los, rtol=0, atol=1e-8)
        name = "wavefront error of the fitted terms, rms"
        np.testing.assert_allclose(take.series[name][1][:, 0], one.wfe_rms, rtol=1e-9)
        rms = np.sqrt(np.mean(shown(take.maps[0]) ** 2, axis=1))
        np.testing.assert_allclose(rms, one.wfe_rms_flat, rtol=2e-2)
        assert take.maps[0].reach == found.takes[0].maps[0].reach
    assert np.abs(taken(found, "rigid").track).max() < 1e-2 * np.abs(taken(found, "disturbed").track).max()


@pytest.mark.parametrize("controller", ["rigid", "elastic"])
def test_m2_follows_the_segments(telescope, controller):
    """A segment that rises by d shortens the light's way by 2 d; M2, which looks down, has to rise by d."""
    _, found = telescope
    stage, take = found.stages[0], taken(found, controller)
    moved = displacements(stage, take)
    m1, m2 = (np.isin(stage.body, one) for one in (range(18), [stage.names.index("M2")]))
    size = [np.hypot(*stage.points[one, :2].T).max() for one in (m1, m2)]
    instant = int(np.abs(moved[:, m1, 2]).max(axis=1).argmax())

    def plane(mask, scale):
        x, y = stage.points[mask, :2].T / scale
        columns = np.stack([np.ones_like(x), x, y], axis=1)
        return np.linalg.lstsq(columns, moved[instant, mask, 2], rcond=None)[0][1:]

    if controller == "rigid":  # tilts go the same way
        one, other = plane(m1, size[0]), plane(m2, size[1])
        assert one @ other > 0.95 * np.linalg.norm(one) * np.linalg.norm(other)
        return
    centers = np.array([stage.points[stage.body == k, :2].mean(axis=0) for k in range(18)]) / size[0]
    rise = np.array([moved[instant, stage.body == k, 2].mean() for k in range(18)])
    places = stage.points[m2, :2] / size[1]
    nearest = np.linalg.norm(places[:, None] - centers[None], axis=2).argmin(axis=0)
    under = moved[instant, m2, 2][nearest]
    assert np.corrcoef(rise, under)[0, 1] > 0.8
    assert 0.5 < np.std(under) / np.std(rise) < 1.5


def test_a_rigid_m2_turns_about_its_vertex(telescope):
    stored, found = telescope
    stage, take = found.stages[0], taken(found, "rigid")
    body = stage.names.index("M2")
    mine = stage.body == body
    turned = Rotation.from_rotvec(np.append(stored.m2_tilt.sel(case=0)[3], 0.0) * 1e3)
    flip = np.array([1.0, 1.0, -1.0])  # the stage's z axis is to the sky, the trace's along the light
    away = (stage.points[mine] - stage.pivots[body]) * flip
    wanted = (turned.apply(away) - away) * flip / 1e3
    found_there = displacements(stage, take)[3, mine]
    assert np.abs(found_there - wanted).max() < 2e-3 * np.abs(wanted).max()


def test_maps_of_noll_terms_are_their_closed_forms():
    one = zernike_map("defocus", np.eye(4)[3:], 0.3)
    n = len(one.cells)
    x, y = np.meshgrid(*[(2.0 * np.arange(n) + 1.0 - n) / n] * 2)
    lit = one.cells >= 0
    assert lit.mean() == pytest.approx(np.pi / 4 * (1.0 - 0.3**2), abs=0.01)
    values = shown(one)[0][one.cells[lit]]
    rho2 = x[lit] ** 2 + y[lit] ** 2
    np.testing.assert_allclose(values, np.sqrt(3.0) * (2.0 * rho2 - 1.0 - 0.09) / (1.0 - 0.09), atol=1e-12)
    assert m2_map(np.array([[0.0, 0.0, 1.0]])).reach == pytest.approx(np.sqrt(3.0), rel=0.02)


def test_cells_show_the_nearest_point_and_nothing_beyond():
    x, y = (one.ravel() for one in np.meshgrid(np.linspace(-1, 1, 9), np.linspace(-1, 1, 9)))
    kept = np.hypot(x, y) > 0.6
    cells = over_pupil(x[kept], y[kept], 51)
    assert cells[25, 25] == -1
    axis = 1.02 * (2.0 * np.arange(51) - 50) / 51
    row, column = 47, 30
    nearest = np.hypot(x[kept] - axis[column], y[kept] - axis[row]).argmin()
    assert cells[row, column] == nearest


def test_a_mirrors_exposure_is_the_mean_of_its_images(tmp_path):
    stored, found = film(tmp_path, "mirror-exposure", EXPOSED_MIRROR, [1])
    take = taken(found, "one300")
    one = stored.sel(case=1, excitation="one300")
    instants = np.linspace(0, len(take.time) - 1, 5).round().astype(int)
    np.testing.assert_allclose(take.images[instants].mean(axis=0), one.exposure, rtol=0, atol=5e-5)
    track = 0.01 * one.los_mm.to_numpy() / float(one.resolution_mm)
    np.testing.assert_allclose(take.track, track, atol=1e-9)
    assert [each.name for each in take.maps] == ["wavefront, reference", "wavefront, krylov36(150)"]
    rms = [np.sqrt(np.mean(shown(each) ** 2, axis=1)) for each in take.maps]
    np.testing.assert_allclose(rms[1], one.wfe_rms, rtol=0.05, atol=1e-9)
    off = np.sqrt(np.mean((shown(take.maps[1]) - shown(take.maps[0])) ** 2, axis=1))
    np.testing.assert_allclose(off, one.wfe_error, rtol=0.05, atol=1e-3 * float(one.wfe_rms.max()))


def test_a_reduced_segment_shakes_the_telescope(tmp_path):
    stored, found = film(tmp_path, "tmt-segment-mor", SEGMENT)
    take = next(take for take in found.takes if take.case == 1 and take.of == "floor")
    one = stored.sel(case=1, excitation="floor")
    np.testing.assert_allclose(take.images.mean(axis=0), one.exposure, rtol=0, atol=1e-9)
    np.testing.assert_allclose(take.series["wavefront error from rest, rms"][1][:, 0], one.wfe_rms, rtol=1e-9)
    moving = np.abs(take.poses).max(axis=(0, 2)) > 0.0
    assert [found.stages[0].names[k] for k in np.flatnonzero(moving)] == ["6"]
    mode = next(take for take in found.takes if take.of == "mode 1")
    first, second = map(float, re.search(r"mode 1, ([\d.]+) and ([\d.]+) Hz", mode.label).groups())
    assert first <= second * (1.0 + 1e-6) < 1.01 * first  # Rayleigh and Ritz: from above


STABILIZER = {
    "campaign.cases": 1,
    "campaign.device": "numpy",
    "optics.rays": 60,
    "imaging.pixels": 16,
    "system.fields_deg": [[0.0, 0.0]],
}


def test_a_lens_moves_against_the_image_under_every_controller(tmp_path):
    """The system is round: the perfect shift is one and the same multiple of the image motion in x and y."""
    stored, found = film(tmp_path, "image-stabilizer", STABILIZER)
    takes = {take.of: take for take in found.takes}
    assert set(takes) == {"off", "perfect", "lqg"}
    (stage,) = found.stages
    off, perfect = takes["off"], takes["perfect"]
    assert not off.poses.any()  # the light shakes, and no element
    assert "No surface moves" in off.note
    moving = [
        name for name, poses in zip(stage.names, np.moveaxis(perfect.poses, 1, 0), strict=True) if poses.any()
    ]
    rear = next(body for body in wq.load_study("image-stabilizer").body if body.name == "rear").surfaces
    assert moving == list(rear)
    shift = perfect.poses[:, stage.names.index(rear[0]), :2]
    np.testing.assert_array_equal(shift, perfect.poses[:, stage.names.index(rear[-1]), :2])
    image = off.series["line of sight"][1]
    factor = np.vdot(image, shift) / np.vdot(image, image)
    assert abs(factor) > 1e-4  # m per mm
    np.testing.assert_allclose(shift, factor * image, atol=2e-3 * np.abs(shift).max())
    mm = stored["los_mm"].isel(case=0, field=0, wavelength=1)
    for number, name in enumerate(map(str, stored["controller"].to_numpy())):
        if name in takes:
            first = stored["los_mm"].isel(case=0, field=0, wavelength=0, controller=number)
            np.testing.assert_allclose(takes[name].series["line of sight"][1], first)
    assert np.abs(mm.sel(controller=stored["controller"] == "perfect")).max() < 1e-3 * np.abs(mm).max()


def test_lenses_swing_as_the_store_says(tmp_path):
    keys = {"time.duration_s": 2.0, "time.step_ms": 20.0, "campaign.cases": 1}
    stored, found = film(tmp_path, "lens-experiment", keys)
    stage, take = found.stages[0], taken(found, "uncontrolled")
    one = stored.sel(case=0, controller="uncontrolled")
    across = {name: take.poses[:, k, 1] for k, name in enumerate(stage.names)}
    np.testing.assert_allclose(across["L4 back"], 1e-3 * one.lens_position, atol=1e-7 * 3e-3)
    lenses = np.stack([across[f"L{k} front"] for k in range(1, 7)], axis=1)
    assert not lenses[:, 4].any()  # the stage stands still
    np.testing.assert_allclose(lenses @ SENSITIVITIES, across["image"], atol=1e-6 * 3e-3)
    modal = taken(found, "modal")
    np.testing.assert_allclose(
        modal.poses[:, list(stage.names).index("L5 front"), 1],
        1e-3 * stored.stage_position.sel(case=0, controller="modal"),
    )
    assert np.ptp(modal.poses[:, -1, 1]) < 0.5 * np.ptp(across["image"])


def test_a_search_shows_the_bench_that_it_found(tmp_path):
    stored, found = film(tmp_path, "lens-passive", {"campaign.cases": 1, "passive.iterations": 2})
    after = taken(found, "bench that was found").series["image displacement"][1]
    assert np.ptp(after) == pytest.approx(float(stored.peak_to_peak_mm[0]), rel=5e-2)  # every 5 ms
    assert len([take for take in found.takes if take.of.startswith("mode")]) == 13


def test_surfaces_deform_as_the_trace_deforms_them(tmp_path):
    stored, _ = film(tmp_path, "euv", {"campaign.cases": 3, "optics.rays": 60, "wavefront.zernike_terms": 11})
    bench = system_bench(read_manifest(tmp_path / "store").study)
    case = int(stored.case[stored.disturbance == "heating"][0])
    states = system_states(bench, draw(bench, case)[1])
    stage, surfaces = systems.stage_of_system(bench)
    rng = np.random.default_rng(1)
    given = tuple(None if one is None else rng.normal(size=(2, one.shape[1])) for one in states.deformations)
    assert any(one is not None for one in given)
    still = np.zeros((2, *states.surface_motion.shape[1:]))
    random = States(still, given, np.zeros((2, 2)))
    shapes, weights = systems.figures_of(bench, random, stage, surfaces)
    moved = np.tensordot(weights, shapes, 1)
    for body, index in enumerate(surfaces):
        surface, mine = bench.system.surfaces[index], stage.body == body
        x, y, _ = ((stage.points[mine] * 1e3 - surface.position) @ surface.rotation).T
        if given[index] is None:
            assert not moved[:, mine].any()
            continue
        inside = np.hypot(x, y) <= surface.deformation.pupil_radius
        heights = deformation_sag(surface.deformation, given[index][1], x, y)[0] / 1e3
        along = moved[1, mine] @ surface.rotation[:, 2]
        np.testing.assert_allclose(along[inside], heights[inside], atol=1e-4 * np.abs(heights).max())
