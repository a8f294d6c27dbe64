"""Bundled telescopes."""

from dataclasses import replace
from math import inf, radians

import numpy as np

from wavequake.optics.segments.catalog import telescope
from wavequake.optics.segments.parent import parent_system
from wavequake.optics.shapes.shapes import Conic, Opening
from wavequake.optics.systems.kinematics import Break, SurfaceRow, sequential
from wavequake.optics.systems.system import OpticalSystem, Pupil

_ARCMIN = radians(1.0 / 60.0)


def tmt_thesis() -> OpticalSystem:
    """Return the TMT of Störkle 2018, Table 4.2, M2's conic with its sign: folded by M3, f = 449.9986 m."""
    return _with_fields(parent_system(telescope("tmt-thesis")), 5.0)


def tmt() -> OpticalSystem:
    """Return the parent optics of the official TMT prescription, folded by M3, f = 450 m."""
    return _with_fields(parent_system(telescope("tmt")), 5.0)


def _with_fields(system: OpticalSystem, arcmin: float) -> OpticalSystem:
    return replace(system, fields=np.array([[0.0, 0.0], [arcmin * _ARCMIN, 0.0]]))


def jwst() -> OpticalSystem:
    """Return the three mirrors of the James Webb Space Telescope, without the flat fine-steering mirror.

    Radii and conics of M1 (15.88 m, -0.9967) and M2 (1778.913 mm, -1.6598) are quoted by public sources as
    those of Lightsey et al. 2012 (Opt. Eng. 51, 011003) and of the mirrors' makers. M3 and the spacings are
    commonly given, but we have not seen them in print: take them as approximate. They are consistent with the
    rest: at best focus the rms spot radius is 4 to 5 um over 9 arcmin of field, a tenth of the Airy radius at
    2 um, which other numbers would not give. The focal length is 132.8 m; the published 131.4 m would need M2
    just 0.11 mm further from M1. The image plane stands at the best focus of the field, which lies off the
    axis.

    The pupil is the circle about the segments' outermost corners.
    """
    rows = [
        SurfaceRow("M1", Conic(-15879.7, -0.9967), -7169.0, "reflect"),
        SurfaceRow("M2", Conic(-1778.913, -1.6598), 7965.3, "reflect"),
        SurfaceRow("M3", Conic(-3016.227, -0.6595), -4855.643, "reflect"),
        SurfaceRow("image"),
    ]
    return OpticalSystem(
        name="jwst",
        surfaces=sequential(rows),
        stop=0,
        pupil=Pupil("entrance_diameter", 6603.464, 0.2),
        fields=np.array([[0.0, 0.0023]]),
        wavelengths=np.array([2000e-6]),
        note="M1 and M2 are published. Assumed, as commonly given but not confirmed in print: M3 (radius, "
        "conic) and all spacings; the published focal length is 131.4 m. The flat "
        "fine-steering mirror is left out.",
    )


def herschel() -> OpticalSystem:
    """Return a classical Cassegrain telescope like Herschel's: 3.5 m, f/0.5 primary, f = 28.5 m, f/8.68.

    Given are the diameter and focal ratio of M1, the focal length and ratio of the telescope, whose stop is
    M2, and the focus 1050 mm behind M1. From these the mirror formula makes the spacing (1588.0 mm, as
    published) and M2; its conic makes the axis stigmatic. Far infrared: 100 um.
    """
    f1, focal, behind = 1750.0, 28500.0, 1050.0
    magnification = focal / f1
    to_focus = (f1 + behind) / (magnification + 1.0)  # from M2 to the focus of M1
    f2 = -1.0 / (1.0 / to_focus - 1.0 / (magnification * to_focus))
    conic = -(((magnification + 1.0) / (magnification - 1.0)) ** 2)
    gap = f1 - to_focus
    rows = [
        SurfaceRow("M1", Conic(-2.0 * f1, -1.0), -gap, "reflect", opening=Opening(1750.0)),
        SurfaceRow("M2", Conic(2.0 * f2, conic), gap + behind, "reflect"),
        SurfaceRow("image"),
    ]
    return OpticalSystem(
        name="herschel",
        surfaces=sequential(rows),
        stop=1,
        pupil=Pupil("f_number", 8.68, 0.1),
        fields=np.array([[0.0, 0.0], [0.0, 5.0 * _ARCMIN]]),
        wavelengths=np.array([0.1]),
        note="Published are diameter, focal lengths and focus; assumed is a classical Cassegrain telescope, "
        "from which M2, both conics and an obscuration of 0.1 follow.",
    )


def gregorian() -> OpticalSystem:
    """Return an unobscured Gregorian telescope (Störkle 2018, Fig. 1.3): 1 m, f = 12 m, nothing in the beam.

    M1 is an off-axis part of a paraboloid of 2 m focal length, whose axis lies 900 mm beside the pupil's
    center. M2 is part of an ellipsoid with one focus in that of M1 and the other in the image: radius
    2 p q / (p + q), conic -((q - p) / (q + p))^2 for the distances p and q of its foci. So the axis is
    stigmatic.
    """
    f1, p, q, beside = 2000.0, 500.0, 3000.0, 900.0
    rows: list[SurfaceRow | Break] = [
        Break((beside, 0.0, 0.0)),
        SurfaceRow("stop"),
        Break((-beside, 0.0, 0.0), thickness=3000.0),
        SurfaceRow("M1", Conic(-2.0 * f1, -1.0), -(f1 + p), "reflect"),
        SurfaceRow("M2", Conic(2.0 * p * q / (p + q), -(((q - p) / (q + p)) ** 2)), q, "reflect"),
        SurfaceRow("image", Conic(inf)),
    ]
    return OpticalSystem(
        name="gregorian",
        surfaces=sequential(rows),
        stop=0,
        pupil=Pupil("entrance_diameter", 1000.0),
        fields=np.array([[0.0, 0.0], [0.0, 1.0 * _ARCMIN]]),
    )
