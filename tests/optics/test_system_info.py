from dataclasses import replace

import numpy as np
import pytest
from scipy.special import jn_zeros

from wavequake.drawing.light import field_names
from wavequake.errors import UserError
from wavequake.optics.catalog.names import optical_system
from wavequake.optics.media.glasses import Medium
from wavequake.optics.rays.packing import pack
from wavequake.optics.segments.catalog import telescope
from wavequake.optics.segments.kinematics import cardan
from wavequake.optics.segments.parent import parent_system
from wavequake.optics.shapes.shapes import Conic, EvenAsphere, Opening, ZernikeDeformation
from wavequake.optics.systems.info import info
from wavequake.optics.systems.kinematics import Break, SurfaceRow, sequential
from wavequake.optics.systems.system import OpticalSystem, Pupil, Surface


def line_of(text, start):
    return next(line for line in text.splitlines() if line.startswith(start))


def test_table_of_a_thin_lens():
    glass = Medium("crown", "constant", (1.5,))
    rows = [
        SurfaceRow("front", Conic(100.0), 0.0, "refract", glass, Opening(12.0)),
        SurfaceRow("rear", EvenAsphere(-100.0, 0.0, (0.0, 1e-9)), 200.0, "refract"),
        SurfaceRow(
            "screen", deformation=ZernikeDeformation(3, 1.0), opening=Opening(4.0, 1.0, arms=((0.0, 1.0),))
        ),
    ]
    system = OpticalSystem(
        "thin lens",
        sequential(rows),
        0,
        Pupil("entrance_diameter", 20.0),
        object_distance=200.0,
        fields=np.array([[0.0, 3.0]]),
        wavelengths=np.array([500e-6, 600e-6]),
        primary_wavelength=1,
    )
    text = info(system)
    assert line_of(text, "focal length").split() == ["focal", "length", "100", "mm"]
    assert line_of(text, "magnification").split()[-1] == "-1"
    assert line_of(text, "NA in object").split()[-1] == "0.05"
    assert line_of(text, "f-number").split()[-1] == "10"
    assert line_of(text, "object").endswith("200 mm before front")
    assert line_of(text, "field").endswith("(0, 3) mm")
    assert line_of(text, "wavelength").split()[2:] == ["500", "600", "primary"]
    assert line_of(text, "front (stop)").split()[-3:] == ["refract", "crown", "12"]
    assert "EvenAsphere" in line_of(text, "rear ")
    assert "deforms" in line_of(text, "screen")
    assert line_of(text, "screen").endswith("1 to 4, 1 arms")
    assert not any(line != line.rstrip() for line in text.splitlines())


def paraboloid(f_number, shift=0.0):
    rows = [SurfaceRow("M", Conic(-200.0, -1.0), -100.0, "reflect"), SurfaceRow("image", thickness=shift)]
    return OpticalSystem("p", sequential(rows), 0, Pupil("f_number", f_number))


@pytest.mark.parametrize("f_number", [0.5, 1.0, 2.0])
def test_a_fast_paraboloid_shows_the_aperture_of_its_real_rays(f_number):
    """A ray of height h leaves at 2 arctan(h / 2 f) to the axis (polar equation of the parabola)."""
    angle = 2.0 * np.arctan(1.0 / (4.0 * f_number))
    *words, real = line_of(info(paraboloid(f_number)), "NA in image").split()
    assert " ".join(words) == f"NA in image {0.5 / f_number:g}, of real rays"
    assert float(real) == pytest.approx(np.sin(angle), rel=1e-7)
    assert line_of(info(paraboloid(8.0)), "NA in image").split()[-1] == "0.0625"  # of both, within 0.1 %


