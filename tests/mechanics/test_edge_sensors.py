import numpy as np
import pytest
from scipy import stats

from wavequake.errors import UserError
from wavequake.mechanics.disturbances.registry import analytic_rms, draw_case
from wavequake.mechanics.disturbances.sources.edge_sensors import (
    EdgeSensorNoise,
    _second_moments,
    null_count,
    sensor_matrix,
    shaping,
    shared_edges,
    unseen_motions,
)

OFFSET = 0.100722


@pytest.fixture(scope="module")
def ring(hexagons):
    """Seven hexagons without gaps."""
    angles = np.pi / 6 + np.arange(6) * np.pi / 3
    centers = 0.716 * np.sqrt(3) * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return hexagons(np.vstack([[0.0, 0.0], centers]))


@pytest.mark.parametrize(
    ("arm", "gain", "null_modes", "smallest"),
    [
        (0.0, 9.27340249764489, 4, 0.008813849757116967),
        (0.05, 29.181333234735128, 3, 0.0016269085688616052),
        (0.10, 16.548823990489428, 3, 0.0032225626676260426),
    ],
)
def test_tmt_noise_gain_and_null_modes_are_the_published_geometrys(tmt, arm, gain, null_modes, smallest):
    shape = shaping(tmt, arm, OFFSET)
    assert shape.transposed.shape == (1476, 2772)
    assert shape.unseen.shape == (1476, null_modes)
    assert shape.gain == pytest.approx(gain, rel=2e-4)
    worst = power_iteration(lambda motion: shape.seen(shape.factor.solve(shape.seen(motion))), 1476)
    assert 1 / np.sqrt(worst) == pytest.approx(smallest, rel=2e-4)


def power_iteration(applied, size):
    """Return the largest eigenvalue of a symmetric matrix."""
    vector = np.random.default_rng(0).standard_normal((size, 1))
    for _ in range(60):
        vector = applied(vector)
        vector /= np.linalg.norm(vector)
    return (vector.T @ applied(vector)).item()


@pytest.mark.parametrize("arm", [0.0, 0.05])
def test_unknowns_are_those_of_a_singular_value_decomposition(tmt, arm):
    shape = shaping(tmt, arm, OFFSET)
    left, values, right = np.linalg.svd(sensor_matrix(tmt, arm, OFFSET).matrix.toarray(), full_matrices=False)
    known = values > 1e-8 * values[0]
    assert (~known).sum() == shape.unseen.shape[1]
    readings = np.random.default_rng(3).standard_normal((2772, 8))
    found = right[known].T @ ((left[:, known].T @ readings) / values[known, None])
    np.testing.assert_allclose(shape.unknowns(readings), found, rtol=0, atol=1e-8 * found.std())


def test_tmt_has_1386_shared_edges(tmt):
    first, second, ends = shared_edges(tmt)
    assert len(first) == 1386
    assert np.all(first < second)
    assert len(set(zip(first.tolist(), second.tolist(), strict=True))) == 1386
    # Ungapped edges are about as long as the segments' sides: 0.716 m scaled by 1.0103 and less outside.
    length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    assert 0.69 < length.min() < length.max() < 0.75


def test_rigid_motion_of_the_whole_mirror_is_unseen_and_focus_is_seen_with_an_arm_only(ring):
    centers = ring.centers_m[:, :2]
    for arm, seen in ((0.0, False), (0.05, True)):
        sensors = sensor_matrix(ring, arm, OFFSET)
        for height, slope in ((1.0, (0.0, 0.0)), (0.0, (1.0, 0.0)), (0.3, (-0.2, 0.7))):
            slopes = np.tile(slope, (7, 1))
            motion = np.column_stack([height + centers @ slope, slopes * sensors.radius[:, None]])
            np.testing.assert_allclose(sensors.matrix @ motion.ravel(), 0, rtol=0, atol=1e-12)
        # Segments tangent to z = r^2 at their centers meet at the middle of every edge, at an angle.
        motion = np.column_stack([np.sum(centers**2, axis=1), 2 * centers * sensors.radius[:, None]])
        assert (np.abs(sensors.matrix @ motion.ravel()).max() > 1e-3) == seen


def test_a_reading_is_the_step_across_the_edge_and_the_dihedral_angle(ring):
    # Tilt segment 0 only: z = 2 x + 5 y; its neighbor 1 stays.
    first, second, ends = shared_edges(ring)
    edge = int(np.flatnonzero((first == 0) & (second == 1))[0])
    place = ends[edge, 0] + OFFSET * (ends[edge, 1] - ends[edge, 0]) / 0.716
    outward = (ring.centers_m[1] - ring.centers_m[0])[:2] / np.linalg.norm(ring.centers_m[1])
    for arm in (0.0, 0.07):
        sensors = sensor_matrix(ring, arm, OFFSET)
        motion = np.zeros((7, 3))
        motion[0, 1:] = np.array([2.0, 5.0]) * sensors.radius[0]
        readings = (sensors.matrix @ motion.ravel()).reshape(2, -1)
        assert readings[0, edge] == pytest.approx([2, 5] @ place + arm * ([2, 5] @ outward), rel=1e-12)


@pytest.mark.parametrize("instants", [1, 10, 161])
def test_bits_do_not_depend_on_what_is_drawn_together(ring, instants):
    entry, time = EdgeSensorNoise(name="edge"), np.arange(float(instants))

    def drawn(realizations):
        randoms = [lambda name, k=k: np.random.default_rng(k) for k in realizations]
        return entry.draw_several([ring] * len(realizations), time, randoms, realizations)

    together = drawn(range(32, 48))
    for few in ([32], [35, 36, 47], range(38, 43)):
        for realization, motion in zip(few, drawn(few), strict=True):
            assert np.array_equal(motion.segment_motion, together[realization - 32].segment_motion)


