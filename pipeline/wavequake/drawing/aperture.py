"""A segmented mirror from above: every segment where it stands, with its name, and the pupil's annulus."""

from dataclasses import replace

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.patches import Circle
from numpy.typing import NDArray

from wavequake.drawing.faces import Faces
from wavequake.drawing.labels import Labels
from wavequake.drawing.layout import Layout, Part, layouts
from wavequake.drawing.light import field_names
from wavequake.drawing.section import box_of, draw_section, widened
from wavequake.drawing.style import STYLE, Drawing
from wavequake.optics.segments.layout import is_monolithic
from wavequake.optics.segments.parent import parent_system
from wavequake.optics.systems.system import OpticalSystem

Array = NDArray[np.float64]

_FILL, _EDGE, _PUPIL = "#e8eef4", "#55718c", "#D55E00"
_CLEAR = 0.42  # of a segment's width: how wide a name of so many letters may be written
_NARROW = 0.01  # of the pupil's radius: gaps that are not drawn
_LARGEST, _SMALLEST = 9.0, 3.5  # points


def telescope_figure(
    telescope: OpticalSystem, system: OpticalSystem | None = None, width: float = 11.0
) -> Drawing:
    """Return a telescope's primary mirror from above and, beside it, its section with rays.

    Parameters
    ----------
    telescope : OpticalSystem
    system : OpticalSystem, optional
        The telescope with a mirror of one piece, and the fields to draw; by default its axis.
    width : float
        Of the figure, inches.

    Raises
    ------
    UserError
        As `wavequake.drawing.layout.layouts`.
    """
    system = system or parent_system(telescope)
    layout = on_glass(telescope, layouts(system, across=_richest(telescope, system))[0])
    with rc_context(STYLE):
        side = (width - 1.6) / 2.0
        height = side + 1.05
        figure = Drawing(figsize=(width, height))
        above = figure.add_axes((0.6 / width, 0.55 / height, side / width, side / height))
        beside = figure.add_axes(((side + 1.45) / width, 0.55 / height, side / width, side / height))
        draw_aperture(above, telescope)
        count = len(telescope.segments)
        what = "" if is_monolithic(telescope.segments) else f", {count} segments"
        above.set_title(f"{telescope.name}: primary mirror from above{what}")
        draw_section(beside, layout, widened(box_of(layout), 1.0))
        names = field_names(system)
        shown = ", ".join(names[field] for field in sorted({field for field, _ in layout.rays}))
        beside.set_title(f"Section with rays of the field {shown}")
    return figure


def _richest(telescope: OpticalSystem, system: OpticalSystem) -> Array | None:
    """Return y or x, whichever meets more glass, where neither fields nor folds say what to cut along."""
    bent = [surface.position[:2] for surface in system.surfaces]
    tilted = any(np.abs(surface.rotation[2, :2]).max() > 1e-9 for surface in system.surfaces)
    if is_monolithic(telescope.segments) or tilted or np.any(bent) or np.any(system.fields):
        return None
    axes = np.eye(3)[[1, 0]]
    met = [sum(high - low for low, high in _crossed(telescope, axis)) for axis in axes]
    return np.asarray(axes[int(met[1] > 1.001 * met[0])])


def _crossed(telescope: OpticalSystem, across: Array) -> list[tuple[float, float]]:
    """Return where the line through the middle along `across` is on segments, mm; narrow gaps are none.

    Where it would run along a gap, it is the nearest beside the middle that does not.
    """
    found, aside = list[tuple[float, float]](), _NARROW * telescope.annulus.outer
    while not found and aside < telescope.annulus.outer:
        found = _crossed_beside(telescope, across, aside)
        aside *= 2.0
    return found


def _crossed_beside(telescope: OpticalSystem, across: Array, aside: float) -> list[tuple[float, float]]:
    """Return where the line along `across`, so far beside the middle, is on segments."""
    along, beside = across[:2], np.array([-across[1], across[0]])
    found = list[tuple[float, float]]()
    for corners in telescope.segments.corners:
        s, t = corners @ along, corners @ beside + aside
        ends = [
            float(a + (b - a) * u / (u - v))
            for a, b, u, v in zip(s, np.roll(s, -1), t, np.roll(t, -1), strict=True)
            if (u > 0.0) != (v > 0.0)
        ]
        found += [(min(ends), max(ends))] if ends else []
    whole = list[tuple[float, float]]()
    for low, high in sorted(found):
        if whole and low - whole[-1][1] < _NARROW * telescope.annulus.outer:
            low, high = whole[-1][0], max(high, whole.pop()[1])
        whole.append((low, high))
    return whole


