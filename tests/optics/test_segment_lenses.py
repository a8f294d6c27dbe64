"""Lenses behind a segmented M1: against the sequential tracer, Snell's law of a plate, and paraxial data."""

from dataclasses import replace

import numpy as np
import pytest

from wavequake.errors import UserError
from wavequake.kernels.device.devices import choose_device, list_devices
from wavequake.kernels.trace.sequence import Rays
from wavequake.kernels.trace.sequential_numpy import trace_sequence_numpy
from wavequake.kernels.trace.status import TOTAL_REFLECTION, lost_at
from wavequake.optics.media.glasses import AIR, constant, glass
from wavequake.optics.rays.packing import moving, pack
from wavequake.optics.rays.pupils import PupilRays, segment_rays
from wavequake.optics.segments.catalog import telescope
from wavequake.optics.segments.parent import parent_system
from wavequake.optics.segments.prepared import chief_rays, prepare, trace_states
from wavequake.optics.segments.slopes import slope_fit
from wavequake.optics.segments.telescope import Row, first_order, footprints, sequential_surfaces
from wavequake.optics.segments.wavefront import analyse
from wavequake.optics.systems.kinematics import rest_states
from wavequake.optics.systems.paraxial import paraxial

COLORS = 450e-6, 900e-6
DEVICES = [device.name for device in list_devices()]
BK7, F2 = glass("N-BK7"), glass("F2")


def tmt18(*behind, image=500.0):
    """A telescope of 18 segments whose light goes 19.5 m behind M3, and then through more surfaces."""
    system = telescope("tmt-18", gap=20.0)
    m2 = system.after_primary[0]
    rows = [
        Row("M2", m2.shape.radius, m2.shape.conic, 27093.75),
        Row("M3", np.inf, 0.0, 23593.75, tilt=np.pi / 4.0),
        *behind,
        Row("image", np.inf, 0.0, image),
    ]
    return replace(system, surfaces=(*system.surfaces[:2], *sequential_surfaces(rows)))


def corrector(tilt=0.05, image=7873.0):
    """A window, a cemented doublet with an asphere and, behind a fold, a meniscus; in focus."""
    return tmt18(
        Row("window", np.inf, 0.0, 17000.0, tilt=tilt, glass=BK7),
        Row("window's back", np.inf, 0.0, 40.0, tilt=tilt, glass=AIR),
        Row("crown", 3000.0, -0.3, 300.0, even=(0.0, 1e-12), glass=BK7),
        Row("flint", -2500.0, 0.0, 60.0, glass=F2),
        Row("doublet's back", -9000.0, 0.0, 30.0, glass=AIR),
        Row("fold", np.inf, 0.0, 500.0, tilt=0.6),
        Row("meniscus", -800.0, 0.0, 300.0, glass=F2),
        Row("meniscus' back", -900.0, 0.0, 40.0, glass=AIR),
        image=image,
    )


def traced_in_sequence(system, rays, field, wavelength, motion=None, spheres=None):
    direction = np.array([np.tan(field[0]), np.tan(field[1]), 1.0])
    direction /= np.linalg.norm(direction)
    position = np.stack([rays.x, rays.y, np.full_like(rays.x, system.stop_z)])
    rays = Rays(position, np.tile(direction[:, None], (1, len(rays.x))), direction @ position)
    parent = parent_system(system)
    parent = replace(parent, surfaces=tuple(replace(one, opening=None) for one in parent.surfaces))
    states = rest_states(parent)
    if motion is not None:
        states.surface_motion[0] = motion
    return trace_sequence_numpy(pack(parent, wavelength), rays, moving(parent, states, spheres))


@pytest.mark.parametrize("wavelength", COLORS)
@pytest.mark.parametrize("device", DEVICES)
def test_the_sequential_tracer_agrees_also_where_lenses_move(device, wavelength):
    system = corrector()
    prepared = prepare(system, segment_rays(system.segments, 3), wavelength, 15)
    field, states = (2e-4, -1e-4), rest_states(system, 16)
    own = np.random.default_rng(3).normal(size=(len(system.surfaces), 6)) * ([0.1] * 3 + [1e-4] * 3)
    states.line_of_sight[:] = field
    own[:2] = 0.0
    states.surface_motion[1:] = own
    ours = trace_states(prepared, states, choose_device(device))
    assert not np.asarray(ours.status).any()
    axis = PupilRays(*np.zeros((4, 1)))
    for lane, motion in ((0, None), (1, own)):
        chief = traced_in_sequence(system, axis, field, wavelength, motion)
        sphere = np.array([[chief.x[0, 0], chief.y[0, 0], 0.0, prepared.train.sphere_radius]])
        theirs = traced_in_sequence(system, prepared.rays, field, wavelength, motion, sphere)
        assert (theirs.status == 0).all()
        opd = chief.path[0, 0] - prepared.train.sphere_radius - theirs.path[0]
        for name, expected in (("x", theirs.x[0]), ("y", theirs.y[0]), ("opd", opd)):
            found = np.asarray(getattr(ours, name))[0, :, lane]
            np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("wavelength", COLORS)
