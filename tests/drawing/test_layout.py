"""Sections of systems: the plane, where rays begin and end, glass, mirrors and stop, as coordinates."""

from dataclasses import replace

import numpy as np
import pytest
from test_paths import FOLDED

from wavequake.drawing.layout import layouts
from wavequake.errors import UserError
from wavequake.kernels.device.devices import choose_device
from wavequake.kernels.trace.sequential import trace_sequence
from wavequake.optics.catalog.names import optical_system, system_names
from wavequake.optics.media.glasses import AIR
from wavequake.optics.media.gradients import selfoc
from wavequake.optics.rays.aiming import pupil_rays
from wavequake.optics.rays.packing import moving, pack
from wavequake.optics.shapes.sag import shape_sag
from wavequake.optics.shapes.shapes import Conic, Opening
from wavequake.optics.systems.kinematics import SurfaceRow, rest_states, sequential
from wavequake.optics.systems.paraxial import paraxial
from wavequake.optics.systems.system import OpticalSystem, Pupil, wavelength_of

ACROSS = {"tmt": "x", "tmt-thesis": "x", "gregorian": "x"}


def part(layout, kind, name=None):
    found = [one for one in layout.parts if one.kind == kind and name in (None, one.name)]
    assert len(found) == 1, [(one.kind, one.name) for one in layout.parts]
    return found[0]


@pytest.mark.parametrize("name", system_names())
def test_rays_of_a_drawing_end_where_the_kernel_says(name):
    """The drawn ends of each field are image points that the OpenCL kernel finds, to 1e-9 mm of 500 m."""
    system = optical_system(name)
    (layout,) = layouts(system)
    across = {"x": [1.0, 0.0, 0.0], "y": [0.0, 1.0, 0.0]}[ACROSS.get(name, "y")]
    np.testing.assert_array_equal(layout.across, across)
    share = np.linspace(-1.0 + 1e-6, 1.0 - 1e-6, 7)
    inner = system.pupil.obscuration
    if inner:
        half = np.linspace(inner + 1e-6, 1.0 - 1e-6, 4)
        share = np.concatenate([-half[::-1], half])
    x, y = np.outer(across[:2], share)
    image = system.surfaces[-1]
    for field, point in enumerate(system.fields):
        ways = [ray for number, ray in layout.rays if number == field]
        ends = np.array([way[-1] for way in ways if len(way) == len(system.surfaces) + 1])  # not stopped
        rays = pupil_rays(system, point, wavelength_of(system), x, y)
        at_rest = moving(system, rest_states(system))
        traced = trace_sequence(pack(system, wavelength_of(system)), rays, at_rest, choose_device("auto"))
        sag = shape_sag(image.shape, traced.x[0], traced.y[0])[0]
        points = image.position + np.stack([traced.x[0], traced.y[0], sag], axis=1) @ image.rotation.T
        expected = np.stack([points[:, 2], points @ across], axis=1)[np.isfinite(traced.x[0])]
        assert len(ends) > 0.5 * len(ways) == 0.5 * len(x)
        ends, expected = (a[np.lexsort(np.round(a.T, 6))] for a in (ends, expected))
        np.testing.assert_allclose(ends, expected, rtol=0, atol=1e-9)


def test_light_from_infinity_begins_on_one_plane_before_everything():
    for name in ("tmt", "double-gauss"):
        system = optical_system(name)
        (layout,) = layouts(system)
        begin = np.array([ray[0] for _, ray in layout.rays])
        assert np.ptp(begin[:, 0]) < 1e-9 * np.abs(begin).max()
        lowest = min(line[:, 0].min() for one in layout.parts for line in one.lines)
        assert begin[0, 0] < lowest
        for field, ray in layout.rays:  # straight up to the first surface, in the direction of the field
            slope = (ray[1, 1] - ray[0, 1]) / (ray[1, 0] - ray[0, 0])
            number = 0 if layout.across[0] else 1
            assert slope == pytest.approx(np.tan(system.fields[field][number]), abs=1e-12)


