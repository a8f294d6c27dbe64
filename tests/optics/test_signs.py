"""Signs, frames and scales from a motion in SI units to the stored image, against an independent tracer.

The tracer works in one global frame with z to the *sky* (the optics have z along the light), finds surfaces
by Newton's method and moves segments as material bodies. Images are Huygens' sum over its rays' points on the
reference sphere, so that neither an OPD's sign nor a pupil's orientation can be wrong unnoticed.
"""

import csv
from pathlib import Path

import numpy as np
import pytest
from sky_tracer import glass, huygens, jwst, tmt, whole

from wavequake.campaign.contract import DONE
from wavequake.errors import UserError
from wavequake.kernels.device.devices import choose_device, list_devices
from wavequake.mechanics.disturbances.motion import still
from wavequake.optics.segments.prepared import trace_states
from wavequake.workflows.segments import disturbance as workflow
from wavequake.workflows.segments.bench import bench_of
from wavequake.workflows.segments.launches import surface_states
from wavequake.workflows.segments.study import SegmentStudy as Study

OPENCL = [device.name for device in list_devices() if device.kind != "numpy"]
DEVICE = OPENCL[0] if OPENCL else "numpy"
MAS = np.pi / 180 / 3600e3
NM = 1e-9
FACTS = Path(__file__).parents[1] / "data" / "tmt_segments.csv"
TMT_M1 = (1 / 60000, -1.00095348)
TABLE_M1 = (1 / 60000, -1.0009535)


# ---- the code under test -------------------------------------------------------------------------


def study(telescope, **sections):
    record = {
        "study": {"name": "signs", "workflow": "segment-disturbance", "seed": 1},
        "telescope": telescope if isinstance(telescope, dict) else {"name": telescope},
        "disturbance": [{"name": "given", "model": "static-random"}],
        "imaging": {"pixels": 24},
    }
    return Study.model_validate(record | sections)


def drawn(case_study, motion):
    instants = np.arange(1.0, 1.0 + len(motion.mount))
    return workflow.CaseDraw(case_study.disturbance[0], 0, instants, motion)


def computed(case_study, motion, monkeypatch):
    """What the store gets of a case that draws `motion`."""
    monkeypatch.setattr(workflow, "_draw_all", lambda bench, cases: [drawn(case_study, motion)])
    result = workflow.KIND.compute(case_study.identity_text(), np.array([0]), DEVICE)
    assert result.status[0] == DONE, result.messages
    instants = slice(len(motion.mount))
    return {
        name: array[0][instants] if array.shape[1:2] == (16,) else array[0]
        for name, array in result.arrays.items()
    }


def traced(bench, case_study, motion, device):
    states = surface_states(bench, drawn(case_study, motion), 0, len(motion.mount))
    return trace_states(bench.prepared, states, choose_device(device))


# ---- one segment ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def tmt_492():
    figured = [{"name": "given", "model": "static-random", "figure_nm": {"10": 0.0}}]
    case_study = study("tmt", disturbance=figured)
    return case_study, bench_of(case_study.identity_text()), tmt(TMT_M1, 6227.67857, 46406.542614758)


def facts(name):
    """Center and axes of a TMT segment as published, z to the sky."""
    with FACTS.open() as file:
        row = next(row for row in csv.DictReader(file) if row["id"] == name)
    numbers = {key: float(value) for key, value in row.items() if key != "id"}
    center = 1e3 * np.array([numbers[key] for key in ("x_m", "y_m", "z_m")])
    normal, along = (
        np.array([numbers[key] for key in keys])
        for keys in (("nx", "ny", "nz"), ("xaxis_x", "xaxis_y", "xaxis_z"))
    )
    normal /= np.linalg.norm(normal)
    along -= normal * (along @ normal)
    along /= np.linalg.norm(along)
    return center, np.stack([along, np.cross(normal, along), normal], axis=1)


AMPLITUDES = {"dx": 2e-6, "dy": 2e-6, "dz": 1e-7, "rx": 1e-7, "ry": 1e-7, "rz": 1e-4}


