"""A system as it stands at an instant: moved and deformed surfaces, and turned light, as a system at rest."""

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
from wavequake.optics.systems.kinematics import moved_poses
from wavequake.optics.systems.system import OpticalSystem, Surface, SystemStates

Array = NDArray[np.float64]


def frozen(system: OpticalSystem, states: SystemStates, instant: int = 0) -> OpticalSystem:
    """Return the system at an instant, with nothing left that moves or deforms.

    Raises
    ------
    UserError
        If there is no such instant, the light of a near object turns, or a surface has a form that no shape
        holds together with its deformation.
    """
    count = len(states.surface_motion)
    if not 0 <= instant < count:
        raise UserError(f"There are {count} instants, 0 to {count - 1}; there is no instant {instant}.")
    position, rotation = moved_poses(system, states.surface_motion[instant : instant + 1])
    surfaces = []
    for index, surface in enumerate(system.surfaces):
        given = states.deformations[index]
        shape = surface.shape if given is None else _deformed(surface, given[instant])
        surfaces.append(
            replace(
                surface,
                shape=shape,
                deformation=None,
                position=position[0, index],
                rotation=rotation[0, index],
            )
        )
    moved = surfaces[0].position[2] - system.surfaces[0].position[2]
    return replace(
        system,
        surfaces=tuple(surfaces),
        object_distance=system.object_distance + float(moved),
        fields=_turned(system, states.line_of_sight[instant]),
    )


def _turned(system: OpticalSystem, line_of_sight: Array) -> Array:
    if not line_of_sight.any():
        return system.fields
    if np.isfinite(system.object_distance):
        raise UserError(
            f"The light of {system.name} comes from a near object and turns, which fields cannot say."
        )
    turn, _ = bundle_rotation(system, line_of_sight[None])
    slopes = np.tan(system.fields)
    directions = np.concatenate([slopes, np.ones((len(slopes), 1))], axis=1) @ turn[0].T
    angles: Array = np.arctan(directions[:, :2] / directions[:, 2:])
    return angles


def _deformed(surface: Surface, numbers: Array) -> Shape:
    shape, form = surface.shape, surface.deformation
    if not numbers.any():
        return shape
    if isinstance(form, GridDeformation):
        if isinstance(shape, Conic):
            return GridSag(
                shape.radius, shape.conic, numbers.reshape(form.rows, form.columns), form.dx, form.dy
            )
    elif isinstance(form, ZernikeDeformation) and not numbers[form.terms :].any():
        terms = numbers[: form.terms]
        if isinstance(shape, Conic):
            return ZernikeSag(
                shape.radius, shape.conic, tuple(terms.tolist()), form.pupil_radius, form.obscuration
            )
        if isinstance(shape, EvenAsphere):
            shape = _with_zernike(shape, form)
        same = isinstance(shape, ZernikeSag) and (shape.pupil_radius, shape.obscuration) == (
            form.pupil_radius,
            form.obscuration,
        )
        if same:
            assert isinstance(shape, ZernikeSag)
            count = max(len(shape.coefficients), form.terms)
            total = np.zeros(count)
            total[: len(shape.coefficients)] += shape.coefficients
            total[: form.terms] += terms
            return replace(shape, coefficients=tuple(total.tolist()))
    raise UserError(
        f"The surface {surface.name} is a {type(shape).__name__} that deforms; no shape holds both (conics "
        "and even aspheres that deform by Zernike polynomials are known, and conics that do on a grid). "
        "Displacements, FILE.txt, hold all."
    )


def _with_zernike(shape: EvenAsphere, form: ZernikeDeformation) -> ZernikeSag:
    """Return an even asphere by the polynomials that deform it, of which its powers are finite sums."""
    powers = powers_as_zernike(shape.coefficients, form.pupil_radius) if any(shape.coefficients) else ()
    if powers and form.obscuration:
        powers = tuple(transform_coefficients(np.array(powers), 0.0, form.obscuration).tolist())
    return ZernikeSag(shape.radius, shape.conic, powers, form.pupil_radius, form.obscuration)
