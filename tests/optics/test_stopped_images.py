"""Images of telescopes whose mirrors stop light: Airy's pattern, Huygens' sum over the rays that arrive."""

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.special import j0, j1
from sky_tracer import Tracer, glass, huygens, whole

import wavequake as wq
from wavequake.campaign.contract import DONE
from wavequake.kernels.device.devices import list_devices
from wavequake.mechanics.disturbances.motion import still
from wavequake.workflows.exposures.exposure_study import TelescopeExposureStudy
from wavequake.workflows.kinds import find_kind
from wavequake.workflows.segments import disturbance as workflow
from wavequake.workflows.segments.bench import bench_of
from wavequake.workflows.segments.study import SegmentStudy

DEVICE = list_devices()[0].name
EDGE, SIDE, FOCUS = 150.0, 400.0, 10000.0
QUADRANTS = ((1, 1), (-1, 1), (-1, -1), (1, -1))
# Light parallel to the axis that meets a flat fold half way to the focus, 150 mm from its vertex.
BEAM = brentq(lambda r: r * (FOCUS / 2) / (FOCUS - r**2 / (4 * FOCUS)) - EDGE, 200.0, 400.0)


def study(gap, rays, edge=EDGE, **sections):
    """Four squares of a parabola that focuses by a fold at its vertex."""
    lines = ["id,x1_m,y1_m,x2_m,y2_m,x3_m,y3_m,x4_m,y4_m"]
    for index, (sx, sy) in enumerate(QUADRANTS):
        x, y = sorted((sx * gap, sx * (gap + SIDE))), sorted((sy * gap, sy * (gap + SIDE)))
        corners = [(x[0], y[0]), (x[1], y[0]), (x[1], y[1]), (x[0], y[1])]
        lines.append(f"{index}," + ",".join(f"{v / 1e3!r}" for corner in corners for v in corner))
    record = {
        "study": {"name": "stopped", "workflow": "segment-disturbance", "seed": 1},
        "telescope": {
            "name": "custom",
            "polygons_csv": "\n".join(lines),
            "primary_radius_mm": -2.0 * FOCUS,
            "surfaces": [
                {"name": "fold", "distance_mm": FOCUS / 2, "semi_diameter_mm": edge},
                {"name": "image", "distance_mm": FOCUS / 2},
            ],
        },
        "disturbance": [{"name": "given", "model": "static-random"}],
        "imaging": {"pixels": 48, "sampling": 0.25},
        "optics": {"sampling": "sunflower", "rays": rays},
        "wavefront": {"zernike_terms": 6},
    }
    return SegmentStudy.model_validate(record | sections)


def sky_of(bench):
    """The same telescope for the other tracer."""
    fold = (np.array([0.0, 0.0, FOCUS / 2]), np.eye(3), 0.0, 0.0)
    radius = bench.prepared.train.sphere_radius
    return Tracer((0.5 / FOCUS, -1.0), (fold,), np.zeros(3), np.diag([1.0, 1.0, -1.0]), radius)


def computed(case_study, monkeypatch, motion):
    """What the store gets of a case that draws `motion`."""
    drawn = workflow.CaseDraw(case_study.disturbance[0], 0, np.arange(1.0, 1.0 + len(motion.mount)), motion)
    monkeypatch.setattr(workflow, "_draw_all", lambda bench, cases: [drawn])
    result = workflow.KIND.compute(case_study.identity_text(), np.array([0]), DEVICE)
    assert result.status[0] == DONE, result.messages
    return {name: array[0] for name, array in result.arrays.items()}


@pytest.mark.parametrize("figured", [False, True])
def test_a_round_mirror_that_stops_the_corners_makes_airys_pattern(figured, monkeypatch):
    """Squares without gaps of 400 mm, of which a circle of 300 mm gets through; 3000 rays within it."""
    given = {"name": "given", "model": "static-random"} | ({"figure_nm": {4: 0.0}} if figured else {})
    case_study = study(1e-6, 8000, disturbance=[given])
    bench = bench_of(case_study.identity_text())
    share = np.pi * BEAM**2 / (2 * SIDE) ** 2
    assert bench.stopped.light == pytest.approx(share, rel=2e-3)
    got = computed(case_study, monkeypatch, still(1, 4))
    smaller = BEAM / bench.system.annulus.outer
    axis = (np.arange(48) - 24) * 0.25 * smaller * np.pi
    v = np.hypot(axis, axis[:, None])
    airy = np.where(v == 0.0, 1.0, (2 * j1(v) / np.where(v == 0.0, 1.0, v)) ** 2)
    np.testing.assert_allclose(got["exposure"], airy, rtol=0, atol=1e-3)
    for name, share in (("ee50", 0.5), ("ee80", 0.8)):
        radius = (
            brentq(lambda v, share=share: 1.0 - j0(v) ** 2 - j1(v) ** 2 - share, 0.5, 3.7) / np.pi / smaller
        )
        assert got[name] == pytest.approx(radius, rel=3e-3)
    assert got["strehl"][0] == pytest.approx(1.0, abs=1e-9)
    assert got["vignetted"] == bench.stopped.vignetted > 0