@pytest.mark.parametrize("device", sorted({"numpy", DEVICE}))
@pytest.mark.parametrize("name", ["A1", "A82", "D55"])
def test_each_motion_of_a_segment_has_the_opd_and_spot_of_a_moved_body(tmt_492, name, device):
    """A segment at the rim is inclined by 14 degrees: its normal has a part along x and y."""
    case_study, bench, tracer = tmt_492
    index = bench.system.segments.names.index(name)
    center, axes = facts(name)
    motion = still(7, 492, 10)
    motion.segment_motion[np.arange(6), index, np.arange(6)] = list(AMPLITUDES.values())
    all_rays = traced(bench, case_study, motion, device)
    mine = bench.prepared.rays.segment == index
    x, y = bench.prepared.rays.x[mine], bench.prepared.rays.y[mine]
    chief = tracer.chief(1874.9721)
    at_rest = tracer.rays(x, y)
    rest_opd = tracer.on_sphere(at_rest, chief)[0]
    for lane, (dof, amplitude) in enumerate(AMPLITUDES.items()):
        moved = np.zeros(6)
        moved[lane] = amplitude * (1e3 if lane < 3 else 1)
        rays = tracer.rays(x, y, body=(center, axes, moved))
        change = tracer.on_sphere(rays, chief)[0] - rest_opd
        spot = tracer.in_image(rays[0]) - tracer.in_image(at_rest[0])
        got = all_rays.opd[0, mine, lane] - all_rays.opd[0, mine, 6]
        moved_to = np.stack(
            [values[0, mine, lane] - values[0, mine, 6] for values in (all_rays.x, all_rays.y)], 1
        )
        np.testing.assert_allclose(got, change, rtol=0, atol=1e-6 * 550e-6, err_msg=dof)
        np.testing.assert_allclose(moved_to, spot, rtol=0, atol=1e-6 * np.abs(spot).max() + 1e-9, err_msg=dof)
        np.testing.assert_array_equal(all_rays.opd[0, ~mine, lane], all_rays.opd[0, ~mine, 6], err_msg=dof)
    # And in words: towards the sky shortens the path by twice the cosine; the light leaves by twice the tilt.
    normal = axes[2, 2]
    assert np.mean(all_rays.opd[0, mine, 2] - all_rays.opd[0, mine, 6]) == pytest.approx(
        2 * normal * 1e-4, rel=1e-3
    )
    if name == "A1":  # its axes are nearly the global ones
        assert np.mean(all_rays.x[0, mine, 4]) > 0.05  # about +y: the normal, and the light, lean to +x
        assert np.mean(all_rays.y[0, mine, 3]) < -0.05


NOLL = {  # u, v in units of the circumscribed radius: height, slopes
    4: lambda u, v: np.sqrt(3) * np.array([2 * (u**2 + v**2) - 1, 4 * u, 4 * v]),
    5: lambda u, v: np.sqrt(6) * np.array([2 * u * v, 2 * v, 2 * u]),
    6: lambda u, v: np.sqrt(6) * np.array([u**2 - v**2, 2 * u, -2 * v]),
    7: lambda u, v: np.sqrt(8) * np.array([(3 * (u**2 + v**2) - 2) * v, 6 * u * v, 3 * u**2 + 9 * v**2 - 2]),
    8: lambda u, v: np.sqrt(8) * np.array([(3 * (u**2 + v**2) - 2) * u, 9 * u**2 + 3 * v**2 - 2, 6 * u * v]),
    9: lambda u, v: np.sqrt(8) * np.array([3 * u**2 * v - v**3, 6 * u * v, 3 * (u**2 - v**2)]),
    10: lambda u, v: np.sqrt(8) * np.array([u**3 - 3 * u * v**2, 3 * (u**2 - v**2), -6 * u * v]),
}


def test_figures_are_towards_the_sky_and_turn_with_the_segments_axes(tmt_492):
    case_study, bench, tracer = tmt_492
    index = bench.system.segments.names.index("A82")
    center, axes = facts("A82")
    mine = bench.prepared.rays.segment == index
    x, y = bench.prepared.rays.x[mine], bench.prepared.rays.y[mine]
    radius = np.hypot(*(bench.system.segments.corners[index] - center[:2]).T).max()
    ex, ey = axes[:2, 0] / np.hypot(*axes[:2, 0]) / radius
    chief = tracer.chief(1874.9721)
    rest = tracer.on_sphere(tracer.rays(x, y), chief)[0]
    at_rest = traced(bench, case_study, still(1, 492, 10), "numpy").opd[0, mine, 0]
    for noll, shape in NOLL.items():

        def figure(px, py, shape=shape):
            u, v = (
                ex * (px - center[0]) + ey * (py - center[1]),
                ex * (py - center[1]) - ey * (px - center[0]),
            )
            height, slope_u, slope_v = shape(u, v) * 1e-4 / axes[2, 2]
            return height, slope_u * ex - slope_v * ey, slope_u * ey + slope_v * ex

        motion = still(1, 492, 10)
        motion.segment_figure[index, noll - 1] = 100 * NM
        got = traced(bench, case_study, motion, "numpy").opd[0, mine, 0] - at_rest
        want = tracer.on_sphere(tracer.rays(x, y, figure=figure), chief)[0] - rest
        np.testing.assert_allclose(got, want, rtol=0, atol=1e-6 * 550e-6, err_msg=str(noll))


