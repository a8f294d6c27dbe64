"""From motions of segments and surfaces to the transforms that the ray trace reads.

A transform (12 numbers) maps a point as q = A p + o: nine entries of A by rows, then o. It leads from the
frame in which a ray arrives to that of the displaced surface, so that the trace meets every surface in its
own frame.
"""

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.kernels.device.tiles import TILE, to_tiles
from wavequake.kernels.trace.poses_numpy import cardan_entries, quaternion, rotation_minus_one
from wavequake.optics.segments.layout import Segments
from wavequake.optics.systems.system import OpticalSystem

Array = NDArray[np.float64]


def cardan(angles: Array) -> Array:
    """Return rotation matrices of Cardan angles: R = Rx(alpha) Ry(beta) Rz(gamma).

    Parameters
    ----------
    angles : ndarray, shape (..., 3)
        alpha, beta, gamma in rad.

    Returns
    -------
    ndarray, shape (..., 3, 3)
        ``R @ e_z`` is the normal of Störkle 2018, Eq. 3.10.
    """
    return np.ascontiguousarray(np.moveaxis(cardan_entries(np.moveaxis(angles, -1, 0)), (0, 1), (-2, -1)))


def cardan_angles(rotation: Array) -> Array:
    """Return the Cardan angles x-y-z (T, 3) of rotations (T, 3, 3), the inverse of `cardan`."""
    return np.stack(
        [
            np.arctan2(-rotation[:, 1, 2], rotation[:, 2, 2]),
            np.arctan2(rotation[:, 0, 2], np.hypot(rotation[:, 0, 0], rotation[:, 0, 1])),
            np.arctan2(-rotation[:, 0, 1], rotation[:, 0, 0]),
        ],
        axis=1,
    )


def _require_motions(what: str, motion: Array, count: int) -> None:
    if motion.ndim != 3 or motion.shape[1:] != (count, 6) or len(motion) % TILE:
        raise UserError(
            f"the array of {what} motions has the shape {motion.shape}, "
            f"it must be (whole number of tiles of {TILE}, {count}, 6)"
        )


def segment_poses(segments: Segments, motion: Array, frame: str = "local") -> Array:
    """Return the transforms from the optics frame of M1 to the parent frame of every displaced segment.

    A point q of the undisturbed segment moves to c + t + R (q - c) with the pivot c = ``segments.centers[k]``
    (Störkle 2018, Eq. 4.6). The transform undoes this motion, ``A = R^T`` and ``o = c - R^T (c + t)``; o is
    computed as ``-(R - I)^T (c + t) - t``, which keeps its digits for motions of nanometers and nanoradians.

    Parameters
    ----------
    segments : Segments
    motion : ndarray, shape (batch, S, 6)
        dx, dy, dz in mm and Cardan angles rx, ry, rz in rad; the batch is a whole number of tiles.
    frame : "local" or "global"
        Axes of the motion: each segment's own (the normal points to the sky) or those of the optics frame.

    Returns
    -------
    ndarray, shape (batch / 16, S, 12, 16)

    Raises
    ------
    UserError
        If the frame is unknown or the motion has the wrong shape.
    """
    count = len(segments)
    if frame not in ("local", "global"):
        raise UserError(f"the frame of a segment motion is {frame!r}, it must be 'local' or 'global'")
    _require_motions("segment", motion, count)
    to_optics = segments.axes * np.array([1.0, 1.0, -1.0])[:, None] if frame == "local" else None
    tiles = motion.reshape(-1, TILE, count, 6)
    poses = np.empty((len(tiles), count, 12, TILE))
    for tile, out in zip(tiles, poses, strict=True):  # a tile at a time stays in the cache
        _write_poses(out, np.ascontiguousarray(tile.transpose(2, 1, 0)), segments.centers, to_optics)
    return poses


def carried_segments(segments: Segments) -> Array:
    """Return how segments move, in their own axes, with M1 as one rigid body, per unit of its motion.

    Parameters
    ----------
    segments : Segments

    Returns
    -------
    ndarray, shape (6, S, 6)
        Of shifts along and turns about the axes of the optics frame, whose origin is M1's vertex, the motions
        that `segment_poses` takes, to first order; mm and rad, per mm or rad.
    """
    to_optics = segments.axes * np.array([1.0, 1.0, -1.0])[:, None]
    local = np.moveaxis(to_optics, 1, 0)  # components of the axes of the optics frame, (3, S, 3)
    swept = np.cross(np.eye(3)[:, None], segments.centers)  # of the centers, by turns
    found = np.zeros((6, len(segments), 6))
    found[:3, :, :3] = local
    found[3:, :, :3] = np.einsum("isa,sad->isd", swept, to_optics)
    found[3:, :, 3:] = -local  # a rotation vector is axial, and the local frame a reflection
    return found


