"""Curved images, such as the focal surface of a Schmidt telescope."""

from dataclasses import replace

import numpy as np
import pytest

from wavequake.errors import UserError
from wavequake.kernels.device.devices import NUMPY, choose_device
from wavequake.optics.rays.pupils import sunflower
from wavequake.optics.shapes.shapes import Conic, ZernikeDeformation
from wavequake.optics.systems.kinematics import SurfaceRow, rest_states, sequential
from wavequake.optics.systems.system import OpticalSystem, Pupil
from wavequake.optics.wavefronts.wavefront import (
    measure_system,
    prepare_system,
    trace_system,
    with_fitted_sphere,
    with_slopes,
)

RAYS = sunflower(0.0, 1.0, 300)
WAVE = 550e-6


def mirror(image, field, f_number, before_mirror, to_image=-100.0, **row):
    rows = [
        SurfaceRow("stop", thickness=before_mirror),
        SurfaceRow("M", Conic(-200.0), to_image, "reflect", **row),
        SurfaceRow("image", image),
    ]
    return OpticalSystem(
        "mirror",
        sequential(rows),
        0,
        Pupil("f_number", f_number),
        fields=np.array([[0.0, field]]),
        wavelengths=np.array([WAVE]),
    )


def prepared(system, terms=15):
    return prepare_system(system, RAYS.x, RAYS.y, RAYS.weight, terms)


@pytest.mark.parametrize("device", ["numpy", "auto"])
@pytest.mark.parametrize("field", [0.0, 0.1, 0.3])
def test_a_sphere_about_the_stop_images_alike_at_all_angles(field, device):
    """All follows from the distance b at which a ray passes the center C of the mirror, sin i = b / R.

    It goes R cos i to the mirror, which turns it by 2 i, and from there, at M, along e. By (F - M) e it comes
    next to the focus F, R / 2 from C on the field's own axis, where the image is, at a distance s from it.
    The reference sphere goes through the exit pupil, which is in C, behind the image.
    """
    system = mirror(Conic(-100.0), field, 4.0, 200.0)
    light = prepared(system)
    on = NUMPY if device == "numpy" else choose_device()
    opd, _, chief = trace_system(light, rest_states(system), on)
    np.testing.assert_allclose(chief[0], [0.0, 100.0 * np.sin(field)], rtol=0, atol=1e-9)
    place = 12.5 * np.stack([RAYS.x, RAYS.y, np.zeros_like(RAYS.x)])
    along = np.array([0.0, np.sin(field), np.cos(field)])
    distance = np.linalg.norm(np.cross(place.T, along), axis=1)
    i = np.arcsin(distance / 200.0)
    to_focus = np.stack([-distance, 100.0 - 200.0 * np.cos(i)])  # across the field's axis, and along it
    onwards = np.sum(to_focus * -np.stack([np.sin(2 * i), np.cos(2 * i)]), axis=0)
    onwards += np.sqrt(100.0**2 - np.sum(to_focus**2, axis=0) + onwards**2)
    expected = (400.0 - 200.0 * np.cos(i) - onwards) / WAVE
    assert np.ptp(expected) > 0.2
    np.testing.assert_allclose(opd[0], expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize("radius", [30.0, -30.0, np.inf])
def test_pure_coma_moves_the_chief_ray_and_not_the_line_of_sight(radius):
    """However steep the image is, tilt in the pupil counts along it: coma of Zernike has none."""
    figure = ZernikeDeformation(8, 2.5)
    # Rays of the plane of incidence meet R cos(0.1) / 2 behind the mirror; there the image is put.
    focus = 100.0 * np.cos(0.1) * np.array([np.sin(0.1), np.cos(0.1)])
    sag = 0.0 if np.isinf(radius) else radius - np.sign(radius) * np.sqrt(radius**2 - focus[0] ** 2)
    system = mirror(Conic(radius), 0.1, 20.0, 0.0, -focus[1] - sag, deformation=figure)
    states = rest_states(system)
    coma = np.zeros((1, 8))
    coma[0, 6] = 1e-6  # j = 7, along y
    light = prepared(system)
    still = measure_system(light, states, NUMPY)
    moved = measure_system(light, replace(states, deformations=(None, coma, None)), NUMPY)
    chief, los = (moved.chief - still.chief)[0, 1], (moved.los - still.los)[0, 1]
    # The slope of sqrt(8) (3 r^3 - 2 r) at the center, twice, over 100 mm and more.
    assert abs(chief) == pytest.approx(4.0 * np.sqrt(8.0) * 1e-6 / 2.5 * 100.0, rel=0.1)
    assert abs(los) < 2e-3 * abs(chief)


def test_slopes_and_the_fitted_sphere_need_a_plane_image():
    light = prepared(mirror(Conic(-100.0), 0.1, 4.0, 200.0))
    for other in (with_slopes, with_fitted_sphere):
        with pytest.raises(UserError, match="the image of mirror, image, is curved; wavefront"):
            other(light)
