import numpy as np

from wavequake.imaging.exposures.placement import place


def test_no_shift_and_equal_frames_change_nothing():
    images = np.arange(2 * 36.0).reshape(2, 6, 6)
    np.testing.assert_array_equal(place(images, np.zeros((2, 2), dtype=np.int64), 6), images)


def test_a_bright_pixel_goes_where_it_is_sent():
    images = np.zeros((3, 8, 8))
    images[:, 4, 4] = 1.0  # the origin
    placed = place(images, np.array([[1, 0], [0, -2], [40, 0]]), 6)
    expected = np.zeros((3, 6, 6))
    expected[0, 3, 4] = expected[1, 1, 3] = 1.0  # the third leaves the frame
    np.testing.assert_array_equal(placed, expected)


def test_a_larger_image_fills_the_frame_after_a_shift():
    images = np.ones((1, 12, 12))
    assert place(images, np.array([[3, -3]]), 6).sum() == 36.0
    assert place(images, np.array([[4, 0]]), 6).sum() == 30.0
