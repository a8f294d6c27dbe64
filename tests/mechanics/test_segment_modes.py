"""The interaction matrix of 492 real segments, against numbers computed elsewhere and bodies in space."""

from dataclasses import replace

import numpy as np
import pytest

from wavequake.mechanics.disturbances.sources.edge_sensors import shared_edges
from wavequake.mechanics.segment_control import EdgeSensing, SensingErrors, mode_interaction, seen_modes

PLANAR = EdgeSensing(0.531, (90.0, 210.0, 330.0), 0.05, 0.100722, curved=False)
CURVED = replace(PLANAR, curved=True)
# M1 of the TMT: radius of curvature, conic constant.
RADIUS, CONIC = 60.0, -1.000953


@pytest.fixture(scope="module")
def planar(tmt):
    return seen_modes(tmt, PLANAR)


@pytest.fixture(scope="module")
def curved(tmt):
    return seen_modes(tmt, CURVED)


def singular_values(matrix):
    return np.sqrt(np.abs(np.linalg.eigvalsh(matrix.T @ matrix)))


def read_in_space(layout, sensing, radius):
    """Readings of segments that turn about their centers as bodies in space, along the mirror's own normal.

    Sensors sit on the conic. They read the displacement along its normal there, and the turn about the edge
    times the arm.
    """
    first, second, ends = shared_edges(layout)
    along = ends[:, 1] - ends[:, 0]
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    found = []
    for place in (ends[:, 0] + sensing.offset_m * along, ends[:, 1] - sensing.offset_m * along):
        square = np.sum(place**2, axis=1, keepdims=True)
        root = np.sqrt(1 - (1 + CONIC) * square / RADIUS**2)
        point = np.hstack([place, square / RADIUS / (1 + root)])
        normal = np.hstack([-place / (RADIUS * root), np.ones_like(square)])
        edge = np.hstack([along, np.sum(-normal[:, :2] * along, axis=1, keepdims=True)])
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        across = np.cross(edge / np.linalg.norm(edge, axis=1, keepdims=True), normal)
        rows = np.zeros((len(first), len(layout), 3))
        for segment, sign in ((first, 1.0), (second, -1.0)):
            x, y, z = np.moveaxis(layout.axes[segment], 2, 0)
            lever = point - layout.centers_m[segment] + sensing.arm_m * across
            # z = slope_x x + slope_y y is the rotation (slope_y, -slope_x).
            moved = [
                z,
                np.cross(-y, lever) / radius[segment, None],
                np.cross(x, lever) / radius[segment, None],
            ]
            for column, one in enumerate(moved):
                rows[np.arange(len(first)), segment, column] = sign * np.sum(normal * one, axis=1)
        found.append(rows.reshape(len(first), -1))
    return np.vstack(found)


def test_singular_values_of_the_planar_matrix_are_the_references(planar):
    # Reading per stroke of the actuators, m/m, computed apart from this code; to the last printed digit.
    found = singular_values(planar.readings @ planar.strokes)
    assert found[:3].max() < 1e-6
    printed = np.array([9.37450e-4, 5.15370e-3, 5.16053e-3, 1.15523e-2, 3.34050])
    assert np.all(np.abs(found[[3, 4, 5, 6, -1]] - printed) < [6e-9, 6e-9, 6e-9, 6e-8, 6e-6])


def test_noise_multipliers_are_the_references(tmt, planar):
    assert len(planar.singular) == 1473
    # The reference has regular hexagons of 0.7201 m for the mean square of a surface.
    regular = np.tile([1.0, *[np.sqrt(5 / 24) * 0.7201] * 2], len(tmt))
    own = np.stack([np.ones(len(tmt)), planar.radius, planar.radius], axis=1).ravel()
    found = 1 / (singular_values(planar.readings.toarray() * (own / regular))[3:] * np.sqrt(len(tmt)))
    np.testing.assert_allclose(found[:5], [27.71, 5.05, 5.04, 2.25, 2.21], rtol=0, atol=5e-3)
    assert np.linalg.norm(found) == pytest.approx(29.181, abs=5e-4)
    # Of real segments: each has a second moment of its own, smaller ones toward the rim.
    assert np.abs(own / regular - 1).max() < 0.03
    assert np.linalg.norm(planar.multipliers) == pytest.approx(29.1775, abs=5e-5)


def test_a_curved_mirror_is_read_as_bodies_in_space(tmt, curved):
    expected = singular_values(read_in_space(tmt, CURVED, curved.radius))[3:]
    # Normals of segments and mirror differ by half a dihedral angle, 1.25 m / 60 m / 2: squared 1.1e-4.
    assert curved.singular[0] == pytest.approx(expected[0], rel=1.1e-4)
    # A sensor 0.67 m from the center is 3.8 mm above the plane of its segment. Seen along the axis, at
    # a slope of 0.24, that is 0.9 mm of its lever, 1.4e-3.
    np.testing.assert_allclose(curved.singular, expected, rtol=1.4e-3)
    assert np.linalg.norm(1 / curved.singular) == pytest.approx(np.linalg.norm(1 / expected), rel=1.1e-4)


def test_focus_of_a_curved_mirror_per_stroke(planar, curved):
    # 9.1 of 9.4 e-4: an arm is across the edge in the plane of its segment.
    assert singular_values(curved.readings @ curved.strokes)[3] == pytest.approx(9.09994e-4, abs=6e-9)
    assert singular_values(planar.readings @ planar.strokes)[3] == pytest.approx(9.37450e-4, abs=6e-9)


