"""Rendered frames against the disk that they show, calibration against the distortion that it undoes."""

from dataclasses import replace

import numpy as np
import pytest

from wavequake.control.camera import (
    Camera,
    calibrate,
    camera_error,
    camera_reading,
    center_of_intensity,
    image_position,
    render,
)
from wavequake.errors import UserError

STRAIGHT = Camera(distortion=0.0, rows=60, unsteadiness=0.0)
STEPS = 1e-3 * np.arange(-3, 4)


def test_center_of_intensity_of_known_frames():
    frames = np.zeros((2, 4, 800), dtype=np.uint8)
    frames[0, 1, 10] = frames[0, 2, 20] = 200
    frames[1, :, 7], frames[1, 0, 700] = 100, 30  # the last one is below the threshold
    np.testing.assert_allclose(center_of_intensity(STRAIGHT, frames), [15.0, 7.0])


def test_a_frame_holds_a_disk_of_its_area():
    camera = replace(STRAIGHT, rows=400, blur=10e-6)
    frame = render(camera, 0.0)[0]
    assert (frame >= camera.level / 2).sum() * camera.pixel**2 == pytest.approx(
        np.pi * camera.spot_radius**2, rel=2e-3
    )
    assert frame.max() == 200


def test_centers_follow_the_point_far_below_a_pixel():
    position = np.linspace(-3e-3, 3e-3, 13) + 3.3e-6
    center = center_of_intensity(STRAIGHT, render(STRAIGHT, position))
    np.testing.assert_allclose(
        (center - 399.5) * STRAIGHT.pixel, position, rtol=0, atol=0.05 * STRAIGHT.pixel
    )


def test_calibration_uses_the_sensitivity_of_the_lens_that_moves():
    found = calibrate(STRAIGHT, STEPS, 1.394)
    position = 1.394 * STEPS[[0, 3, 6]]
    center = (position / STRAIGHT.pixel) + 399.5
    np.testing.assert_allclose(image_position(found, center), position, rtol=0, atol=1e-6)


def test_calibration_undoes_distortion():
    camera = replace(STRAIGHT, distortion=-0.05)
    position = 1.394 * np.linspace(-3e-3, 3e-3, 25)
    center = center_of_intensity(camera, render(camera, position))
    error = image_position(calibrate(camera, STEPS, 1.394), center) - position
    raw = (center - 399.5) * camera.pixel - position
    assert np.abs(error).max() < 0.2 * np.abs(raw).max()


def test_distortion_is_cubic_over_half_the_width():
    """A point at a quarter of the width, half of half the width, is off by a quarter of the term."""
    camera = replace(STRAIGHT, distortion=-0.08)
    at = 200 * camera.pixel
    (center,) = center_of_intensity(camera, render(camera, [at]))
    assert (center - 399.5) / 200 == pytest.approx(1 - 0.08 / 4, abs=2e-4)


def test_measured_error_stands_for_rendered_frames():
    rng = np.random.default_rng(2)
    calibration = calibrate(STRAIGHT, STEPS, 1.394)
    error = camera_error(STRAIGHT, calibration, rng)
    position = rng.uniform(-3e-3, 3e-3, 60)
    frames = render(STRAIGHT, position, rng.standard_normal((60, 60, 800)))
    rendered = image_position(calibration, center_of_intensity(STRAIGHT, frames)) - position
    modeled = camera_reading(error, position, rng.standard_normal(60)) - position
    assert modeled.std() == pytest.approx(rendered.std(), rel=0.4)
    assert rendered.std() < 2e-6


def test_bad_cameras_and_frames_are_refused():
    with pytest.raises(UserError, match="must be positive"):
        Camera(pixel=0.0)
    with pytest.raises(UserError, match="threshold must lie between"):
        Camera(threshold=220.0)
    with pytest.raises(UserError, match="Frame 1 is dark"):
        center_of_intensity(STRAIGHT, render(STRAIGHT, [0.0, 1.0]))
    with pytest.raises(UserError, match="at least two rising steps"):
        calibrate(STRAIGHT, [0.0], 1.394)