@pytest.mark.parametrize("index", [1.0, 1.33])
def test_a_wide_object_aperture_shows_that_of_real_rays(index):
    """A stop of radius r at a distance d takes n sin(arctan(r / d)); the paraxial aperture is n r / d."""
    water = Medium("immersion", "constant", (index,))
    rows = [SurfaceRow("stop", thickness=10.0), SurfaceRow("image")]
    system = OpticalSystem(
        "bare", sequential(rows), 0, Pupil("object_na", 0.5), object_distance=10.0, medium=water
    )
    radius = 10.0 * 0.5 / index
    text = info(system)
    assert line_of(text, "stop").split()[-2] == f"{radius:.8g}"
    assert line_of(text, "NA in object").startswith("NA in object                  0.5, of real rays ")
    assert float(line_of(text, "NA in object").split()[-1]) == pytest.approx(
        index * np.sin(np.arctan(radius / 10.0)), rel=1e-7
    )


def test_surfaces_that_light_meets_obliquely_are_named():
    """A tilted sphere has the powers 2 / (R cos i) in the plane of incidence and 2 cos i / R across it."""
    tilt = np.deg2rad(12.0)
    rows = [
        Break(tilt=(tilt, 0.0, 0.0)),
        SurfaceRow("sphere", Conic(-2000.0), 0.0, "reflect"),
        Break(tilt=(tilt, 0.0, 0.0), thickness=-1000.0),
        SurfaceRow("image"),
    ]
    system = OpticalSystem("tilted", sequential(rows), 0, Pupil("entrance_diameter", 20.0))
    text = info(system)
    assert "obliquely (degrees): sphere (12). " in text
    assert "obliquely" not in info(optical_system("tmt"))  # M3 at 45 degrees has no power
    real = 0.01 * np.array([1.0 / np.cos(tilt), np.cos(tilt)])
    assert line_of(text, "NA in image").startswith("NA in image                   0.01, of real rays ")
    shown = [float(line_of(text, "NA in image").split()[k]) for k in (-3, -1)]
    # The stop stands upright on the tilted mirror: along the tilt the beam is narrower by its cosine.
    assert shown == pytest.approx(sorted([real[1], real[0] * np.cos(tilt)], reverse=True), rel=2e-3)


def test_what_is_infinite_is_called_so():
    afocal = OpticalSystem(
        "mersenne",
        sequential(
            [
                SurfaceRow("a", Conic(-2000.0, -1.0), -1500.0, "reflect"),
                SurfaceRow("b", Conic(1000.0, -1.0), 500.0, "reflect"),
                SurfaceRow("image"),
            ]
        ),
        0,
        Pupil("entrance_diameter", 10.0),
    )
    text = info(afocal)
    assert line_of(text, "focal length").endswith("infinite")
    assert line_of(text, "resolution").endswith("infinite")
    assert line_of(text, "object").endswith("infinity")


@pytest.mark.parametrize(
    ("name", "wavelength", "f_number"),
    [("tmt", 500e-6, 15.0), ("euv", 13.5e-6, 2.0), ("herschel", 0.1, 8.68)],  # published
)
def test_resolution_is_the_radius_of_the_airy_disk(name, wavelength, f_number):
    """The first zero of J1(pi r / (wavelength N)), or 0.61 wavelength / NA, at the primary wavelength."""
    waves = np.array([2.0 * wavelength, wavelength])
    text = info(replace(optical_system(name), wavelengths=waves, primary_wavelength=1))
    words = line_of(text, "resolution (Airy radius)").split()
    assert words[4:8] == ["um", "at", f"{1e6 * wavelength:g}", "nm,"]
    assert float(words[3]) == pytest.approx(1e3 * jn_zeros(1, 1)[0] / np.pi * wavelength * f_number, rel=5e-5)


def test_fields_of_a_telescope_are_angles():
    assert "(5, 0) arcmin" in line_of(info(optical_system("tmt")), "field")
    double_gauss = optical_system("double-gauss")
    wide = line_of(info(double_gauss), "field")
    assert all(field in wide for field in field_names(double_gauss)), wide  # called as in tables and legends