def test_the_shaped_noise_is_the_dense_pseudo_inverse_of_the_noise(ring):
    entry = EdgeSensorNoise(name="edge", sensor_rms_nm=2.0)
    motion = entry.draw(ring, np.arange(5.0), lambda name: np.random.default_rng(4))
    noise = np.random.default_rng(4).standard_normal((5, 24)) * 2e-9
    sensors = sensor_matrix(ring, 0.05, OFFSET)
    solution = (np.linalg.pinv(sensors.matrix.toarray(), rcond=1e-9) @ noise.T).T.reshape(5, 7, 3)
    np.testing.assert_allclose(motion.segment_motion[..., 2], solution[..., 0], rtol=0, atol=1e-19)
    np.testing.assert_allclose(
        motion.segment_motion[..., 3], solution[..., 2] / sensors.radius, rtol=0, atol=1e-18
    )
    np.testing.assert_allclose(
        motion.segment_motion[..., 4], -solution[..., 1] / sensors.radius, rtol=0, atol=1e-18
    )
    assert not motion.segment_motion[..., [0, 1, 5]].any()


def test_sampled_surface_rms_is_the_analytic_one(ring):
    entry = EdgeSensorNoise(name="edge", sensor_rms_nm=2.0, instants=64)
    analytic, unit = analytic_rms(entry, ring)
    assert unit == "nm"
    motions = np.concatenate([draw_case([entry], entry, ring, 1, case).segment_motion for case in range(200)])
    radius = sensor_matrix(ring, 0.05, OFFSET).radius
    surface = motions[..., 2] ** 2 + (motions[..., 3] ** 2 + motions[..., 4] ** 2) * radius**2
    for squares, rms in ((surface, 2 * shaping(ring, 0.05, OFFSET).gain), (motions[..., 2] ** 2, analytic)):
        per_instant = squares.mean(axis=1) * 1e18
        error = 5 * per_instant.std() / np.sqrt(len(per_instant))
        assert per_instant.mean() == pytest.approx(rms**2, abs=error)
        assert error < 0.12 * rms**2
    # One control step knows nothing of the one before.
    piston = motions[..., 2]
    assert abs(stats.pearsonr(piston[:-1].ravel(), piston[1:].ravel())[0]) < 0.02


def test_rotations_follow_the_local_axes(ring):
    import dataclasses

    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    turned = dataclasses.replace(ring, axes=np.tile(turn, (7, 1, 1)))
    entry = EdgeSensorNoise(name="edge")
    motion, local = (draw_case([entry], entry, layout, 1, 0).segment_motion for layout in (ring, turned))
    rotation = np.einsum("ij,nsj->nsi", turn, local[..., 3:])
    np.testing.assert_allclose(rotation, motion[..., 3:], rtol=0, atol=1e-18)
    np.testing.assert_allclose(local[..., 2], motion[..., 2], rtol=0, atol=1e-18)


def test_second_moments_are_those_of_a_hexagon_and_of_a_triangle(ring):
    np.testing.assert_allclose(_second_moments(ring.corners_m), 5 / 24 * 0.716**2, rtol=1e-12)
    # The last corner of a polygon with fewer corners is repeated.
    triangle = np.array([[[7.0, -2.0], [13.0, -2.0], [7.0, 1.0], [7.0, 1.0]]])
    np.testing.assert_allclose(_second_moments(triangle), [(36 / 18 + 9 / 18) / 2], rtol=1e-12)


def test_null_modes_lie_below_the_gap():
    assert null_count(np.array([-1e-16, 1e-16, 2e-15, 2.6e-6, 8e-5, 1.0, 11.0])) == 3
    assert null_count(np.array([1e-18, 1e-16, 2e-15, 5e-15, 8e-5, 1.0, 11.0])) == 4


def test_mirrors_without_shared_edges_and_sensors_that_do_not_fit_are_refused(few, hexagons, ring):
    entry = EdgeSensorNoise(name="edge")
    with pytest.raises(UserError, match=r"no segments of this mirror do: .* or take another telescope"):
        draw_case([entry], entry, hexagons([(0, 0), (3, 0)]), 1, 0)
    import dataclasses

    with pytest.raises(UserError, match="this one has no edges"):
        shared_edges(dataclasses.replace(few, corners_m=np.zeros((5, 0, 2))))
    with pytest.raises(UserError, match=r"do not fit on an edge of 0\.716 m"):
        sensor_matrix(ring, 0.05, 0.4)


@pytest.mark.parametrize(
    ("places", "unseen"), [([0, 1, 2, 3, 4, 5, 6], 0), ([1, 2, 3, 4, 5, 6], 3), ([0, 1, 4], 2)]
)
@pytest.mark.parametrize("arm", [0.05, 0.3])
def test_motions_that_no_sensor_sees_are_counted(ring, hexagons, places, unseen, arm):
    """Two readings per edge: six segments in a ring share 6 edges, so 12 readings leave 6 of 18 unknowns.

    Of three in a row each of the two edges is a hinge with dihedral angle: a plane on a plane needs three
    readings and has two.
    """
    layout = hexagons(ring.centers_m[places, :2])
    parameters = EdgeSensorNoise(name="noise", dihedral_arm_m=arm)
    assert unseen_motions(parameters, layout) == unseen
    matrix = sensor_matrix(layout, arm, OFFSET).matrix.toarray()
    assert matrix.shape[1] - np.linalg.matrix_rank(matrix, tol=1e-6) - 3 == unseen