def test_tip_and_tilt_of_a_curved_mirror_are_left_out_by_geometry(planar, curved):
    found = singular_values(curved.readings @ curved.strokes)
    # They seem to be seen: by the widest gap between these values one mode would be left out, not three.
    gaps = found[1:5] / found[:4]
    assert gaps.argmax() == 0
    assert found[2] < 0.01 * found[3]
    assert len(curved.singular) == len(planar.singular) == 1473
    assert np.abs(curved.shapes.T @ curved.rigid).max() < 1e-9


def test_rigid_motions_of_the_whole_mirror_are_read_for_lack_of_motions_in_segments_planes(
    tmt, planar, curved
):
    assert np.abs(planar.readings @ planar.rigid).max() < 1e-13
    # Neighbors at a height z, at an angle of 1.25 m / 60 m, lack z times the angle that the mirror turns by.
    first, second, _ = shared_edges(tmt)
    angle = np.linalg.norm(tmt.axes[first, :, 2] - tmt.axes[second, :, 2], axis=1).max()
    height = np.abs(tmt.centers_m[:, 2]).max()
    turned = 1 / np.sqrt(np.sum(tmt.centers_m[:, 0] ** 2))
    assert np.abs(curved.readings @ curved.rigid).max() < angle * height * turned


def test_the_least_seen_mode_is_focus_and_is_seen_in_proportion_to_the_arm(tmt, planar):
    x, y = tmt.centers_m[:, :2].T
    motion = np.zeros((len(tmt), 3))
    motion[:, 0] = x**2 + y**2
    plane = tmt.axes[:, :2, 0] / np.linalg.norm(tmt.axes[:, :2, 0], axis=1, keepdims=True)
    slope = 2 * np.column_stack([x, y])
    motion[:, 1] = np.sum(slope * plane, axis=1) * planar.radius
    motion[:, 2] = (slope[:, 1] * plane[:, 0] - slope[:, 0] * plane[:, 1]) * planar.radius
    focus = motion.ravel() - planar.rigid @ (planar.rigid.T @ motion.ravel())
    # Of the mode by strokes the reference has 0.9999965.
    assert abs(focus @ planar.shapes[:, 0]) / np.linalg.norm(focus) > 0.99999645
    longer = seen_modes(tmt, replace(PLANAR, arm_m=0.1)).singular[0]
    # Least singular values of the published geometry with 10 and 5 cm, of regular hexagons.
    expected = 0.0032225626676260426 / 0.0016269085688616052
    assert longer / planar.singular[0] == pytest.approx(expected, rel=2e-6)


def test_without_errors_a_mode_is_read_as_itself(tmt, planar):
    found = mode_interaction(tmt, PLANAR, planar, SensingErrors(), np.random.default_rng(1))
    np.testing.assert_allclose(found, np.eye(len(found)), rtol=0, atol=1e-7)


def test_an_arm_of_another_length_scales_focus_and_hardly_others(tmt, planar):
    drawn = np.random.default_rng(1).standard_normal()
    errors = SensingErrors(arm=(0.04 / 0.05 - 1) / drawn)
    values = np.linalg.eigvals(mode_interaction(tmt, PLANAR, planar, errors, np.random.default_rng(1)))
    values = values[np.argsort(np.abs(values - 1))]
    assert values[-1] == pytest.approx(0.8, abs=1e-6)
    # Of both interaction matrices per stroke, built and inverted apart from this code: others move by 2.4 %,
    # mostly in phase; their sizes stay within 1.1 % below and 0.4 % above 1.
    assert abs(values[-2]) == pytest.approx(abs(0.99154581 + 0.02282299j), abs=1e-8)
    assert abs(values[-2] - 1) == pytest.approx(abs(-0.00845419 + 0.02282299j), abs=1e-8)
    sizes = np.abs(values[:-1])
    assert sizes.min() == pytest.approx(0.98885283, abs=1e-7)
    assert sizes.max() == pytest.approx(1.00404862, abs=1e-7)


@pytest.mark.parametrize("kind", ["sensor_gain", "actuator_gain", "entries"])
def test_errors_mix_modes_as_much_as_their_variances_say(tmt, planar, kind):
    size = 1e-3
    found = mode_interaction(tmt, PLANAR, planar, SensingErrors(**{kind: size}), np.random.default_rng(1))
    readings = planar.readings @ planar.shapes / planar.singular
    strokes = np.linalg.solve(planar.strokes, planar.shapes)
    matrix = planar.readings @ planar.strokes
    # Independent relative errors of rows, of columns and of entries: all three are linear in them.
    variance = {
        "sensor_gain": lambda: (readings**2).T @ readings**2 * planar.singular**2,
        "actuator_gain": lambda: (readings.T @ matrix) ** 2 @ strokes**2,
        "entries": lambda: (readings**2).T @ matrix**2 @ strokes**2,
    }[kind]() / planar.singular[:, None] ** 2
    standard = (found - np.eye(len(found))) / (size * np.sqrt(variance))
    # Mean square of at least 1476 draws: three standard errors.
    assert np.mean(standard**2) == pytest.approx(1.0, abs=3 * np.sqrt(2 / 1476))
    # Of 2.2 million normal numbers none is above 6.
    assert np.abs(standard).max() < 6
    if kind == "entries":
        own = np.sqrt(np.diag(variance))
        assert own[0] == pytest.approx(42.9, abs=0.05)  # errors of 1e-3 move focus by 4.3 %
        assert own[1:].max() < own[0] / 7
