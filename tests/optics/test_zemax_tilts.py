"""Surfaces that are tilted by themselves (SCBD), what the axis ray does there, and planes on the object.

"A surface tilt/decenter can be thought of as a coordinate break, followed by the surface, followed by another
coordinate break" (Ansys, OpticStudio's help, Tilt/Decenter).
"""

import numpy as np
import pytest

from wavequake.errors import UserError
from wavequake.optics.systems.axis_ray import follow_axis
from wavequake.optics.systems.info import info
from wavequake.optics.systems.system import OpticalSystem
from wavequake.optics.zemax.read import parse_zmx

HEADER = "ENPD 10\nWAVM 1 0.801 1\nFTYP 0 0 1 1 0 0 0\nYFLN 0\nGCAT SCHOTT"


def parsed(*rows: str, distance: str = "INFINITY", header: str = HEADER) -> OpticalSystem:
    rows = (f"DISZ {distance}", *rows, "DISZ 0")
    lines = [f"SURF {k}\n" + "\n".join(f"  {line}" for line in row.split("; ")) for k, row in enumerate(rows)]
    return parse_zmx(header + "\n" + "\n".join(lines) + "\n", "lens.zmx")


def a_break(thickness: float, *numbers: float) -> str:
    given = "; ".join(f"PARM {k} {value}" for k, value in enumerate(numbers, 1))
    return f"TYPE COORDBRK; {given}; DISZ {thickness}"


@pytest.mark.parametrize(
    ("lines", "after"),
    [
        ("SCBD 2 0 0 0.5 0 -20 4 0", (0.5, 0, -20, 4, 0, 0)),  # its own
        ("SCBD 2 0 1 1.5 -2 10 20 30", (1.5, -2, 10, 20, 30, 0)),  # those before once more
        ("SCBD 2 1 2 -1.5 2 -10 -20 -30", (-1.5, 2, -10, -20, -30, 1)),  # their reverse
    ],
)
def test_a_tilt_of_a_surface_is_a_break_before_and_one_after(lines, after):
    front = "STOP; CURV 0.01; GLAS N-BK7; DISZ 5"
    mine = parsed(front, f"CURV -0.01; SCBD 1 0 0 1.5 -2 10 20 30; {lines}; DISZ 40")
    theirs = parsed(front, a_break(0, 1.5, -2, 10, 20, 30, 0), "CURV -0.01; DISZ 0", a_break(40, *after))
    for one, other in zip(mine.surfaces, theirs.surfaces, strict=True):
        np.testing.assert_allclose(one.position, other.position, atol=1e-12)
        np.testing.assert_allclose(one.rotation, other.rotation, atol=1e-14)
        assert one.shape == other.shape


def test_a_break_that_is_the_stop_stops_at_the_plane_to_which_it_leads():
    mine = parsed("STOP; " + a_break(7.0, 1.0, -2.0, 10, 20, 30), "CURV 0.01; GLAS N-BK7; DISZ 5")
    theirs = parsed(a_break(0.0, 1.0, -2.0, 10, 20, 30), "STOP; DISZ 7", "CURV 0.01; GLAS N-BK7; DISZ 5")
    assert mine.stop == theirs.stop == 0
    for one, other in zip(mine.surfaces, theirs.surfaces, strict=True):
        np.testing.assert_array_equal(one.position, other.position)
        np.testing.assert_array_equal(one.rotation, other.rotation)
        assert (one.shape, one.action) == (other.shape, other.action)


def test_a_mirror_that_is_tilted_twice_folds_the_axis():
    system = parsed("STOP; DISZ 20", "GLAS MIRROR; SCBD 1 0 0 0 0 45 0 0; SCBD 2 0 1 0 0 45 0 0; DISZ -30")
    assert system.surfaces[-1].position == pytest.approx([0.0, 30.0, 20.0], abs=1e-12)


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        (
            ["STOP; DISZ 5; SCBD 1 0 1 0 0 10 0 0"],
            "line 11 .SCBD.: surface 1 takes its tilt from another surface",
        ),
        (["STOP; DISZ 5; SCBD 1 0 0 0 0 9 0 0; SCBD 2 1 2 0 0 9 0 0"], "takes its tilt from another surface"),
        (["STOP; DISZ 5; SCBD 2 0 4 0 0 10 0 0"], "takes its tilt from another surface"),
        (["STOP; DISZ 5; SCBD 3 0 0 0 0 10 0 0"], "one tilt before it .1. and one after it .2. at most"),
        (["STOP; DISZ 5; SCBD 1 0 0 0 0 10"], "the number 7 after the keyword is missing"),
        (["STOP; DISZ 5", a_break(0, 1) + "; SCBD 1 0 0 0 0 9 0 0"], "not supported there"),
    ],
)
def test_what_another_surface_would_say_is_refused(rows, said):
    with pytest.raises(UserError, match=said):
        parsed(*rows)