def test_the_image_is_huygens_sum_over_the_rays_that_arrive(monkeypatch):
    case_study = study(10.0, 8000)
    bench = bench_of(case_study.identity_text())
    wavelength, diameter = 550e-6, 2 * bench.system.annulus.outer
    motion = still(1, 4)
    motion.segment_motion[0, 0, 2] = 0.12 * wavelength * 1e-3
    motion.segment_motion[0, 2, 3], motion.segment_motion[0, 3, 4] = (
        np.array([0.6, 0.5]) * wavelength / diameter
    )
    got = computed(case_study, monkeypatch, motion)
    sky = sky_of(bench)
    pupil = glass(bench.layout.corners_m * 1e3, 60)
    at_fold = Tracer(sky.primary, (), np.array([0.0, 0.0, FOCUS / 2]), np.diag([1.0, 1.0, -1.0]), 1e5)
    arrives = np.hypot(*whole(at_fold, bench, pupil, motion.segment_motion[0]).spots.T) <= EDGE
    state = whole(sky, bench, pupil, motion.segment_motion[0])
    rows = np.arange(0, 48, 5)
    x, y = np.meshgrid(*[(rows - 24) * 0.25 * wavelength / diameter * FOCUS] * 2)
    image = huygens(sky, state, pupil[2] * arrives / (pupil[2] @ arrives), x, y, wavelength)
    np.testing.assert_allclose(got["exposure"][np.ix_(rows, rows)], image, rtol=0, atol=2e-3)
    assert np.abs(image - image.T).max() > 0.05  # so the test tells x from y
    assert np.abs(huygens(sky, state, pupil[2], x, y, wavelength) - image).max() > 0.2  # if all glass shone


def test_a_ray_that_motion_takes_past_an_edge_is_dark_at_that_instant_alone(monkeypatch):
    """The corner of the pupil clears the fold by 2 um; a tilt of the line of sight by 1 lambda/D takes 7."""
    free = study(10.0, 800, edge=1e4)
    bench = bench_of(free.identity_text())
    rays, weight, diameter = bench.prepared.rays, bench.prepared.weight, 2 * bench.system.annulus.outer
    radius = np.hypot(rays.x, rays.y)
    corner, last = radius.max(), int(np.argmax(radius))
    outwards = np.array([rays.x[last], rays.y[last]]) / corner
    motion = still(3, 4)
    motion.mount[1], motion.mount[2] = outwards * 550e-6 / diameter, -outwards * 550e-6 / diameter
    tight = study(10.0, 800, edge=corner * (FOCUS / 2) / (FOCUS - corner**2 / (4 * FOCUS)) + 2e-3)
    assert bench_of(tight.identity_text()).stopped.words() == ""
    lit = [computed(free, monkeypatch, pick(motion, instant)) for instant in range(3)]
    found = [computed(tight, monkeypatch, pick(motion, instant)) for instant in range(3)]
    assert [one["vignetted"] for one in found] == [0, 1, 0]
    for instant in (0, 2):
        np.testing.assert_array_equal(found[instant]["exposure"], lit[instant]["exposure"])
    together = computed(tight, monkeypatch, motion)["exposure"]
    np.testing.assert_allclose(together, np.mean([one["exposure"] for one in found], axis=0), atol=1e-6)

    sky, arrives = sky_of(bench), np.arange(len(weight)) != last
    pupil = np.stack([rays.x, rays.y], axis=1), rays.segment, weight
    state = whole(sky, bench, pupil, motion.segment_motion[1], tuple(motion.mount[1]))
    order = np.argsort(rays.segment, kind="stable")  # as the other tracer returns its rays
    rows = np.arange(0, 48, 5)
    x, y = np.meshgrid(*[(rows - 24) * 0.25 * 550e-6 / diameter * FOCUS] * 2)
    without, with_it = (
        np.abs(
            found[1]["exposure"][np.ix_(rows, rows)]
            - huygens(sky, state, (weight * kept)[order], x, y, 550e-6)
        ).max()
        for kept in (arrives, np.ones_like(arrives))
    )
    assert without < 5e-4 < 2e-3 < with_it


def pick(motion, instant):
    """The motion of one instant."""
    one = slice(instant, instant + 1)
    picked = {
        name: {key: part[one] for key, part in values.items()} if isinstance(values, dict) else values[one]
        for name, values in vars(motion).items()
    }
    return type(motion)(**picked)


