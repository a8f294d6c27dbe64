"""Noise of the edge sensors of a segmented mirror, as its control loop turns it into segment motion.

The loop drives piston, tip and tilt of all segments to the least-squares solution of the sensor readings,
so white sensor noise turns into motion by the pseudo-inverse of the sensor matrix: smooth modes of the
whole mirror, which neighbors hardly feel, dominate it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import ClassVar, Literal

import numpy as np
import scipy  # its parts load when first used
from numpy.typing import NDArray
from pydantic import Field

from wavequake.errors import UserError
from wavequake.mechanics.disturbances.layout import SegmentLayout
from wavequake.mechanics.disturbances.motion import Motion, still
from wavequake.mechanics.disturbances.source import Randoms, Source, register
from wavequake.mechanics.disturbances.streams import Random
from wavequake.mechanics.level_factor import LevelFactor, level_factor
from wavequake.prepared import prepared
from wavequake.tables import kept

Array = NDArray[np.float64]

_COLUMNS = 160  # instants of all realizations that are solved for at once


@register
class EdgeSensorNoise(Source):
    """White noise of two edge sensors per shared edge, independent at every instant (control step).

    A sensor reads the difference of height across the gap, where it sits, plus the dihedral angle times its
    arm. It sits where those of the TMT do; its noise and arm are no published figures of the TMT: set them.
    """

    fits: ClassVar = ("segments",)
    stratified: ClassVar = False

    model: Literal["edge-sensor-noise"] = "edge-sensor-noise"
    duration_s: float = Field(
        default=16.0, gt=0, le=1e5, description="number of control steps times their length"
    )
    sensor_rms_nm: float = Field(default=1.0, ge=0, description="noise of one reading")
    dihedral_arm_m: float = Field(
        default=0.05, ge=0, le=10, description="reading per dihedral angle; 0: heights only"
    )
    sensor_offset_m: float = Field(default=0.100722, ge=0, description="from the end of the edge, gap closed")

    def draw(self, layout: SegmentLayout, time: Array, randoms: Randoms) -> Motion:
        """Draw one realization."""
        return self.draw_several([layout], time, [randoms], [0])[0]

    def draw_several(
        self,
        layouts: Sequence[SegmentLayout],
        time: Array,
        randoms: Sequence[Randoms],
        realizations: Sequence[int],
    ) -> list[Motion]:
        """Draw realizations whose readings are solved for at once."""
        drawn, at_once = [], _at_once(len(time))
        for _, group in groupby(range(len(layouts)), lambda one: realizations[one] // at_once):
            mine = list(group)
            places = [realizations[one] % at_once for one in mine]
            streams = [randoms[one](self.name) for one in mine]
            drawn += draw_edge_noise(self, layouts[mine[0]], time, streams, places)
        return drawn

    def analytic_rms(self, layout: SegmentLayout) -> tuple[float, Literal["mas", "nm"]]:
        """Return that of the pistons."""
        return edge_noise_rms_nm(self, layout), "nm"


@dataclass(frozen=True)
class SensorMatrix:
    """Readings of edge sensors (m) per piston, tip and tilt of the segments.

    Attributes
    ----------
    matrix : scipy.sparse.csr_array, shape (2 E, 3 S)
        Unknowns per segment: piston, and the slopes along its local x and y times its ``radius``, so that the
        sum of their squares is the mean square of its surface.
    radius : ndarray, shape (S,)
        Root of the second moment of area per area and axis, m.
    """

    matrix: scipy.sparse.csr_array
    radius: Array


def sensor_matrix(
    layout: SegmentLayout, dihedral_arm_m: float, sensor_offset_m: float, curved: bool = False
) -> SensorMatrix:
    """Build the matrix of two sensors per shared edge for the mirror projected along its axis.

    With n the normal of the edge from the first segment (the earlier one) to the second, a sensor at p
    reads z1(p) - z2(p) + arm (dz1/dn - dz2/dn). The 3 S unknowns span the motions of three actuators per
    segment; in this basis the pseudo-inverse leaves out piston, tip and tilt of the whole surface, whatever
    the actuators. `curved` takes lever arms and normals of edges in the tangent plane of each segment: then
    tip and tilt of the whole mirror are seen a little, for lack of the segments' motions in their planes.

    Raises
    ------
    UserError
        If no two segments share an edge, or the sensors do not fit on one.
    """
    first, second, ends = shared_edges(layout)
    along = ends[:, 1] - ends[:, 0]
    length = np.linalg.norm(along, axis=1, keepdims=True)
    if 2 * sensor_offset_m >= length.min():
        raise UserError(
            f"Edge sensors {sensor_offset_m:g} m from the ends do not fit on an edge "
            f"of {length.min():.4g} m; move them to the ends (offset_m, sensor_offset_m)."
        )
    along = along / length
    outward = np.stack([along[:, 1], -along[:, 0]], axis=1)
    radius = segment_radius(layout)
    rows = np.arange(2 * len(first)).reshape(2, -1)
    entries = []
    for places, row in zip(
        (ends[:, 0] + sensor_offset_m * along, ends[:, 1] - sensor_offset_m * along), rows, strict=True
    ):
        for segment, sign in ((first, 1.0), (second, -1.0)):
            lever = places - layout.centers_m[segment, :2]
            if curved:
                local = _in_tangent_plane(layout.axes[segment], lever)
                turned = _in_tangent_plane(layout.axes[segment], along)
                normal = np.stack([turned[:, 1], -turned[:, 0]], axis=1)
                local += dihedral_arm_m * normal / np.linalg.norm(normal, axis=1, keepdims=True)
            else:
                plane = planar_axes(layout)[segment]
                local = np.einsum("eij,ei->ej", plane, lever + dihedral_arm_m * outward)
            slopes = local / radius[segment, None]
            values = sign * np.column_stack([np.ones(len(segment)), slopes])
            entries.append((np.repeat(row, 3), (3 * segment[:, None] + np.arange(3)).ravel(), values.ravel()))
    row_index, column_index, values = (np.concatenate(parts) for parts in zip(*entries, strict=True))
    matrix = scipy.sparse.coo_array(
        (values, (row_index, column_index)), shape=(2 * len(first), 3 * len(layout))
    )
    return SensorMatrix(matrix.tocsr(), radius)


def shared_edges(layout: SegmentLayout) -> tuple[NDArray[np.intp], NDArray[np.intp], Array]:
    """Find the edges that two segments face each other with.

    Returns
    -------
    first, second : ndarray of int, shape (E,)
        Segments, first < second.
    ends : ndarray, shape (E, 2, 2)
        Ends of the edge in the middle of the gap, where the edges of an ungapped mirror meet; in the
        counter-clockwise sense of the first segment.

    Raises
    ------
    UserError
        If there is none.
    """
    corners = layout.corners_m
    count, sides = corners.shape[:2]
    starts, stops = corners, np.roll(corners, -1, axis=1)
    segment = np.repeat(np.arange(count), sides)
    starts, stops = starts.reshape(-1, 2), stops.reshape(-1, 2)
    length = np.linalg.norm(stops - starts, axis=1)
    keep = length > 0
    segment, starts, stops, length = segment[keep], starts[keep], stops[keep], length[keep]
    if not len(segment):
        raise UserError("Edge sensors need a segmented mirror; this one has no edges.")
    middle = (starts + stops) / 2
    tree = scipy.spatial.cKDTree(middle)
    widest = 0.1 * float(length.max())
    pairs = tree.query_pairs(widest, output_type="ndarray")
    pairs = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]
    a, b = pairs.T
    facing = np.einsum("ei,ei->e", stops[a] - starts[a], starts[b] - stops[b]) > 0.99 * length[a] * length[b]
    a, b = a[facing & (segment[a] != segment[b])], b[facing & (segment[a] != segment[b])]
    if not len(a):
        raise UserError(
            "Edge sensors sit on edges that two segments share, and no segments of this mirror do: none of "
            f"their edges are parallel and within {1e3 * widest:.3g} mm of each other; leave the sensors "
            "out, or take another telescope."
        )
    ends = np.stack([starts[a] + stops[b], stops[a] + starts[b]], axis=1) / 2
    along = (ends[:, 1] - ends[:, 0]) / np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1, keepdims=True)
    across = middle[b] - middle[a]
    gap = np.abs(across[:, 0] * along[:, 1] - across[:, 1] * along[:, 0])
    # Hexagons that shrink by half a gap lose half a gap / sqrt(3) at each end of an edge.
    lost = (gap / (2 * np.sqrt(3)))[:, None] * along
    return segment[a], segment[b], ends + np.stack([-lost, lost], axis=1)


@dataclass(frozen=True)
class Shaping:
    """How noise becomes motion.

    ``transposed`` is A^T (3 S, 2 E); ``unseen`` (3 S, k) are orthonormal motions that no sensor sees, and
    ``factor`` is that of A^T A with k of its unknowns held, which those are made of. ``radius`` (S,) scales
    the slopes; ``gain`` is the rms of the surface per rms of a sensor and ``piston_gain`` that of the pistons
    alone.
    """

    transposed: scipy.sparse.csr_array
    factor: LevelFactor
    unseen: Array
    radius: Array
    gain: float
    piston_gain: float

    def unknowns(self, readings: Array) -> Array:
        """Return the shortest least-squares solutions (3 S, n) of readings (2 E, n).

        With some unknowns held, a solution differs from the shortest one by unseen motions.
        """
        return self.seen(self.factor.solve(self.seen(self.transposed @ readings)))

    def seen(self, unknowns: Array) -> Array:
        """Return unknowns (3 S, n) without what no sensor sees of them."""
        rest: Array = unknowns - self.unseen @ (self.unseen.T @ unknowns)
        return rest


@prepared(maxsize=3)
def shaping(layout: SegmentLayout, dihedral_arm_m: float, sensor_offset_m: float) -> Shaping:
    """Invert the sensor matrix, leaving out the modes that it does not see.

    A^T A of 1476 unknowns is decomposed in 0.6 s, once. Null modes lie below the largest gap between
    eigenvalues in the lowest 1e-5 of their range (for the TMT: 1e-16 against 8e-8 and more). The numbers
    depend neither on the signs of eigenvectors nor on their choice where eigenvalues coincide.

    Raises
    ------
    UserError
        If the mirror has no shared edges.
    """
    arrays = layout.centers_m, layout.axes, layout.corners_m
    found = kept(_Tables, _tables, *arrays, dihedral_arm_m, sensor_offset_m)
    size = 3 * len(layout)
    transposed = scipy.sparse.csr_array((found.values, found.columns, found.starts), (size, found.readings))
    holds = np.zeros((size, len(found.held)))
    holds[found.held, np.arange(len(found.held))] = 1.0
    normal = (transposed @ transposed.T).tocsr()
    held = scipy.sparse.diags_array(normal.diagonal().mean() * holds.sum(axis=1))
    factor = level_factor((normal + held).tocsr())
    # (A^T A + H) v = h, where H holds unknowns: v moves one of those alone, and no sensor sees it.
    unseen = np.linalg.qr(factor.solve(holds))[0]
    gain, piston_gain = (float(np.sqrt(one / len(layout))) for one in (found.variance, found.piston_variance))
    return Shaping(transposed, factor, unseen, found.radius, gain, piston_gain)


@dataclass(frozen=True)
class _Tables:
    """The transposed sensor matrix by rows, and what its decomposition tells.

    ``held`` are as many unknowns as there are null modes, which tell those apart; ``variance`` of all
    unknowns, and of the pistons, is for readings of variance 1.
    """

    values: Array
    columns: NDArray[np.int32]
    starts: NDArray[np.int32]
    readings: int
    held: NDArray[np.int64]
    variance: float
    piston_variance: float
    radius: Array


def _tables(centers: Array, axes: Array, corners: Array, dihedral_arm_m: float, offset_m: float) -> _Tables:
    """Return what noise is shaped by, from the arrays of a layout, which no name has a part in."""
    names = tuple(map(str, range(len(centers))))
    layout = SegmentLayout(names, centers, axes, corners, np.zeros(len(centers)))
    sensors = sensor_matrix(layout, dihedral_arm_m, offset_m)
    transposed = sensors.matrix.T.tocsr()
    normal = (sensors.matrix.T @ sensors.matrix).toarray()
    eigenvalues, vectors = scipy.linalg.eigh(normal, check_finite=False, driver="evd")
    null = null_count(eigenvalues)
    _, order = scipy.linalg.qr(vectors[:, :null].T, mode="r", pivoting=True)
    return _Tables(
        *(transposed.data, transposed.indices, transposed.indptr, transposed.shape[1]),
        np.sort(order[:null]).astype(np.int64),
        float(np.sum(1 / eigenvalues[null:])),
        float(np.sum(vectors[::3, null:] ** 2 / eigenvalues[null:])),
        sensors.radius,
    )


def null_count(eigenvalues: Array) -> int:
    """Count the eigenvalues, in ascending order, below the largest gap in the lowest 1e-5 of their range."""
    relative = np.maximum(eigenvalues / eigenvalues[-1], 1e-17)
    low = int(np.searchsorted(relative, 1e-5)) + 1
    jumps = np.diff(np.log(relative[: low + 1]))
    return int(np.argmax(jumps)) + 1


def edge_noise_rms_nm(parameters: EdgeSensorNoise, layout: SegmentLayout) -> float:
    """Return the analytic rms of the pistons of all segments, nm."""
    shape = shaping(layout, parameters.dihedral_arm_m, parameters.sensor_offset_m)
    return parameters.sensor_rms_nm * shape.piston_gain


def unseen_motions(parameters: EdgeSensorNoise, layout: SegmentLayout) -> int:
    """Return how many motions of the segments no sensor sees, besides piston, tip and tilt of the mirror.

    They are not in the motion that is drawn.
    """
    return len(shaping(layout, parameters.dihedral_arm_m, parameters.sensor_offset_m).unseen.T) - 3


def draw_edge_noise(
    parameters: EdgeSensorNoise,
    layout: SegmentLayout,
    time: Array,
    randoms: Sequence[Random],
    places: Sequence[int],
) -> list[Motion]:
    """Draw independent sensor noise at each instant and turn it into segment motion.

    A realization has a place of its own in products of a constant shape, so that its bits do not depend on
    what is drawn with it.
    """
    shape = shaping(layout, parameters.dihedral_arm_m, parameters.sensor_offset_m)
    readings = np.zeros((_at_once(len(time)), len(time), shape.transposed.shape[1]))
    for place, random in zip(places, randoms, strict=True):
        readings[place] = random.standard_normal(readings.shape[1:])
    solved = shape.unknowns(readings.reshape(-1, readings.shape[2]).T * (parameters.sensor_rms_nm * 1e-9))
    unknowns = np.ascontiguousarray(solved.T).reshape(len(readings), len(time), len(layout), 3)
    return [_motion(shape, unknowns[place]) for place in places]


def _motion(shape: Shaping, unknowns: Array) -> Motion:
    """Return the motion of S segments by their unknowns (n, S, 3)."""
    piston, x_slope, y_slope = np.moveaxis(unknowns, 2, 0)
    motion = still(len(unknowns), unknowns.shape[1])
    motion.segment_motion[..., 2] = piston
    # z = slope_x x + slope_y y is the rotation (slope_y, -slope_x).
    motion.segment_motion[..., 3] = y_slope / shape.radius
    motion.segment_motion[..., 4] = -x_slope / shape.radius
    return motion


def _at_once(instants: int) -> int:
    """Return how many realizations are solved for at once: the factor is read for all of their instants."""
    return next((count for count in (16, 8, 4, 2) if count * instants <= _COLUMNS), 1)


def _in_tangent_plane(axes: Array, vectors: Array) -> Array:
    """Return vectors (n, 2), seen along the mirror's axis, in the local x and y (n, 2) of axes (n, 3, 3)."""
    normal = axes[:, :, 2]
    height = -np.einsum("ei,ei->e", normal[:, :2], vectors) / normal[:, 2]
    local: Array = np.einsum("eij,ei->ej", axes[:, :, :2], np.column_stack([vectors, height]))
    return local