# ---- the whole telescope -------------------------------------------------------------------------


def tables(name):
    if name == "jwst":
        case_study = study(name, optics={"wavelength_nm": 2000.0})
        bench = bench_of(case_study.identity_text())
        return case_study, bench, jwst(bench.first_order.exit_pupil_distance)
    case_study = study(name)
    return case_study, bench_of(case_study.identity_text()), tmt(TABLE_M1, 6227.68, 46406.543198188)


@pytest.mark.parametrize("name", ["tmt-18", "jwst"])
@pytest.mark.parametrize("what", ["segments", "mount", "m2"])
def test_the_stored_image_is_huygens_sum_over_traced_rays(name, what, monkeypatch):
    """Also raw rms, Strehl ratio, centroid and LOS of the same instant; 18 rays per segment against 750."""
    case_study, bench, tracer = tables(name)
    wavelength, focal_length = bench.prepared.wavelength, bench.first_order.focal_length
    diameter = 2 * bench.system.annulus.outer
    resolved = wavelength / diameter
    motion = still(1, 18)
    m2 = (0.0, 0.0)
    if what == "segments":
        motion.segment_motion[0, 4, 3], motion.segment_motion[0, 11, 4] = 0.7 * resolved, 0.6 * resolved
        motion.segment_motion[0, 2, 2] = 0.1 * wavelength * 1e-3
    else:
        getattr(motion, what)[0] = 1.6 * resolved, -0.8 * resolved
    got = computed(case_study, motion, monkeypatch)
    if (
        what == "m2"
    ):  # a rotation vector in the optics' frame, which a mirror turns into that of the sky's frame
        m2 = tuple(-bench.m2_tilt @ motion.m2[0])
    pupil = glass(bench.layout.corners_m * 1e3, 30)
    weight = pupil[2]
    state = whole(tracer, bench, pupil, motion.segment_motion[0], tuple(motion.mount[0]), m2)
    rest = whole(tracer, bench, pupil, np.zeros((18, 6)))

    to_mas = 1 / focal_length / MAS
    spot_radius = np.sqrt(weight @ np.sum((state.spots - weight @ state.spots) ** 2, axis=1)) * to_mas
    np.testing.assert_allclose(
        got["centroid"][0],
        weight @ (state.spots - rest.spots) * to_mas,
        rtol=1e-5,
        atol=1e-4 * max(spot_radius, 1.0),
    )
    opd = state.opd - weight @ state.opd
    assert got["wfe_rms_raw"][0] == pytest.approx(np.sqrt(weight @ opd**2) * 1e6, rel=2e-3)
    plane = np.column_stack([np.ones_like(opd), pupil[0]])
    root = np.sqrt(weight)[:, None]
    fitted = np.linalg.lstsq(root * plane, root[:, 0] * opd, rcond=None)[0]
    strehl = np.abs(weight @ np.exp(2j * np.pi / wavelength * (opd - plane @ fitted))) ** 2
    assert got["strehl"][0] == pytest.approx(strehl, abs=3e-4)
    if what != "segments":
        np.testing.assert_allclose(got["los"][0] * MAS, motion.mount[0] + motion.m2[0], rtol=2e-4)

    rows = np.arange(0, 24, 3)
    axis = (rows - 12) * 0.25 * resolved * focal_length
    x, y = np.meshgrid(axis, axis)
    image = huygens(tracer, state, weight, x, y, wavelength)
    np.testing.assert_allclose(got["exposure"][np.ix_(rows, rows)], image, rtol=0, atol=1e-3)
    assert np.abs(image - image.T).max() > 0.02  # so the test tells x from y


