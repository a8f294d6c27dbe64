"""Figures of a campaign: each function turns data into one matplotlib ``Figure``, which nobody has saved yet.

All figures have one size, so that they line up in a report. Maps diverge from white at zero (blue to red),
images are perceptually uniform, and curves use the Okabe-Ito palette with a line style each: all of it reads
well without color vision.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib import colormaps, rc_context
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import PolyCollection
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Circle, PathPatch
from matplotlib.path import Path
from numpy.typing import NDArray

from wavequake.drawing.color_scales import colorbar
from wavequake.drawing.faces import Faces
from wavequake.drawing.labels import Labels
from wavequake.drawing.style import COLORS as COLORS
from wavequake.drawing.style import HEIGHT as HEIGHT
from wavequake.drawing.style import LINES as LINES
from wavequake.drawing.style import STYLE as STYLE
from wavequake.drawing.style import WIDTH as WIDTH
from wavequake.drawing.style import as_name, hover
from wavequake.drawing.style import curve_style as curve_style
from wavequake.drawing.style import one_panel as one_panel
from wavequake.drawing.style import stacked as stacked
from wavequake.drawing.ticks import in_inches, number_powers
from wavequake.report.populations import Histories, Population
from wavequake.report.segments.detail import Bent, Detail
from wavequake.report.segments.raster import fill_segments
from wavequake.report.statistics import distribution
from wavequake.report.table import number

_GRID, _DIVERGING = "#dddddd", "RdBu_r"
_MAP_PIXELS = 400
_READABLE = 7.0  # points
_FAR_APART = 20.0  # values that differ by more have no room beside each other but on a scale of powers
_ROUNDING = 1e-9  # mas: what differs by less stands still


@rc_context(STYLE)
def segment_map(detail: Detail) -> Figure:
    """Map the displacement of each segment along its normal at the worst instant, with its number.

    Where no segment moves along its normal, the map shows what moves: tilt and clocking by the displacement
    of the farthest corner, or the in-plane displacement.
    """
    figure = Figure(figsize=(WIDTH, HEIGHT))
    _draw_segments(figure, _square(figure), detail)
    return figure


@rc_context(STYLE)
def figure_map(detail: Detail, bent: Bent) -> Figure:
    """Map the figures of the segments, heights along their normals, at the worst instant."""
    figure = Figure(figsize=(WIDTH, HEIGHT))
    axes, heights = _square(figure), bent.heights[detail.worst_instant]
    norm, colors = _symmetric(heights), colormaps[_DIVERGING]
    _aperture(axes, detail)
    corners = bent.points[bent.faces]
    faces = colors(norm(heights[bent.faces].mean(axis=1)))
    axes.add_collection(
        PolyCollection(list(corners * 1e-3), facecolors=faces, edgecolors=faces, lw=0.3, rasterized=True)
    )
    axes.add_collection(
        PolyCollection(list(detail.corners * 1e-3), facecolors="none", edgecolors="#555555", lw=0.25)
    )
    rms = number(float(np.sqrt(np.mean(heights**2))))
    axes.set_title(f"Figures of the segments, {_instant(detail)}\nrms {rms} nm")
    colorbar(figure, axes, ScalarMappable(norm, colors), "height (nm)")
    return figure


@rc_context(STYLE)
def opd_map(detail: Detail) -> Figure:
    """Map the optical path differences over the glass at the worst instant, piston and tilt removed."""
    figure = Figure(figsize=(WIDTH, HEIGHT))
    _draw_opd(figure, _square(figure), detail)
    return figure


@rc_context(STYLE)
def psf_image(
    image: NDArray[np.float64],
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    case: int,
    track: NDArray[np.float64] | None = None,
) -> Figure:
    """Show an exposure (Y, X) over pixel centers in lambda/D, log-scaled from 1e-5 to 1 = perfect peak.

    The track (T, 2) of the line of sight, lambda/D, is drawn over it.
    """
    figure = Figure(figsize=(WIDTH, HEIGHT))
    axes = _square(figure)
    _draw_psf(figure, axes, image, x, y, case)
    if track is not None and image.size:
        axes.set_autoscale_on(False)
        axes.plot(track[:, 0], track[:, 1], color="#5ad1ff", lw=0.8, marker=".", markersize=2.0)
    return figure


@rc_context(STYLE)
def spot_diagram(detail: Detail) -> Figure:
    """Show where the rays meet the image at the worst instant, about their centroid, with the Airy disk."""
    figure = Figure(figsize=(WIDTH, HEIGHT))
    axes = _square(figure)
    spot = detail.spot[detail.worst_instant][detail.glass]
    spot = spot - spot.mean(axis=0) if len(spot) else spot
    distance = np.hypot(*spot.T)
    reach = 1.1 * max(float(distance.max(initial=0.0)), detail.airy_mas)
    axes.add_patch(Circle((0.0, 0.0), detail.airy_mas, facecolor="none", edgecolor=COLORS[1], lw=1.2))
    axes.scatter(spot[:, 0], spot[:, 1], s=3, color=COLORS[0], lw=0, alpha=0.5, rasterized=True)
    axes.set(xlim=(-reach, reach), ylim=(-reach, reach), xlabel="x (mas)", ylabel="y (mas)", aspect="equal")
    rms = number(float(np.sqrt(np.mean(distance**2)))) if len(spot) else "–"
    axes.set_title(
        f"Spot diagram, {_instant(detail)}\nrms {rms} mas, circle: Airy disk, {number(detail.airy_mas)} mas"
    )
    return figure


@rc_context(STYLE)
def distributions(
    values: Mapping[str, NDArray[np.float64]],
    label: str,
    sets: Mapping[str, NDArray[np.int64] | None] | None = None,
    of_instants: bool = False,
) -> Figure:
    """Show the cumulative distributions of values by name, each with its 95 % band.

    Parameters
    ----------
    values : mapping of str to ndarray
        Of a number of each case shape (C,), of one of each instant (C, T); none of those without a case.
    label : str
        Of the values, with their unit.
    sets : mapping of str to (ndarray of int, shape (C,), or None), optional
        The stratified set that each case belongs to, where they are not independent.
    of_instants : bool
        Whether they are shares, each of an instant, which are shown evenly from nothing to all.
    """
    figure = Figure(figsize=(WIDTH, HEIGHT))
    box = (0.65, 0.5, WIDTH - 0.85, HEIGHT - 0.95)
    what = "instants" if of_instants else "cases"
    axes = _draw_distributions(figure, box, values, label, sets or {}, f"Share of {what}")
    if not of_instants:
        _scale(axes, values)
    return figure


@rc_context(STYLE)
def history(population: Population, histories: Histories) -> Figure:
    """Show wavefront error and line of sight over time: median and worst case before all others."""
    figure = Figure(figsize=(WIDTH, HEIGHT))
    gap, height = 0.2, (HEIGHT - 1.4) / 3
    bottoms = [0.5 + row * (height + gap) for row in (2, 1, 0)]
    panels = [in_inches(figure, 0.75, bottom, WIDTH - 0.95, height, label=0.54) for bottom in bottoms]
    los = histories.los - histories.los.mean(axis=(0, 1)) if histories.los.size else histories.los
    series = (histories.wfe_raw, los[..., 0], los[..., 1])
    for axes, values, label in zip(
        panels, series, ("WFE on glass (nm)", "LOS x (mas)", "LOS y (mas)"), strict=True
    ):
        _draw_history(axes, population, histories.time_s, values)
        axes.set_ylabel(label)
        axes.tick_params(labelbottom=axes is panels[-1])
    low, high = _common_limits(panels[1:])
    still = high - low < _ROUNDING
    for axes in panels[1:]:
        axes.set_ylim((-1.0, 1.0) if still else (low, high))
    panels[0].set_ylim(0, 1.06 * panels[0].get_ylim()[1])
    panels[-1].set_xlabel("time (s)")
    panels[0].set_title(
        f"{as_name(population.name)}: median and worst case by {population.ranked_by}", pad=18
    )
    if len(population.cases):
        panels[0].legend(
            loc="lower right", bbox_to_anchor=(1.0, 1.0), borderaxespad=0.1, borderpad=0.1, ncols=3,
            columnspacing=1.0, handlelength=1.6,
        )  # fmt: skip
    return figure


@rc_context(STYLE)
def summary_figure(detail: Detail, populations: Sequence[Population]) -> Figure:
    """Show a campaign in one wide picture: segments, wavefront, image, distribution of the error."""
    pitch, square, bottom = 4.0, 2.45, 0.5
    figure = Figure(figsize=(4 * pitch - 0.1, 3.45))
    maps = [in_inches(figure, 0.65 + place * pitch, bottom, square, square) for place in range(3)]
    _draw_segments(figure, maps[0], detail, numbers=False)
    _draw_opd(figure, maps[1], detail)
    _draw_psf(figure, maps[2], detail.image, detail.image_x, detail.image_y, detail.case)
    named = {one.name: one for one in populations if len(one.cases)}
    raw = {name: one.wfe_raw for name, one in named.items()}
    sets = {name: one.sets for name, one in named.items()}
    box, label = (0.65 + 3 * pitch, bottom, square + 0.6, square), "WFE rms on glass of a case (nm)"
    _scale(_draw_distributions(figure, box, raw, label, sets, "Wavefront error over cases"), raw)
    return figure


def _square(figure: Figure) -> Axes:
    return in_inches(figure, 0.65, 0.5, HEIGHT - 0.95, HEIGHT - 0.95)


def _aperture(axes: Axes, detail: Detail) -> None:
    """Set the axes of a map in m."""
    points = [detail.corners.reshape(-1, 2), np.stack([detail.ray_x, detail.ray_y], axis=1)]
    reach = 1.02e-3 * max((float(np.abs(part).max()) for part in points if part.size), default=1.0)
    axes.set(xlim=(-reach, reach), ylim=(-reach, reach), xlabel="x (m)", ylabel="y (m)", aspect="equal")


def _symmetric(values: NDArray[np.float64]) -> Normalize:
    finite = values[np.isfinite(values)]
    reach = float(np.abs(finite).max()) if finite.size else 0.0
    return Normalize(-reach or -1.0, reach or 1.0)


def _instant(detail: Detail) -> str:
    return f"case {detail.case}, t = {number(float(detail.time_s[detail.worst_instant]))} s"


def _displacement(detail: Detail) -> tuple[NDArray[np.float64], str]:
    """Return what the map of segments shows, nm, and what it is called."""
    motion = detail.segment_motion[detail.worst_instant]
    arms = np.linalg.norm(detail.corners - detail.centers[:, None], axis=2).max(axis=1, initial=0.0) * 1e-3
    for values, meaning in (
        (motion[:, 2], "displacement along the normal"),
        (np.hypot(motion[:, 3], motion[:, 4]) * arms, "edge displacement by tilt"),
        (np.hypot(motion[:, 0], motion[:, 1]), "in-plane displacement"),
        (motion[:, 5] * arms, "edge displacement by clocking"),
    ):
        if values.any():
            return values * 1e9, meaning
    return np.zeros(len(motion)), "no segment moves"


def _draw_segments(figure: Figure, axes: Axes, detail: Detail, numbers: bool = True) -> None:
    values, meaning = _displacement(detail)
    norm, colors = _symmetric(values), colormaps[_DIVERGING]
    _aperture(axes, detail)
    if detail.corners.size:
        faces = colors(norm(values))
        glass = Faces(detail.corners * 1e-3, faces, "#555555", 0.25)
        glass.set_gid(
            hover(
                [
                    f"{name}: {number(value)} nm"
                    for name, value in zip(detail.segment_names, values, strict=True)
                ]
            )
        )
        axes.add_collection(glass)
        if numbers:
            _number_segments(figure, axes, detail, np.abs(norm(values) - 0.5) > 0.3)
    rms = f", rms {number(float(np.sqrt(np.mean(values**2))))} nm" if values.any() else ""
    axes.set_title(f"M1 segments, {_instant(detail)}\n{meaning}{rms}")
    if values.any():
        colorbar(figure, axes, ScalarMappable(norm, colors), "displacement (nm)")


def _number_segments(figure: Figure, axes: Axes, detail: Detail, dark: NDArray[np.bool_]) -> None:
    """Write each segment's name as large as the smallest segment allows, or none that nobody could read."""
    inches = (
        axes.get_position().width * figure.get_size_inches()[0] / (axes.get_xlim()[1] - axes.get_xlim()[0])
    )
    width = np.ptp(detail.corners[..., 0], axis=1).min() * 1e-3 * inches * 72
    letters = max(len(name) for name in detail.segment_names)
    size = min(9.0, 0.8 * width / (0.65 * letters))
    if size < _READABLE:
        return
    colors = ["white" if on_dark else "#333333" for on_dark in dark]
    axes.add_artist(Labels(detail.segment_names, detail.centers[:, :2] * 1e-3, colors, size))


