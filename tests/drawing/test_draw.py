"""Drawings of systems, telescopes, models and studies: what they show, and as files."""

import csv
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import xarray as xr
from matplotlib.collections import PolyCollection

from wavequake.drawing.aperture import on_glass
from wavequake.drawing.draw import described_study, draw, look
from wavequake.drawing.labels import Labels
from wavequake.drawing.layout import layouts, stretching
from wavequake.drawing.light import field_names
from wavequake.drawing.solid import model_scene, segment_skin, stretched, system_scene
from wavequake.drawing.still import viewing
from wavequake.drawing.style import svg_text
from wavequake.errors import UserError
from wavequake.mechanics.mirrors.models import AnnularMirror, annular_mirror, circular_mirror
from wavequake.optics.catalog.names import optical_system, system_names
from wavequake.optics.segments.catalog import telescope
from wavequake.optics.segments.parent import parent_system
from wavequake.reduction.reduce import reduce
from wavequake.report.layout_picture import drawn_layout
from wavequake.report.page import picture
from wavequake.workflows.study import bundled_studies, load_study

FACTS = Path(__file__).parents[1] / "data" / "tmt_segments.csv"


def test_models_of_many_faces_are_drawn_in_dots(monkeypatch):
    """172,000 vectors made a page of 27 MB."""
    mirror = circular_mirror()
    assert svg_text(draw(mirror)).count("<path") > 2 * 100
    monkeypatch.setattr("wavequake.drawing.model._MANY", 100)
    assert svg_text(draw(mirror)).count("<path") < 100


def test_segments_are_drawn_where_the_published_table_has_them():
    """All 492 outlines (x1 ... y6) to 1 um, and each name in its own segment."""
    with FACTS.open() as file:
        rows = {row["id"]: row for row in csv.DictReader(file)}
    axes = draw("tmt").axes[0]
    (polygons,) = [one for one in axes.collections if isinstance(one, PolyCollection)]
    drawn = {
        tuple(np.round(path.vertices[:6].mean(axis=0), 4)): path.vertices[:6] for path in polygons.get_paths()
    }
    assert len(drawn) == 492
    (labels,) = [one for one in axes.get_children() if isinstance(one, Labels)]
    names = dict(zip(labels.words, labels.points, strict=True))
    assert set(names) == set(rows)
    for name, row in rows.items():
        corners = np.array([[float(row[f"{axis}{k}_m"]) for axis in "xy"] for k in range(1, 7)])
        middle = corners.mean(axis=0)
        found = min(drawn.values(), key=lambda polygon: np.hypot(*(polygon.mean(axis=0) - middle)))
        gaps = np.hypot(*(found[:, None] - corners[None]).transpose(2, 0, 1)).min(axis=1)
        assert gaps.max() < 1e-6
        assert np.hypot(*(names[name] - middle)) < 0.05


@pytest.mark.parametrize(("around", "rings"), [(48, 6), (18, 2), (12, 2), (96, 2)])
def test_mounts_and_optical_surface_of_a_mirror_are_where_its_parameters_say(around, rings):
    scene = model_scene(annular_mirror(AnnularMirror(around=around, rings=rings)))
    angle = np.arctan2(scene.dots[:, 1], scene.dots[:, 0])
    np.testing.assert_allclose(np.hypot(scene.dots[:, 0], scene.dots[:, 1]), 0.333, atol=1e-12)
    np.testing.assert_allclose(np.sort(np.degrees(angle) % 360.0), [0.0, 120.0, 240.0], atol=1e-9)
    (skin,) = scene.skins
    corners = skin.points[skin.faces]
    sides = corners[:, 1:, :2] - corners[:, :1, :2]
    area = np.abs(np.linalg.det(sides)).sum() / 2.0
    sides = 2 * around  # of both rims, which have a node in the middle of each element
    polygon = sides / 2 * np.sin(2 * np.pi / sides) * (0.5**2 - 0.2**2)
    assert area == pytest.approx(polygon, rel=1e-12)  # the hole stays open, and nothing else does
    np.testing.assert_allclose(
        skin.points[:, 2], (skin.points[:, 0] ** 2 + skin.points[:, 1] ** 2) / (4 * 1.7), atol=1e-9
    )


