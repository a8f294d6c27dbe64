"""Bundled lens systems."""

from math import radians

import numpy as np

from wavequake.optics.media.glasses import AIR, glass, refractive_index
from wavequake.optics.shapes.shapes import Conic
from wavequake.optics.systems.kinematics import SurfaceRow, sequential
from wavequake.optics.systems.system import OpticalSystem, Pupil

_D_LINE, _F_LINE, _C_LINE = 587.5618e-6, 486.1327e-6, 656.2725e-6  # mm

_STOP_AFTER = 3  # lens of the six-lens objective
# Kinematic-optical sensitivities of the six lenses, mm per mm (Störkle 2018, Table 5.1).
TABLE_5_1 = (0.071, -0.366, 1.303, -0.913, 1.394, 0.145)


def double_gauss() -> OpticalSystem:
    """Return the double Gauss lens of 28 degrees that is the usual example of lens design: f = 100 mm, f/3.

    Radii and thicknesses are the widely published ones (for instance in the documentation of ray-optics, an
    open program of M. Hayford), with today's lead-free glasses of the same index.
    """
    radii_thicknesses_glasses = [
        (56.20238, 8.75, "N-SSK2"),
        (152.28580, 0.5, None),
        (37.68262, 12.5, "N-SK2"),
        (np.inf, 3.8, "F5"),
        (24.23130, 16.369445, None),
        (None, 13.747957, None),  # the stop
        (-28.37731, 3.8, "F5"),
        (np.inf, 11.0, "N-SK16"),
        (-37.92546, 0.5, None),
        (177.41176, 7.0, "N-SK16"),
        (-79.41143, 61.487536, None),
    ]
    rows: list[SurfaceRow] = []
    for number, (radius, thickness, name) in enumerate(radii_thicknesses_glasses, start=1):
        if radius is None:
            rows.append(SurfaceRow("stop", thickness=thickness))
        else:
            medium = AIR if name is None else glass(name)
            rows.append(SurfaceRow(f"surface {number}", Conic(radius), thickness, "refract", medium))
    return OpticalSystem(
        name="double-gauss",
        surfaces=sequential([*rows, SurfaceRow("image")]),
        stop=5,
        pupil=Pupil("entrance_diameter", 33.33),
        fields=np.array([[0.0, 0.0], [0.0, radians(10.0)], [0.0, radians(14.0)]]),
        wavelengths=np.array([_F_LINE, _D_LINE, _C_LINE]),
        primary_wavelength=1,
        note="Radii and thicknesses are published; assumed are lead-free glasses of the same index.",
    )


def six_lens() -> OpticalSystem:
    """Return an objective of six lenses that has the sensitivities of Störkle 2018, Table 5.1.

    The text (section 5.1) gives six lenses, an object of 5 mm radius, an image of about 2.5 mm, and how far
    the image moves per lens moved sideways, s_1 ... s_6. A thin lens that moves by d bends every ray by d
    times its power, so s_k = (u_(k-1) - u_k) / -u_6 with the slopes u_k of the marginal ray: the table fixes
    all slopes, and the magnification 1 - (s_1 + ... + s_6) = -0.634. What it leaves open is chosen: the
    spacings, lenses of N-BK7 with equal sides, 6 mm thick in their centers, principal planes where the thin
    lenses would stand, a stop between the third and fourth lens, and an aperture of 0.01.
    """
    gaps, object_distance = (60.0, 60.0, 80.0, 80.0, 100.0), 150.0
    slopes = np.sum(TABLE_5_1) - 1.0 - np.cumsum([0.0, *TABLE_5_1])
    heights = slopes[0] * object_distance + np.cumsum([0.0, *(slopes[1:-1] * gaps)])
    powers = -np.diff(slopes) / heights
    thickness, index = 6.0, refractive_index(glass("N-BK7"), _D_LINE)
    curvatures = powers / ((index - 1.0) * (1.0 + np.sqrt(1.0 - thickness * powers / index)))
    principal = (index - 1.0) * thickness * curvatures / (index * powers)  # from the nearer vertex
    ways = [*(gaps - principal[:-1] - principal[1:]), -heights[-1] / slopes[-1] - principal[-1]]
    rows: list[SurfaceRow] = []
    for number, (curvature, way) in enumerate(zip(curvatures, ways, strict=True), start=1):
        radius, name = float(1.0 / curvature), f"L{number}"
        rows += [SurfaceRow(f"{name} front", Conic(radius), thickness, "refract", glass("N-BK7"))]
        if number == _STOP_AFTER:
            rows += [SurfaceRow(f"{name} back", Conic(-radius), way / 2.0, "refract")]
            rows += [SurfaceRow("stop", thickness=way / 2.0)]
        else:
            rows += [SurfaceRow(f"{name} back", Conic(-radius), float(way), "refract")]
    return OpticalSystem(
        name="six-lens",
        surfaces=sequential([*rows, SurfaceRow("image")]),
        stop=2 * _STOP_AFTER,
        pupil=Pupil("image_na", 0.01),
        object_distance=float(object_distance - principal[0]),
        fields=np.array([[0.0, 0.0], [0.0, 5.0]]),
        wavelengths=np.array([_D_LINE]),
        note="Published are its sensitivities (Störkle 2018, Table 5.1); assumed are spacings, glass and "
        "shapes that have them.",
    )