def _write_poses(out: Array, motion: Array, centers: Array, to_optics: Array | None) -> None:
    """Write the transforms (S, 12, 16) of a tile of motions (6, S, 16) in the axes `to_optics` (S, 3, 3)."""
    shift_x, shift_y, shift_z, *angles = motion
    shift: tuple[Array, ...] = (shift_x, shift_y, shift_z)
    if not motion[3:].any():  # nothing turns, as in wind on stiff segments
        out[:, :9] = np.eye(3).reshape(9, 1)
        out[:, 9:] = -np.stack(shift if to_optics is None else _turn(to_optics, shift), axis=1)
        return
    w, vector = quaternion(*angles)
    if to_optics is not None:
        # A reflection (z to the sky -> z along the light): a rotation vector, being axial, changes its sign.
        shift, vector = _turn(to_optics, shift), _turn(-to_optics, vector)
    entries = rotation_minus_one(w, *vector)
    x, y, z = (centers[:, axis, None] + shift[axis] for axis in range(3))
    for row in range(3):
        for column in range(3):
            entry = entries[3 * column + row]  # transposed
            out[:, 3 * row + column] = entry + 1.0 if row == column else entry
        out[:, 9 + row] = -(entries[row] * x + entries[3 + row] * y + entries[6 + row] * z) - shift[row]


def _turn(matrices: Array, vector: tuple[Array, ...]) -> tuple[Array, Array, Array]:
    """Return matrices (S, 3, 3) times vectors given by components (S, 16)."""
    x, y, z = vector
    a, b, c = (
        matrices[:, row, 0, None] * x + matrices[:, row, 1, None] * y + matrices[:, row, 2, None] * z
        for row in range(3)
    )
    return a, b, c


def displaced(position: Array, rotation: Array, motion: Array) -> tuple[Array, Array]:
    """Return positions (T, L, 3) and rotations (T, L, 3, 3) of frames that move in their own axes.

    Parameters
    ----------
    position : ndarray, shape (L, 3)
        At rest.
    rotation : ndarray, shape (L, 3, 3)
    motion : ndarray, shape (T, L, 6)
        Displacements and Cardan angles.
    """
    return position + (rotation @ motion[..., :3, None])[..., 0], rotation @ cardan(motion[..., 3:])


def after_m1(system: OpticalSystem, motion: Array) -> tuple[Array, Array]:
    """Return where the surfaces after M1 stand (`displaced`) when all surfaces move by `motion` (T, L, 6).

    Raises
    ------
    UserError
        If the motion has the wrong shape.
    """
    _require_motions("surface", motion, len(system.surfaces))
    after = system.after_primary
    position = np.array([surface.position for surface in after])
    rotation = np.array([surface.rotation for surface in after])
    return displaced(position, rotation, motion[:, -len(after) :])


def relative_transforms(position: Array, rotation: Array) -> Array:
    """Return the transforms to every surface after M1 from its predecessor, shape (T / 16, L, 12, 16).

    The first one leads from the optics frame of M1 (Störkle 2018, Eq. 4.2-4.4).

    Parameters
    ----------
    position : ndarray, shape (T, L, 3)
        From `after_m1`; whole tiles of instants.
    rotation : ndarray, shape (T, L, 3, 3)
    """
    batch, count = position.shape[:2]
    before_position = np.concatenate([np.zeros((batch, 1, 3)), position[:, :-1]], axis=1)
    before_rotation = np.concatenate([np.broadcast_to(np.eye(3), (batch, 1, 3, 3)), rotation[:, :-1]], axis=1)
    inverse = np.swapaxes(rotation, -1, -2)
    poses = np.empty((batch, count, 12))
    poses[..., :9] = (inverse @ before_rotation).reshape(batch, count, 9)
    poses[..., 9:] = (inverse @ (before_position - position)[..., None])[..., 0]
    return to_tiles(poses)


def field_directions(field: Array) -> Array:
    """Return the unit vectors of incoming light.

    Parameters
    ----------
    field : ndarray, shape (batch, 2)
        Angles in rad to the z axis in the x-z and y-z planes; the batch is a whole number of tiles.

    Returns
    -------
    ndarray, shape (batch / 16, 3, 16)
    """
    slopes = np.tan(field)
    direction = np.concatenate([slopes, np.ones((len(field), 1))], axis=1)
    return to_tiles(direction / np.sqrt(1.0 + np.sum(slopes**2, axis=1, keepdims=True)))