def test_a_scene_holds_what_the_section_holds():
    system = optical_system("tmt")
    scene = system_scene(system, telescope("tmt"))
    names = [skin.name for skin in scene.skins]
    assert names == ["M1", "M2", "M3", "image"]
    m1 = scene.skins[0]
    assert m1.faces.shape == (492, 6)
    radius = np.sum(m1.points[:, :2] ** 2, axis=1)
    # Conic, Eq. (3.18) of the reference text, written with the radius.
    conic, r = -1.00095348, -60000.0
    np.testing.assert_allclose(
        m1.points[:, 2], radius / (r * (1 + np.sqrt(1 - (1 + conic) * radius / r**2))), rtol=1e-12
    )
    ends = [points[-1] for _, points in scene.lines]
    np.testing.assert_allclose([point[0] for point in ends], -20000.0, atol=1e-6)
    assert segment_skin(telescope("jwst")).faces.shape[0] == 18


def test_a_camera_sees_light_go_to_the_right_without_distortion():
    for up in ([0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]):
        eye = viewing(np.array(up))
        np.testing.assert_allclose(eye @ eye.T, np.eye(3), atol=1e-14)
        assert np.linalg.det(eye) == pytest.approx(1.0)
        assert eye[1] @ up > 0.5
        assert up[2] or eye[0, 2] > 0.5


SHAPELESS = "tip-tilt-vibration"  # loops about one number: there is no system


@pytest.mark.parametrize("name", [*system_names(), *sorted(set(bundled_studies()) - {SHAPELESS})])
def test_everything_bundled_can_be_drawn(name):
    seen = look(name)
    assert seen.system is not None or seen.models
    figure = draw(name)
    assert figure.axes
    assert all(axes.get_xlabel() or axes.get_ylabel() for axes in figure.axes)


def test_what_has_no_shape_is_told():
    with pytest.raises(UserError, match="tip-tilt-vibration has nothing to be drawn"):
        draw(SHAPELESS)
    study = load_study(SHAPELESS)
    assert drawn_layout(xr.Dataset(attrs={"study": study.identity_text()})) is None


def test_objects_are_drawn_as_their_names_are():
    assert draw(optical_system("euv"))._repr_svg_() == draw("euv")._repr_svg_()
    svg = draw(load_study("tmt18-history"))._repr_svg_()
    assert all(f">{name}</text>" in svg for name in telescope("tmt-18").segments.names)
    assert draw("tmt-segments", ["telescope.name=tmt-18"]).axes[0].get_title(loc="left").startswith("tmt-18")
    model = circular_mirror()
    assert "7083 degrees of freedom" in draw(model).axes[0].get_title(loc="left")
    assert "craigb36: 36 degrees" in draw(reduce(model, "craigb36")).axes[0].get_title(loc="left")


@pytest.mark.parametrize("solid", [False, True])
@pytest.mark.parametrize("evil", ["$\\frac{ x$", "a\x1b[2J\r\x00\u202eb", "<script>"])
def test_names_from_files_are_shown_as_they_are(tmp_path, evil, solid):
    """They are no formulas, no markup, and nothing in them is obeyed."""
    plain = optical_system("double-gauss")
    surfaces = tuple(replace(one, name=f"{one.name}{evil}") for one in plain.surfaces)
    figure = draw(replace(plain, name=evil, surfaces=surfaces), solid=solid)
    shown = evil.replace("<", "&lt;").replace(">", "&gt;")
    for code, words in {"\x1b": r"\x1b", "\r": r"\r", "\0": r"\x00", "\u202e": r"\u202e"}.items():
        shown = shown.replace(code, words)
    assert shown in figure._repr_svg_()
    ElementTree.fromstring(figure._repr_svg_())