def on_glass(telescope: OpticalSystem, layout: Layout) -> Layout:
    """Return the section of a telescope of one piece with what it has of M1, and the rays that meet it."""
    if is_monolithic(telescope.segments):
        return layout
    pieces, parts, faces = _crossed(telescope, layout.across), list[Part](), list[Array]()
    for part in layout.parts:
        if part.kind != "mirror" or part.name.removesuffix(" (stop)") != "M1":
            parts.append(part)
            continue
        whole = [line[: len(line) // 2] for line in part.lines]
        back = part.lines[0][-1] - part.lines[0][0]
        face = np.concatenate(sorted(whole, key=lambda one: float(one[:, 1].mean())))
        face = face[np.argsort(face[:, 1])]
        cut = []
        for low, high in pieces:
            s = np.linspace(low, high, 40)
            cut.append(np.stack([np.interp(s, face[:, 1], face[:, 0]), s], axis=1))
        parts.append(replace(part, lines=tuple(np.concatenate([one, (one + back)[::-1]]) for one in cut)))
        faces.append(face)
    rays = tuple(
        (field, ray)
        for field, ray in layout.rays
        if _is_met(ray, faces, pieces, _NARROW * telescope.annulus.outer)
    )
    return replace(layout, parts=tuple(parts), rays=rays or layout.rays)


def _is_met(ray: Array, faces: list[Array], pieces: list[tuple[float, float]], reach: float) -> bool:
    """Return whether a ray (P, 2) touches a mirror's face nowhere but on its pieces."""
    for face in faces:
        size = float(np.ptp(face[:, 1]))
        near = np.abs(ray[:, 0] - np.interp(ray[:, 1], face[:, 1], face[:, 0])) < 1e-3 * size
        for s in ray[near, 1]:
            if not any(low - reach <= s <= high + reach for low, high in pieces):
                return False
    return True


def draw_aperture(axes: Axes, telescope: OpticalSystem) -> None:
    """Draw the segments of a telescope on axes, in m."""
    segments, outer = telescope.segments, telescope.annulus.outer / 1e3
    corners = segments.corners / 1e3
    reach = max(outer, float(np.hypot(corners[..., 0], corners[..., 1]).max(initial=0.0)))
    for radius in (outer, telescope.annulus.inner / 1e3):
        axes.add_patch(
            Circle((0, 0), radius, facecolor="none", edgecolor=_PUPIL, lw=0.9, ls=(0, (4, 2)), zorder=3)
        )
    if is_monolithic(segments):
        axes.add_patch(Circle((0, 0), outer, facecolor=_FILL, edgecolor=_EDGE, lw=0.9))
        axes.add_patch(
            Circle((0, 0), telescope.annulus.inner / 1e3, facecolor="white", edgecolor=_EDGE, lw=0.9)
        )
    else:
        axes.add_collection(Faces(corners, _FILL, _EDGE, 0.5))
        _write_names(axes, corners, segments.names, 1.04 * reach)
    axes.set(xlim=(-1.04 * reach, 1.04 * reach), ylim=(-1.04 * reach, 1.04 * reach), aspect="equal")
    axes.set_xlabel("x (m); dashed: pupil")
    axes.set_ylabel("y (m)")


def _write_names(axes: Axes, corners: Array, names: tuple[str, ...], reach: float) -> None:
    """Write each name into its segment, as large as the smallest segment lets the longest name be."""
    low, high = corners.min(axis=1), corners.max(axis=1)
    room = float((high - low).min()) / (2.0 * reach)  # of the width of the axes
    points = room * axes.get_window_extent().width * 72.0 / axes.figure.get_dpi()
    size = min(_LARGEST, points * 2.0 * _CLEAR / max(1, max(map(len, names))) * 1.6)
    if size < _SMALLEST:
        return
    axes.add_artist(Labels(names, (low + high) / 2.0, ["#222222"] * len(names), size))
