"""Segmented telescopes that stand or are built, Keck, GTC, HET, GMT and ELT: whence their numbers are."""

from math import cos, inf, pi, sin

import numpy as np

from wavequake.optics.segments.arrangements import circular_segments, elt_segments
from wavequake.optics.segments.layout import hexagon_ring_segments
from wavequake.optics.segments.telescope import Row, around_its_glass
from wavequake.optics.systems.system import OpticalSystem


def keck() -> OpticalSystem:
    """Return a Keck telescope: 36 segments, f/15 secondary, f = 149.58 m.

    M1 is that of J. Nelson, Optical parameters of the Keck telescope, Keck Observatory Technical Note 163
    (rev. 3, 1991): R = 34.974 m, conic -1.003683, hexagons with sides of 0.9 m. The f/15 secondary (R =
    4.737916 m, conic -1.644326) puts the focus 2.5 m behind the vertex of M1 from 15.395 m before it; both
    numbers follow from the note's f = 149.583 m and 2.5 m by the mirror formula and third-order theory.
    """
    radius, conic = -34974.0, -1.003683
    rows = [
        Row("M2", -4737.916, -1.644326, 15394.985),
        Row("image", inf, 0.0, 17895.0025),
    ]
    gap = 3.0
    segments = hexagon_ring_segments(900.0 + gap / 3.0**0.5, 3, gap, radius, conic)
    note = (
        "M1 as in Keck Observatory Technical Note 163; the f/15 secondary is the one that makes the note's "
        "focal length and focus without spherical aberration; assumed are hexagons that are regular as seen "
        "along the axis."
    )
    return around_its_glass("keck", segments, radius, conic, rows, note)


def gtc() -> OpticalSystem:
    """Return the Gran Telescopio Canarias: 36 segments, f = 170.0 m (published: 169.9 m).

    Radii of 33 m and 3.899678 m, conics of -1.002250 and -1.504835, 14.73941 m between the mirrors and
    hexagons with sides of 0.936 m, as the observatory and papers on its polarization and active optics give
    them. The focus is that of these numbers, 3.400 m behind M1.
    """
    radius, conic = -33000.0, -1.002250
    rows = [
        Row("M2", -3899.678, -1.504835, 14739.41),
        Row("image", inf, 0.0, 18139.4197),
    ]
    gap = 3.0
    segments = hexagon_ring_segments(936.0 + gap / 3.0**0.5, 3, gap, radius, conic)
    note = (
        "Radii, conics and the spacing are published by the observatory and in papers on its optics; assumed "
        "are hexagons that are regular as seen along the axis."
    )
    return around_its_glass("gtc", segments, radius, conic, rows, note)


def het() -> OpticalSystem:
    """Return the Hobby-Eberly Telescope: 91 segments of a sphere and a corrector of one mirror, f = 36.5 m.

    Published are 91 hexagons of 1 m across flats, equal parts of a sphere of R = 26.165 m, an array of 11.1 m
    by 9.8 m, and f/3.65 of 10 m behind the wide-field corrector. Its four mirrors are not: M2 is here the one
    Gregorian mirror, 1.2 m behind the focus of M1, that makes all paths along the axis equal and f = 36.5 m.
    Its heights follow from the paths in closed form; the coefficients are fitted to them over the whole
    array, and leave 11 nm rms of wavefront.
    """
    radius, focal_length, behind = -26165.0, 36500.0, 1200.0
    reach = behind * focal_length / (0.5 * -radius)  # from M2 to the image
    m2_radius, m2_conic = (
        2.0 * behind * reach / (behind + reach),
        -(((reach - behind) / (reach + behind)) ** 2),
    )
    even = (
        *(0.0, -9.85133814616e-11, 1.65222011281e-16, -4.34423478771e-22, 1.0696817104e-27),
        *(-1.97956787974e-33, 2.25108280907e-39, -1.14276975237e-45),
    )
    rows = [
        Row("M2", m2_radius, m2_conic, 0.5 * -radius + behind, even=even),
        Row("image", inf, 0.0, reach),
    ]
    gap = 6.0
    segments = hexagon_ring_segments((1000.0 + gap) / 3.0**0.5, 5, gap, radius, 0.0, central=True)
    note = (
        "Published are the segments, the radius of M1 and the focal length; assumed are gaps of 6 mm, with "
        "which the array is as wide as published, hexagons that are regular as seen along the axis, and M2: "
        "one mirror in the place of the corrector's four, sharp on the axis alone; all of M1 is used, where "
        "the telescope's pupil is a circle of 10 m that wanders over it."
    )
    return around_its_glass("het", segments, radius, 0.0, rows, note)


def gmt() -> OpticalSystem:
    """Return the Giant Magellan Telescope: seven round mirrors, Gregorian, f = 207.6 m (f/8.16 of 25.4 m).

    The prescription is that of the telescope's public simulation program (github.com/rconan/geotrans):
    M1 R = 36 m, conic -0.9982857, M2 R = 4.1639009 m, conic -0.71692784, 20.26247614 m before M1; six
    vertices 8.71 m from that of the central mirror, 8.365 m of clear glass. The focus is 5.83 m behind M1.
    """
    radius, conic, out = -36000.0, -0.9982857, 8710.0
    rows = [
        Row("M2", 4163.9009, -0.71692784, 20262.47614),
        Row("image", inf, 0.0, 26092.48145),
    ]
    turns = pi / 3.0 * np.arange(6)
    centers = np.array([*((out * cos(turn), out * sin(turn)) for turn in turns), (0.0, 0.0)])
    segments = circular_segments([str(number) for number in range(1, 8)], centers, 8365.0, radius, conic)
    note = (
        "Prescription of the project's public simulation programs; M2 is of one piece here; left out: the "
        "hole of the central mirror and what shadows it."
    )
    return around_its_glass("gmt", segments, radius, conic, rows, note)


def elt() -> OpticalSystem:
    """Return ESO's Extremely Large Telescope: 798 segments, five mirrors, f = 684.0 m.

    Published (ESO) are 798 hexagons of about 1.4 m with gaps of 4 mm, a mirror 39.15 m across at f/0.88, a
    convex M2 of f/1.1 and 4.2 m, a concave M3 of f/2.6, flat M4 and M5, f = 684 m (3.316 mm/arcsec). Radii
    of M2 and M3 are those of a public Zemax model, too (Anche et al. 2023, A&A 672, A121); that of M1,
    spacings and aspheres are not published: `note` says what is assumed. At best focus the axis has 17 nm
    rms; the image is curved, concave to the light.
    """
    radius, conic = -68900.0, -0.99614283
    rows = [
        Row("M2", -9313.0, -2.26479982, 30764.0212),
        Row("M3", -21067.0, -0.6296677, 30764.0212),
        Row("M4", inf, 0.0, 14500.0, tilt=7.75 * pi / 180.0),
        Row("M5", inf, 0.0, 6500.0, tilt=37.25 * pi / 180.0),
        Row("image", inf, 0.0, 33121.1996),
    ]
    segments = elt_segments(39146.34, 4.0, radius, conic)
    note = (
        "Published are the segments, the focal ratios of M1, M2 and M3, the focal length, and radii of M2 "
        "and M3 (a Zemax model of Anche et al. 2023, whose M1 has 69 m and whose f is 646.8 m); assumed are "
        "a radius of M1 that follows, equal spacings that give f = 684 m, and conics that make the telescope "
        "free of spherical aberration, coma and astigmatism; M4 and M5 fold as drawn by ESO, at 7.75 and "
        "37.25 degrees."
    )
    return around_its_glass("elt", segments, radius, conic, rows, note)
