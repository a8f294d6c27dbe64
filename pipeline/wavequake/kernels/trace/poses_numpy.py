"""The NumPy twin of ``kernels/poses.cl``, and rotations from quaternions."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def quaternion(alpha: Array, beta: Array, gamma: Array) -> tuple[Array, tuple[Array, Array, Array]]:
    """Return the unit quaternion (scalar, vector) of Cardan angles, from half angles: nothing cancels."""
    (sin_a, sin_b, sin_c), (cos_a, cos_b, cos_c) = (
        [f(angle / 2) for angle in (alpha, beta, gamma)] for f in (np.sin, np.cos)
    )
    both_cos, both_sin = cos_a * cos_b, sin_a * sin_b
    only_a, only_b = sin_a * cos_b, cos_a * sin_b
    vector = (
        only_a * cos_c + only_b * sin_c,
        only_b * cos_c - only_a * sin_c,
        both_cos * sin_c + both_sin * cos_c,
    )
    return both_cos * cos_c - both_sin * sin_c, vector


def rotation_minus_one(w: Array, x: Array, y: Array, z: Array) -> list[Array]:
    """Return the nine entries (by rows) of R - I for a unit quaternion, small numbers for small rotations."""
    x2, y2, z2, w2 = 2 * x, 2 * y, 2 * z, 2 * w
    xx, yy, zz = x2 * x, y2 * y, z2 * z
    xy, xz, yz = x2 * y, x2 * z, y2 * z
    wx, wy, wz = w2 * x, w2 * y, w2 * z
    return [-(yy + zz), xy - wz, xz + wy, xy + wz, -(xx + zz), yz - wx, xz - wy, yz + wx, -(xx + yy)]


def cardan_entries(angles: Array) -> Array:
    """Return rotation matrices (3, 3, ...) of Cardan angles (3, ...), Rx(alpha) Ry(beta) Rz(gamma).

    Products of many such matrices (`numpy.einsum`) take a quarter of the time that they take by `@`.
    """
    w, vector = quaternion(*angles)
    rotation = np.array(rotation_minus_one(w, *vector)).reshape(3, *angles.shape)
    for axis in range(3):
        rotation[axis, axis] += 1.0
    return rotation


def surface_poses_numpy(position: Array, rotation: Array, motion: Array) -> Array:
    """Return transforms (T, L, 12), see `wavequake.kernels.trace.poses.surface_poses`."""
    found = np.empty((*motion.shape[:2], 12))
    unturned = np.tile(np.eye(3)[..., None], len(motion))
    shift_before, before = np.zeros((3, len(motion))), unturned
    for surface, moves in enumerate(motion.transpose(1, 2, 0).copy()):  # rows of instants are fast
        shift, own = moves[:3], cardan_entries(moves[3:]) if moves[3:].any() else unturned
        back = rotation[surface].T
        # No `@`: its last bits depend on the number of instants with some processors' BLAS.
        place = np.einsum("ij,jt->it", back, shift_before - position[surface, :, None]) - shift
        turned = np.einsum("ij,jkt->ikt", back, before)
        found[:, surface, :9] = np.einsum("jit,jkt->ikt", own, turned).reshape(9, -1).T
        found[:, surface, 9:] = np.einsum("jit,jt->it", own, place).T
        shift_before, before = shift, own
    return found