def test_a_tilted_object_is_refused():
    with pytest.raises(
        UserError, match="surface 0 has a tilt or decenter of its own, which is not supported"
    ):
        parsed("STOP; DISZ 5", distance="10; SCBD 2 0 0 0 0 10 0 0")


GRISM = (  # the red grating of the SWIFT spectrograph at 801 nm (oxford-pcs/zSpec, camera70.zmx)
    "DISZ 50",
    a_break(0, 3.3568, 0, 0, 9.667, 0, 0),
    a_break(0, 0, 0, 0, 33.696, 0, 0),
    "GLAS SF6; DISZ 0",
    a_break(18.671, 0, 0, 0, -33.696, 0, 1),
    "STOP; GLAS N-BK7; DISZ 3",
    "TYPE DGRATING; SCBD 1 0 0 0 0 0 0 90; SCBD 2 1 2 -0 -0 -0 -0 -90; PARM 1 0.828; PARM 2 1; "
    "GLAS N-BK7; DISZ 3",
    "GLAS SF6; DISZ 18.671",
    a_break(0, 0, 0, 0, -33.696, 0, 0),
    "DISZ 0",
    a_break(0, 0, 0, 0, 33.696, 0, 1),
    a_break(0, 0, 0, 0, 9.667, 0, 0),
    a_break(40, -3.0756, 0, 0, 1.62186, 0, 0),
)


def test_the_axis_ray_leaves_a_grism_as_its_designers_had_it():
    """Their camera stands where it comes, and looks along it: to 0.1 um and 3e-6 rad."""
    system = parsed(*GRISM, "DISZ 100")
    steps = list(follow_axis(system, 801e-6))
    point = np.array([0.0, 0.0, 0.0])
    direction = np.array([0.0, 0.0, 1.0])
    for step in steps:
        point, direction = point + step.way * direction, step.direction
    camera, image = system.surfaces[-2:]
    assert image.position - point == pytest.approx(np.zeros(3), abs=2e-4)
    assert camera.rotation[:, 2] == pytest.approx(direction, abs=3e-6)


def test_the_axis_ray_turns_in_a_prism_by_the_law_of_refraction():
    """At minimum deviation, for an apex of 60 degrees and n = 1.5: 2 asin(n sin 30) - 60 degrees."""
    incidence = np.rad2deg(np.arcsin(1.5 * np.sin(np.pi / 6.0)))
    glass = "GLAS ___BLANK 1 0 1.5 0"
    system = parsed(
        "STOP; DISZ 50",
        a_break(0, 0, 0, incidence, 0, 0, 0),
        f"{glass}; DISZ 0",
        a_break(10, 0, 0, -60, 0, 0, 0),
        "DISZ 0",
        a_break(30, 0, 0, 0, 0, 0, 0),
    )
    *_, out, _ = follow_axis(system, 801e-6)
    turned = np.arctan2(out.direction[1], out.direction[2])
    assert abs(turned) == pytest.approx(2.0 * np.deg2rad(incidence) - np.pi / 3.0, rel=1e-12)


def test_a_ray_that_cannot_leave_a_prism_is_named():
    with pytest.raises(
        UserError, match="the axis ray of lens is totally reflected at surface 4; turn the surface"
    ):
        info(parsed("STOP; DISZ 9", "GLAS N-SF6; DISZ 5", a_break(0, 0, 0, 50), "DISZ 9"))


def test_planes_on_the_object_are_its_own():
    """A spectrograph's slit is the object and stands once more as the first surface."""
    lens = ("STOP; CURV 0.02; GLAS N-BK7; DISZ 4", "CURV -0.02; DISZ 60")
    header = HEADER.replace("FTYP 0", "FTYP 1")
    system = parsed("COMM slit; DISZ 75", *lens, distance="0", header=header)
    plain = parsed(*lens, distance="75", header=header)
    assert system.object_distance == plain.object_distance == 75.0
    assert [surface.name for surface in system.surfaces] == ["surface 2", "surface 3", "surface 4"]
    assert (system.stop, plain.stop) == (0, 0)
    with pytest.raises(UserError, match="stands in the first surface; move it off"):
        info(parsed("CURV 0.01; DISZ 75", *lens, distance="0", header=header))
