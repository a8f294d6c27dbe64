"""Where the surfaces of a system stand: prescriptions by rows, relative and absolute poses, motions.

A pose is a position (3,) and a rotation (3, 3). Absolute poses are given in the system's frame, relative ones
in the frame of the previous surface (Störkle 2018, section 4.2.1).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.optics.checks import all_within, array, require_fields, require_kind, whole
from wavequake.optics.media.glasses import AIR, Medium
from wavequake.optics.media.gradients import GradientIndex
from wavequake.optics.segments.kinematics import cardan, displaced
from wavequake.optics.shapes.phases import Effect
from wavequake.optics.shapes.shapes import (
    Conic,
    Deformation,
    Opening,
    Shape,
    SurfaceAction,
    ZernikeDeformation,
)
from wavequake.optics.systems.system import LARGEST, OpticalSystem, States, Surface

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SurfaceRow:
    """A line of a prescription: a surface, and how far along z the next one stands.

    ``thickness`` is signed, since z keeps the sense of the incoming light: it is negative after an odd number
    of mirrors.
    """

    name: str
    shape: Shape = field(default_factory=Conic)
    thickness: float = 0.0
    action: SurfaceAction = "pass"
    medium: Medium | GradientIndex = AIR
    opening: Opening | None = None
    deformation: Deformation | None = None
    phase: Effect | None = None


@dataclass(frozen=True)
class Break:
    """A line of a prescription that moves the frame in which all later rows are given.

    First by ``decenter`` (x, y, z) in mm, then by ``tilt``, Cardan angles x-y-z in rad; with ``tilt_first``
    the other way round, which undoes a break whose numbers are negative. Then the next row stands
    ``thickness`` further along the new z.
    """

    decenter: tuple[float, float, float] = (0.0, 0.0, 0.0)
    tilt: tuple[float, float, float] = (0.0, 0.0, 0.0)
    tilt_first: bool = False
    thickness: float = 0.0


def sequential(rows: Sequence[SurfaceRow | Break]) -> tuple[Surface, ...]:
    """Place the surfaces of a prescription one after the other; the first row stands at the origin.

    A fold mirror at 45 degrees lies between two breaks of 45 degrees (Störkle 2018, Table 4.2).

    Raises
    ------
    UserError
        If a thickness, decenter or tilt is not a finite number, or there is no surface.
    """
    position, rotation = np.zeros(3), np.eye(3)
    surfaces = []
    for number, row in enumerate(rows, start=1):
        require_kind(row, SurfaceRow | Break, f"row {number} of the prescription")
        require_fields(row, f"row {number} of the prescription")
        if isinstance(row, Break):
            if not np.isfinite([*row.decenter, *row.tilt]).all():
                raise UserError(f"row {number} of the prescription moves the frame by a number not finite")
            turn = cardan(np.array(row.tilt))
            shift = np.array(row.decenter)
            position = position + rotation @ (turn @ shift if row.tilt_first else shift)
            rotation = rotation @ turn
        else:
            surfaces.append(
                Surface(
                    row.name,
                    row.shape,
                    position,
                    rotation,
                    row.action,
                    row.medium,
                    row.opening,
                    row.deformation,
                    row.phase,
                )
            )
        if not np.isfinite(row.thickness):
            raise UserError(f"the thickness of row {number} of the prescription is {row.thickness} mm")
        position = position + row.thickness * rotation[:, 2]
    if not surfaces:
        raise UserError("the prescription has no surface; it needs at least an image plane")
    return tuple(surfaces)


def relative_poses(position: Array, rotation: Array) -> tuple[Array, Array]:
    """Return each surface's pose in the frame of its predecessor (Störkle 2018, Eq. 4.2, solved).

    Parameters
    ----------
    position : ndarray, shape (..., L, 3)
    rotation : ndarray, shape (..., L, 3, 3)

    Returns
    -------
    position, rotation : ndarray
        Of the same shapes; the first pose is relative to the system's frame, that is, absolute.
    """
    before = np.concatenate(
        [np.broadcast_to(np.eye(3), (*rotation.shape[:-3], 1, 3, 3)), rotation[..., :-1, :, :]], axis=-3
    )
    step = np.diff(position, axis=-2, prepend=np.zeros((*position.shape[:-2], 1, 3)))
    back = np.swapaxes(before, -1, -2)
    return (back @ step[..., None])[..., 0], back @ rotation


def absolute_poses(position: Array, rotation: Array) -> tuple[Array, Array]:
    """Return poses in the system's frame from relative ones (Störkle 2018, Eq. 4.2).

    Parameters
    ----------
    position : ndarray, shape (..., L, 3)
    rotation : ndarray, shape (..., L, 3, 3)
    """
    positions, rotations = [], []
    at, turned = np.zeros(3), np.eye(3)
    for surface in range(position.shape[-2]):
        at = at + (turned @ position[..., surface, :, None])[..., 0]
        turned = turned @ rotation[..., surface, :, :]
        positions.append(at)
        rotations.append(turned)
    return np.stack(positions, axis=-2), np.stack(rotations, axis=-3)


def relative_changes(position: Array, rotation: Array, rest: tuple[Array, Array]) -> tuple[Array, Array]:
    """Return the relative displacements and rotations against the poses at rest (Störkle 2018, Eq. 4.4).

    Parameters
    ----------
    position : ndarray, shape (..., L, 3)
        Absolute, at the instants.
    rotation : ndarray, shape (..., L, 3, 3)
    rest : tuple of ndarray, shape (L, 3) and (L, 3, 3)
        Absolute, at rest.
    """
    now, then = relative_poses(position, rotation), relative_poses(*rest)
    return now[0] - then[0], np.swapaxes(then[1], -1, -2) @ now[1]


def rest_poses(system: OpticalSystem) -> tuple[Array, Array]:
    """Return positions (L, 3) and rotations (L, 3, 3) of the surfaces at rest, in the system's frame."""
    position = np.array([surface.position for surface in system.surfaces], dtype=np.float64)
    return position, np.array([surface.rotation for surface in system.surfaces], dtype=np.float64)