def _draw_opd(figure: Figure, axes: Axes, detail: Detail) -> None:
    flat = detail.flat_opd[detail.worst_instant]
    norm = _symmetric(flat)
    _aperture(axes, detail)
    rms = number(float(np.sqrt(np.mean(flat**2)))) if flat.size else "–"
    rays = np.stack([detail.ray_x, detail.ray_y], axis=1)[detail.glass]
    if detail.corners.size and flat.size:
        reach = axes.get_xlim()[1]
        picture = fill_segments(
            detail.corners,
            detail.centers,
            rays,
            detail.ray_segment[detail.glass],
            flat,
            reach * 1e3,
            _MAP_PIXELS,
        )
        extent = (-reach, reach, -reach, reach)
        shown = axes.imshow(
            picture, extent=extent, origin="lower", cmap=_DIVERGING, norm=norm, interpolation="none"
        )
        glass = Path.make_compound_path_from_polys(detail.corners * 1e-3)
        outline = PathPatch(glass, facecolor="none", edgecolor="#777777", lw=0.2)
        axes.add_artist(outline)
        shown.set_clip_path(outline)
    else:
        axes.scatter(rays[:, 0] * 1e-3, rays[:, 1] * 1e-3, c=flat, s=4, cmap=_DIVERGING, norm=norm, lw=0)
    axes.set_title(f"Wavefront, {_instant(detail)}\npiston and tilt removed, rms {rms} nm")
    colorbar(figure, axes, ScalarMappable(norm, colormaps[_DIVERGING]), "OPD (nm)")