def test_coherent_objects_miss_the_light_that_a_mirror_stops(monkeypatch):
    """A slit is the sum of its points' amplitudes, Airy's of the round light that is left."""
    slit = {"slit": 0.2, "light": "coherent"}
    case_study = study(1e-6, 8000, imaging={"pixels": 32, "sampling": 0.2}, object=slit)
    bench = bench_of(case_study.identity_text())
    got = computed(case_study, monkeypatch, still(1, 4))
    smaller = BEAM / bench.system.annulus.outer
    axis = (np.arange(32) - 16) * 0.2
    parts = (np.arange(5) - 2) * 0.04  # of a pixel
    along = (axis[:, None] + parts).ravel()
    across = (axis[:, None] - parts)[None, :, :, None]
    up = (axis[:, None] - along)[:, None, None, :]
    v = np.maximum(np.pi * smaller * np.hypot(across, up), 1e-9)
    field = (2.0 * j1(v) / v).sum(axis=(2, 3))
    expected = (field * 0.04**2 * 0.25 * np.pi * smaller**2) ** 2
    np.testing.assert_allclose(got["object_image"], expected, rtol=0, atol=5e-3 * expected.max())


def exposure_study(rays, scale=1.0, **sections):
    """The same telescope, whose flat mirror corrects, in the workflow telescope-exposure."""
    record = study(1e-6, rays).model_dump(mode="json") | sections
    for key in ("allow", "budget", "rare", "detector", "structure", "segment"):
        record.pop(key, None)
    record["study"]["workflow"] = "telescope-exposure"
    record["exposure"] = {"scale": scale, "figure_terms": 6}
    return TelescopeExposureStudy.model_validate(record, strict=False)


def test_controllers_expose_the_light_that_a_mirror_leaves():
    """At rest Airy's pattern of the round light; disturbed, what segment-disturbance makes of the draw."""
    given = {"name": "given", "model": "static-random", "piston_nm": 60.0, "tip_nrad": 100.0}
    one = exposure_study(8000, disturbance=[given])
    kind = find_kind("telescope-exposure")
    kind.check(one.identity_text())
    told = " ".join(kind.notices(one.identity_text()))
    assert "fold stops" in told
    found = kind.compute(one.identity_text(), np.array([0]), DEVICE)
    assert found.status[0] == DONE, found.messages
    controllers = kind.template(one.identity_text()).fixed["controller"][1].tolist()
    images = dict(zip(controllers, found.arrays["exposure"][0], strict=True))
    bench = bench_of(study(1e-6, 8000).identity_text())
    smaller = BEAM / bench.system.annulus.outer
    axis = (np.arange(48) - 24) * 0.25 * smaller * np.pi
    v = np.maximum(np.hypot(axis, axis[:, None]), 1e-9)
    np.testing.assert_allclose(images["static"], (2 * j1(v) / v) ** 2, rtol=0, atol=1e-3)
    plain = study(1e-6, 8000, disturbance=[given])
    other = workflow.KIND.compute(plain.identity_text(), np.array([0]), DEVICE).arrays
    np.testing.assert_allclose(images["disturbed"], other["exposure"][0], rtol=0, atol=1e-3)
    row = controllers.index("disturbed")
    np.testing.assert_allclose(found.arrays["los"][0, row], other["los"][0], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(found.arrays["ee50"][0, row], other["ee50"][0], rtol=2e-3)
    # A tilt takes the motion of the image away, and nothing else.
    rigid = controllers.index("rigid")
    away, back = (np.abs(found.arrays["los"][0, one]).max() for one in (row, rigid))
    assert back < 1e-4 * away
    np.testing.assert_allclose(found.arrays["wfe_rms"][0, rigid], found.arrays["wfe_rms"][0, row], rtol=1e-3)
    assert found.arrays["wfe_rms"][0, controllers.index("elastic")].max() < 0.01 * other["wfe_rms"][0].max()


def test_views_of_controllers_show_light_that_is_stopped(tmp_path):
    given = {"name": "given", "model": "common-history", "piston_nm": 60.0, "instants": 2}
    one = exposure_study(1000, disturbance=[given], imaging={"pixels": 16, "sampling": 0.25})
    one = one.model_copy(update={"campaign": one.campaign.model_copy(update={"cases": 1, "device": "numpy"})})
    surfaces = one.telescope.surfaces
    named = (surfaces[0].model_copy(update={"name": "M2"}), *surfaces[1:])
    one = one.model_copy(update={"telescope": one.telescope.model_copy(update={"surfaces": named})})
    wq.run(one, store=tmp_path / "store", on="serial")
    assert wq.view(tmp_path / "store", file=tmp_path / "view.html").exists()