def test_a_near_object_is_drawn_and_a_far_one_is_not():
    (near,) = layouts(optical_system("six-lens"))
    thing = part(near, "object").lines[0]
    np.testing.assert_allclose(thing[:, 0], -optical_system("six-lens").object_distance)
    begin = {round(float(ray[0, 1]), 9) for field, ray in near.rays}
    assert begin == {0.0, 5.0}
    (far,) = layouts(
        replace(optical_system("double-gauss"), object_distance=1e5, fields=np.array([[0.0, 1e4]]))
    )
    assert not [one for one in far.parts if one.kind == "object"]
    assert min(ray[0, 0] for _, ray in far.rays) > -1000.0


def test_glass_fills_the_lenses_and_the_stop_is_as_wide_as_the_beam():
    """Vertices, thicknesses and glasses of the double Gauss lens as they are published."""
    system = optical_system("double-gauss")
    (layout,) = layouts(system)
    glass = [one for one in layout.parts if one.kind == "glass"]
    assert [one.name for one in glass] == ["N-SSK2", "N-SK2", "F5", "F5", "N-SK16", "N-SK16"]
    for lens, thickness in zip(glass, (8.75, 12.5, 3.8, 3.8, 11.0, 7.0), strict=True):
        z, y = lens.lines[0].T
        on_axis = np.sort(z[np.abs(y) < 1e-9])
        assert on_axis[-1] - on_axis[0] == pytest.approx(thickness, abs=1e-9)
        assert y.max() == pytest.approx(-y.min(), abs=1e-9)  # lenses are round
    ticks = part(layout, "stop").lines
    radius = paraxial(system).stop_radius
    inner = sorted(line[0, 1] for line in ticks)
    np.testing.assert_allclose(inner, [-radius, radius], rtol=1e-5)
    assert all(abs(line[1, 1]) > abs(line[0, 1]) for line in ticks)