def test_first_order_data_are_those_of_the_parent_in_each_color(wavelength):
    system = replace(corrector(tilt=0.0), wavelengths=np.array([wavelength]))
    ours, theirs = first_order(system), paraxial(parent_system(system))
    assert ours.focal_length == pytest.approx(theirs.focal_length, rel=1e-9)
    assert ours.exit_pupil_distance == pytest.approx(-theirs.exit_pupil, rel=1e-9)
    assert ours.defocus == pytest.approx(theirs.defocus, abs=1e-6)
    assert ours.numerical_aperture == pytest.approx(theirs.image_na, rel=0.02)


@pytest.mark.parametrize("device", DEVICES)
def test_a_plate_shifts_the_focus_as_snell_says(device):
    """By t (1 - cos / sqrt(n^2 - sin^2)) for a ray at an angle; paths follow from Fermat's principle."""
    thickness, index = 200.0, 1.6
    plate = [Row("plate", np.inf, 0.0, 19000.0, glass=constant(index))]
    plate.append(Row("plate's back", np.inf, 0.0, thickness, glass=AIR))
    bare, glazed = tmt18(image=20000.0), tmt18(*plate, image=800.0)
    assert first_order(glazed).defocus - first_order(bare).defocus == pytest.approx(
        -thickness * (1.0 - 1.0 / index), rel=1e-9
    )
    assert first_order(glazed).focal_length == pytest.approx(first_order(bare).focal_length, rel=1e-12)
    still = rest_states(bare, 16), rest_states(glazed, 16)
    both = [prepare(one, segment_rays(one.segments, 3), 550e-6, 15) for one in (bare, glazed)]
    one, other = (
        trace_states(each, state, choose_device(device)) for each, state in zip(both, still, strict=True)
    )
    # The slope of a ray at the image, from where it meets a plane 1 m before it.
    before = prepare(tmt18(image=19000.0), both[0].rays, 550e-6, 15)
    upstream = trace_states(before, still[0], choose_device("numpy"))
    slope = [(np.asarray(getattr(one, k)) - np.asarray(getattr(upstream, k)))[0, :, 0] / 1e3 for k in "xy"]
    sine2 = (slope[0] ** 2 + slope[1] ** 2) / (1.0 + slope[0] ** 2 + slope[1] ** 2)
    shift = thickness * (1.0 - np.sqrt((1.0 - sine2) / (index**2 - sine2)))
    for name, along in zip(("x", "y"), slope, strict=True):
        moved = np.asarray(getattr(other, name)) - np.asarray(getattr(one, name))
        np.testing.assert_allclose(moved[0, :, 0], -along * shift, rtol=0.0, atol=1e-9)


def test_wavefronts_by_slopes_and_by_paths_agree_behind_lenses():
    system = corrector()
    prepared = prepare(system, segment_rays(system.segments, 3), 550e-6, 15)
    slopes = replace(prepared, slopes=slope_fit(prepared))
    states = rest_states(system, 16)
    states.surface_motion[1:, 6, 0] = 0.5
    both = []
    for one in (prepared, slopes):
        traced = trace_states(one, states, choose_device("numpy"))
        both.append(analyse(one, traced, chief_rays(one, states)).zernike[:2])
    change = [each[1] - each[0] for each in both]
    np.testing.assert_allclose(change[1][3:], change[0][3:], atol=0.01 * np.abs(change[0][3:]).max())
    assert np.abs(change[0][3:]).max() > 1e-3


@pytest.mark.parametrize("device", DEVICES)
def test_totally_reflected_light_is_lost_there(device):
    """Behind the plate's back, tilted by 50 degrees, there is none: the critical angle is 41.8."""
    rows = [
        Row("prism", np.inf, 0.0, 15000.0, glass=constant(1.5)),
        Row("prism's back", np.inf, 0.0, 2000.0, glass=AIR),
    ]
    system = tmt18(*rows, image=3000.0)
    prepared = prepare(system, segment_rays(system.segments, 3), 550e-6, 15)
    states = rest_states(system, 16)
    states.surface_motion[8:, 5, 4] = np.radians(50.0)
    status = np.asarray(trace_states(prepared, states, choose_device(device)).status)
    assert (status[..., :8] == 0).all()
    assert (status[..., 8:] == lost_at(TOTAL_REFLECTION, 3)).all()