def moved_poses(system: OpticalSystem, motion: Array) -> tuple[Array, Array]:
    """Return the absolute poses of surfaces that move in their own frames.

    Parameters
    ----------
    system : OpticalSystem
    motion : ndarray, shape (T, L, 6)
        Displacements in mm and Cardan angles in rad.

    Returns
    -------
    position, rotation : ndarray, shape (T, L, 3) and (T, L, 3, 3)

    Raises
    ------
    UserError
        If the motion has the wrong shape or is not finite.
    """
    require_motion(system, motion)
    return displaced(*rest_poses(system), motion)


def motion_about(point: Array, rotation: Array) -> Array:
    """Return the shift of a frame that a rotation about another point causes (Störkle 2018, Eq. 4.6).

    Parameters
    ----------
    point : ndarray, shape (..., 3)
        In the frame of the surface.
    rotation : ndarray, shape (..., 3, 3)
    """
    shift: Array = point - (rotation @ point[..., None])[..., 0]
    return shift


def require_motion(system: OpticalSystem, motion: Array) -> None:
    """Raise UserError unless the motion is an array (T, L, 6) of numbers that can be traced."""
    motion = array(motion, f"the motion of the surfaces of {system.name}")
    if motion.ndim != 3 or motion.shape[1:] != (len(system.surfaces), 6):
        raise UserError(
            f"the motion of the surfaces of {system.name} has the shape {motion.shape}, it must be "
            f"(instants, {len(system.surfaces)}, 6)"
        )
    if all_within(motion, LARGEST):
        return
    size, known = np.abs(motion), np.isfinite(motion)
    instant, surface, _ = np.argwhere(size > LARGEST if known.all() else ~known)[0]
    name = system.surfaces[surface].name
    if not known.all():
        raise UserError(f"the motion of {name} at instant {instant} is not a finite number")
    raise UserError(
        f"the motion of {name} at instant {instant} is {size[instant, surface].max():.3g}; it must be at "
        f"most {LARGEST:g} mm or rad"
    )


def rest_states(system: OpticalSystem, instants: int = 1) -> States:
    """Return the states of a system in which nothing moves or deforms, writable arrays of zeros.

    Raises
    ------
    UserError
        If the instants are no number from 0.

    Examples
    --------
    >>> rest_states(telescope("tmt-18"), 3).segment_motion.shape  # doctest: +SKIP
    (3, 18, 6)
    """
    require_kind(system, OpticalSystem, "the system")
    if whole(instants, "the number of instants") < 0:
        raise UserError(f"the number of instants is {instants}; it must be at least 0")
    segments = None if system.segmented is None else system.segments
    count, terms = (0, 0) if segments is None else (len(segments), segments.figure_terms)
    return States(
        surface_motion=np.zeros((instants, len(system.surfaces), 6)),
        deformations=tuple(_no_deformation(surface.deformation, instants) for surface in system.surfaces),
        line_of_sight=np.zeros((instants, 2)),
        segment_motion=np.zeros((instants, count, 6)),
        segment_figure=np.zeros((instants, count, terms)),
    )


def at_instant(states: States, instant: int) -> States:
    """Return the states of one instant alone."""
    return _each(lambda one: one[instant : instant + 1], states)


def joined(parts: Sequence[States]) -> States:
    """Return the states of parts of a case, one after the other."""
    return _each(lambda *one: np.concatenate(one), *parts)


def _each(change: Callable[..., Array], *parts: States) -> States:
    """Return states of which each array is what becomes of the same array of the given ones."""
    arrays = {
        name: change(*(getattr(one, name) for one in parts))
        for name in ("surface_motion", "line_of_sight", "segment_motion", "segment_figure")
    }
    forms = zip(*(one.deformations for one in parts), strict=True)
    return States(deformations=tuple(None if one[0] is None else change(*one) for one in forms), **arrays)


def _no_deformation(deformation: Deformation | None, instants: int) -> Array | None:
    if deformation is None:
        return None
    if isinstance(deformation, ZernikeDeformation):
        return np.zeros((instants, deformation.size))
    return np.zeros((instants, deformation.rows, deformation.columns))
