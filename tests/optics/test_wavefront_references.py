"""Wavefronts of telescopes against extended-precision traces."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from wavefront_cases import (
    WAVELENGTH,
    each_device,
    local_motion,
    reference,
    slope,
    states_of,
)

from wavequake.kernels.device.tiles import TILE, from_tiles
from wavequake.optics.rays.pupils import PupilRays
from wavequake.optics.segments.catalog import telescope
from wavequake.optics.segments.prepared import chief_rays, prepare, trace_states
from wavequake.optics.segments.wavefront import analyse, los_eq339, measure


@each_device
def test_fields_of_the_thesis_telescope(thesis, device):
    fields = reference("tmt_optics.json")["fields"]
    states = states_of(thesis)
    states.line_of_sight[: len(fields), 0] = np.deg2rad([field["field_arcmin"] / 60 for field in fields])
    wavefront = measure(thesis, states, device)
    for instant, field in enumerate(fields):
        np.testing.assert_allclose(wavefront.zernike[instant], field["c_noll_annular"], rtol=0, atol=1e-6)
        assert wavefront.rms[instant] == pytest.approx(field["wfe_rms_j4up"], abs=1e-6)
        assert wavefront.rms_raw[instant] == pytest.approx(field["wfe_rms_piston_removed"], abs=1e-6)
        np.testing.assert_allclose(wavefront.chief[instant], [1e3 * field["chief_x_m"], 0], rtol=0, atol=1e-8)
        assert wavefront.spot_rms[instant] == pytest.approx(1e3 * field["rms_spot_radius_m"], rel=1e-6)
    assert not wavefront.lost.any()


@each_device
def test_four_lines_of_sight_of_m2(thesis, device):
    step = 1e-6
    states = states_of(thesis)
    states.surface_motion[:2, 2, 3] = step, -step
    states.surface_motion[2:4, 2, 2] = 1e3 * step, -1e3 * step
    wavefront = measure(thesis, states, device)
    printed = los_eq339(wavefront.chief, wavefront.zernike, WAVELENGTH, thesis.numerical_aperture)
    for pair, name in ((slice(0, 2), "alpha"), (slice(2, 4), "dz")):
        expected = reference("tmt_optics.json")["m2_rigid_per_m_or_rad"][name]
        c = np.array(expected["c_noll_annular_waves"])
        np.testing.assert_allclose(
            slope(wavefront.zernike[pair], step)[0], c, rtol=0, atol=1e-6 * np.abs(c).max()
        )
        for quantity, key in (
            (wavefront.chief, "chief"),
            (wavefront.centroid, "centroid"),
            (printed, "LOS_339_annular"),
            (wavefront.los, "LOS_339_annular_over_sqrt1pe2"),
        ):
            np.testing.assert_allclose(
                1e-3 * slope(quantity[pair], step)[0], expected[key], rtol=1e-6, atol=1e-6
            )


def test_m2_about_its_center_of_curvature_leaves_the_chief_ray(thesis):
    step = 1e-6
    states = states_of(thesis)
    center = np.array([0.0, 0.0, thesis.system.after_primary[0].shape.radius])
    for instant, angle in enumerate((step, -step)):
        turn = Rotation.from_euler("x", angle).as_matrix()
        states.surface_motion[instant, 2] = *(center - turn @ center), angle, 0, 0
    chief = chief_rays(thesis, states)
    assert np.abs(1e-3 * slope(from_tiles(chief)[:2, :2], step)).max() < 2e-5


@each_device
def test_random_pistons_of_18_segments(tmt18, device):
    expected = reference("tmt18_segments.json")
    np.testing.assert_allclose(
        tmt18.system.segments.centers[:, :2], 1e3 * np.array(expected["centers_m"]), rtol=0, atol=1e-6
    )
    # The reference scales the NA of 15 m with the radius; ours is the sine of the real marginal ray.
    assert tmt18.numerical_aperture == pytest.approx(expected["numerical_aperture"], rel=1e-6)
    pistons = expected["random_pistons"]
    motion = np.zeros((TILE, 18, 6))
    motion[1, :, 2] = 1e3 * np.array(pistons["pistons_m"])
    states = replace(states_of(tmt18), segment_motion=local_motion(tmt18.system.segments, motion))
    wavefront = measure(tmt18, states, device)
    np.testing.assert_allclose(wavefront.zernike[0], expected["nominal_zernike"], rtol=0, atol=1e-6)
    np.testing.assert_allclose(wavefront.zernike[1], pistons["zernike"], rtol=0, atol=1e-6)
    assert wavefront.rms_raw[1] == pytest.approx(pistons["rms_raw"], abs=1e-6)
    assert wavefront.rms[1] == pytest.approx(0.095681727, abs=1e-6)
    printed = los_eq339(wavefront.chief, wavefront.zernike, WAVELENGTH, expected["numerical_aperture"])
    np.testing.assert_allclose(1e-3 * printed[1], pistons["los_m"], rtol=1e-6)


@each_device
def test_sensitivities_of_18_pistons(tmt18, device):
    data = reference("tmt18_segments.json")
    expected = {key: np.array(values) for key, values in data["piston_z"].items()}
    step = 1e-7
    motion = np.zeros((3 * TILE, 18, 6))
    for segment in range(18):
        motion[2 * segment : 2 * segment + 2, segment, 2] = 1e3 * step, -1e3 * step
    states = replace(states_of(tmt18, 3 * TILE), segment_motion=local_motion(tmt18.system.segments, motion))
    traced, chief = trace_states(tmt18, states, device), chief_rays(tmt18, states)
    wavefront = analyse(tmt18, traced, chief)
    opd = slope(from_tiles(traced.opd)[:36], step) / WAVELENGTH
    on_segment = np.array([opd[k, tmt18.rays.segment == k].mean() for k in range(18)])
    printed = los_eq339(wavefront.chief, wavefront.zernike, WAVELENGTH, data["numerical_aperture"])
    for values, key in (
        (slope(wavefront.zernike[:36], step), "zernike"),
        (1e-3 * slope(printed[:36], step), "los"),
        (1e-3 * slope(wavefront.centroid[:36], step), "centroid"),
        (opd.std(axis=1), "rms_raw"),
        (on_segment, "mean_opd_on_segment"),
    ):
        np.testing.assert_allclose(
            values, expected[key], rtol=0, atol=1e-6 * np.abs(expected[key]).max(), err_msg=key
        )


def grid_rays(system, names, total):
    """The reference's grid points on the named segments; 6 rays stand for the points on each other one."""
    segments = system.segments
    grid = (np.arange(600) + 0.5) * 50.0 - 15e3
    parts, counted = [], 0
    for k in map(segments.names.index, names):
        center, corners = segments.centers[k, :2], segments.corners[k]
        x, y = (axis.ravel() for axis in np.meshgrid(*(grid[np.abs(grid - c) < 800] for c in center)))
        edge = np.roll(corners, -1, axis=0) - corners
        side = edge[:, 0, None] * (y - corners[:, 1, None]) - edge[:, 1, None] * (x - corners[:, 0, None])
        x, y = x[(side > 0).all(axis=0)], y[(side > 0).all(axis=0)]
        parts.append((x, y, np.ones_like(x), np.full(len(x), k)))
        counted += len(x)
    others = [k for k in range(len(segments)) if segments.names[k] not in names]
    spread = np.array([[0, 0], [400, 0], [0, 400], [-400, 0], [0, -400], [300, 300.0]])
    x, y = (segments.centers[others, None, :2] + spread).reshape(-1, 2).T
    weight = np.full(len(x), (total - counted) / len(x))
    parts.append((x, y, weight, np.repeat(others, len(spread))))
    return PupilRays(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


@each_device
def test_two_of_492_segments(device):
    expected = reference("tmt492_segments.json")
    names, dofs, step = ["A1", "B10"], {"piston_z": (2, 1e-4), "rot_x": (3, 1e-7), "rot_y": (4, 1e-7)}, 1e-7
    system = telescope("tmt")
    prepared = prepare(system, grid_rays(system, names, expected["rays_on_glass"]), WAVELENGTH, 11)
    motion = np.zeros((TILE, 492, 6))
    for case, (name, (dof, h)) in enumerate((name, dof) for name in names for dof in dofs.values()):
        motion[2 * case : 2 * case + 2, system.segments.names.index(name), dof] = h, -h
    states = replace(states_of(prepared), segment_motion=local_motion(system.segments, motion))
    traced = trace_states(prepared, states, device)
    opd, x, y = (1e-3 * slope(from_tiles(values)[:12], step) for values in (traced.opd, traced.x, traced.y))
    for case, (name, dof) in enumerate((name, dof) for name in names for dof in dofs):
        values = expected["segments"][name][dof]
        own = prepared.rays.segment == system.segments.names.index(name)
        assert np.count_nonzero(own) == expected["segments"][name]["n_rays"]
        mean = opd[case, own].mean()
        assert mean == pytest.approx(values["mean_opd_m_per_unit"], abs=2e-6)
        assert opd[case, own].std() == pytest.approx(values["rms_opd_on_segment"], abs=1e-6)
        full = np.sqrt(prepared.weight @ (opd[case] - prepared.weight @ opd[case]) ** 2)
        assert full == pytest.approx(values["rms_opd_full_pupil_piston_removed"], rel=1e-6)
        spot = [x[case, own].mean(), y[case, own].mean()]
        np.testing.assert_allclose(spot, values["spot_shift_of_segment_m_per_unit"], rtol=1e-6, atol=1e-5)
        centroid = [prepared.weight @ x[case], prepared.weight @ y[case]]
        np.testing.assert_allclose(centroid, values["centroid_full_pupil_m_per_unit"], rtol=1e-6, atol=1e-7)
