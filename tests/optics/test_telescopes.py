from importlib.resources import files
from io import StringIO

import numpy as np
import pytest

from wavequake.errors import UserError
from wavequake.kernels.device.tiles import TILE
from wavequake.kernels.trace.segmented import SegmentedTrain, trace_chief
from wavequake.optics.segments.catalog import telescope
from wavequake.optics.segments.layout import half_planes, tmt18_segments
from wavequake.optics.segments.telescope import first_order, surface_transforms
from wavequake.optics.systems.system import OpticalSystem

NAMES = ["tmt", "tmt-18", "tmt-thesis", "jwst"]
SURFACES = [
    {"name": "M2", "radius_mm": -1778.913, "conic": -1.2737, "distance_mm": 7104.0},
    {"name": "fold", "distance_mm": 10000.0, "tilt_deg": 45.0},
    {"name": "image", "radius_mm": None, "conic": 0.0, "distance_mm": 3830.0},
]


def jwst_table():
    return StringIO(files("wavequake.optics.segments").joinpath("jwst_segments.csv").read_text())


def axial_rays(system: OpticalSystem, heights):
    """Trace rays through the undisturbed system; return image x, y and path lengths (ray, 3)."""
    train = SegmentedTrain(
        primary_curvature=1.0 / system.primary.shape.radius,
        primary_conic=system.primary.shape.conic,
        edges=half_planes(system.segments),
        figure_frames=np.zeros((len(system.segments), 4)),
        figure_degree=-1,
        surface_curvatures=np.array([1.0 / surface.shape.radius for surface in system.after_primary]),
        surface_conics=np.array([surface.shape.conic for surface in system.after_primary]),
        sphere_radius=first_order(system).exit_pupil_distance,
    )
    poses = np.repeat(surface_transforms(system)[None, :, :, None], TILE, axis=3)
    directions = np.zeros((1, 3, TILE))
    directions[:, 2] = 1.0
    rays = [trace_chief(train, poses, directions, system.stop_z, (0.6 * r, 0.8 * r)) for r in heights]
    return np.array([ray[0, :, 0] for ray in rays])


@pytest.mark.parametrize("name", NAMES)
def test_every_telescope_forms_an_image_on_axis(name):
    system = telescope(name)
    heights = np.linspace(system.annulus.inner, system.annulus.outer, 6)
    x, y, _ = axial_rays(system, heights).T
    radius = np.hypot(x, y).max()
    assert radius < {"tmt": 3e-4, "jwst": 1e-8}.get(name, 6e-3)  # mm; Table 4.2 is out of focus by 0.14 mm


def test_the_equivalent_of_the_jwst_is_exactly_stigmatic():
    system = telescope("jwst")
    optics = first_order(system)
    assert optics.focal_length == pytest.approx(131400.0, rel=1e-13)
    assert optics.defocus == pytest.approx(0.0, abs=1e-7)
    assert system.after_primary[0].shape.radius == -1778.913
    assert 7000.0 < -system.after_primary[0].position[2] < 7200.0
    paths = axial_rays(system, np.linspace(0.0, system.annulus.outer, 9))[:, 2]  # Fermat: all alike
    np.testing.assert_allclose(paths, paths[0], rtol=0, atol=1e-9)


def test_prescriptions_of_the_tmt():
    official, table_4_2 = telescope("tmt"), telescope("tmt-thesis")
    assert (official.primary.shape.conic, official.after_primary[0].shape.radius) == (
        -1.00095348,
        -6227.67857,
    )
    assert (table_4_2.primary.shape.conic, table_4_2.after_primary[0].shape.radius) == (-1.0009535, -6227.68)
    for system in (official, table_4_2, telescope("tmt-18")):
        assert system.primary.shape.radius == -60000.0
        assert system.after_primary[0].shape.conic == -1.31822813
        assert system.stop_z == pytest.approx(-1874.9721, abs=1e-4)
    assert (official.annulus.inner, official.annulus.outer) == (1512.2, 15000.0)
    assert [len(telescope(name).segments) for name in NAMES] == [492, 18, 1, 18]


@pytest.mark.parametrize("side", [3000.0, 15000 / np.sqrt(19)])
def test_the_18_segments_fill_their_pupil_and_no_larger_annulus(side):
    system = telescope("tmt-18", side=side)
    assert system.annulus.inner / system.annulus.outer == pytest.approx(1 / np.sqrt(13))
    edges = half_planes(tmt18_segments(side))
    corners = system.segments.corners.reshape(-1, 2)  # the narrowest places are at corners
    azimuth = np.append(np.linspace(0.0, 2 * np.pi, 361), np.arctan2(*corners.T[::-1]))[:, None, None]

    def covered(radius):
        x, y = radius * np.cos(azimuth), radius * np.sin(azimuth)
        return (edges[..., 0] * x + edges[..., 1] * y <= edges[..., 2] + 1e-6).all(axis=2).any(axis=1)

    assert covered(system.annulus.inner).all()
    assert covered(system.annulus.outer).all()
    assert not covered(system.annulus.inner * 0.999).all()
    assert not covered(system.annulus.outer * 1.001).all()


