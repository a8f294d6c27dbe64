"""A scene as a picture: orthographic, faces sorted from behind to the front, edges show the shape."""

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.transforms import Bbox
from numpy.typing import NDArray

from wavequake.drawing.section import HALO
from wavequake.drawing.solid import MOUNT, Scene
from wavequake.drawing.style import COLORS, STYLE, Drawing, as_name

Array = NDArray[np.float64]

_AZIMUTH, _ELEVATION = np.radians(35.0), np.radians(22.0)


def still_figure(scene: Scene, width: float = 9.0) -> Drawing:
    """Return a scene as seen from the side and above."""
    with rc_context(STYLE):
        figure = Drawing(figsize=(width, 0.68 * width))
        axes = figure.add_axes((0.02, 0.02, 0.96, 0.9))
        draw_scene(axes, scene)
        axes.set_title(scene.name)
    return figure


def viewing(up: Array, azimuth: float = _AZIMUTH) -> Array:
    """Return rows right, up and towards the eye, (3, 3), of a camera beside the z axis and above it."""
    z = np.array([0.0, 0.0, 1.0])
    side = np.cross(z, up) if abs(up @ z) < 0.9 else np.array([1.0, 0.0, 0.0])
    along = z if abs(up @ z) < 0.9 else np.array([0.0, 1.0, 0.0])
    towards = (
        np.cos(_ELEVATION) * (np.cos(azimuth) * side - np.sin(azimuth) * along) + np.sin(_ELEVATION) * up
    )
    towards /= np.linalg.norm(towards)
    right = np.cross(up, towards)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(towards, right), towards])


def draw_scene(axes: Axes, scene: Scene) -> None:
    """Draw a scene on axes without frame."""
    eye = viewing(scene.up)
    polygons, depths, colors = list[Array](), list[float](), list[str]()
    for skin in scene.skins:
        seen = skin.points @ eye.T
        for face in skin.faces:
            polygons.append(seen[face, :2])
            depths.append(float(seen[face, 2].mean()))
            colors.append(skin.color)
    order = np.argsort(depths, kind="stable")
    axes.add_collection(
        PolyCollection(
            [polygons[k] for k in order],
            facecolors=[colors[k] for k in order],
            edgecolors="#5b6670",
            linewidths=0.25,
            alpha=0.85,
        )
    )
    lines = [points @ eye[:2].T for _, points in scene.lines]
    axes.add_collection(
        LineCollection(lines, colors=[COLORS[field % 7] for field, _ in scene.lines], linewidths=0.6)
    )
    if len(scene.dots):
        axes.plot(*(scene.dots @ eye[:2].T).T, "o", color=MOUNT, markersize=5)
    everything = np.concatenate([*polygons, *lines])
    low, high = everything.min(axis=0), everything.max(axis=0)
    border = 0.04 * (high - low).max()
    axes.set(
        xlim=(low[0] - border, high[0] + border), ylim=(low[1] - border, high[1] + border), aspect="equal"
    )
    axes.set_axis_off()
    axes.apply_aspect()
    taken = list[Bbox]()
    for name, point in scene.labels:
        place = (float(eye[0] @ point), float(eye[1] @ point))
        text = axes.annotate(as_name(name), place, (0, 7), textcoords="offset points", ha="center", bbox=HALO)
        covered = text.get_window_extent()
        if any(covered.overlaps(other) for other in taken):
            text.remove()
        else:
            taken.append(covered)
