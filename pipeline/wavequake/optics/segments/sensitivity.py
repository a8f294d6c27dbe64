"""Kinematic-optical sensitivities: how wavefront and line of sight follow small motions and figures.

One column of the matrix C_a of Störkle 2018, Eq. 4.21 per degree of freedom, by central differences of full
ray traces (section 4.4.1; Eq. 4.24 is M2's tilt columns, Eq. 4.26 the columns of a figure). A pair of
instants of a batch is one column, so that the matrices of hundreds of segments are a few launches.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.kernels.device.devices import Device
from wavequake.kernels.device.tiles import TILE, padded
from wavequake.optics.derivatives.central import (
    BY_ELEMENT,
    DOFS,
    FAINT,
    TOLERANCE,
    Differences,
    Indices,
    SensitivityMatrix,
    Steps,
    differences,
    sensitivity_matrix,
    weighted_rms,
)
from wavequake.optics.segments.kinematics import carried_segments
from wavequake.optics.segments.prepared import PreparedTrace, chief_rays, trace_states
from wavequake.optics.segments.telescope import M2
from wavequake.optics.segments.wavefront import analyse, measure
from wavequake.optics.systems.kinematics import rest_states
from wavequake.optics.systems.system import States

Array = NDArray[np.float64]
# Writes into states at instants (K,) how far (K,) elements (K,) move in their degrees of freedom (K,).
_Move = Callable[[States, Indices, Indices, Indices, Array], None]

_LAUNCH_TILES = 32  # about 40 MB per output array at 9000 rays
_LAUNCH_NUMBERS = 2**24  # and no more motions, poses and figures of segments than this


@dataclass(frozen=True)
class Sensitivities:
    """The matrices of a telescope: M1 as one rigid body, surfaces after it, its segments, figures of both."""

    primary: SensitivityMatrix
    surfaces: SensitivityMatrix
    segments: SensitivityMatrix
    figures: SensitivityMatrix | None
    mirrors: SensitivityMatrix | None

    @property
    def all_surfaces(self) -> SensitivityMatrix:
        """M1 as one rigid body and the surfaces after it."""
        both = (self.primary, self.surfaces)
        joined: dict[str, Any] = {
            name: np.concatenate([getattr(one, name) for one in both]) for name in BY_ELEMENT
        }
        return replace(self.surfaces, elements=self.primary.elements + self.surfaces.elements, **joined)


def sensitivities(
    prepared: PreparedTrace,
    device: Device,
    steps: Steps | None = None,
    tolerance: float = TOLERANCE,
) -> Sensitivities:
    """Return the kinematic-optical sensitivities about the reference configuration.

    Surfaces move about their vertices in their own frames at rest, M1 with all its segments, too;
    segments by themselves about their centers in their local frames (see `States`). Nothing is
    inverted here; rows of piston and tilt never should be.

    Parameters
    ----------
    prepared : PreparedTrace
        Its numbers of figure terms are those of the figures' matrices.
    device : Device
    steps : Steps, optional
    tolerance : float
        See `SensitivityMatrix.disagreement`; whether it is kept is said by `SensitivityMatrix.agrees`.

    Raises
    ------
    UserError
        If a step is not a positive number, or all rays are lost at rest.
    """
    steps = steps or Steps()
    steps.require()
    still = rest_states(prepared.system, TILE)
    terms, mirror_terms = prepared.figure_matrix.shape[2], prepared.mirror_matrix.shape[1]
    lost = int(measure(prepared, still, device).lost[0])
    if lost == len(prepared.rays.x):
        raise UserError(f"no ray of {prepared.system.name} reaches the image at rest; check the field point")
    rigid = np.repeat([steps.translation, steps.rotation], 3)
    surface_names = tuple(surface.name for surface in prepared.system.after_primary)
    segment_names = tuple(prepared.system.segments.names)
    figure_names = tuple(f"Z{j}" for j in range(1, max(terms, mirror_terms) + 1))

    def matrix(
        move: _Move, elements: Sequence[str], dofs: tuple[str, ...], sizes: Array
    ) -> SensitivityMatrix:
        def pairs(element: Indices, dof: Indices, size: Array) -> Differences:
            plus = 2 * np.arange(len(element))
            states = rest_states(prepared.system, padded(2 * len(element)))
            move(states, plus, element, dof, size)
            move(states, plus + 1, element, dof, -size)
            return _pair_differences(prepared, device, states, lost).first(len(element))

        # A tilt of the pupil by one unit, and the image's answer to it.
        turns = np.array([name in DOFS[3:] for name in dofs])
        radius, image = (
            np.where(turns, length, 1.0) for length in (prepared.system.annulus.outer, prepared.focal_length)
        )
        faint = (FAINT * np.abs(radius / prepared.wavelength), FAINT * np.abs(image))
        return sensitivity_matrix(pairs, _at_once(prepared), elements, dofs, sizes, faint, tolerance)

    return Sensitivities(
        primary=matrix(_together(prepared), ("M1",), DOFS, rigid),
        surfaces=matrix(_surface, surface_names, DOFS, rigid),
        segments=matrix(_one_by_one("segment_motion"), segment_names, DOFS, rigid),
        figures=matrix(
            _one_by_one("segment_figure"), segment_names, figure_names[:terms], np.full(terms, steps.figure)
        )
        if terms
        else None,
        mirrors=matrix(
            _mirror,
            surface_names[:-1],
            figure_names[:mirror_terms],
            np.full(mirror_terms, steps.figure),
        )
        if mirror_terms and len(surface_names) > 1
        else None,
    )


def _one_by_one(name: str) -> _Move:
    """Return how entries (element, dof) of an array of `States` move by themselves."""

    def move(states: States, instant: Indices, element: Indices, dof: Indices, size: Array) -> None:
        getattr(states, name)[instant, element, dof] = size

    return move


def _surface(states: States, instant: Indices, element: Indices, dof: Indices, size: Array) -> None:
    states.surface_motion[instant, M2 + element, dof] = size


def _mirror(states: States, instant: Indices, element: Indices, dof: Indices, size: Array) -> None:
    for number, figure in enumerate(states.deformations[M2:-1]):
        assert figure is not None
        mine = element == number
        figure[instant[mine], dof[mine]] = size[mine]


def _together(prepared: PreparedTrace) -> _Move:
    """Return how all segments move as one rigid body.

    Along the derivative of their motions: what is of second order has no part in a central difference.
    """
    carried = carried_segments(prepared.system.segments)

    def move(states: States, instant: Indices, element: Indices, dof: Indices, size: Array) -> None:
        states.segment_motion[instant] = size[:, None, None] * carried[dof]

    return move


def _at_once(prepared: PreparedTrace) -> int:
    """Return how many pairs of instants a launch has room for."""
    segments, _, terms = map(int, prepared.figure_matrix.shape)
    tiles = min(max(_LAUNCH_NUMBERS // (TILE * segments * (terms + 20)), 1), _LAUNCH_TILES)
    return tiles * TILE // 2


def _pair_differences(prepared: PreparedTrace, device: Device, states: States, lost: int) -> Differences:
    """Trace a batch of pairs of instants."""
    traced = trace_states(prepared, states, device)
    wavefront = analyse(prepared, traced, chief_rays(prepared, states), device)
    change = [(tile[:, 0::2] - tile[:, 1::2]).T for tile in traced.opd]
    rms = np.concatenate([weighted_rms(prepared.weight, one) for one in change]) / prepared.wavelength
    return differences(wavefront, rms, wavefront.lost == lost)
