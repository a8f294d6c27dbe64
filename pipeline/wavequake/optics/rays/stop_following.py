"""Light that follows the stop: when surfaces move, the beam is what the moved stop lets through.

Rays are aimed at the stop at rest (`wavequake.optics.rays.aiming`). At each instant the whole bundle of a
field point is then moved so that its chief ray meets the stop's center where that is now: it is shifted if
the object is at infinity, and turned about the object point if not. Both keep the wave what it is. What is
left is the distortion of the pupil times the motion: at the corner of a double Gauss lens of 28 degrees other
rays miss their points of the moved stop by 5 % of its shift, in systems of small fields by 0.1 % or less.
Derivatives take that into account, too (`wavequake.optics.wavefronts.reaiming`).
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from wavequake.kernels.trace.sequence import Moving, Rays, Sequence
from wavequake.kernels.trace.sequential_numpy import trace_sequence_numpy
from wavequake.optics.derivatives.central import gradient
from wavequake.optics.rays.packing import moving
from wavequake.optics.rays.stop_map import axes_across
from wavequake.optics.segments.kinematics import cardan
from wavequake.optics.systems.kinematics import rest_states
from wavequake.optics.systems.system import OpticalSystem, States

Array = NDArray[np.float64]

_CENTERED = 1e-9  # distance of a chief ray from the center of the stop that is left alone, mm
_STEPS = 20
_SIDEWAYS = 1e-3  # z of directions along which a shift along x and y hardly moves light
_DIFFERENCE = 1e-5  # step of the differences, as a share of the stop's distance or size, rad or 1


def steering(system: OpticalSystem, sequence: Sequence, chief: Rays) -> Array:
    """Return how to move the light per mm of the chief ray in the stop, at rest: a matrix (2, 2).

    Of shifts in mm for an object at infinity, else of turns in rad; NaN where the ray does not follow them.
    """
    far = not np.isfinite(system.object_distance)
    reach = float(np.abs(system.surfaces[system.stop].position).max())
    step = _DIFFERENCE * (max(1.0, reach) if far else 1.0)
    trials = np.array([[step, 0.0], [-step, 0.0], [0.0, step], [0.0, -step]])
    light = _moved(moving(system, rest_states(system, 4)), chief, trials, far)
    ends = _meet(sequence, chief, light, system.stop)
    slopes = gradient(ends, step)
    if not (np.isfinite(slopes).all() and np.linalg.det(slopes) != 0.0):
        return np.full((2, 2), np.nan)
    return np.asarray(np.linalg.inv(slopes), dtype=np.float64)


def stays(system: OpticalSystem, chief: Rays, states: States) -> bool:
    """Tell whether the chief ray surely meets the stop's center at all instants, without a trace.

    It does where nothing up to the stop moves as a rigid body and nothing before the stop deforms. A stop
    that deforms itself, such as a mirror, moves the point only of a ray that is not upright to it.
    """
    if states.surface_motion[:, : system.stop + 1].any() or states.line_of_sight.any():
        return False
    upright = not (system.surfaces[system.stop].rotation.T @ chief.direction[:, 0])[:2].any()
    given = states.deformations[: system.stop + (not (upright and system.stop == 0))]
    return not any(numbers is not None and numbers.any() for numbers in given)


def follow_stop(
    system: OpticalSystem, sequence: Sequence, chief: Rays, steer: Array, light: Moving
) -> Moving:
    """Return the moving parts with the incoming light moved so that its chief ray meets the stop's center.

    Parameters
    ----------
    system : OpticalSystem
    sequence : Sequence
        Its surfaces.
    chief : Rays
        One ray, which meets the center of the stop at rest.
    steer : ndarray, shape (2, 2)
        See `steering`.
    light : Moving
        T instants.

    Returns
    -------
    Moving
        The same where chief rays meet the center to 1e-9 mm as it is. An instant in which no motion of the
        light brings the chief ray there is left as it is.
    """
    far = not np.isfinite(system.object_distance)
    met = _meet(sequence, chief, light, system.stop)
    numbers = np.zeros_like(met)
    going = ~_centered(met) & np.isfinite(met).all(axis=1)
    if not (going.any() and np.isfinite(steer).all()):
        return light
    for _ in range(_STEPS):
        correction = np.stack([steer[i, 0] * met[:, 0] + steer[i, 1] * met[:, 1] for i in (0, 1)], axis=1)
        numbers = np.where(going[:, None], numbers - correction, numbers)
        moved = _moved(light, chief, numbers, far)
        met = _meet(sequence, chief, moved, system.stop)
        going = ~_centered(met) & np.isfinite(met).all(axis=1)
        if not going.any():
            break
    aimed = _centered(met)
    return moved if aimed.all() else _moved(light, chief, np.where(aimed[:, None], numbers, 0.0), far)


def _centered(met: Array) -> NDArray[np.bool_]:
    """Tell which of the points (T, 2) of the stop are its center."""
    return np.asarray((np.abs(met) <= _CENTERED).all(axis=1))


def meet_stop(sequence: Sequence, rays: Rays, light: Moving, stop: int) -> Array:
    """Return where rays meet the stop, which does nothing, in its frame at each instant, (2, T, N) in mm."""
    count = stop + 1
    elements = sequence.elements[:count]
    part = replace(sequence, elements=(*elements[:-1], replace(elements[-1], action="pass")))
    short = Moving(light.poses[:, :count], light.deformations[:count], light.grids[:count])
    traced = trace_sequence_numpy(part, rays, short, ignore_apertures=True)
    return np.stack([traced.x, traced.y])


def _meet(sequence: Sequence, chief: Rays, light: Moving, stop: int) -> Array:
    """Return where the chief ray meets the stop, (T, 2)."""
    return meet_stop(sequence, chief, light, stop)[:, :, 0].T


def _moved(light: Moving, chief: Rays, numbers: Array, far: bool) -> Moving:
    """Return the moving parts with light that is shifted, or turned about the object, by numbers (T, 2).

    Zeros leave an instant as it is, to the last bit.
    """
    flat = np.concatenate([numbers, np.zeros((len(numbers), 1))], axis=1)
    first = light.poses[:, 0].copy()
    rotation = first[:, :9].reshape(-1, 3, 3)
    if far:
        wide = chief.direction[2, 0] < _SIDEWAYS
        shift = numbers @ axes_across(chief.direction[:, 0]).T if wide else flat
    else:
        turn, point = cardan(flat), chief.position[:, 0]
        shift = point - _product(turn, point[None, :, None])[..., 0]
    first[:, 9:] += _product(rotation, shift[..., None])[..., 0]
    if not far:
        first[:, :9] = _product(rotation, turn).reshape(-1, 9)
    first = np.where((numbers != 0.0).any(axis=1)[:, None], first, light.poses[:, 0])
    return replace(light, poses=np.concatenate([first[:, None], light.poses[:, 1:]], axis=1))


def _product(left: Array, right: Array) -> Array:
    """Return matrix products (T, 3, K) whose bits do not depend on T."""
    total = left[:, :, :1] * right[:, :1]
    for k in (1, 2):
        total = total + left[:, :, k : k + 1] * right[:, k : k + 1]
    return np.asarray(total)