def test_options_reach_the_segments():
    gap = (
        half_planes(telescope("tmt", gap=0.0).segments)[:, :, 2]
        - half_planes(telescope("tmt").segments)[:, :, 2]
    )
    np.testing.assert_allclose(gap, 1.25, rtol=0.04)  # foreshortened


def test_a_custom_telescope_like_the_jwst():
    custom = telescope("custom", polygons=jwst_table(), primary_radius=-15879.7, surfaces=SURFACES)
    jwst = telescope("jwst")
    np.testing.assert_array_equal(custom.segments.corners, jwst.segments.corners)
    np.testing.assert_array_equal(custom.segments.centers, jwst.segments.centers)
    assert (custom.stop_z, custom.annulus.inner, custom.annulus.outer) == (
        jwst.stop_z,
        jwst.annulus.inner,
        jwst.annulus.outer,
    )
    assert custom.annulus.inner == pytest.approx(667.604, abs=1e-3)
    assert first_order(custom).focal_length == pytest.approx(131400.0, rel=3e-3)
    np.testing.assert_allclose(custom.after_primary[-1].position, [-3830.0, 0.0, 2896.0], rtol=0, atol=1e-9)


def complaint(name, **options):
    with pytest.raises(UserError) as caught:
        telescope(name, **options)
    assert str(caught.value).endswith(".")
    return str(caught.value)


def test_unknown_names_and_options():
    assert "'tmt18'; the nearest valid one is 'tmt-18'" in complaint("tmt18")
    assert "'jwts'; the nearest valid one is 'jwst'" in complaint("jwts")
    assert "tmt-18 has no option 'sid'; the nearest valid one is 'side'" in complaint("tmt-18", sid=1.0)
    assert "custom needs the option 'polygons'" in complaint("custom", primary_radius=-1.0)


def changed(index, **keys):
    return [{**surface, **(keys if place == index else {})} for place, surface in enumerate(SURFACES)]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"primary_radius": 100.0}, "radius of the primary mirror is 100 mm"),
        ({"primary_radius": float("nan")}, "radius of the primary mirror is nan mm"),
        ({"primary_conic": float("inf")}, "conic constant of the primary mirror"),
        ({"surfaces": []}, "needs surfaces after the primary mirror"),
        ({"surfaces": ["M2", "image"]}, "surface 1 after the primary mirror is 'M2'; it must be a Mapping"),
        ({"surfaces": SURFACES[:1]}, "'M2', is the image plane"),
        ({"surfaces": changed(len(SURFACES) - 1, semi_diameter_mm=5.0)}, "no semi_diameter_mm and no glass"),
        (
            {"surfaces": changed(1, name="M2")},
            "Surface 2 after the primary mirror is called 'M2'",
        ),
        (
            {"surfaces": changed(0, name="M1")},
            "Surface 1 after the primary mirror is called 'M1'",
        ),
        ({"surfaces": changed(0, name=" ")}, "Surface 1 after the primary mirror is called ' '"),
        (
            {"polygons": StringIO("id,x1_m,y1_m,x2_m,y2_m,x3_m,y3_m\nA,0,0,3000,0,0,3000\n")},
            "reach 3e+06 mm from the axis, farther than the radius of curvature of the primary mirror",
        ),
        ({"surfaces": changed(0, radius=1.0)}, "unknown key 'radius'; the nearest valid one is 'radius_mm'"),
        ({"surfaces": changed(0, conic=float("nan"))}, "'M2' has conic = nan"),
        ({"surfaces": changed(1, distance_mm=None)}, "'fold' has distance_mm = None"),
        ({"surfaces": changed(1, distance_mm=0.0)}, "'fold' needs a radius_mm other than 0"),
        ({"surfaces": changed(0, radius_mm=0.0)}, "'M2' needs a radius_mm other than 0"),
        (
            {"primary_radius": -3000.0, "primary_conic": 0.0},
            "reaches beyond the primary mirror's parent surface",
        ),
    ],
)
def test_impossible_custom_telescopes(options, words):
    valid = {"polygons": jwst_table(), "primary_radius": -15879.7, "surfaces": SURFACES}
    assert words in complaint("custom", **{**valid, **options})
