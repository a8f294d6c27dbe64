"""What a viewer shows: stages of bodies in space, and takes in which they move. SI units but where said."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from wavequake.drawing.solid import Scene
from wavequake.drawing.style import COLORS
from wavequake.optics.polynomials.zernike import annular_zernike

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

MAP_CELLS = 96
_MAP_SHARE = 1e-3


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
    terms : ndarray, shape (V, J), optional
        Heights of corners along their body's z axis, per unit of each term of its figure.
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
    terms: Array | None = None


NO_BODIES = Stage(
    np.zeros((0, 3)),
    np.zeros((0, 3), dtype=np.int64),
    np.zeros(0, dtype=np.int64),
    (),
    (),
    np.zeros((0, 3)),
    np.zeros((0, 3, 3)),
)
"""Of what has histories alone."""


@dataclass(frozen=True, eq=False)
class Map:
    """A flat picture of numbers that change over T instants, such as a wavefront over the pupil.

    Attributes
    ----------
    name, unit : str
    cells : ndarray of int, shape (n, n)
        Which of N numbers each cell shows, -1 for none; the lowest row first.
    shapes, weights : ndarray, shapes (r, N) and (T, r)
        The numbers are ``weights @ shapes``.
    reach : float
        Colors go from minus to plus this; the same for maps that are to be compared.
    """

    name: str
    unit: str
    cells: Integers
    shapes: Array
    weights: Array
    reach: float


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
    figures : ndarray, shape (T, B, J), optional
        Of each body by the terms of the stage, m.
    shapes, weights : ndarray, shapes (r, V, 3) and (T, r), optional
        Corners move by ``weights @ shapes``, m.
    planes : ndarray, shape (T, B, 3), optional
        Wavefront over each body: nm at its pivot, and nm per m along x and y.
    images : ndarray, shape (T, n, n), optional
        Irradiance of every instant; ``pixel`` is that of a pixel, in lambda/D.
    track : ndarray, shape (T, 2), optional
        Line of sight on the images, in lambda/D.
    maps : tuple of Map
    series : mapping of str to (str, ndarray of shape (T, k))
        Unit and values of numbers over time.
    case : int
        Id of the case; -1 of what is at rest.
    of : str
        Which of several takes of the case it is: its controller, excitation or mode.
    """

    label: str
    time: Array
    note: str = ""
    stage: int = 0
    poses: Array | None = None
    figures: Array | None = None
    shapes: Array | None = None
    weights: Array | None = None
    planes: Array | None = None
    images: Array | None = None
    pixel: float = 1.0
    track: Array | None = None
    maps: tuple[Map, ...] = ()
    series: Mapping[str, tuple[str, Array]] = field(default_factory=dict)
    case: int = -1
    of: str = ""


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
    if take.figures is not None and stage.terms is not None:
        heights = np.einsum("tvj,vj->tv", take.figures[:, stage.body], stage.terms)
        moved += heights[..., None] * stage.axes[stage.body, :, 2]
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


def map_of(name: str, unit: str, cells: Integers, values: Array) -> Map:
    """Return a map of values (T, N), kept to a thousandth of the largest; one that is not finite is 0."""
    known = np.nan_to_num(values)[..., None]
    shapes, weights = principal(known, _MAP_SHARE)
    return Map(name, unit, cells, shapes[..., 0], weights, float(np.abs(known).max(initial=0.0)))


def over_pupil(x: Array, y: Array, size: int = MAP_CELLS) -> Integers:
    """Return which of the points (N,) of a pupil is nearest to each of size x size cells over them.

    A cell farther from all of them than twice the points' mean distance shows none (-1).
    """
    from scipy.spatial import cKDTree

    half = 1.02 * float(max(np.abs(x).max(), np.abs(y).max()))
    axis = half * (2.0 * np.arange(size) + 1.0 - size) / size
    places = np.stack(np.meshgrid(axis, axis), axis=-1)
    points = np.stack([x, y], axis=1)
    apart = float(np.median(cKDTree(points).query(points, 2)[0][:, 1])) if len(x) > 1 else half
    away, nearest = cKDTree(points).query(places)
    return np.where(away <= max(1.5 * apart, 2.0 * half / size), nearest, -1)


def zernike_map(name: str, terms: Array, obscuration: float) -> Map:
    """Return a map of Noll coefficients (T, J) from 1, nm, over a pupil."""
    axis = (2.0 * np.arange(MAP_CELLS) + 1.0 - MAP_CELLS) / MAP_CELLS
    x, y = (one.ravel() for one in np.meshgrid(axis, axis))
    radius = np.hypot(x, y)
    lit = (radius <= 1.0) & (radius >= obscuration)
    cells = np.where(lit, np.cumsum(lit) - 1, -1).reshape(MAP_CELLS, MAP_CELLS)
    shapes = annular_zernike(x[lit], y[lit], terms.shape[1], obscuration).T
    return Map(name, "nm", cells, shapes, terms, float(np.abs(terms @ shapes).max(initial=0.0)))


def same_reach(maps: Sequence[Map]) -> tuple[Map, ...]:
    """Return maps whose colors mean the same."""
    reach = max((one.reach for one in maps), default=0.0)
    return tuple(replace(one, reach=reach) for one in maps)