def test_folded_and_holed_mirrors_stand_where_the_prescription_says():
    (layout,) = layouts(optical_system("tmt"))
    m3, image = part(layout, "mirror", "M3").lines[0], part(layout, "image").lines[0]
    face = m3[: len(m3) // 2]
    slope = np.diff(face, axis=0)
    np.testing.assert_allclose(np.abs(slope[:, 1] / slope[:, 0]), 1.0, rtol=1e-9)  # at 45 degrees
    np.testing.assert_allclose(image[:, 1], -20000.0, atol=1.0)
    assert len(part(layout, "mirror", "M1").lines) == 1  # no light goes through M1 of the TMT
    for name in ("herschel", "jwst"):
        (layout,) = layouts(optical_system(name))
        first = next(one for one in layout.parts if one.kind == "mirror" and one.name.startswith("M1"))
        below, above = first.lines
        assert below[:, 1].max() < 0.0 < above[:, 1].min()


def test_mirrors_show_the_part_that_light_uses_and_lie_on_their_surface():
    """EUV: M2 is the stop, the beams on the others lie off their axis; bodies stand behind the faces."""
    system = optical_system("euv")
    (layout,) = layouts(system)
    for surface in system.surfaces[:-1]:
        name = surface.name + (" (stop)" if surface.name == "M2" else "")
        (outline,) = part(layout, "mirror", name).lines
        face, back = outline[: len(outline) // 2], outline[len(outline) // 2 :][::-1]
        sag = shape_sag(surface.shape, 0.0 * face[:, 1], face[:, 1])[0]
        np.testing.assert_allclose(face[:, 0], surface.position[2] + sag, rtol=0, atol=1e-9)
        number = [one.name for one in system.surfaces].index(surface.name)
        ray = layout.rays[3][1]
        side = np.sign(ray[number + 1, 0] - ray[number, 0])
        assert (np.sign(back[:, 0] - face[:, 0]) == side).all()
        at = [ray[number + 1, 1] for _, ray in layout.rays]
        assert face[:, 1].min() < min(at)
        assert max(at) < face[:, 1].max()


def test_an_opening_bounds_what_is_drawn():
    rows = [SurfaceRow("M1", Conic(-400.0, -1.0), -200.0, "reflect", opening=Opening(30.0, 5.0))]
    square = ((-10.0, -20.0), (10.0, -20.0), (10.0, 20.0), (-10.0, 20.0))
    rows[:0] = [SurfaceRow("frame", thickness=150.0, opening=Opening(corners=square, center=(0.0, 5.0)))]
    system = OpticalSystem(
        "mirror", sequential([*rows, SurfaceRow("image")]), 1, Pupil("entrance_diameter", 40.0)
    )
    (layout,) = layouts(system)
    below, above = part(layout, "mirror").lines
    radii = [below[: len(below) // 2, 1], above[: len(above) // 2, 1]]
    np.testing.assert_allclose([r[[0, -1]] for r in radii], [[-30.0, -5.0], [5.0, 30.0]], atol=1e-12)
    np.testing.assert_allclose(part(layout, "surface").lines[0][[0, -1], 1], [-15.0, 25.0], atol=1e-12)
    stopped = [ray for _, ray in layout.rays if len(ray) == 2]
    assert stopped
    assert all(ray[-1, 0] == pytest.approx(0.0, abs=1e-12) for ray in stopped)  # they end at the frame


def test_a_system_that_leaves_every_plane_is_drawn_in_two():
    found = layouts(FOLDED)
    assert sorted(int(np.argmax(layout.across)) for layout in found) == [0, 1]
    turned = np.radians(30.0)
    fields = np.outer([-0.1, 0.0, 0.1], [np.sin(turned), np.cos(turned)])
    (oblique,) = layouts(replace(optical_system("double-gauss"), fields=fields))
    np.testing.assert_allclose(oblique.across, [0.5, np.sqrt(0.75), 0.0], atol=1e-3)


def test_rays_through_a_gradient_are_drawn_bent():
    rows = [
        SurfaceRow("in", thickness=40.0, action="refract", medium=selfoc(1.6, 0.05)),
        SurfaceRow("out", action="refract", medium=AIR, thickness=5.0),
        SurfaceRow("image"),
    ]
    system = OpticalSystem("rod", sequential(rows), 0, Pupil("entrance_diameter", 4.0))
    (layout,) = layouts(system)
    assert all(12 <= len(ray) <= 30 for _, ray in layout.rays)
    assert part(layout, "glass").lines[0][:, 0].max() == pytest.approx(40.0)


def test_without_light_there_is_no_drawing():
    system = replace(optical_system("double-gauss"), fields=np.array([[0.0, 1.5]]))
    with pytest.raises(UserError, match=r"at field \(0, 85.94\) deg"):
        layouts(system)


def test_rings_that_share_a_blank_do_not_cover_each_other():
    """Rubin: M1 is a ring about M3, both have their bodies behind them, and all mirrors are round.

    M1 has its light between 2.558 and 4.18 m, M3 within 2.508 m, as the observatory says.
    """
    (layout,) = layouts(optical_system("rubin"))
    below, above = part(layout, "mirror", "M1 (stop)").lines
    inner = part(layout, "mirror", "M3").lines[0]
    assert 2450.0 < above[:, 1].min() < 2558.0
    assert inner[:, 1].max() < above[:, 1].min() + 60.0  # their bodies meet, and do not cover each other
    for line in (below, above, inner):
        half = len(line) // 2
        assert (line[half:, 0].mean() - line[:half, 0].mean()) > 0.0  # light comes along +z
    for one in (below, above), (inner,):
        y = np.concatenate(one)[:, 1]
        assert y.max() == pytest.approx(-y.min(), rel=1e-9)
