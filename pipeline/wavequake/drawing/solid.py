"""Bodies in space: faces, lines and names, which a still or the viewer draws. Lengths in one unit."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from wavequake.drawing.layout import Layout, layouts, stretching
from wavequake.drawing.light import all_ways, beginnings
from wavequake.errors import UserError
from wavequake.mechanics.importers.areas import mesh_points
from wavequake.mechanics.model import Model, shifts
from wavequake.optics.segments.layout import is_monolithic
from wavequake.optics.segments.parent import parent_system
from wavequake.optics.shapes.sag import shape_sag
from wavequake.optics.systems.system import OpticalSystem, Surface

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

_RINGS, _SECTORS = 4, 48
_MARGIN = 1.05
_GLASS, _MIRROR, _IMAGE, _SEGMENT = "#9cc4e4", "#b9bec4", "#333333", "#d5dfe8"
MOUNT = "#D55E00"


@dataclass(frozen=True, eq=False)
class Skin:
    """Faces of one color: corners (V, 3), and which of them each face goes round, (F, n)."""

    name: str
    points: Array
    faces: Integers
    color: str


@dataclass(frozen=True, eq=False)
class Scene:
    """What is to be seen.

    Attributes
    ----------
    name, unit : str
        The unit is that of all lengths.
    skins : tuple of Skin
    lines : tuple of (int, ndarray of shape (P, 3))
        Rays by number of their field.
    labels : tuple of (str, ndarray of shape (3,))
    dots : ndarray, shape (K, 3)
        Mounts.
    up : ndarray, shape (3,)
        What is drawn upwards.
    """

    name: str
    unit: str
    skins: tuple[Skin, ...]
    lines: tuple[tuple[int, Array], ...]
    labels: tuple[tuple[str, Array], ...]
    dots: Array
    up: Array


def system_scene(system: OpticalSystem, telescope: OpticalSystem | None = None) -> Scene:
    """Return the used parts of all surfaces with the rays of a section of every field.

    Parameters
    ----------
    system : OpticalSystem
    telescope : OpticalSystem, optional
        Its segments take the place of the surface M1.

    Raises
    ------
    UserError
        As `wavequake.drawing.layout.layouts`.
    """
    rims, first = all_ways(system), layouts(system, 3)[0]
    fans = all_ways(system, np.cross(first.across, [0.0, 0.0, 1.0]), 5)
    skins, labels = [], []
    segmented = telescope is not None and not is_monolithic(telescope.segments)
    last = len(system.surfaces) - 1
    for number, surface in enumerate(system.surfaces):
        if surface.action == "pass" and number != last:
            continue
        if segmented and telescope is not None and surface.name == "M1":
            skins.append(segment_skin(telescope))
        else:
            hits = np.concatenate([one.hits[number] for one in (*rims, *fans)], axis=1)
            hits = hits[:, np.isfinite(hits).all(axis=0)]
            if not hits.size:
                continue
            color = _IMAGE if number == last else _GLASS if surface.action == "refract" else _MIRROR
            skins.append(_patch(surface, hits, _hole(first, surface), color))
        if surface.action != "refract":
            labels.append((surface.name, skins[-1].points.mean(axis=0)))
    lines = []
    for one, points in zip(fans, beginnings(system, fans), strict=True):
        lines += [(one.field, ray[np.isfinite(ray).all(axis=1)]) for ray in np.moveaxis(points, 2, 0)]
    return Scene(system.name, "mm", tuple(skins), tuple(lines), tuple(labels), np.zeros((0, 3)), first.across)


def telescope_scene(telescope: OpticalSystem) -> Scene:
    """Return a segmented telescope with the rays of its axis."""
    return system_scene(parent_system(telescope), telescope)


def segment_skin(telescope: OpticalSystem) -> Skin:
    """Return the segments, one face each, with corners on the parent surface."""
    corners = telescope.segments.corners
    count, size = corners.shape[:2]
    surface = parent_system(telescope).surfaces[1]
    x, y = corners.reshape(-1, 2).T
    z = np.asarray(shape_sag(surface.shape, x, y)[0])
    return Skin("M1", np.stack([x, y, z], axis=1), np.arange(count * size).reshape(count, size), _SEGMENT)


def _hole(layout: Layout, surface: Surface) -> float:
    """Return the share of a mirror's half width that is a hole in the section."""
    for part in layout.parts:
        if (
            part.kind == "mirror"
            and part.name.removesuffix(" (stop)") == surface.name
            and len(part.lines) == 2
        ):
            first, second = (line[: len(line) // 2] for line in part.lines)
            gap = float(np.linalg.norm(second[0] - first[-1]))
            return gap / float(np.linalg.norm(second[-1] - first[0]))
    return 0.0


def _patch(surface: Surface, hits: Array, hole: float, color: str) -> Skin:
    """Return the ellipse about the hits (3, N), or the ring, on a surface."""
    local = surface.rotation.T @ (hits - surface.position[:, None])
    low, high = local[:2].min(axis=1), local[:2].max(axis=1)
    middle, half = (low + high) / 2.0, _MARGIN * (high - low) / 2.0
    half = np.maximum(half, 0.02 * half.max())
    share, angle = np.meshgrid(
        np.linspace(hole, 1.0, _RINGS + 1), 2.0 * np.pi * np.arange(_SECTORS) / _SECTORS, indexing="ij"
    )
    x, y = middle[0] + half[0] * share * np.cos(angle), middle[1] + half[1] * share * np.sin(angle)
    z = np.asarray(shape_sag(surface.shape, x.ravel(), y.ravel())[0])
    points = np.stack([x.ravel(), y.ravel(), np.nan_to_num(z)], axis=1) @ surface.rotation.T
    number = np.arange(points.shape[0]).reshape(_RINGS + 1, _SECTORS)
    following = np.roll(number, -1, axis=1)
    faces = np.stack([number[:-1], number[1:], following[1:], following[:-1]], axis=-1).reshape(-1, 4)
    return Skin(surface.name, points + surface.position, faces, color)


def model_scene(model: Model) -> Scene:
    """Return the optical surface of a finite-element model as triangles, and its mounts.

    Raises
    ------
    UserError
        If the optical surface has fewer than three nodes, or they lie on a line as seen along z.
    """
    points = model.nodes[model.surface_nodes]
    middle = points.mean(axis=0)
    axes = np.linalg.svd(points - middle, full_matrices=False)[2] if len(points) > 2 else np.eye(3)
    if not len(faces := mesh_points((points - middle) @ axes[:2].T)):
        raise UserError(
            f"the optical surface of the model {model.name} has {len(points)} nodes that span no area; it "
            "needs at least three that do"
        )
    skin = Skin("optical surface", points, faces, _GLASS)
    return Scene(
        model.name,
        "m",
        (skin,),
        (),
        tuple(
            (f"mount {number}", model.nodes[node])
            for number, node in enumerate(model.interfaces[shifts(model)], 1)
        ),
        model.nodes[model.interfaces[shifts(model)]],
        np.array([0.0, 0.0, 1.0]),
    )


def stretched(scene: Scene) -> tuple[Scene, float]:
    """Return the scene of a thin system stretched across z, and how many times; others as they are."""
    everything = np.concatenate([*(skin.points for skin in scene.skins), *(line for _, line in scene.lines)])
    x, y, z = np.ptp(everything, axis=0)
    times = stretching(max(x, y) / z) if z else 1.0
    across = np.array([times, times, 1.0])
    return (
        replace(
            scene,
            skins=tuple(replace(skin, points=across * skin.points) for skin in scene.skins),
            lines=tuple((field, across * line) for field, line in scene.lines),
            labels=tuple((name, across * place) for name, place in scene.labels),
        ),
        times,
    )
