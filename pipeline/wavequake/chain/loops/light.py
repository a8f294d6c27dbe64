"""What the sensors of a loop see."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from wavequake.mechanics.disturbances.layout import SegmentLayout
from wavequake.mechanics.disturbances.motion import RAD_PER_MAS

Array = NDArray[np.float64]


@dataclass(frozen=True)
class RayLight:
    """Light at the pupil by rays, of a batch of instants.

    Attributes
    ----------
    x, y : ndarray, shape (N,)
        Where rays enter the pupil, mm.
    weight : ndarray, shape (N,)
        Share of the light.
    phase : ndarray, shape (batch, N)
        In waves, about the line of sight at rest; it rises to where the image goes.
    """

    x: Array
    y: Array
    weight: Array
    phase: Array


@dataclass(frozen=True)
class Light:
    """What sensors see: the line of sight x, y in mas and Noll coefficients 4..J of the wavefront in nm.

    Where a sensor sees bodies themselves, dz (nm), rx and ry (nrad) of all segments follow, then M2's dx, dy,
    dz (nm), rx, ry, rz (nrad), then nodes of the structure (nm).

    Attributes
    ----------
    terms : int
        J.
    obscuration, radius_mm : float
        Of the pupil.
    layout : SegmentLayout
        The segments of M1.
    bodies_too : bool
        Whether motions of bodies are seen.
    nodes : tuple of str
    movable : mapping of str to ndarray, shape (6, L, 6)
        Motions of the L surfaces, as states of a telescope take them, per dx, dy, dz (mm), rx, ry
        and rz (rad) of each surface or body of surfaces by name.
    wavelength_nm : float
        0: there is none.
    """

    terms: int
    obscuration: float
    radius_mm: float
    layout: SegmentLayout
    bodies_too: bool = False
    nodes: tuple[str, ...] = ()
    movable: Mapping[str, Array] = field(default_factory=dict)
    wavelength_nm: float = 0.0

    @property
    def optical(self) -> int:
        """Number of entries that are light."""
        return self.terms - 1

    def __len__(self) -> int:
        return self.optical + (self.bodies if self.bodies_too else 0)

    @property
    def bodies(self) -> int:
        """Number of entries that are motions of bodies."""
        return 3 * len(self.layout) + 6 + len(self.nodes)

    @property
    def tilt(self) -> float:
        """Noll tilt of the wavefront, nm, of 1 mas of line of sight: OPD falls to where the image goes."""
        size = self.radius_mm * 1e6 * RAD_PER_MAS
        return float(-0.5 * np.hypot(1.0, self.obscuration) * size)

    @property
    def noll(self) -> Array:
        """From what sensors see to Noll coefficients 2..J in nm, (J - 1, J - 1)."""
        return np.diag([self.tilt, self.tilt, *np.ones(self.terms - 3)])
