"""Where OpticStudio's rays go otherwise: the stop that a real ray fills, the other point of a sphere."""

import math

import pytest

from wavequake.optics.rays.other_points import other_points
from wavequake.optics.systems.info import info
from wavequake.optics.systems.paraxial import paraxial
from wavequake.optics.zemax.export import zmx_text
from wavequake.optics.zemax.read import parse_zmx

RADIUS, BEHIND, INDEX = 40.0, 10.0, 1.5


def lens(aiming, aperture="ENPD 30", distance="INFINITY"):
    """Return a sphere of glass 10 mm before its stop, in which light stays."""
    return parse_zmx(
        f"MODE SEQ\n{aperture}\n{aiming}WAVM 1 0.55 1\nFTYP 0 0 1 1 0 0 0\nSURF 0\n  DISZ {distance}\n"
        f"SURF 1\n  CURV {1.0 / RADIUS}\n  GLAS ___BLANK 1 0 {INDEX} 0 0 0\n  DISZ {BEHIND}\n"
        "SURF 2\n  STOP\n  DISZ 100\nSURF 3\n",
        "lens.zmx",
    )


def real_height(height, slope=0.0):
    """Return by sines where a ray meets the stop that comes to the vertex plane at a height with a slope."""
    angle = math.atan(slope)
    # From the center of the sphere, at z = RADIUS: distance of the ray and where it meets the sphere.
    off = height * math.cos(angle) + RADIUS * math.sin(angle)
    before = math.asin(off / RADIUS)
    turn = before - math.asin(off / RADIUS / INDEX)
    polar = before - angle
    y, z = RADIUS * math.sin(polar), RADIUS * (1.0 - math.cos(polar))
    return y + math.tan(angle - turn) * (BEHIND - z)


def edge(system):
    data = paraxial(system)
    return data.entrance_pupil, data.entrance_pupil_diameter / 2.0


@pytest.mark.parametrize("aperture", ["ENPD 30", "FNUM 4"])
def test_the_stop_is_as_wide_as_the_real_ray_where_the_file_aims_by_it(aperture):
    plain, real = lens("RAIM 0 1 1 1\n", aperture), lens("RAIM 0 2 1 1\n", aperture)
    expected = real_height(edge(plain)[1])
    assert abs(expected / paraxial(plain).stop_radius - 1.0) > 1e-3
    assert paraxial(real).stop_radius == pytest.approx(expected, rel=1e-12)
    for aiming in ("", "RAIM 0 0 1 1\n"):
        assert paraxial(lens(aiming, aperture)).stop_radius == paraxial(plain).stop_radius


def test_a_beam_that_does_not_just_fill_the_stop_is_told():
    share = real_height(15.0) / paraxial(lens("")).stop_radius
    assert f"its beam fills {share:.4g} of the stop's radius" in lens("RAIM 0 0 1 1\n").note
    for aiming, aperture in (("", "ENPD 30"), ("RAIM 0 1\n", "ENPD 30"), ("RAIM 0 0\n", "ENPD 3")):
        assert lens(aiming, aperture).note == ""


def test_the_real_ray_of_a_near_object_goes_to_the_edge_of_the_entrance_pupil():
    plain, real = lens("", distance="200"), lens("RAIM 0 2\n", distance="200")
    place, radius = edge(plain)
    slope = radius / (200.0 + place)
    assert paraxial(real).stop_radius == pytest.approx(real_height(200.0 * slope, slope), rel=1e-12)


def test_a_real_ray_that_is_lost_leaves_the_paraxial_stop():
    plain, real = lens("", "ENPD 90"), lens("RAIM 0 2\n", "ENPD 90")
    assert real.pupil == plain.pupil


def test_a_written_file_keeps_the_stop():
    for system in (lens("RAIM 0 1\n"), lens("", "FNUM 4")):
        again = parse_zmx(zmx_text(system), "again.zmx")
        assert paraxial(again).stop_radius == pytest.approx(paraxial(system).stop_radius, rel=1e-12)


def two_spheres(first, opening):
    """Return light on two mirrors of which the first is convex: at grazing incidence it goes on forwards."""
    return parse_zmx(
        "MODE SEQ\nENPD 85\nWAVM 1 0.55 1\nFTYP 0 0 1 1 0 0 0\nSURF 0\n  DISZ INFINITY\nSURF 1\n  DISZ 10\n"
        f"SURF 2\n  STOP\n  COMM first\n  CURV {1.0 / first}\n  DISZ -5\n  GLAS MIRROR 0 0\n  {opening}\n"
        "SURF 3\n  COMM second\n  CURV 0.02\n  DISZ 174.8243911105\n  GLAS MIRROR 0 0\nSURF 4\n",
        "spheres.zmx",
    )


def test_a_sphere_that_light_meets_at_another_point_is_named():
    system = two_spheres(50.0, "CLAP 40 42.5 0")
    assert other_points(system) == ["second"]
    assert "meets second at another point than in OpticStudio" in info(system)


def test_light_that_goes_as_the_axis_ray_is_not_named():
    system = two_spheres(150.0, "CLAP 0 42.5 0")
    assert other_points(system) == []
    assert "OpticStudio" not in info(system)
