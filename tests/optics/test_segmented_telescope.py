from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from wavequake.errors import UserError
from wavequake.optics.segments.catalog import telescope
from wavequake.optics.segments.layout import monolithic
from wavequake.optics.segments.telescope import (
    Row,
    first_order,
    segmented_telescope,
    sequential_surfaces,
    surface_transforms,
)
from wavequake.optics.systems.system import Surface

PLANE = float("inf")


def mirror(rows, radius=-60000.0, conic=-1.0, stop_z=-100.0, outer=15000.0):
    return segmented_telescope(
        "test", monolithic(outer), radius, conic, sequential_surfaces(rows), stop_z, 0.0, outer
    )


@given(st.floats(1e3, 1e5), st.floats(0.01, 0.6), st.floats(-0.05, 0.3), st.floats(-0.01, 0.01))
def test_a_single_parabola(focal_length, height, stop, shift):
    rows = [Row("image", PLANE, 0.0, focal_length * (1.0 + shift))]
    outer = height * focal_length
    optics = first_order(mirror(rows, -2.0 * focal_length, -1.0, -stop * focal_length, outer))
    assert optics.focal_length == pytest.approx(focal_length, rel=1e-13)
    assert optics.back_focus == pytest.approx(focal_length, rel=1e-13)
    assert optics.defocus == pytest.approx(shift * focal_length, rel=1e-9, abs=1e-9 * focal_length)
    # Thin-mirror equation: the stop, a distance s before the mirror, is imaged at 1/s' = 1/f - 1/s.
    pupil = focal_length * (1.0 + shift) + stop / (1.0 - stop) * focal_length
    assert optics.exit_pupil_distance == pytest.approx(pupil, rel=1e-12)
    # A parabola reflects the ray at height h to its focus, h^2 / 4 f nearer to the mirror's rim plane.
    rim_to_focus = focal_length - outer**2 / (4.0 * focal_length)
    assert optics.numerical_aperture == pytest.approx(outer / np.hypot(outer, rim_to_focus), rel=1e-12)


THESIS = {
    "focal_length": 449998.5548436816,
    "defocus": 0.14053164314020705,
    "exit_pupil_distance": 46406.54319818776,
    "numerical_aperture": 0.03333339261351774966,  # 40-digit trace
}
OFFICIAL = {
    "focal_length": 450000.00144515,
    "defocus": 3.9212e-4,
    "exit_pupil_distance": 46406.542614758,
    "numerical_aperture": 0.03333330136987160633,
}


@pytest.mark.parametrize(("name", "expected"), [("tmt-thesis", THESIS), ("tmt", OFFICIAL)])
def test_first_order_of_the_tmt(name, expected):
    optics = first_order(telescope(name))
    assert optics.focal_length == pytest.approx(expected["focal_length"], rel=1e-13)
    assert optics.exit_pupil_distance == pytest.approx(expected["exit_pupil_distance"], rel=1e-13)
    assert optics.numerical_aperture == pytest.approx(expected["numerical_aperture"], rel=1e-12)
    assert optics.defocus == pytest.approx(expected["defocus"], abs=1e-8)
    assert optics.back_focus + optics.defocus == pytest.approx(20000.000532124, rel=1e-13)


def test_the_18_segments_have_the_aperture_of_their_annulus():
    optics = first_order(telescope("tmt-18"))
    assert optics.numerical_aperture == pytest.approx(0.02757240662842551741, rel=1e-12)  # 40-digit trace
    assert optics.exit_pupil_distance == pytest.approx(THESIS["exit_pupil_distance"], rel=1e-13)


def test_exit_pupil_of_a_stop_at_the_vertex():
    thesis = telescope("tmt-thesis")
    stop, *others = thesis.surfaces
    optics = first_order(replace(thesis, surfaces=(Surface("stop", opening=stop.opening), *others)))
    assert optics.exit_pupil_distance == pytest.approx(46386.61161438922, rel=1e-13)


def test_relative_shifts_of_table_4_2():
    m2, m3, image = telescope("tmt-thesis").after_primary
    np.testing.assert_allclose(m2.position, [0.0, 0.0, -27093.75])
    np.testing.assert_allclose(m2.rotation, np.eye(3))
    np.testing.assert_allclose(m3.position - m2.position, [0.0, 0.0, 23593.75])
    shift = m3.rotation.T @ (image.position - m3.position)
    np.testing.assert_allclose(shift, [-14142.136, 0.0, -14142.136], rtol=1e-14, atol=1e-10)
    turn = m3.rotation.T @ image.rotation
    np.testing.assert_allclose(turn, m3.rotation, rtol=0, atol=1e-15)  # another 45 degrees
    np.testing.assert_allclose(image.rotation[:, 2], [1.0, 0.0, 0.0], rtol=0, atol=1e-15)
    assert [m2.action, m3.action, image.action] == ["reflect", "reflect", "pass"]


@given(st.lists(st.tuples(st.floats(1.0, 1e4), st.floats(-0.6, 0.6)), min_size=1, max_size=4))
def test_transforms_lead_from_surface_to_surface(path):
    rows = [Row(str(index), PLANE, 0.0, distance, tilt) for index, (distance, tilt) in enumerate(path)]
    system = mirror(rows)
    point = np.array([3.0, -4.0, 5.0])  # in the optics frame
    local = point
    for surface, transform in zip(system.after_primary, surface_transforms(system), strict=True):
        local = transform[:9].reshape(3, 3) @ local + transform[9:]
        np.testing.assert_allclose(local, surface.rotation.T @ (point - surface.position), rtol=0, atol=1e-10)


@given(st.floats(-0.7, 0.7), st.floats(-0.7, 0.7))
def test_folds_do_not_change_the_first_order(first, second):
    def system(one, other):
        rows = [
            Row("M2", -6227.68, -1.3, 27093.75),
            Row("fold", PLANE, 0.0, 10000.0, one),
            Row("fold 2", PLANE, 0.0, 13593.75, other),
            Row("image", PLANE, 0.0, 20000.0),
        ]
        return first_order(mirror(rows))

    folded, straight = system(first, second), system(0.0, 0.0)
    for name, value in vars(straight).items():
        assert getattr(folded, name) == pytest.approx(value, rel=1e-10, abs=1e-9), name


def test_systems_without_an_image():
    afocal = [Row("M2", -6000.0, -1.0, 27000.0), Row("image", PLANE, 0.0, 1000.0)]
    with pytest.raises(UserError, match="test is afocal"):
        first_order(mirror(afocal))
    telecentric = mirror([Row("image", PLANE, 0.0, 30000.0)], stop_z=-30000.0)
    assert first_order(telecentric).exit_pupil_distance == np.inf
    small = [Row("M2", -6227.68, 3.0, 20000.0), Row("image", PLANE, 0.0, 1000.0)]
    with pytest.raises(UserError, match="outer pupil radius of 15000 mm misses a surface of test"):
        first_order(mirror(small))