def test_bad_systems_are_refused():
    with pytest.raises(UserError, match="stop of x"):
        info(OpticalSystem("x", (Surface("image"),), 3, Pupil("stop", 1.0)))


BOW_TIE = ((0.0, 0.0), (4.0, 0.0), (4.0, 4.0), (1.0, 4.0), (2.0, -1.0), (0.0, 4.0))


@pytest.mark.parametrize(
    ("shown", "words"),
    [
        ({"opening": Opening(corners=BOW_TIE)}, "the surface lens of x: .* its edges cross"),
        ({"opening": Opening(corners=((0.0, 0.0), (1.0, 0.0)))}, "at least 3 corners"),
        ({"opening": Opening(arms=((0.0, -1.0),))}, "spider arm"),
        ({"deformation": ZernikeDeformation(3000, 5.0)}, "3000 Zernike terms; it can have 1 to 2016"),
    ],
)
def test_what_cannot_be_traced_is_refused_as_the_trace_refuses_it(shown, words):
    glass = Medium("crown", "constant", (1.5,))
    rows = [
        SurfaceRow("lens", Conic(100.0), 0.0, "refract", glass, **shown),
        SurfaceRow("rear", Conic(-100.0), 100.0, "refract"),
        SurfaceRow("image"),
    ]
    system = OpticalSystem("x", sequential(rows), 1, Pupil("entrance_diameter", 5.0))
    with pytest.raises(UserError, match=words) as of_info:
        info(system)
    with pytest.raises(UserError) as of_trace:
        pack(system, 550e-6)
    assert str(of_info.value) == str(of_trace.value)


def test_every_wavelength_must_suit_the_glasses():
    lens = optical_system("double-gauss")
    with pytest.raises(UserError, match="wavelength"):
        info(replace(lens, wavelengths=np.array([587.6e-6, 20e-3])))


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("jwst", ["Assumed", "M3 (radius, conic) and all spacings", "131.4 m"]),
        ("herschel", ["assumed", "M2, both conics"]),
        ("double-gauss", ["assumed are lead-free glasses"]),
        ("six-lens", ["assumed are spacings, glass and shapes"]),
        ("euv", ["A design of our own"]),
    ],
)
def test_what_is_assumed_of_bundled_systems_is_said(name, words):
    *_, last = info(replace(optical_system(name), name="mine")).split("\n\n")
    assert all(word in last for word in words), last


def test_the_segmented_jwst_says_that_it_is_an_equivalent():
    assert info(parent_system(telescope("jwst"))).endswith("a stigmatic axis.")
    assert "assumed" not in info(optical_system("tmt"))  # as published


def test_an_object_in_the_first_surface_is_refused_as_in_a_trace():
    lens = replace(optical_system("six-lens"), object_distance=0.0)
    with pytest.raises(UserError, match="the object of six-lens stands in the first surface; move it off"):
        info(lens)


def test_surfaces_off_the_axis_are_listed_with_their_places_and_angles():
    rows = [
        SurfaceRow("front", Conic(100.0), 5.0, "refract", Medium("crown", "constant", (1.5,))),
        SurfaceRow("back", Conic(-100.0), 100.0, "refract"),
        SurfaceRow("image"),
    ]
    straight = OpticalSystem("lens", sequential(rows), 0, Pupil("entrance_diameter", 10.0))
    assert "off the axis" not in info(straight)
    angles = np.array([1e-6, -2e-5, 3e-4])
    moved = replace(straight.surfaces[1], position=np.array([3e-6, -2e-3, 5.0]), rotation=cardan(angles))
    text = info(replace(straight, surfaces=(straight.surfaces[0], moved, straight.surfaces[2])))
    table = text[text.index("off the axis") :].splitlines()
    assert len(table) == 2
    name, *numbers = table[1].split()
    assert name == "back"
    expected = [3e-6, -2e-3, *np.rad2deg(angles)]
    np.testing.assert_allclose([float(number) for number in numbers], expected, rtol=1e-7)