def planar_axes(layout: SegmentLayout) -> Array:
    """Return the local x and y axes projected along the mirror's axis, orthonormal columns, (S, 2, 2)."""
    x_axis = layout.axes[:, :2, 0] / np.linalg.norm(layout.axes[:, :2, 0], axis=1, keepdims=True)
    return np.stack([x_axis, np.stack([-x_axis[:, 1], x_axis[:, 0]], axis=1)], axis=2)


def segment_radius(layout: SegmentLayout) -> Array:
    """Return the root of each segment's second moment of area per area and axis, m, (S,)."""
    return np.asarray(np.sqrt(_second_moments(layout.corners_m)))


def _second_moments(corners: Array) -> Array:
    """Return the second moment per area of polygons about their centroids, mean of both axes, m^2, (S,)."""
    following = np.roll(corners, -1, axis=1)
    cross = corners[..., 0] * following[..., 1] - corners[..., 1] * following[..., 0]
    area = cross.sum(axis=1) / 2
    centroid = np.sum((corners + following) * cross[..., None], axis=1) / (6 * area[:, None])
    squares = corners**2 + corners * following + following**2
    polar = np.sum(squares.sum(axis=2) * cross, axis=1) / 12
    moments: Array = (polar / area - np.sum(centroid**2, axis=1)) / 2
    return moments
