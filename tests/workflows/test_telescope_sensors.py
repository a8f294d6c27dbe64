"""Sensors of loops on telescopes: what they read, misplaced, of edges and slopes, with noise."""

import numpy as np
import pytest
from small_loops import LIGHT

from wavequake.chain.loops.block import Centroids
from wavequake.chain.loops.displaced import seen_through
from wavequake.chain.loops.sensors.edges import EdgeSensors
from wavequake.chain.loops.sensors.slopes import SlopeSensor
from wavequake.chain.loops.sensors.wavefront import WavefrontSensor
from wavequake.mechanics.disturbances.motion import RAD_PER_MAS
from wavequake.mechanics.disturbances.sources.edge_sensors import shared_edges
from wavequake.optics.polynomials.zernike import annular_zernike, annular_zernike_gradient


def test_a_misplaced_wavefront_sensor_reads_the_shifted_and_turned_wavefront():
    """Coefficients of W at displaced points, fitted by another way: an overlap integral over the annulus."""
    sensor = WavefrontSensor(name="w", shift=(0.02, -0.01), rotation_deg=3.0, magnification=1.01)
    rng = np.random.default_rng(4)
    seen = rng.standard_normal(len(LIGHT))
    rho = np.sqrt(np.linspace(0.3**2, 1, 401)[:-1] + 0.5 * (1 - 0.09) / 400)
    angle = np.arange(400) * 2 * np.pi / 400
    x, y = (np.outer(rho, part(angle)).ravel() for part in (np.cos, np.sin))
    turn = np.radians(3.0)
    at_x = 0.02 + 1.01 * (np.cos(turn) * x - np.sin(turn) * y)
    at_y = -0.01 + 1.01 * (np.sin(turn) * x + np.cos(turn) * y)
    noll = LIGHT.noll @ seen
    values = annular_zernike(at_x, at_y, 28, 0.3)[:, 1:] @ noll
    wanted = (annular_zernike(x, y, 28, 0.3)[:, 1:] * values[:, None]).mean(axis=0)
    np.testing.assert_allclose(
        sensor.matrix(LIGHT) @ seen, wanted, rtol=2e-4, atol=2e-4 * np.abs(wanted).max()
    )
    np.testing.assert_allclose(sensor.matrix(LIGHT, nominal=True) @ seen, noll)


def test_the_tilt_of_the_wavefront_falls_to_where_the_image_goes():
    """1 mas of line of sight along +x: a wavefront that falls by 1 mas times the distance along x."""
    slopes = np.zeros(len(LIGHT))
    slopes[0] = 1.0
    noll = LIGHT.noll @ slopes
    _, by_x, _ = annular_zernike_gradient(np.array([0.5]), np.array([0.2]), 28, 0.3)
    # nm per radius of 15 m.
    assert by_x[0, 1:] @ noll / 15e9 == pytest.approx(-RAD_PER_MAS)


def test_misplaced_slopes_turn_with_the_sensor_and_are_those_of_what_it_sees():
    """A line of sight along x is cos and -sin of it along axes turned by 10 deg, times the magnification."""
    turned = SlopeSensor(name="s", across=6, rotation_deg=10.0, magnification=1.05).matrix(LIGHT)
    count = len(turned) // 2
    wanted = 1.05 * np.repeat([np.cos(np.radians(10.0)), -np.sin(np.radians(10.0))], count)
    np.testing.assert_allclose(turned[:, 0], wanted, atol=1e-12)
    placed = WavefrontSensor(name="w", shift=(0.1, 0.05), rotation_deg=20.0, magnification=0.9)
    x, y, h = np.array([0.3, -0.5]), np.array([0.4, 0.1]), 1e-6
    seen = seen_through(placed, x, y, 15, 0.3)
    for slopes, dx, dy in ((seen.by_x, h, 0.0), (seen.by_y, 0.0, h)):
        ahead, behind = (seen_through(placed, x + way * dx, y + way * dy, 15, 0.3).values for way in (1, -1))
        np.testing.assert_allclose(slopes, (ahead - behind) / (2 * h), atol=1e-7)


