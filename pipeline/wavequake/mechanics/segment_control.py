"""Segments moved by actuators and seen by edge sensors: interaction matrix, its modes, and errors of it.

All motions are those of `SensorMatrix`: piston and slopes of every segment, scaled such that the sum of
squares is that of the surface.
"""

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from wavequake.mechanics.disturbances.layout import SegmentLayout
from wavequake.mechanics.disturbances.sources.edge_sensors import planar_axes, sensor_matrix

Array = NDArray[np.float64]


@dataclass(frozen=True)
class EdgeSensing:
    """Where actuators and sensors are.

    Attributes
    ----------
    radius_m : float
        Of the circle of each segment's three actuators.
    angles_deg : tuple of float
        Where they are on it, from the segment's x axis.
    arm_m, offset_m : float
        Reading per dihedral angle, and place of a sensor from the end of its edge.
    curved : bool
        Whether lever arms are those of the curved mirror.
    """

    radius_m: float
    angles_deg: tuple[float, float, float]
    arm_m: float
    offset_m: float
    curved: bool


@dataclass(frozen=True)
class SeenModes:
    """Modes of a mirror that its edge sensors see, the least seen first.

    Attributes
    ----------
    readings : scipy.sparse.csr_array, shape (2 E, 3 S)
        Per motion, with the rigid motions of the whole mirror as they are.
    strokes : ndarray, shape (3 S, 3 S)
        Motions per stroke of the actuators.
    singular : ndarray, shape (M,)
        Readings per motion.
    shapes : ndarray, shape (3 S, M)
        Orthonormal motions.
    rigid : ndarray, shape (3 S, 3)
        Piston, tip and tilt of the whole mirror, orthonormal: no mode has a part of them.
    radius : ndarray, shape (S,)
        By which slopes are scaled, m.
    """

    readings: scipy.sparse.csr_array
    strokes: Array
    singular: Array
    shapes: Array
    rigid: Array
    radius: Array

    @property
    def multipliers(self) -> Array:
        """Surface rms of each mode per rms of white sensor noise that is fed through the inverse, (M,)."""
        return np.asarray(np.sqrt(3.0 / len(self.rigid)) / self.singular)


def seen_modes(layout: SegmentLayout, sensing: EdgeSensing) -> SeenModes:
    """Decompose the sensor matrix without the rigid motions, which are known from geometry.

    A gap between singular values does not tell them apart: sensors of a curved mirror seem to see two.

    Raises
    ------
    UserError
        If no two segments share an edge, or the sensors do not fit on one.
    """
    sensors = sensor_matrix(layout, sensing.arm_m, sensing.offset_m, sensing.curved)
    rigid = rigid_motions(layout, sensors.radius, sensing.curved)
    seen = sensors.matrix.toarray()
    seen -= (seen @ rigid) @ rigid.T
    values, shapes = scipy.linalg.eigh(seen.T @ seen, check_finite=False, driver="evd")
    least = 3 + int(
        (values[3:] < 1e-9 * values[-1] / len(values)).sum()
    )  # without an arm focus is unseen, too
    strokes = stroke_matrix(sensors.radius, sensing)
    singular = np.sqrt(values[least:])
    return SeenModes(sensors.matrix, strokes, singular, shapes[:, least:], rigid, sensors.radius)


def stroke_matrix(radius: Array, sensing: EdgeSensing) -> Array:
    """Return motions per stroke along the normal of three actuators of every segment, (3 S, 3 S)."""
    angles = np.radians(sensing.angles_deg)
    places = sensing.radius_m * np.column_stack([np.cos(angles), np.sin(angles)])
    inverse = np.linalg.inv(np.column_stack([np.ones(3), places]))
    return np.asarray(scipy.linalg.block_diag(*(np.diag([1.0, one, one]) @ inverse for one in radius)))


def rigid_motions(layout: SegmentLayout, radius: Array, curved: bool) -> Array:
    """Return piston, tip and tilt of the whole mirror as orthonormal motions (3 S, 3) of its segments."""
    centers, axes = layout.centers_m, layout.axes
    if not curved:
        centers, axes = centers * [1.0, 1.0, 0.0], np.zeros_like(axes)
        axes[:, :2, :2], axes[:, 2, 2] = planar_axes(layout), 1.0
    found = np.zeros((len(layout), 3, 3))
    found[:, 0, 0] = axes[:, 2, 2]
    for column, turn in ((1, np.array([1.0, 0.0, 0.0])), (2, np.array([0.0, 1.0, 0.0]))):
        found[:, 0, column] = np.einsum("si,si->s", np.cross(turn, centers), axes[:, :, 2])
        # z = slope_x x + slope_y y is the rotation (slope_y, -slope_x).
        found[:, 1, column] = -radius * (axes[:, :, 1] @ turn)
        found[:, 2, column] = radius * (axes[:, :, 0] @ turn)
    return np.asarray(np.linalg.qr(found.reshape(-1, 3))[0])


@dataclass(frozen=True)
class SensingErrors:
    """What a controller does not know of its mirror; rms of independent relative errors unless said.

    Attributes
    ----------
    sensor_gain, actuator_gain, entries : float
        Of readings, of strokes, and of every entry of the interaction matrix.
    arm : float
        Relative error that all dihedral arms share (gaps of another width).
    misplaced_m : float
        Of sensors along their edges, rms.
    """

    sensor_gain: float = 0.0
    actuator_gain: float = 0.0
    entries: float = 0.0
    arm: float = 0.0
    misplaced_m: float = 0.0


def mode_interaction(
    layout: SegmentLayout,
    sensing: EdgeSensing,
    modes: SeenModes,
    errors: SensingErrors,
    random: np.random.Generator,
) -> Array:
    """Draw how modes that are commanded are read back, (M, M): 1 without errors.

    It is the inverse of the matrix that is believed times the true one.
    """
    true = sensor_matrix(
        layout, sensing.arm_m * (1 + errors.arm * random.standard_normal()), sensing.offset_m, sensing.curved
    ).matrix
    shift = errors.misplaced_m * random.standard_normal(true.shape[0])
    if errors.misplaced_m:
        step = 1e-3
        near, far = (
            sensor_matrix(layout, sensing.arm_m, sensing.offset_m + one, sensing.curved).matrix
            for one in (-step, step)
        )
        true = true + scipy.sparse.diags_array(shift / (2 * step)) @ (far - near)
    by_strokes = (true @ scipy.sparse.csr_array(modes.strokes)).tocsr()
    by_strokes.data *= 1 + errors.entries * random.standard_normal(by_strokes.nnz)
    sensors = scipy.sparse.diags_array(1 + errors.sensor_gain * random.standard_normal(true.shape[0]))
    strokes = 1 + errors.actuator_gain * random.standard_normal(by_strokes.shape[1])
    product = modes.readings.T @ (sensors @ by_strokes)
    back = np.linalg.solve(modes.strokes, modes.shapes)
    found: Array = modes.shapes.T @ (product @ (strokes[:, None] * back)) / modes.singular[:, None] ** 2
    return found
