"""Pupils of systems whose stop stands before, inside and behind their lenses."""

from math import inf

import numpy as np
import pytest
from test_paraxial import lens

from wavequake.errors import UserError
from wavequake.optics.systems.kinematics import SurfaceRow
from wavequake.optics.systems.paraxial import paraxial
from wavequake.optics.systems.system import Pupil


def test_stop_before_inside_and_behind_a_thin_lens():
    before = lens(100.0, -100.0, 0.0, 100.0, rows=[SurfaceRow("stop", thickness=50.0)])
    data = paraxial(before)
    assert data.entrance_pupil == 0.0
    # 50 mm before a lens of 100 mm: the virtual image lies 100 mm before it, twice as large.
    assert data.exit_pupil == pytest.approx(-200.0)
    assert data.exit_pupil_diameter == pytest.approx(20.0)
    behind = lens(100.0, -100.0, 0.0, 50.0, stop=2, after=[SurfaceRow("stop", thickness=50.0)])
    data = paraxial(behind)
    assert data.entrance_pupil == pytest.approx(100.0)
    assert data.entrance_pupil_diameter == pytest.approx(10.0)
    assert data.stop_radius == pytest.approx(2.5)
    assert data.pupil_magnification == pytest.approx(2.0)
    assert data.exit_pupil == pytest.approx(-50.0)


def test_stop_in_the_focal_plane_is_telecentric():
    pupil = Pupil("object_na", 0.1)
    system = lens(
        100.0,
        -100.0,
        0.0,
        100.0,
        stop=2,
        pupil=pupil,
        after=[SurfaceRow("stop", thickness=100.0)],
        object_distance=200.0,
        telecentric=True,
        fields=np.array([[3.0, 4.0]]),
    )
    data = paraxial(system)
    assert data.entrance_pupil == inf
    assert data.entrance_pupil_diameter == inf
    assert data.magnification == pytest.approx(-1.0)
    assert data.object_na == pytest.approx(0.1)
    assert data.image_na == pytest.approx(0.1)
    assert abs(data.lagrange) == pytest.approx(5.0 * 0.1)
    assert data.stop_radius == pytest.approx(10.0)
    with pytest.raises(UserError, match="at infinity and has no diameter"):
        paraxial(lens(100.0, -100.0, 0.0, 100.0, stop=2, after=[SurfaceRow("stop", thickness=100.0)]))


def test_stop_in_the_front_focal_plane_is_telecentric_in_the_image():
    data = paraxial(lens(100.0, -100.0, 0.0, 100.0, rows=[SurfaceRow("stop", thickness=100.0)]))
    assert data.exit_pupil == inf
    assert data.exit_pupil_diameter == inf
    assert data.image_na == pytest.approx(0.05)


def test_pupil_kinds_agree():
    reference = paraxial(lens(80.0, -120.0, 5.0, 90.0))
    slope = 5.0 / reference.focal_length
    for pupil in (
        Pupil("image_na", slope),
        Pupil("f_number", reference.focal_length / 10.0),
        Pupil("stop", 5.0),
    ):
        data = paraxial(lens(80.0, -120.0, 5.0, 90.0, pupil=pupil))
        assert data.entrance_pupil_diameter == pytest.approx(10.0, rel=1e-12)
        assert data.f_number == pytest.approx(reference.focal_length / 10.0, rel=1e-12)
