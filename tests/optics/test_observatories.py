"""Keck, GTC, HET, GMT and ELT against what is published, and another way to the same numbers."""

import numpy as np
import pytest

from wavequake.kernels.device.devices import choose_device
from wavequake.optics.rays.pupils import segment_rays
from wavequake.optics.segments.catalog import telescope
from wavequake.optics.segments.layout import areas
from wavequake.optics.segments.prepared import prepare
from wavequake.optics.segments.telescope import first_order
from wavequake.optics.segments.wavefront import measure
from wavequake.optics.systems.kinematics import rest_states

# Segments, focal length (m), diameter of the glass (m), focus behind M1 (m; ELT: plate scale in mm/arcsec).
PUBLISHED = {
    "keck": (36, 149.583, 10.949, 2.5),
    "gtc": (36, 169.9, 11.4, 3.4),
    "het": (91, -36.5, 11.1, None),
    "gmt": (7, -25.448 * 8.16, 25.448, 5.83),
    "elt": (798, -684.0, 39.146, None),
}


@pytest.fixture(scope="module")
def found():
    return {name: telescope(name) for name in PUBLISHED}


@pytest.mark.parametrize("name", PUBLISHED)
def test_published_figures(found, name):
    count, focal_length, diameter, behind = PUBLISHED[name]
    system = found[name]
    optics = first_order(system)
    assert len(system.segments) == count
    assert optics.focal_length / 1e3 == pytest.approx(focal_length, rel=1e-3)
    assert 2.0 * system.annulus.outer / 1e3 == pytest.approx(diameter, rel=5e-3 if name == "het" else 2e-3)
    if behind is not None:
        assert system.after_primary[-1].position[2] / 1e3 == pytest.approx(behind, rel=1e-4)


def test_glass_of_keck_and_plate_scale_of_the_elt(found):
    assert areas(found["keck"].segments).sum() / 1e6 == pytest.approx(75.76, rel=1e-4)  # m², published
    scale = abs(first_order(found["elt"]).focal_length) * np.pi / 180.0 / 3600.0
    assert scale == pytest.approx(3.316, rel=1e-4)  # mm/arcsec, published


@pytest.mark.parametrize(
    ("name", "nanometers"), [("keck", 0.15), ("gtc", 1.0), ("het", 12.0), ("gmt", 3.5), ("elt", 17.0)]
)
def test_the_axis_is_sharp(found, name, nanometers):
    """Conics and spacings come from different sources; only together do they make an image."""
    system = found[name]
    rays = segment_rays(system.segments, 1)
    prepared = prepare(system, rays, 550e-6, 15)
    wavefront = measure(prepared, rest_states(system, 16), choose_device("numpy"))
    assert wavefront.lost[0] == 0
    assert wavefront.rms_raw[0] * 550.0 < nanometers


def test_the_array_of_the_het(found):
    """Published: 11.1 m by 9.8 m (across what is not said), 78 m2; all are equal parts of a sphere."""
    segments = found["het"].segments
    x, y = np.moveaxis(segments.corners.reshape(-1, 2), -1, 0)
    assert (np.ptp(x), np.ptp(y)) == pytest.approx((11100.0, 9800.0), rel=1e-2)
    assert areas(segments).sum() / 1e6 == pytest.approx(78.0, rel=0.015)
    assert np.hypot(*segments.centers[0, :2]) == 0.0
    away = np.linalg.norm(segments.centers - [0.0, 0.0, -26165.0], axis=1)
    np.testing.assert_allclose(away, 26165.0, rtol=1e-14)
    assert first_order(found["het"]).defocus == pytest.approx(0.0, abs=1e-6)


def test_secondaries_of_keck_and_gtc_follow_from_the_published_numbers(found):
    """Mirror formula for M2's radius; third-order spherical aberration of none for its conic.

    Keck: f = 149.583 m and the focus 2.5 m behind M1 (Technical Note 163). GTC: f = 169.9 m and 3.4 m.
    """
    for name, focal_length, behind, near, much in (
        ("keck", 149583.0, 2500.0, 2e-5, 2e-4),
        ("gtc", 169900.0, 3400.0, 1e-3, 2e-3),
    ):
        system = found[name]
        f1, conic = -0.5 * system.primary.shape.radius, system.primary.shape.conic
        m = focal_length / f1
        s2 = (f1 + behind) / (m + 1.0)  # from M2 to the focus of M1
        m2 = system.after_primary[0]
        assert -m2.shape.radius == pytest.approx(2.0 * s2 * m / (m - 1.0), rel=near)
        k = s2 / f1
        without = -(((m + 1.0) / (m - 1.0)) ** 2) + (conic + 1.0) * m**3 / (k * (m - 1.0) ** 3)
        assert m2.shape.conic == pytest.approx(without, rel=much)


def test_the_elt_has_six_equal_sectors_of_alike_segments_with_gaps_of_4_mm(found):
    system = found["elt"]
    segments = system.segments
    azimuth = np.rad2deg(np.arctan2(segments.centers[:, 1], segments.centers[:, 0])) % 360.0
    assert np.histogram((azimuth + 1e-6) % 360.0, 6, (0.0, 360.0))[0].tolist() == [133] * 6
    assert 2.0 * system.annulus.inner == pytest.approx(9413.6, rel=3e-3)  # published
    # Across the gap to the nearest neighbor: the middles of facing edges are 4 mm apart in the glass.
    middles = 0.5 * (segments.corners + np.roll(segments.corners, -1, axis=1))
    others = np.delete(middles, 0, axis=0).reshape(-1, 2)
    apart = [np.linalg.norm(others - middle, axis=1).min() for middle in middles[0]]
    tilt = segments.axes[0, 2, 2]
    assert 4.0 * tilt**2 - 0.01 < min(apart) < 4.01
    sizes = areas(segments) / segments.axes[:, 2, 2]
    assert sizes.max() / sizes.min() < 1.03


def test_mirrors_of_the_gmt_are_round_in_their_own_planes(found):
    segments = found["gmt"].segments
    outer = segments.corners[0] - segments.centers[0, :2]
    lean = segments.axes[0, 2, 2]
    assert lean == pytest.approx(np.cos(np.deg2rad(13.6)), abs=1e-4)
    across, along = np.ptp(outer[:, 1]), np.ptp(outer[:, 0])
    assert along / across == pytest.approx(lean, rel=3e-3)
    assert areas(segments)[6] == pytest.approx(np.pi / 4.0 * 8365.0**2, rel=1e-12)
    assert np.linalg.norm(segments.centers[:6, :2], axis=1) == pytest.approx(8710.0)
