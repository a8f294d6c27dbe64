"""Kinematic-optical sensitivities of any optical system at a field point and wavelength.

The columns of C_a of Störkle 2018, Eq. 4.21, for motions of surfaces and bodies (Eq. 4.24) and for figures of
surfaces (Eq. 4.26), by central differences of full traces with two steps; see
`wavequake.optics.derivatives.central` for the matrices themselves.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.kernels.device.devices import Device
from wavequake.kernels.trace.sequence import TracedRays
from wavequake.optics.derivatives.central import (
    DOFS,
    FAINT,
    Differences,
    Indices,
    SensitivityMatrix,
    Steps,
    differences,
    sensitivity_matrix,
    weighted_rms,
)
from wavequake.optics.shapes.shapes import ZernikeDeformation
from wavequake.optics.systems.bodies import Body, with_bodies
from wavequake.optics.systems.kinematics import rest_states
from wavequake.optics.systems.paraxial import paraxial
from wavequake.optics.systems.system import OpticalSystem, States
from wavequake.optics.wavefronts.reaiming import stop_slopes, trace_aimed
from wavequake.optics.wavefronts.wavefront import PreparedSystem, analyse_system, trace_system

Array = NDArray[np.float64]

_PAIRS = 32  # columns per launch, a constant shape

# From elements (K,), their degrees of freedom (K,) and how far each moves (K,) to the states of K instants.
_Move = Callable[[Indices, Indices, Array], States]


def rigid_sensitivity(
    prepared: PreparedSystem, bodies: Sequence[Body], device: Device, steps: Steps | None = None
) -> SensitivityMatrix:
    """Return how wavefront and line of sight follow motions of all surfaces and of the given bodies.

    A surface moves about its vertex in its own frame, a body about its point in its own. The image is a
    surface, too: it moves against the light.

    Parameters
    ----------
    prepared : PreparedSystem
    bodies : sequence of Body
    device : Device
    steps : Steps, optional

    Raises
    ------
    UserError
        If a step is not a positive number.
    """
    steps = _checked(steps, prepared.system)
    system = prepared.system
    count = len(system.surfaces)

    def move(element: Indices, dof: Indices, size: Array) -> States:
        rest = rest_states(system, len(element))
        own, instants = rest.surface_motion, np.arange(len(element))
        single = element < count
        own[instants[single], element[single], dof[single]] = size[single]
        carried = []
        for number, body in enumerate(bodies):
            moved, mine = np.zeros((len(element), 6)), element == count + number
            moved[instants[mine], dof[mine]] = size[mine]
            if mine.any():
                carried.append((body, moved))
        return replace(rest, surface_motion=with_bodies(system, own, carried))

    # A turn by 1 rad moves the far end of the system by its length, and tilts the pupil by its radius.
    length = float(np.ptp([surface.position for surface in system.surfaces], axis=0).max())
    radius = paraxial(system).stop_radius
    waves, image = (np.repeat([1.0, arm], 3) for arm in (radius, max(length, radius)))
    return _matrix(
        prepared,
        device,
        (*(surface.name for surface in system.surfaces), *(body.name for body in bodies)),
        DOFS,
        np.repeat([steps.translation, steps.rotation], 3),
        move,
        (FAINT * waves / prepared.wavelength, FAINT * image),
    )


def figure_sensitivity(
    prepared: PreparedSystem,
    surfaces: Sequence[int],
    terms: int,
    device: Device,
    steps: Steps | None = None,
) -> SensitivityMatrix:
    """Return how wavefront and line of sight follow Zernike figures of surfaces (heights along their z).

    Parameters
    ----------
    prepared : PreparedSystem
    surfaces : sequence of int
        Indices; each can deform by at least `terms` Noll terms.
    terms : int
    device : Device
    steps : Steps, optional

    Raises
    ------
    UserError
        If a surface cannot deform so, or the step is not a positive number.
    """
    steps = _checked(steps, prepared.system)
    system = prepared.system
    if not surfaces:
        raise UserError(f"no surface of {system.name} is named whose figure could act; give at least one")
    for index in surfaces:
        if not 0 <= index < len(system.surfaces):
            raise UserError(
                f"{system.name} has no surface {index}; it has {len(system.surfaces)}, counted from 0"
            )
        form = system.surfaces[index].deformation
        if not isinstance(form, ZernikeDeformation) or form.terms < terms:
            raise UserError(
                f"the surface {system.surfaces[index].name} of {system.name} cannot deform by {terms} "
                "Zernike terms"
            )

    def move(element: Indices, dof: Indices, size: Array) -> States:
        states = rest_states(system, len(element))
        for number, index in enumerate(surfaces):
            form, mine = states.deformations[index], np.flatnonzero(element == number)
            if form is not None:
                form[mine, dof[mine]] = size[mine]
        return states

    aperture = float(np.abs(np.linalg.det(prepared.cosines))) ** 0.5
    return _matrix(
        prepared,
        device,
        tuple(system.surfaces[index].name for index in surfaces),
        tuple(f"Z{j}" for j in range(1, terms + 1)),
        np.full(terms, steps.figure),
        move,
        (np.full(terms, FAINT / prepared.wavelength), np.full(terms, FAINT / aperture)),
    )


def default_steps(system: OpticalSystem) -> Steps:
    """Return steps that move a rim of the stop's size about as far by a turn as by a shift.

    The thesis' 1e-6 rad suits a telescope; a lens of a few millimeters turned by it drowns in rounding, and
    10 nm of figure on it are so steep that they act nonlinearly.
    """
    radius = paraxial(system).stop_radius
    turn = min(max(Steps.translation / radius, Steps.rotation), 1e-4)
    return Steps(rotation=turn, figure=min(max(1e-6 * radius, 1e-6), Steps.figure))


def _checked(steps: Steps | None, system: OpticalSystem) -> Steps:
    steps = steps or default_steps(system)
    steps.require()
    return steps


def _matrix(
    prepared: PreparedSystem,
    device: Device,
    elements: tuple[str, ...],
    dofs: tuple[str, ...],
    sizes: Array,
    move: _Move,
    faint: tuple[Array, Array],
) -> SensitivityMatrix:
    """Return the matrix; `faint` are scales (D,) of derivatives of waves and of millimeters."""
    lost = ~np.isfinite(trace_system(prepared, rest_states(prepared.system), device)[0][0])
    slopes = stop_slopes(prepared)

    def pairs(element: Indices, dof: Indices, size: Array) -> Differences:
        count = len(element)
        column = np.repeat(np.minimum(np.arange(_PAIRS), count - 1), 2)
        states = move(element[column], dof[column], np.tile([1.0, -1.0], _PAIRS) * size[column])
        return _differences(prepared, trace_aimed(prepared, slopes, states, device), lost).first(count)

    return sensitivity_matrix(pairs, _PAIRS, elements, dofs, sizes, faint)


def _differences(
    prepared: PreparedSystem, traced: tuple[Array, TracedRays, Array], lost: NDArray[np.bool_]
) -> Differences:
    """Return the differences of pairs of instants."""
    opd = traced[0]
    same = (np.isfinite(opd) == ~lost).all(axis=1)
    rms = weighted_rms(prepared.fit.weight, opd[0::2] - opd[1::2])
    return differences(analyse_system(prepared, *traced), rms, same)
