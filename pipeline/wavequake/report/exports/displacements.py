"""The displacements of surfaces at an instant of a case, a text file for each, as Zemax STAR takes them."""

import re
from collections.abc import Iterator
from math import inf, pi
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.optics.rays.pupils import sunflower
from wavequake.optics.shapes.shapes import GridDeformation, GridSag, ZernikeDeformation, ZernikeSag
from wavequake.optics.systems.bodies import beam_radii
from wavequake.optics.systems.kinematics import moved_poses
from wavequake.optics.systems.system import OpticalSystem, States, Surface
from wavequake.report.exports.case_states import disturbed

Array = NDArray[np.float64]

_POINTS, _RIM = 2000, 180  # over the surface, and on its edge


def export_displacements(
    store: Path, path: Path, case: int, instant: int = 0, overwrite: bool = False, under: str = ""
) -> tuple[Path, ...]:
    """Write ``NAME-SURFACE.txt`` for NAME.txt and each surface that moves or deforms: lines x y z dx dy dz.

    All is in mm and in the frame of the surface at rest, about its vertex: points of the surface and how far
    the motion and the figure of the case bring them. Return the files.

    Raises
    ------
    UserError
        If there is no such case or instant, the store's workflow has no optical system of surfaces, nothing
        moves, or a file exists and shall not be overwritten.
    """
    system, states = disturbed(store, case, under)
    count = len(states.surface_motion)
    if not 0 <= instant < count:
        raise UserError(f"There are {count} instants, 0 to {count - 1}; there is no instant {instant}.")
    tables = dict(displacements(system, states, instant))
    if not tables:
        raise UserError(f"No surface moves or deforms in case {case} at instant {instant}.")
    files = {
        index: path.with_name(f"{path.stem}-{index + 1}-{_plain(system, index)}.txt") for index in tables
    }
    for file in files.values():
        if file.exists() and not overwrite:
            raise UserError(f"{file} exists already; choose another name or give --overwrite.")
    for index, file in files.items():
        np.savetxt(file, tables[index], fmt="%.17g")
    return tuple(file.resolve() for file in files.values())


def displacements(system: OpticalSystem, states: States, instant: int) -> Iterator[tuple[int, Array]]:
    """Yield each surface that moves or deforms, by index: rows x y z dx dy dz (p, 6) in its frame, mm."""
    position, rotation = moved_poses(system, states.surface_motion[instant : instant + 1])
    figures = [None if one is None or not one[instant].any() else one[instant] for one in states.deformations]
    moving = [
        index
        for index, figure in enumerate(figures)
        if figure is not None or states.surface_motion[instant, index].any()
    ]
    for index in moving:
        surface, figure = system.surfaces[index], figures[index]
        x, y = _spread(_radius(system, index))
        z = np.asarray(surface.shape.sag(x, y)[0])
        raised = z if figure is None else z + _heights(surface, figure, x, y)
        home = np.asarray(surface.rotation)
        turn, shift = home.T @ rotation[0, index], home.T @ (position[0, index] - surface.position)
        points = np.stack([x, y, z], axis=1)
        moved = np.stack([x, y, raised], axis=1) @ turn.T + shift
        yield index, np.hstack([points, moved - points])


def _spread(radius: float) -> tuple[Array, Array]:
    inside, angle = sunflower(0.0, radius, _POINTS), 2.0 * pi * np.arange(_RIM) / _RIM
    return (
        np.concatenate([inside.x, radius * np.cos(angle)]),
        np.concatenate([inside.y, radius * np.sin(angle)]),
    )


def _radius(system: OpticalSystem, index: int) -> float:
    """Return how far from its vertex a surface deforms, its edge lies, or beams reach, mm."""
    surface = system.surfaces[index]
    if isinstance(surface.deformation, ZernikeDeformation):
        return surface.deformation.pupil_radius
    opening = surface.opening
    if opening is not None and np.isfinite(opening.outer):
        return float(opening.outer + np.hypot(*opening.center))
    return float(beam_radii(system, [index])[0])


def _heights(surface: Surface, numbers: Array, x: Array, y: Array) -> Array:
    """Return the heights of a figure along z: those of shapes over a plane."""
    form = surface.deformation
    if isinstance(form, GridDeformation):
        return _grid(form, numbers, x, y)
    assert isinstance(form, ZernikeDeformation)
    terms = tuple(numbers[: form.terms].tolist())
    heights = np.asarray(ZernikeSag(inf, 0.0, terms, form.pupil_radius, form.obscuration).sag(x, y)[0])
    if form.residual is not None:
        heights = heights + _grid(form.residual, numbers[form.terms :], x, y)
    return heights


def _grid(form: GridDeformation, heights: Array, x: Array, y: Array) -> Array:
    grid = GridSag(inf, 0.0, heights.reshape(form.rows, form.columns), form.dx, form.dy)
    return np.asarray(grid.sag(x, y)[0])


def _plain(system: OpticalSystem, index: int) -> str:
    return re.sub(r"\W+", "-", system.surfaces[index].name).strip("-")
