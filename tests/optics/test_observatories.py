"""Keck, GTC, GMT and ELT against what is published of them, and against another way to the same numbers."""

import numpy as np
import pytest

from wavequake.kernels.device.devices import choose_device
from wavequake.optics.rays.pupils import segment_rays
from wavequake.optics.segments.catalog import telescope
from wavequake.optics.segments.layout import areas
from wavequake.optics.segments.prepared import prepare
from wavequake.optics.segments.states import rest
from wavequake.optics.segments.telescope import first_order
from wavequake.optics.segments.wavefront import measure

# Segments, focal length (m), diameter of the glass (m), focus behind M1 (m; ELT: plate scale in mm/arcsec).
PUBLISHED = {
    "keck": (36, 149.583, 10.949, 2.5),
    "gtc": (36, 169.9, 11.4, 3.4),
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
    assert 2.0 * system.pupil_outer / 1e3 == pytest.approx(diameter, rel=2e-3)
    if behind is not None:
        assert system.surfaces[-1].position[2] / 1e3 == pytest.approx(behind, rel=1e-4)


def test_glass_of_keck_and_plate_scale_of_the_elt(found):
    assert areas(found["keck"].segments).sum() / 1e6 == pytest.approx(75.76, rel=1e-4)  # m², published
    scale = abs(first_order(found["elt"]).focal_length) * np.pi / 180.0 / 3600.0
    assert scale == pytest.approx(3.316, rel=1e-4)  # mm/arcsec, published


@pytest.mark.parametrize(("name", "nanometers"), [("keck", 0.15), ("gtc", 1.0), ("gmt", 3.5), ("elt", 17.0)])
def test_the_axis_is_sharp(found, name, nanometers):
    """Conics and spacings come from different sources; only together do they make an image."""
    system = found[name]
    rays = segment_rays(system.segments, 1)
    prepared = prepare(system, rays, 550e-6, 15)
    wavefront = measure(
        prepared, rest(16, len(system.segments), len(system.surfaces)), choose_device("numpy")
    )
    assert wavefront.lost[0] == 0
    assert wavefront.rms_raw[0] * 550.0 < nanometers


def test_the_elt_has_six_equal_sectors_of_alike_segments_with_gaps_of_4_mm(found):
    system = found["elt"]
    segments = system.segments
    azimuth = np.rad2deg(np.arctan2(segments.centers[:, 1], segments.centers[:, 0])) % 360.0
    assert np.histogram((azimuth + 1e-6) % 360.0, 6, (0.0, 360.0))[0].tolist() == [133] * 6
    assert 2.0 * system.pupil_inner == pytest.approx(9413.6, rel=3e-3)  # published
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
