"""Figures show what they say, in one size, also for the odd campaign."""

import io
import re
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest
from markupsafe import Markup
from matplotlib.collections import PolyCollection
from matplotlib.image import imread

from wavequake.report import figures
from wavequake.report.exposures.figures import Panel, exposure_panels
from wavequake.report.page import Picture, inline_svg
from wavequake.report.populations import histories_of, populations
from wavequake.report.segments.detail import Bent


def pixels(figure, dpi=60):
    """Draw a figure and read it back, shape (height, width, 4)."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=dpi)
    buffer.seek(0)
    return imread(buffer)


def history(dataset, place):
    population = populations(dataset)[place]
    return figures.history(population, histories_of(dataset, population))


def values(found, key):
    return {one.name: getattr(one, key) for one in found if len(one.cases)}


def all_figures(detail, campaign):
    found = populations(campaign)
    return {
        "segments": figures.segment_map(detail),
        "opd": figures.opd_map(detail),
        "spot": figures.spot_diagram(detail),
        "psf": figures.psf_image(detail.image, detail.image_x, detail.image_y, detail.case),
        "wfe": figures.distributions(values(found, "wfe_raw"), "nm"),
        "strehl": figures.distributions(values(found, "strehl"), "Strehl", of_instants=True),
        "history": history(campaign, 0),
    }


def test_every_figure_has_ink_and_the_same_size(detail, campaign):
    drawn = {name: pixels(figure) for name, figure in all_figures(detail, campaign).items()}
    assert len({picture.shape for picture in drawn.values()}) == 1
    for name, picture in drawn.items():
        assert np.mean(picture[..., :3].min(axis=2) < 0.97) > 0.02, name


def test_nothing_is_drawn_beyond_the_edge(detail, campaign):
    found = populations(campaign)
    for name, figure in {
        **all_figures(detail, campaign),
        "summary": figures.summary_figure(detail, found),
    }.items():
        picture = pixels(figure)[..., :3]
        edges = (picture[0], picture[-1], picture[:, 0], picture[:, -1])
        assert all((edge == 1.0).all() for edge in edges), name


def test_segments_have_the_color_of_their_displacement_at_the_worst_instant(detail):
    axes, side = figures.segment_map(detail).axes
    (glass,) = (artist for artist in axes.collections if isinstance(artist, PolyCollection))
    # Instant 2 is the worst; segment k is displaced by 20 k nm, and the scale is symmetric about zero.
    assert side.get_ylim() == pytest.approx((-120.0, 120.0))
    expected = figures.colormaps["RdBu_r"]((20.0 * np.arange(7) + 120.0) / 240.0)
    np.testing.assert_allclose(glass.get_facecolors(), expected)
    assert "t = 0.200 s" in axes.get_title(loc="left")
    assert "rms 72.1 nm" in axes.get_title(loc="left")  # 20 sqrt(0 + 1 + 4 + ... + 36) / sqrt(7)


def test_every_segment_carries_its_name(detail):
    svg = ElementTree.fromstring(inline_svg(figures.segment_map(detail), "a"))
    words = {text.text: text for text in svg.iter("{http://www.w3.org/2000/svg}text")}
    middles = np.array([[float(words[f"S{k}"].get(axis)) for axis in "xy"] for k in range(7)])
    assert all("text-anchor: middle" in words[f"S{k}"].get("style") for k in range(7))
    # One scale along x, and along y from the top, places all centers; baselines are a little below them.
    scale = (middles[1, 0] - middles[4, 0]) / (detail.centers[1, 0] - detail.centers[4, 0])
    expected = (detail.centers - detail.centers[0]) * [scale, -scale]
    np.testing.assert_allclose(middles - middles[0], expected, rtol=0, atol=1e-3)


def test_names_are_centered_where_they_are_drawn_as_pixels(detail):
    """The middle of the ink of each name is the center of its segment, to a pixel of 300 per inch."""
    figure = figures.segment_map(detail)
    axes = figure.axes[0]
    with_names = pixels(figure, 300)
    for artist in axes.artists:
        artist.set_visible(False)
    ink = (with_names != pixels(figure, 300)).any(axis=2)
    figure.set_dpi(300)
    centers = axes.transData.transform(detail.centers * 1e-3)
    for x, y in centers:
        row, column = round(len(ink) - y), round(x)
        near = np.argwhere(ink[row - 60 : row + 60, column - 60 : column + 60])
        middle = (near.min(axis=0) + near.max(axis=0)) / 2 - 60
        np.testing.assert_allclose(middle, 0, rtol=0, atol=2.0)


def test_opd_title_is_the_rms_without_piston_and_tilt(detail):
    x, y = detail.ray_x, detail.ray_y
    # Piston and tilt of any size vanish; what is orthogonal to them by symmetry (x y on hexagons) stays.
    shape = x * y * 1e-6
    opd = np.stack([500.0 - 0.3 * x + 0.2 * y + scale * shape for scale in (1.0, 30.0, 10.0)])
    title = figures.opd_map(replace(detail, opd=opd)).axes[0].get_title(loc="left")
    assert f"rms {30.0 * np.sqrt(np.mean(shape**2)):.1f} nm" in title
    assert "t = 0.100 s" in title


def test_opd_map_is_the_flat_opd_where_the_rays_are(detail):
    axes, side = figures.opd_map(detail).axes
    (image,) = axes.images
    picture, (left, right, bottom, top) = image.get_array(), image.get_extent()
    x, y = detail.ray_x * 1e-3, detail.ray_y * 1e-3
    column = ((x - left) / (right - left) * picture.shape[1]).astype(int)
    row = ((y - bottom) / (top - bottom) * picture.shape[0]).astype(int)
    # Half a pixel is 7 mm, and the steepest segment has 40 nm/m.
    np.testing.assert_allclose(picture[row, column], detail.flat_opd[2], rtol=0, atol=0.4)
    assert image.origin == "lower"
    reach = np.abs(detail.flat_opd[2]).max()
    assert (image.norm.vmin, image.norm.vmax, image.cmap.name) == (-reach, reach, "RdBu_r")
    assert side.get_ylim() == pytest.approx((-reach, reach))


def test_lost_rays_and_rays_in_gaps_are_left_out(detail):
    opd, segment = detail.opd.copy(), detail.ray_segment.copy()
    opd[1, 4], segment[9] = np.nan, -1
    opd[:, 9] = 1e9
    damaged = replace(detail, opd=opd, ray_segment=segment)
    assert damaged.glass.sum() == 40
    assert np.abs(damaged.flat_opd).max() < 1000.0
    assert pixels(figures.opd_map(damaged)).size


def test_names_too_small_to_be_read_are_left_to_pointing(detail):
    small = replace(detail, segment_names=tuple(f"a segment of a name that is long {k}" for k in range(7)))
    svg = inline_svg(figures.segment_map(small), "a")
    assert ">a segment of a name that is long 3</text>" not in svg
    assert "<title>a segment of a name that is long 3: 60.0 nm</title>" in svg


def test_a_page_gives_a_drawing_with_small_text_more_pixels():
    def drawn(size):
        return Picture("a", "a", Markup(f'<svg viewBox="0 0 700 1"><text style="font-size: {size}px;">'))

    assert [drawn(size).points for size in (9.0, 7.0, 5.6, 3.5)] == [700, 700, 875, 1028]
    assert all(drawn(size).wide for size in (9.0, 3.5))


def test_segments_at_rest_are_said_to_be_at_rest(detail):
    still = replace(detail, segment_motion=np.zeros((3, 7, 6)))
    assert "no segment moves" in figures.segment_map(still).axes[0].get_title(loc="left")


def test_tilt_alone_is_shown_at_the_edge(detail):
    motion = np.zeros((3, 7, 6))
    motion[:, 2, 3] = 1e-7  # rad at corners 0.99 m away
    axes, side = figures.segment_map(replace(detail, segment_motion=motion)).axes
    assert "edge displacement by tilt" in axes.get_title(loc="left")
    assert side.get_ylim()[1] == pytest.approx(99.0)


def test_clocking_alone_moves_the_edge_in_its_plane(detail):
    motion = np.zeros((3, 7, 6))
    motion[:, 2, 5] = 1e-7
    axes, side = figures.segment_map(replace(detail, segment_motion=motion)).axes
    assert "clocking" in axes.get_title(loc="left")
    assert side.get_ylim()[1] == pytest.approx(99.0)


def test_a_mirror_of_one_piece_has_no_polygons(detail):
    whole = replace(
        detail,
        segment_names=("M1",),
        corners=np.empty((1, 0, 2)),
        centers=np.zeros((1, 2)),
        segment_motion=detail.segment_motion[:, :1],
        ray_segment=np.zeros(42, dtype=int),
    )
    assert pixels(figures.segment_map(whole)).size
    assert pixels(figures.opd_map(whole)).size


def test_psf_is_log_scaled_over_five_decades(detail):
    image = figures.psf_image(np.zeros((16, 16)), detail.image_x, detail.image_y, 1).axes[0].images[0]
    assert (image.norm.vmin, image.norm.vmax) == (1e-5, 1.0)
    assert image.get_extent() == [-2.125, 1.875, -2.125, 1.875]


def test_history_shows_the_median_and_the_worst_case(campaign):
    panels = history(campaign, 0).axes
    median, worst = panels[0].lines
    assert (median.get_ydata() == 20.0).all()
    assert (worst.get_ydata() == 30.0).all()
    assert [line.get_label() for line in panels[0].lines] == ["median: case 2", "worst: case 4"]


def test_line_of_sight_is_shown_about_the_mean_of_the_population(campaign):
    panels = history(campaign, 1).axes
    assert sorted(panels[1].lines[line].get_ydata()[0] for line in (0, 1)) == [-3.0, 3.0]


def test_distributions_leave_out_empty_populations_and_take_any_name(campaign):
    names = np.where(campaign["disturbance"] == "wind", "_w $\\frac{", campaign["disturbance"])
    named = campaign.assign_coords(disturbance=("case", names))
    figure = figures.distributions(values(populations(named), "wfe_raw"), "nm")
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["_w \\$\\frac{ (3)", "shake (2)"]
    assert pixels(figure).size
    assert pixels(history(named, 0)).size


def test_no_case_at_all_still_draws(campaign):
    assert pixels(figures.distributions({}, "Strehl", of_instants=True)).size
    assert pixels(history(campaign, 2)).size


def test_the_spot_diagram_shows_the_worst_instant_about_its_centroid(detail):
    axes = figures.spot_diagram(replace(detail, spot=detail.spot + 7.0)).axes[0]
    shown = np.asarray(axes.collections[0].get_offsets())
    rays = np.stack([detail.ray_x, detail.ray_y], axis=1)
    assert detail.worst_instant == 2
    np.testing.assert_allclose(shown, 2.0 * (rays - rays.mean(axis=0)), rtol=0, atol=1e-9)
    rms = np.sqrt(np.mean(np.sum(shown**2, axis=1)))
    assert f"rms {rms:.0f} mas, circle: Airy disk, 5.00 mas" in axes.get_title(loc="left")
    assert axes.get_xlim()[1] > np.hypot(*shown.T).max()


def test_figures_of_segments_have_their_heights_as_colors(detail):
    """Two triangles of -6 and +12 nm at the worst instant: colors by height, white is 0, rms in the title."""
    points = np.array([[0.0, 0.0], [500.0, 0.0], [0.0, 500.0], [0.0, 0.0], [-500.0, 0.0], [0.0, -500.0]])
    heights = np.repeat([[-6.0, 12.0]], 3, axis=1).reshape(1, 6).repeat(3, axis=0)
    bent = Bent(points, np.arange(6).reshape(2, 3), heights)
    axes, side = figures.figure_map(detail, bent).axes
    glass = axes.collections[0]
    expected = figures.colormaps["RdBu_r"]((np.array([-6.0, 12.0]) + 12.0) / 24.0)
    np.testing.assert_allclose(glass.get_facecolor(), expected, atol=1e-12)
    assert "rms 9.49 nm" in axes.get_title(loc="left")  # the root of (36 + 144) / 2
    assert side.get_ylabel() == "height (nm)"


@pytest.mark.parametrize("count", [1, 2, 3, 4])
def test_labels_of_exposures_are_inside_the_figure(count):
    axis = np.linspace(-7.75, 7.75, 32)
    image = np.exp(-np.add.outer(axis**2, axis**2) / 4.0) + 1e-4
    panels = [Panel(f"controller {number}", image, np.zeros((3, 2))) for number in range(count)]
    svg = inline_svg(exposure_panels(panels, axis), "exposures")
    baselines = re.findall(r'rotate\(-90 ([\d.]+) [\d.]+\)">y ', svg)
    assert len(baselines) == -(-count // 2)
    assert min(map(float, baselines)) > 0.76 * 9.0  # what a line of 9 points rises above its baseline
    assert svg.count(">x (") == min(count, 2)
