"""What a viewer shows: stages of bodies in space, and takes in which they move. SI units but where said."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from wavequake.drawing.solid import Scene
from wavequake.drawing.style import COLORS

Array = NDArray[np.float64]
Integers = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Stage:
    """Bodies at rest.

    Attributes
    ----------
    points : ndarray, shape (V, 3)
        Corners, in m.
    faces : ndarray of int, shape (F, n)
        Corners of each face; one with fewer than n repeats its last.
    body : ndarray of int, shape (V,)
        Which body each corner belongs to.
    colors : tuple of str, length F
    names : tuple of str, length B
    pivots : ndarray, shape (B, 3)
    axes : ndarray, shape (B, 3, 3)
        Columns: the directions of each body's own axes.
    lines : tuple of (str, ndarray of shape (P, 3))
        Color and points of rays.
    labels : tuple of (str, ndarray of shape (3,))
    up : ndarray, shape (3,)
    """

    points: Array
    faces: Integers
    body: Integers
    colors: tuple[str, ...]
    names: tuple[str, ...]
    pivots: Array
    axes: Array
    lines: tuple[tuple[str, Array], ...] = ()
    labels: tuple[tuple[str, Array], ...] = ()
    up: Array = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))


@dataclass(frozen=True, eq=False)
class Take:
    """A case over T instants.

    Attributes
    ----------
    label, note : str
        What it is, and what one should know of it.
    time : ndarray, shape (T,)
        s.
    stage : int
        Which stage it plays on.
    poses : ndarray, shape (T, B, 6), optional
        Displacement (m) and small rotation (rad) of each body in its own axes.
    shapes, weights : ndarray, shapes (r, V, 3) and (T, r), optional
        Corners move by ``weights @ shapes``, m.
    planes : ndarray, shape (T, B, 3), optional
        Wavefront over each body: nm at its pivot, and nm per m along x and y.
    images : ndarray, shape (T, n, n), optional
        Irradiance of every instant; ``pixel`` is that of a pixel, in lambda/D.
    series : mapping of str to (str, ndarray of shape (T, k))
        Unit and values of numbers over time.
    """

    label: str
    time: Array
    note: str = ""
    stage: int = 0
    poses: Array | None = None
    shapes: Array | None = None
    weights: Array | None = None
    planes: Array | None = None
    images: Array | None = None
    pixel: float = 1.0
    series: Mapping[str, tuple[str, Array]] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Film:
    """A title, what it is of (digest of the store), stages and takes."""

    title: str
    source: str
    stages: tuple[Stage, ...]
    takes: tuple[Take, ...]


def stage_of(scene: Scene) -> Stage:
    """Return a scene as a stage with a body per skin."""
    scale = {"mm": 1e-3, "m": 1.0}[scene.unit]
    most = max(skin.faces.shape[1] for skin in scene.skins)
    points, faces, body, colors = list[Array](), list[Integers](), list[Integers](), list[str]()
    count = 0
    for number, skin in enumerate(scene.skins):
        padded = np.pad(skin.faces, ((0, 0), (0, most - skin.faces.shape[1])), mode="edge")
        faces.append(padded + count)
        points.append(scale * skin.points)
        body.append(np.full(len(skin.points), number))
        colors += [skin.color] * len(skin.faces)
        count += len(skin.points)
    return Stage(
        np.concatenate(points),
        np.concatenate(faces),
        np.concatenate(body),
        tuple(colors),
        tuple(skin.name for skin in scene.skins),
        np.stack([one.mean(axis=0) for one in points]),
        np.broadcast_to(np.eye(3), (len(points), 3, 3)),
        tuple((COLORS[field % 7], scale * line) for field, line in scene.lines),
        tuple((name, scale * point) for name, point in scene.labels),
        scene.up,
    )


def displacements(stage: Stage, take: Take) -> Array:
    """Return how every corner moves, (T, V, 3) in m: what the page computes from what it holds."""
    moved = np.zeros((len(take.time), len(stage.points), 3))
    if take.poses is not None:
        away = np.einsum("vij,vi->vj", stage.axes[stage.body], stage.points - stage.pivots[stage.body])
        pose = take.poses[:, stage.body]
        local = pose[..., :3] + np.cross(pose[..., 3:], away)
        moved += np.einsum("vij,tvj->tvi", stage.axes[stage.body], local)
    if take.shapes is not None and take.weights is not None:
        moved += np.tensordot(take.weights, take.shapes, 1)
    return moved


def principal(moved: Array, share: float = 1e-6) -> tuple[Array, Array]:
    """Return shapes (r, V, 3) and weights (T, r) that give displacements (T, V, 3) to a share of the largest.

    By a singular value decomposition: the fewest shapes that do.
    """
    flat = moved.reshape(len(moved), -1)
    left, sizes, right = np.linalg.svd(flat, full_matrices=False)
    kept = max(1, int(np.sum(sizes > share * (sizes[0] or 1.0))))
    scale = np.abs(right[:kept]).max(axis=1)
    scale[scale == 0.0] = 1.0
    shapes = (right[:kept] / scale[:, None]).reshape(kept, *moved.shape[1:])
    return shapes, left[:, :kept] * (sizes[:kept] * scale)
