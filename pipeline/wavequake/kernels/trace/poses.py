"""Where surfaces that move stand at many instants, as the trace takes it."""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from wavequake.kernels.device.first_batch import Pick, compare_first, is_trusted
from wavequake.kernels.device.opencl import NUMPY, Device
from wavequake.kernels.device.program import source
from wavequake.kernels.device.steps import Step, run_steps, vector_width
from wavequake.kernels.trace.poses_numpy import surface_poses_numpy

Array = NDArray[np.float64]

_GROUP = {"cpu": 1, "gpu": 64}


def surface_poses(position: Array, rotation: Array, motion: Array, device: Device = NUMPY) -> Array:
    """Return the transforms (T, L, 12) that lead from each surface's frame to the next one's.

    With the relative pose (s, R) at rest, the own motions (d, Q) of a surface and (d', Q') of its predecessor
    a point p becomes Q^T (R^T Q' p + R^T (d' - s) - d) (Störkle 2018, Eq. 3.11 and 4.3).

    Parameters
    ----------
    position, rotation : ndarray, shape (L, 3) and (L, 3, 3)
        Pose of each surface at rest, in the frame of its predecessor.
    motion : ndarray, shape (T, L, 6)
        Of each surface in its own frame: displacements in mm and Cardan angles in rad; finite.
    device : Device
        Where to run. The bits of an instant do not depend on the others.

    Returns
    -------
    ndarray, shape (T, L, 12)
        What a point is multiplied by, by rows, then what is added.
    """
    motion = np.asarray(motion, dtype=np.float64)
    instants, surfaces, _ = motion.shape
    if device.kind == "numpy" or not motion.size:
        return surface_poses_numpy(position, rotation, motion)
    lanes = vector_width(device, np.dtype(np.float64))
    found = np.empty((instants, surfaces, 12))
    turned = np.swapaxes(rotation, 1, 2).reshape(-1, 9)
    rest = np.concatenate([turned, position], axis=1)
    inputs = {"rest": rest, "motion": motion}
    size, group = (1, -(-instants // lanes), 1), (1, _GROUP[device.kind], 1)
    arguments = (np.int32(instants), np.int32(surfaces), "rest", "motion", "found")
    step = Step(_text(), "poses", (("W", lanes), ("SINGLE", 0)), size, group, arguments)
    run_steps(device, [step], inputs, {"found": found}, {})
    if not is_trusted(device, step.kernel):

        def twin(pick: Pick) -> list[Array]:
            return list(surface_poses_numpy(position, rotation, motion[pick]).reshape(len(pick), -1).T)

        compare_first(device, step.kernel, list(found.reshape(instants, -1).T), twin, kind="instants")
    return found


@lru_cache(maxsize=1)
def _text() -> str:
    return source("poses.cl")
