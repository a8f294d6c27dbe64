"""Structured meshes of discs, rings and hexagons with nodes exactly where the mirror is mounted; SI units.

A disc is a hexagon of three rhombi of n x n quadrilaterals, surrounded by rings of 6 n; so it has the 3-fold
symmetry of its mounts. Every node has a ring number and a position along its ring; the radii and shapes of
the rings (hexagon or circle) place it.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.mechanics.mirrors.hexahedra import TOP

Array = NDArray[np.float64]
Integers = NDArray[np.int64]


@dataclass(frozen=True)
class Mesh:
    """Hexahedra with 20 nodes that fill a mirror.

    Attributes
    ----------
    nodes : ndarray, shape (N, 3)
        m.
    elements : ndarray of int, shape (e, 20)
    front_facets : ndarray of int, shape (f, 8)
        The optical surface, at the largest z.
    mounts : ndarray of int, shape (k,)
        Nodes of the rear face at the mount points.
    """

    nodes: Array
    elements: Integers
    front_facets: Integers
    mounts: Integers

    @property
    def front_nodes(self) -> Integers:
        """Nodes of the optical surface, shape (p,), ascending."""
        return np.unique(self.front_facets)


@dataclass(frozen=True)
class Profile:
    """Radius (m) and shape of the rings, linear between knots, and a turn (rad) along the circumference.

    Attributes
    ----------
    rings : tuple of float
        Ring numbers of the knots, ascending.
    radii : tuple of float
        Radius of these rings (of a hexagon: to its corners).
    roundness : tuple of float
        0 for a hexagon, 1 for a circle.
    turns : tuple of (float, float)
        Pairs of a position along a ring (0 to 6, one per sextant) and the angle by which it is turned there.
    """

    rings: tuple[float, ...]
    radii: tuple[float, ...]
    roundness: tuple[float, ...]
    turns: tuple[tuple[float, float], ...] = ((0.0, 0.0),)

    def place(self, ring: Array, position: Array) -> Array:
        """Return x, y (m), shape (..., 2), of nodes from ring numbers and positions (0 to 6) along rings."""
        angles = np.arange(7) * np.pi / 3
        hexagon = np.stack(
            [np.interp(position, np.arange(7), side) for side in (np.cos(angles), np.sin(angles))], axis=-1
        )
        circle = np.stack([np.cos(position * np.pi / 3), np.sin(position * np.pi / 3)], axis=-1)
        roundness = np.interp(ring, self.rings, self.roundness)[..., None]
        flat = hexagon + roundness * (circle - hexagon)
        flat *= np.interp(ring, self.rings, self.radii)[..., None]
        where, by = zip(*self.turns, strict=True)
        turn = np.interp(position, where, by, period=6.0)
        cosine, sine = np.cos(turn), np.sin(turn)
        x, y = flat[..., 0], flat[..., 1]
        return np.stack([cosine * x - sine * y, sine * x + cosine * y], axis=-1)


def _quadrilaterals(ring: Integers, step: Integers, steps: Integers) -> Integers:
    """Return the numbers of the 8 nodes of each quadrilateral of a block, shape (q, 8, 3).

    All arguments, shape (2 a + 1, 2 b + 1), number the nodes of the block; odd places are middles of edges:
    half rings from the center, half steps along the ring, and how many of them go around.
    """
    numbers = np.stack([ring, step % steps, steps], axis=-1)
    lower, upper = slice(0, -1, 2), slice(2, None, 2)
    middle = slice(1, None, 2)
    corners = [(lower, lower), (upper, lower), (upper, upper), (lower, upper)]
    edges = [(middle, lower), (upper, middle), (middle, upper), (lower, middle)]
    return np.stack([numbers[place] for place in corners + edges], axis=2).reshape(-1, 8, 3)


def _core(divisions: int) -> Integers:
    """Node numbers of the three rhombi of a hexagon, as `_quadrilaterals`."""
    i, j = np.meshgrid(np.arange(2 * divisions + 1), np.arange(2 * divisions + 1), indexing="ij")
    ring = np.maximum(i, j)
    blocks = []
    for rhombus in range(3):
        step = 2 * rhombus * ring + np.where(j <= i, j, 2 * ring - i)
        blocks.append(_quadrilaterals(ring, step, np.maximum(6 * ring, 1)))
    return np.concatenate(blocks)


def _rings(first: int, count: int, around: int) -> Integers:
    """Node numbers, as `_quadrilaterals`, of `count` rings of `around` elements outside ring `first`."""
    ring, step = np.meshgrid(
        np.arange(2 * first, 2 * (first + count) + 1), np.arange(2 * around + 1), indexing="ij"
    )
    return _quadrilaterals(ring, step, np.full_like(ring, 2 * around))


def _extrude(keys: Integers, layers: int) -> tuple[Integers, Integers]:
    """Stack quadrilaterals, whose nodes have integer numbers, into hexahedra.

    Returns the elements (e, 20) and what each node is, shape (N, 2): number in the plane and half layer.
    """
    corner, edge = keys[:, :4], keys[:, 4:]
    span = int(keys.max()) + 1
    stack = []
    for layer in range(layers):
        low, half, high = (span * (2 * layer + step) for step in range(3))
        stack.append(np.hstack([corner + low, corner + high, edge + low, edge + high, corner + half]))
    used, elements = np.unique(np.concatenate(stack), return_inverse=True)
    return elements.reshape(-1, 20), np.column_stack([used % span, used // span])


def _fill(
    numbers: Integers,
    profile: Profile,
    thickness: float,
    focal_length: float,
    layers: int,
    mounts: list[tuple[int, int]],
) -> Mesh:
    """Build the mesh from node numbers; `mounts` are the numbers (whole ring, whole step) of mount points."""
    names, plane = np.unique(numbers.reshape(-1, 3), axis=0, return_inverse=True)
    elements, places = _extrude(plane.reshape(-1, 8), layers)
    flat = profile.place(names[:, 0] / 2, 6 * names[:, 1] / names[:, 2])
    xy = flat[places[:, 0]]
    sag = (xy**2).sum(axis=1) / (4 * focal_length)
    nodes = np.column_stack([xy, sag + thickness * (places[:, 1] / (2 * layers) - 1)])
    top = elements[-len(numbers) :, TOP]
    rear = [
        int(
            np.flatnonzero((names[:, :2] == [2 * a, 2 * b]).all(axis=1)[places[:, 0]] & (places[:, 1] == 0))[
                0
            ]
        )
        for a, b in mounts
    ]
    return Mesh(nodes, elements, top, np.array(rear, dtype=np.int64))


def _turns(angles: tuple[float, ...], around: int) -> tuple[list[int], tuple[tuple[float, float], ...]]:
    """Choose the step along the ring for each mount, and turn the mesh so that it lies at the angle (deg)."""
    relative = np.mod(np.subtract(angles, angles[0]), 360.0)
    steps = [int(step) for step in np.rint(relative * around / 360.0).astype(int) % around]
    if len(set(steps)) < len(steps):
        raise UserError(
            f"two of the mount angles {list(angles)} deg are closer than the mesh resolves "
            f"({360 / around:g} deg); move them apart or refine the mesh"
        )
    surplus = (relative - np.array(steps) * 360.0 / around + 180.0) % 360.0 - 180.0
    where = [6.0 * step / around for step in steps]
    turns = zip(where, np.radians(angles[0] + surplus), strict=True)
    return steps, tuple(sorted((float(a), float(b)) for a, b in turns))


def _split(count: int, inner: float, mount: float, outer: float) -> int:
    """Return how many of `count` rings between two radii lie inside the mount circle."""
    if mount in (inner, outer):
        return 0 if mount == inner else count
    if count < 2:
        raise UserError(
            f"a mesh with {count} ring cannot have nodes at the mount radius {mount} m; use 2 or more"
        )
    return int(np.clip(round(count * (mount - inner) / (outer - inner)), 1, count - 1))


def disc_mesh(
    radius: float,
    thickness: float,
    focal_length: float,
    mount_radius: float,
    mount_angles: tuple[float, ...],
    core: int,
    rings: int,
    layers: int,
) -> Mesh:
    """Mesh a circular meniscus whose front face is the parabola z = r^2 / (4 f); lengths in m, angles in deg.

    `core` is the number of divisions of a side of the hexagonal core, `rings` the number of rings around it.
    """
    middle = min(radius * core / (core + rings), 0.75 * mount_radius)
    inside = _split(rings, middle, mount_radius, radius)
    steps, turns = _turns(mount_angles, 6 * core)
    knots = (0, core, core + inside, core + rings)
    radii = (0.0, middle, mount_radius, radius)
    keep = [0, 1, 2, 3] if inside < rings else [0, 1, 2]
    profile = Profile(
        tuple(knots[k] for k in keep),
        tuple(radii[k] for k in keep),
        tuple((0.0, 0.5, 1.0, 1.0)[k] for k in keep),
        turns,
    )
    numbers = np.concatenate([_core(core), _rings(core, rings, 6 * core)])
    mounts = [(core + inside, step) for step in steps]
    return _fill(numbers, profile, thickness, focal_length, layers, mounts)


def ring_mesh(
    inner_radius: float,
    radius: float,
    thickness: float,
    focal_length: float,
    mount_radius: float,
    mount_angles: tuple[float, ...],
    around: int,
    rings: int,
    layers: int,
) -> Mesh:
    """Mesh an annular meniscus; arguments as `disc_mesh`, `around` is the number of elements in a ring."""
    inside = _split(rings, inner_radius, mount_radius, radius)
    steps, turns = _turns(mount_angles, around)
    # The first ring has number 1: number 0 is the center of a disc.
    knots = sorted({1: inner_radius, 1 + inside: mount_radius, 1 + rings: radius}.items())
    profile = Profile(
        tuple(ring for ring, _ in knots), tuple(r for _, r in knots), (1.0,) * len(knots), turns
    )
    mounts = [(1 + inside, step) for step in steps]
    return _fill(_rings(1, rings, around), profile, thickness, focal_length, layers, mounts)


def hexagon_mesh(
    side: float, thickness: float, focal_length: float, mount_radius: float, divisions: int, layers: int
) -> Mesh:
    """Mesh a hexagonal meniscus with a corner, and the first of three mounts, toward the x axis."""
    inside = _split(divisions, 0.0, mount_radius, side)
    profile = Profile((0, inside, divisions), (0.0, mount_radius, side), (0.0, 0.0, 0.0))
    mounts = [(inside, 2 * corner * inside) for corner in range(3)]
    return _fill(_core(divisions), profile, thickness, focal_length, layers, mounts)