def test_footprints_are_where_the_rim_of_the_pupil_arrives():
    whole = corrector()
    azimuth = 2.0 * np.pi * np.arange(64) / 64
    rim = PupilRays(*(whole.annulus.outer * np.array([np.cos(azimuth), np.sin(azimuth)])), *np.ones((2, 64)))
    for plane in (3, 7):  # the window's back, and the fold
        end = replace(whole.after_primary[plane], action="pass")
        cut = replace(whole, surfaces=(*whole.surfaces[: 2 + plane], end))
        traced = traced_in_sequence(cut, rim, (0.0, 0.0), whole.wavelengths[0])
        radius = np.hypot(traced.x, traced.y).max()
        assert footprints(whole)[plane] == pytest.approx(radius, rel=1e-9)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("radius", [300.0, -160.0], ids=["diverging", "converging"])
def test_a_field_lens_moves_the_exit_pupil_and_leaves_the_wavefront(device, radius):
    """In the image it changes no path there: wavefronts differ by where the sphere is, less than 1e-3."""
    lens = [Row("lens", radius, 0.0, 19999.0, glass=constant(1.5)), Row("back", -radius, 0.0, 0.5, glass=AIR)]
    found = []
    for behind, image in (((), 20000.0), (lens, 0.5)):
        system = tmt18(*behind, image=image)
        prepared = prepare(system, segment_rays(system.segments, 3), 550e-6, 15)
        states = rest_states(system, 16)
        states.segment_motion[1:, 4, 2] = 1e-4
        traced = trace_states(prepared, states, choose_device(device))
        wavefront = analyse(prepared, traced, chief_rays(prepared, states))
        found.append(wavefront.zernike[1] - wavefront.zernike[0])
    # Light goes against z there: the center of a convex face lies on -z.
    assert prepared.train.sphere_radius == pytest.approx(radius, rel=0.01)
    np.testing.assert_allclose(found[1][3:], found[0][3:], atol=1e-3 * np.abs(found[0]).max())


def test_sentences_of_glass(tmp_path):
    def surfaces(**keys):
        return [
            {"name": "M2", "radius_mm": -2500.0, "conic": -2.25, "distance_mm": 4000.0},
            {"name": "lens", "distance_mm": 1000.0, **keys},
            {"name": "back", "distance_mm": 20.0, "glass": "air"},
            {"name": "image", "distance_mm": 4000.0},
        ]

    polygons = tmp_path / "m1.csv"
    header = ",".join(f"x{corner}_m,y{corner}_m" for corner in range(1, 5))
    polygons.write_text(f"id,{header}\n1,-1,-1,1,-1,1,1,-1,1\n")

    def build(rows):
        return telescope("custom", polygons=polygons, primary_radius=-10000.0, surfaces=rows)

    assert build(surfaces(glass="SCHOTT:N-BK7")).after_primary[1].medium.catalogue == "SCHOTT"
    for keys, sentence in (
        ({"glass": "N-BK8"}, "The surface 'lens': .*N-BK8"),
        ({"glass": -1.5}, "glass = -1.5; it must be the name of a glass, a positive index"),
        ({"glass": True}, "glass = True; it must be"),
    ):
        with pytest.raises(UserError, match=sentence):
            build(surfaces(**keys))
    rows = surfaces(glass="N-BK7")
    lens = [row | {"body": "lens 1"} for row in rows[1:3]]
    assert build([rows[0], *lens, rows[3]]).bodies == {"lens 1": ("lens", "back")}
    with pytest.raises(UserError, match=r'meets the image in N-BK7, behind .lens.; .* glass = "air"'):
        build([rows[0], rows[1], rows[3]])
    with pytest.raises(UserError, match=r"is the image plane; it must have .* no glass"):
        build([*rows[:3], rows[3] | {"glass": "air"}])
    for place, name in ((1, "M2"), (3, "lens 1")):
        with pytest.raises(UserError, match="is called as a surface" if place == 1 else "are of mirrors and"):
            build([row | {"body": name} if row is rows[place] else row for row in rows])
    with pytest.raises(UserError, match=r"The index of SCHOTT N-BK7|The index of N-BK7 is known from"):
        first_order(replace(build(rows), wavelengths=np.array([20e-3])))