@pytest.mark.parametrize(
    ("name", "field"), [("tmt", (0.15, -0.2)), ("jwst", (0.2, -0.3)), ("tmt-18", (0.0, 0.0))]
)
def test_a_drawn_line_of_sight_is_seen_on_both_axes_at_a_field_point_too(name, field, monkeypatch):
    case_study = study(name, optics={"field_arcmin": field}, imaging={"pixels": 8})
    segments = len(bench_of(case_study.identity_text()).layout)
    motion = still(4, segments)
    motion.mount[0], motion.mount[1] = (50 * MAS, 0), (0, 50 * MAS)
    motion.m2[2], motion.m2[3] = (50 * MAS, 0), (0, 50 * MAS)
    got = computed(case_study, motion, monkeypatch)
    want = 50 * np.array([[1, 0], [0, 1], [1, 0], [0, 1]])
    np.testing.assert_allclose(got["los"], want, rtol=0, atol=0.01)
    np.testing.assert_allclose(got["los"][2:], want[2:], rtol=0, atol=1e-5)
    np.testing.assert_allclose(got["centroid"][:2], want[:2], rtol=0, atol=0.02)
    # M2's coma: the centroid lags the line of sight.
    assert 0.985 * 50 < got["centroid"][2, 0] < 0.997 * 50


# ---- telescopes of one's own ---------------------------------------------------------------------

HEXAGONS = [(np.sqrt(3) * 0.5 * np.cos(a), np.sqrt(3) * 0.5 * np.sin(a)) for a in np.arange(6) * np.pi / 3]


def own_telescope(surfaces):
    turns = np.pi / 6 + np.arange(6) * np.pi / 3
    lines = ["id," + ",".join(f"x{i}_m,y{i}_m" for i in range(1, 7))]
    for index, (x, y) in enumerate(HEXAGONS):
        corners = np.stack([x + 0.49 * np.cos(turns), y + 0.49 * np.sin(turns)], axis=1)
        lines.append(f"{index}," + ",".join(f"{value:.9f}" for value in corners.ravel()))
    return {
        "name": "custom",
        "polygons_csv": "\n".join(lines),
        "primary_radius_mm": -12000.0,
        "surfaces": surfaces,
    }


def test_a_mirror_that_tilts_as_one_moves_los_centroid_and_image_alike_behind_an_intermediate_image(
    monkeypatch,
):
    """Gregorian telescope: 1.5 m behind the focus of M1, an ellipsoid magnifies 5 times."""
    surfaces = [
        {"name": "M2", "radius_mm": 2500.0, "conic": -((4 / 6) ** 2), "distance_mm": 7500.0},
        {"name": "image", "distance_mm": 7500.0},
    ]
    case_study = study(own_telescope(surfaces), wavefront={"zernike_terms": 10})
    bench = bench_of(case_study.identity_text())
    assert bench.first_order.focal_length == pytest.approx(-30000.0)
    tilt = 20 * MAS
    motion = still(2, 6)
    motion.segment_motion[:, :, 3] = tilt
    motion.segment_motion[:, :, 2] = tilt * bench.layout.centers_m[:, 1]
    got = computed(case_study, motion, monkeypatch)
    # Turning about +x raises the side of +y; its light leaves to -y, and so does the image on the sky.
    np.testing.assert_allclose(got["centroid"], [[0, -40]] * 2, rtol=0, atol=0.4)
    np.testing.assert_allclose(got["los"], [[0, -40]] * 2, rtol=0, atol=0.4)
    row, column = np.unravel_index(got["exposure"].argmax(), (24, 24))
    expected = -40 * MAS / (550e-6 / (2 * bench.system.annulus.outer)) / 0.25
    assert column == 12
    assert abs(row - 12 - expected) < 1

    motion = still(2, 6)
    motion.m2[0], motion.m2[1] = (50 * MAS, 0), (0, 50 * MAS)
    got = computed(case_study, motion, monkeypatch)
    np.testing.assert_allclose(got["los"], 50 * np.eye(2), rtol=0, atol=1e-5)
    np.testing.assert_allclose(got["centroid"], 50 * np.eye(2), rtol=0, atol=1.0)


def test_a_telescope_without_m2_has_none_to_tilt():
    telescope = own_telescope([{"name": "image", "distance_mm": 6000.0}])
    shaken = [{"name": "shake", "model": "line-of-sight", "act": "m2"}]
    with pytest.raises(UserError, match="'shake' tilts M2, but the telescope custom has no mirror"):
        bench_of(study(telescope, disturbance=shaken, wavefront={"zernike_terms": 10}).identity_text())
    bench = bench_of(study(telescope, wavefront={"zernike_terms": 10}).identity_text())
    np.testing.assert_array_equal(bench.m2_tilt, 0.0)