def test_edge_sensors_read_heights_and_angles_of_facing_segments():
    """By the planes of two moved segments at the places of the sensors, and across the edge by the arm."""
    sensor, layout = EdgeSensors(name="e", arm_m=0.05), LIGHT.layout
    rng = np.random.default_rng(6)
    count = len(layout)
    dz, rx, ry = rng.standard_normal((3, count))
    readings = sensor.matrix(LIGHT) @ np.concatenate([dz, rx, ry])
    first, second, ends = shared_edges(layout)
    assert len(readings) == 2 * len(first) == len(sensor.labels(LIGHT))

    def height(segment, at):
        across = layout.axes[segment][:2, 0] / np.linalg.norm(layout.axes[segment][:2, 0])
        x, y = (at - layout.centers_m[segment, :2]) @ np.array([across, [-across[1], across[0]]]).T
        return dz[segment] + rx[segment] * y - ry[segment] * x

    for edge in (0, 7, 20):
        a, b = first[edge], second[edge]
        along = ends[edge, 1] - ends[edge, 0]
        along = along / np.linalg.norm(along)
        outward = np.array([along[1], -along[0]])
        assert outward @ (layout.centers_m[b] - layout.centers_m[a])[:2] > 0
        at = ends[edge, 0] + 0.100722 * along
        step = height(a, at) - height(b, at)
        angle = sum(
            way * (height(segment, at + outward) - height(segment, at)) for segment, way in ((a, 1), (b, -1))
        )
        assert readings[edge] == pytest.approx(step + 0.05 * angle, abs=1e-9)


def test_slopes_are_where_the_images_of_subapertures_go():
    """Of a pure line of sight every subaperture shows it; of all else the mean gradient."""
    sensor = SlopeSensor(name="s", across=8)
    matrix = sensor.matrix(LIGHT)
    count = len(matrix) // 2
    wanted = np.repeat([1.0, 0.0], count)
    np.testing.assert_allclose(matrix[:, 0], wanted, atol=1e-12)
    np.testing.assert_allclose(matrix[:, 1], 1 - wanted, atol=1e-12)
    assert sensor.labels(LIGHT)[0] == "x[2,0]"
    # An inner subaperture, column 5, row 5: the line integral of the wavefront along its sides.
    row = sensor.labels(LIGHT).index("x[5,5]")
    low, high = 5 * 0.25 - 1, 6 * 0.25 - 1
    side = np.linspace(low, high, 2001)
    edge = [annular_zernike(np.full(2001, at), side, 28, 0.3)[:, 3:].mean(axis=0) for at in (low, high)]
    nm_per_radius = (edge[1] - edge[0]) / 0.25
    np.testing.assert_allclose(
        matrix[row, 2:],
        -nm_per_radius / 15e9 / RAD_PER_MAS,
        rtol=0.02,
        atol=0.02 * np.abs(matrix[row, 2:]).max(),
    )


def test_noise_of_centroids_is_that_of_drawn_photons():
    """Centres of 3000 drawn frames: Poisson photons of a Gaussian spot, and read noise of every pixel."""
    camera = Centroids(photons=400.0, read_noise=3.0, spot_mas=20.0, pixel_mas=20.0, pixels=8)
    rng = np.random.default_rng(9)
    places = (np.arange(8) - 3.5) * 20.0
    share = np.exp(-(places**2) / (2 * 20.0**2))
    share /= share.sum()
    frames = rng.poisson(400.0 * np.outer(share, share), (3000, 8, 8)) + rng.normal(0, 3.0, (3000, 8, 8))
    centres = (frames.sum(axis=1) @ places) / 400.0
    drawn_rms = centres.std()
    assert camera.centroid_rms() == pytest.approx(drawn_rms, rel=0.05)
    assert Centroids().centroid_rms() == 0.0


def test_a_density_of_noise_is_that_of_white_noise_averaged_over_the_frame():
    sensor = WavefrontSensor(name="w", rate_hz=500.0, integration=0.5, noise=3.0, noise_density=0.2)
    assert sensor.noise_rms(LIGHT) == pytest.approx(np.hypot(3.0, 0.2 * np.sqrt(500.0)))
