"""A circular or annular pupil with a wavefront, by frequency (Störkle 2018, Eq. 3.68 and 3.69)."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError

Real = NDArray[np.float64]
Complex = NDArray[np.complex128]

# Distance from the rim, in pupil radii, within which a point lies on it.
_ON_THE_RIM = 1e-9


@dataclass(frozen=True)
class PupilShape:
    """What the pupil lets through.

    Attributes
    ----------
    obscuration : float
        Inner over outer radius.
    wavefront : callable, optional
        OPD in waves at x and y in pupil radii, arrays of one shape; none is a perfect system. Where it rises
        along +x, the image moves to +x.
    """

    obscuration: float = 0.0
    wavefront: Callable[[Real, Real], Real] | None = None

    def __post_init__(self) -> None:
        """Refuse a pupil without light."""
        if not 0.0 <= self.obscuration < 1.0:
            raise UserError(f"the obscuration is {self.obscuration}; it must lie in 0 <= obscuration < 1")

    def waves(self, x: Real, y: Real) -> Real:
        """Return the OPD (n,) in waves at x and y (n,) in pupil radii.

        Raises
        ------
        UserError
            If it is not finite somewhere, or the wavefront returns another shape.
        """
        if self.wavefront is None:
            return np.zeros(x.shape)
        found = np.asarray(self.wavefront(x, y), dtype=np.float64)
        if found.shape not in ((), x.shape):
            raise UserError(f"the wavefront at {x.shape} places needs as many numbers, not {found.shape}")
        if not np.isfinite(found).all():
            raise UserError("the wavefront is not finite in the whole pupil, so there is no image")
        return np.broadcast_to(found, x.shape)


def coherent_transfer(pupil: PupilShape, x: Real, y: Real) -> Complex:
    """Return the coherent transfer function at frequencies x and y, which broadcast, per wavelength/diameter.

    It is 1 within the pupil, 1/2 on its rims and 0 outside, times exp(+2 pi i W). An image is the transform
    of the pupil by exp(-2 pi i f x), so that a frequency passes at the opposite place of the pupil, and an
    OPD that rises along +x moves the image to +x.

    Raises
    ------
    UserError
        If the wavefront is not finite somewhere in the pupil, or has another shape than the places.
    """
    across, down = np.broadcast_arrays(-2.0 * np.asarray(x), -2.0 * np.asarray(y))
    radius = np.hypot(across, down)
    passed = _step(1.0 - radius)
    if pupil.obscuration:
        passed = passed - _step(pupil.obscuration - radius)
    transfer: Complex = np.array(passed, dtype=np.complex128)
    if pupil.wavefront is not None:
        lit = passed > 0.0
        transfer[lit] *= np.exp(2j * np.pi * pupil.waves(across[lit], down[lit]))
    return transfer


def _step(distance: Real) -> Real:
    """1 inside, 1/2 on the rim, 0 outside."""
    return np.asarray(np.where(np.abs(distance) <= _ON_THE_RIM, 0.5, distance > 0.0), dtype=np.float64)
