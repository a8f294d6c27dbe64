"""A system as it stands at an instant: moved and deformed surfaces, and turned light, as a system at rest.

A conic or even asphere that deforms by polynomials is a Zernike sag, one that does on a grid a Grid Sag;
other shapes become heights on a grid that is fine enough for 1e-5 waves (`wavequake.optics.systems.on_grid`).
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.optics.polynomials.transforms import powers_as_zernike, transform_coefficients
from wavequake.optics.rays.packing import bundle_rotation
from wavequake.optics.shapes.shapes import (
    Conic,
    EvenAsphere,
    GridDeformation,
    GridSag,
    Shape,
    ZernikeDeformation,
    ZernikeSag,
)
from wavequake.optics.systems.bodies import beam_extents
from wavequake.optics.systems.kinematics import at_instant, moved_poses
from wavequake.optics.systems.on_grid import on_grid
from wavequake.optics.systems.system import OpticalSystem, States, Surface, is_wide

Array = NDArray[np.float64]


def frozen(system: OpticalSystem, states: States, instant: int = 0) -> OpticalSystem:
    """Return the system at an instant, with nothing left that moves or deforms.

    The light of a near object that turns is the system that turns the other way.

    Raises
    ------
    UserError
        If there is no such instant, or no grid holds a surface and its deformation well enough.
    """
    count = len(states.surface_motion)
    if not 0 <= instant < count:
        raise UserError(f"There are {count} instants, 0 to {count - 1}; there is no instant {instant}.")
    (position,), (rotation,) = moved_poses(system, states.surface_motion[instant : instant + 1])
    fields, turned = system.fields, states.line_of_sight[instant : instant + 1]
    if turned.any():
        (turn,), (shift,) = bundle_rotation(system, turned)
        if np.isfinite(system.object_distance):
            position, rotation = (position - shift) @ turn, turn.T @ rotation
        else:
            fields = _turned(fields, turn)
    surfaces = []
    for index, surface in enumerate(system.surfaces):
        given = states.deformations[index]
        shape = surface.shape if given is None else deformed_shape(surface, given[instant])
        if shape is None:
            assert given is not None
            reach = [beam_extents(system, [index], one)[0] for one in (None, at_instant(states, instant))]
            shape = on_grid(surface, given[instant], np.max(reach, axis=0))
        surfaces.append(
            replace(
                surface, shape=shape, deformation=None, position=position[index], rotation=rotation[index]
            )
        )
    moved = surfaces[0].position[2] - system.surfaces[0].position[2]
    return replace(
        system,
        surfaces=tuple(surfaces),
        object_distance=system.object_distance + float(moved),
        fields=fields,
    )


def _turned(fields: Array, turn: Array) -> Array:
    """Return the angles of fields whose directions a rotation turns."""
    if is_wide(fields):
        raise UserError("Light that turns and comes from 85 degrees off the axis or more cannot be written.")
    slopes = np.tan(fields)
    directions = np.concatenate([slopes, np.ones((len(slopes), 1))], axis=1) @ turn.T
    angles: Array = np.arctan(directions[:, :2] / directions[:, 2:])
    return angles


def deformed_shape(surface: Surface, numbers: Array) -> Shape | None:
    """Return a shape and its deformation as one, if there is a form that holds both."""
    shape, form = surface.shape, surface.deformation
    if not numbers.any():
        return shape
    found: Shape | None = shape
    grid, rough = form, numbers
    if isinstance(form, ZernikeDeformation):
        grid, rough = form.residual, numbers[form.terms :]
        found = _with_zernike(shape, form, numbers[: form.terms])
    if found is not None and isinstance(grid, GridDeformation) and rough.any():
        found = _with_grid(found, grid, rough.reshape(grid.rows, grid.columns))
    return found


def _with_zernike(shape: Shape, form: ZernikeDeformation, terms: Array) -> ZernikeSag | GridSag | None:
    """Return a shape and polynomials that deform it as one, if it is a sum of such polynomials but a grid.

    Powers of an even asphere are finite sums of them, and those over a ring of those over a circle.
    """
    norm, ring = form.pupil_radius, form.obscuration
    if isinstance(shape, Conic):
        return ZernikeSag(shape.radius, shape.conic, tuple(terms.tolist()), norm, ring)
    if isinstance(shape, EvenAsphere):
        powers = powers_as_zernike(shape.coefficients, norm) if any(shape.coefficients) else ()
        return ZernikeSag(shape.radius, shape.conic, _sum(powers, 0.0, terms, ring), norm, ring)
    if isinstance(shape, ZernikeSag) and shape.pupil_radius == norm:
        return replace(
            shape, coefficients=_sum(shape.coefficients, shape.obscuration, terms, ring), obscuration=ring
        )
    if isinstance(shape, GridSag) and (not shape.zernike or shape.pupil_radius == norm):
        circular = transform_coefficients(terms, ring, 0.0)
        return replace(shape, zernike=_sum(shape.zernike, 0.0, circular, 0.0), pupil_radius=norm)
    return None


def _sum(own: Sequence[float], source: float, terms: Array, target: float) -> tuple[float, ...]:
    """Return the sum of polynomials over two rings as polynomials over the second."""
    moved = transform_coefficients(np.array(own), source, target) if len(own) else np.zeros(0)
    total = np.zeros(max(len(moved), len(terms)))
    total[: len(moved)] += moved
    total[: len(terms)] += terms
    return tuple(total.tolist())


def _with_grid(shape: Shape, form: GridDeformation, heights: Array) -> GridSag | None:
    """Return a shape and heights on a grid as one surface, if grids are kept over such a shape."""
    on_conic = GridSag(shape.radius, shape.conic, heights, form.dx, form.dy)
    if isinstance(shape, Conic):
        return on_conic
    if isinstance(shape, EvenAsphere):
        return replace(on_conic, even=shape.coefficients)
    if isinstance(shape, ZernikeSag) and not shape.obscuration:
        return replace(on_conic, zernike=shape.coefficients, pupil_radius=shape.pupil_radius)
    same = isinstance(shape, GridSag) and (shape.heights.shape, shape.dx, shape.dy) == (
        heights.shape,
        form.dx,
        form.dy,
    )
    if same:
        assert isinstance(shape, GridSag)
        return replace(shape, heights=shape.heights + heights)
    return None