def test_what_cannot_be_drawn_says_so():
    for what, keys, words in (
        ("nothing", {}, "nothing called 'nothing' to draw"),
        (7, {}, "A int cannot be drawn"),
        ("six-lens", {"optics.rays": 3}, "six-lens is no study"),
        (optical_system("euv"), {"optics.rays": 3}, "Overrides belong to a study"),
    ):
        with pytest.raises(UserError, match=words):
            draw(what, keys)
    with pytest.raises(UserError, match="2 to 1000 rays"):
        draw("euv", rays=1)


def test_files_of_the_command_line(wavequake, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert wavequake("draw", "six-lens")[0] == 0
    first = (tmp_path / "six-lens.svg").read_bytes()
    assert wavequake("draw", "six-lens", "-o", "again.svg")[0] == 0
    assert (tmp_path / "again.svg").read_bytes() == first
    assert b"L3" in first
    code, out, _ = wavequake("info", "six-lens", "--figure", "page.html")
    assert code == 0
    assert "f-number" in out
    assert "<svg" in (tmp_path / "page.html").read_text()
    assert wavequake("draw", "tmt-18", "--3d", "-o", "still.png")[0] == 0
    assert (tmp_path / "still.png").read_bytes()[:4] == b"\x89PNG"
    code, _, err = wavequake("draw", "six-lens", "-o", "film.gif")
    assert (code, "must end in .svg" in err) == (2, True)
    code, _, err = wavequake("draw", "six-lens", "-o", "no/such/folder.svg")
    assert (code, "cannot be written" in err) == (2, True)


@pytest.mark.parametrize("name", sorted(set(bundled_studies()) - {SHAPELESS}))
def test_every_report_begins_with_what_it_is_about(name):
    """The store keeps the study's identity alone, and that is enough."""
    study = load_study(name, {"model.rings": 3} if name.startswith("mirror") else {})
    first = picture("layout", *drawn_layout(xr.Dataset(attrs={"study": study.identity_text()})))
    assert (first.id, "</svg>" in first.svg) == ("layout", True)
    assert first.points > 300
    assert drawn_layout(xr.Dataset(attrs={"study": '{"study": {"workflow": "another"}}'})) is None
    assert drawn_layout(xr.Dataset()) is None


def test_names_and_numbers_of_an_axis_stand_within_the_figure():
    """Also where heights are thousands of mm: herschel is drawn in mm, up to 1.6 m below its axis."""
    figure = draw("herschel")
    figure.draw_without_rendering()
    label = figure.axes[0].yaxis.label.get_window_extent()
    assert figure.axes[0].get_ylabel() == "y (mm)"
    assert label.x0 > 0.0


def _written(axes):
    """Return the names in axes and the boxes that they cover."""
    return {text.get_text(): text.get_window_extent() for text in axes.texts}


def test_small_lenses_are_drawn_once_more_by_themselves_to_scale():
    figure = draw("hsc")
    figure.draw_without_rendering()
    whole, lenses = figure.axes
    assert set(_written(whole)) == {"M1 (stop)", "image"}
    # In that order along z; two elements of the dispersion corrector have one name.
    named = {text.get_text(): text.get_position()[0] for text in lenses.texts}
    assert sorted(named, key=named.get)[:3] == ["image", "window", "filter"]
    assert set(named) >= {"G1", "G2", "G3", "G4", "G5", "ADC"}
    assert (lenses.get_aspect(), whole.get_aspect()) == (1.0, 1.0)
    assert np.ptp(lenses.get_xlim()) < 0.25 * 1e3 * np.ptp(whole.get_xlim())
    assert "M1 (stop)" not in _written(draw("sdss").axes[1])  # whose halves stand above and below


def test_a_thin_system_is_drawn_once_more_with_its_heights_stretched():
    figure = draw("six-lens")
    figure.draw_without_rendering()
    _, stretched = figure.axes
    assert stretched.get_title(loc="left") == "The same, heights stretched 20 times"
    box = stretched.get_window_extent()
    scales = np.array([box.width, box.height]) / [np.ptp(stretched.get_xlim()), np.ptp(stretched.get_ylim())]
    assert scales[1] / scales[0] == pytest.approx(20.0)
    (layout,) = layouts(optical_system("six-lens"))
    heights = np.concatenate([points[:, 1] for _, points in layout.rays])
    low, high = stretched.get_ylim()
    assert low < heights.min() < heights.max() < high
    assert np.ptp(heights) > 0.4 * (high - low)
    assert set(_written(stretched)) == {"object", "L1", "L2", "L3", "stop", "L4", "L5", "L6", "image"}
    assert len(draw("double-gauss").axes) == 1


def test_a_thin_system_is_stretched_across_its_axis_in_space():
    scene = system_scene(optical_system("six-lens"))
    wide, times = stretched(scene)
    assert times == 20.0
    for one, other in zip(scene.skins, wide.skins, strict=True):
        np.testing.assert_allclose(other.points, one.points * [20.0, 20.0, 1.0])
    assert draw("six-lens", solid=True).axes[0].get_title(loc="left").endswith("20 times as wide as it is")
    _, times = stretched(system_scene(optical_system("euv")))
    assert (times, draw("euv", solid=True).axes[0].get_title(loc="left")) == (1.0, "euv")
    assert [stretching(share) for share in (0.0, 0.5, 0.12, 0.119, 0.06, 0.0154, 1e-3)] == [
        1.0, 1.0, 1.0, 2.0, 5.0, 10.0, 200.0,
    ]  # fmt: skip


@pytest.mark.parametrize("solid", [False, True])
@pytest.mark.parametrize("name", ["hsc", "decam", "elt", "euv", "rubin", "six-lens", "tmt"])
def test_names_cover_no_other_names(name, solid):
    figure = draw(name, solid=solid)
    figure.draw_without_rendering()
    named = [list(_written(axes).values()) for axes in figure.axes]
    assert any(named)
    for boxes in named:
        assert not any(one.overlaps(other) for k, one in enumerate(boxes) for other in boxes[:k])


def test_the_section_of_a_telescope_has_mirror_and_rays_where_glass_is():
    """GMT: the circles of 8.365 m about 0 and 8.71 m along x; no ray lands in the gaps between them."""
    segmented = telescope("gmt")
    glass = segmented.segments.corners
    layout = on_glass(segmented, layouts(parent_system(segmented), across=np.array([1.0, 0.0, 0.0]))[0])
    (mirror,) = (part for part in layout.parts if part.name.startswith("M1"))
    spans = sorted((line[:, 1].min(), line[:, 1].max()) for line in mirror.lines)
    along = [c for c in glass if abs(c[:, 1].mean()) < 100.0]
    wanted = sorted((c[:, 0].min(), c[:, 0].max()) for c in along)
    np.testing.assert_allclose(spans, wanted, atol=40.0)
    assert len(layout.rays) >= 3
    for _, ray in layout.rays:
        met = ray[np.abs(ray[:, 0]) < 3000.0]  # M1 lies there, M2 and the image do not
        assert all(any(low - 130 <= s <= high + 130 for low, high in wanted) for s in met[:1, 1])


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("tmt-m1-control", "M2"),
        ("lens-experiment", "focal length"),
        ("mirror-mor", "annular mirror: 6768 degrees of freedom of 2256 nodes, 1 x 1 x"),
        ("controller-mor", "hexagonal segment"),
    ],
)
def test_studies_without_a_system_of_their_own_are_described(name, said):
    assert said in described_study(name)


@pytest.mark.parametrize("name", ["tip-tilt-vibration", "double-gauss", "tmt-18", "euv-allowances"])
def test_what_has_a_system_or_nothing_is_told_elsewhere(name):
    assert described_study(name) is None


def test_fields_are_named_by_four_digits():
    """5 arcmin."""
    system = replace(optical_system("gregorian"), fields=np.deg2rad([[5.0 / 60.0, 0.0]]))
    assert field_names(system) == ["(0.08333, 0) deg"]
