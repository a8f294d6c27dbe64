"""Holograms of two points in lens files, against ways to the points."""

import numpy as np
import pytest

from wavequake.errors import UserError
from wavequake.kernels.trace.sequence import Rays
from wavequake.kernels.trace.sequential_numpy import trace_sequence_numpy
from wavequake.kernels.trace.status import OK
from wavequake.optics.rays.packing import moving, pack
from wavequake.optics.systems.kinematics import rest_states
from wavequake.optics.zemax.read import parse_zmx

MADE = 550e-6
X, Y = 20.0 * np.random.default_rng(2).uniform(-1.0, 1.0, (2, 40))


def lens(first, second, order, glass="", image=100.0, more="", nm=550):
    numbers = (0, 0, first, 0, 0, second, MADE * 1e3, order)
    rows = "\n".join(f"  PARM {k} {value}" for k, value in enumerate(numbers, start=1))
    head = f"ENPD 40\nWAVM 1 {nm / 1e3} 1\nFTYP 1 0 1 1 0 0 0\nYFLN 0\nSURF 0\n  DISZ {abs(first)}\n"
    surface = f"SURF 1\n  STOP\n  TYPE HOLOGRM2\n{rows}\n  DISZ {image}\n  DIAM 30\n{glass}{more}"
    return f"{head}{surface}SURF 2\n  DISZ 0\n"


def traced(text, nm=550e-6):
    system = parse_zmx(text, "hologram.zmx")
    start = np.array([[0.0], [0.0], [-system.object_distance]])
    direction = np.stack([X, Y, 0.0 * X]) - start
    direction /= np.linalg.norm(direction, axis=0)
    rays = Rays(np.repeat(start, X.size, axis=1), direction, np.zeros(X.size))
    found = trace_sequence_numpy(pack(system, nm), rays, moving(system, rest_states(system)))
    assert (found.status == OK).all()
    return found


@pytest.mark.parametrize(("glass", "second"), [("", 100.0), ("  GLAS MIRROR\n", -100.0)])
def test_light_of_one_point_goes_to_the_other_by_equal_ways(glass, second):
    found = traced(lens(-200.0, second, 1, glass, image=second))
    assert np.abs([found.x, found.y]).max() < 1e-11
    assert np.ptp(found.path) < 1e-11


@pytest.mark.parametrize("order", [1, -1, 2])
@pytest.mark.parametrize("nm", [450e-6, 550e-6])
def test_slopes_change_by_those_of_the_ways_at_every_color_and_order(order, nm):
    found = traced(lens(-200.0, 150.0, order, nm=nm * 1e6), nm)
    far, near = np.sqrt(X**2 + Y**2 + 200.0**2), np.sqrt(X**2 + Y**2 + 150.0**2)
    change = order * nm / MADE * (1.0 / far + 1.0 / near)
    np.testing.assert_allclose(found.u[0], X / far - change * X, rtol=0, atol=1e-13)
    np.testing.assert_allclose(found.v[0], Y / far - change * Y, rtol=0, atol=1e-13)
    on_image = far + np.sqrt((found.x[0] - X) ** 2 + (found.y[0] - Y) ** 2 + 100.0**2)
    added = -order * nm / MADE * (far + near - 350.0)
    np.testing.assert_allclose(found.path[0], on_image + added, rtol=0, atol=1e-11)


@pytest.mark.parametrize(
    ("old", "new", "why"),
    [
        ("PARM 1 0", "PARM 1 3", "points off its axis"),
        ("  DIAM 30", "  DIAM 30\n  CURV 0.01", "curved or of points off"),
        ("  DIAM 30", "", "semi-diameter"),
        ("  DIAM 30", "  DIAM 1e-200", "normalization radius"),
        ("PARM 6 100.0", "PARM 6 40.0", "not farther than"),
        (f"PARM 7 {MADE * 1e3}", "PARM 7 -0.55", "not a positive wavelength"),
    ],
)
def test_other_holograms_are_refused(old, new, why):
    text = lens(-200.0, 100.0, 1)
    assert old in text
    with pytest.raises(UserError, match=why):
        parse_zmx(text.replace(old, new), "hologram.zmx")