def _draw_psf(
    figure: Figure,
    axes: Axes,
    image: NDArray[np.float64],
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    case: int,
) -> None:
    half_x, half_y = (float(axis[1] - axis[0]) / 2.0 if len(axis) > 1 else 0.5 for axis in (x, y))
    extent = (float(x[0]) - half_x, float(x[-1]) + half_x, float(y[0]) - half_y, float(y[-1]) + half_y)
    norm = LogNorm(1e-5, 1.0, clip=True)
    shown = axes.imshow(image, extent=extent, origin="lower", cmap="inferno", norm=norm, interpolation="none")
    axes.set(xlabel="x (λ/D)", ylabel="y (λ/D)")
    peak = number(float(np.nanmax(image))) if np.isfinite(image).any() else "–"
    axes.set_title(f"Image, case {case}, mean of its instants\npeak {peak} of the perfect PSF")
    colorbar(figure, axes, shown, "irradiance / peak of the perfect PSF")


def _draw_distributions(
    figure: Figure,
    box: tuple[float, float, float, float],
    values: Mapping[str, NDArray[np.float64]],
    label: str,
    sets: Mapping[str, NDArray[np.int64] | None],
    title: str,
) -> Axes:
    left, bottom, width, height = box
    names = [f"{as_name(name)} ({len(samples)})" for name, samples in values.items()]
    # Letters are about 0.075 inches wide; two columns only where they fit.
    columns = 2 if 2 * (0.075 * max(map(len, names), default=0) + 0.5) <= width + 0.5 else 1
    legend = 0.185 * -(-len(names) // columns)
    axes = in_inches(figure, left, bottom + legend, width, height - legend)
    for index, (name, samples) in enumerate(values.items()):
        curve = distribution(samples, draws=len(samples), sets=sets.get(name))
        color, line = COLORS[index % len(COLORS)], LINES[index % len(LINES)]
        axes.fill_between(curve.values, curve.low, curve.high, step="post", color=color, alpha=0.18, lw=0)
        steps = np.append(curve.values[:1], curve.values), np.append(0.0, curve.probability)
        axes.step(*steps, where="post", color=color, ls=line, lw=1.5)
    axes.grid(color=_GRID, lw=0.6)
    axes.set(axisbelow=True, ylim=(0, 1), xlabel=label, ylabel="share below")
    axes.set_title(f"{title}, 95 % band\n(number of cases in brackets)")
    across, up = figure.get_size_inches()
    figure.legend(
        axes.lines, names, loc="lower left", bbox_to_anchor=((left - 0.4) / across, (bottom - 0.45) / up),
        ncols=columns, columnspacing=1.0, borderaxespad=0, borderpad=0, labelspacing=0.35,
    )  # fmt: skip
    return axes


def _scale(axes: Axes, values: Mapping[str, NDArray[np.float64]]) -> None:
    """Give the axis of values of cases powers of ten, or room where they are alike."""
    lowest = min((float(one.min()) for one in values.values()), default=0.0)
    if lowest > 0.0 and max(float(one.max()) for one in values.values()) > _FAR_APART * lowest:
        axes.set_xscale("log")
        number_powers(axes.xaxis)
        return
    low, high = axes.get_xlim()
    middle = 0.5 * (low + high)
    reach = max(0.5 * (high - low), 1e-3 * abs(middle))  # tables have three digits: alike is one line
    axes.set_xlim(middle - reach, middle + reach)


def _common_limits(panels: Sequence[Axes]) -> tuple[float, float]:
    limits = np.array([axes.get_ylim() for axes in panels])
    return float(limits[:, 0].min()), float(limits[:, 1].max())


def _draw_history(
    axes: Axes, population: Population, time_s: NDArray[np.float64], values: NDArray[np.float64]
) -> None:
    axes.grid(color=_GRID, lw=0.6)
    axes.set_axisbelow(True)
    if not len(population.cases):
        return
    low, high = np.quantile(values, [0.05, 0.95], axis=0)
    middle = time_s[population.median_index]
    axes.fill_between(middle, low, high, color="#999999", alpha=0.25, lw=0, label="90 % of the cases")
    for index, name, color, line in (
        (population.median_index, "median", COLORS[0], "-"),
        (population.worst_index, "worst", COLORS[1], (0, (5, 1.5))),
    ):
        axes.plot(
            time_s[index], values[index], color=color, ls=line, lw=1.3, marker="o", ms=3,
            label=f"{name}: case {population.cases[index]}",
        )  # fmt: skip
