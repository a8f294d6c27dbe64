"""What drives a model over time, in the terms in which the response is exact. SI units.

A drive has p inputs, one per interface direction (3 k + d for node k in direction d): prescribed
displacements in m where `prescribed` says so, forces in N elsewhere. It is the sum of harmonics that start at
some instant, of impulses, and of samples joined by straight lines.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.mechanics.model import Array


@dataclass(frozen=True)
class Harmonic:
    """u(t) = cosine cos(omega t) + sine sin(omega t) for t >= start, zero before.

    ``omega`` in rad/s, ``start`` in s, ``cosine`` and ``sine`` of shape (p,).
    """

    omega: float
    start: float
    cosine: Array
    sine: Array


@dataclass(frozen=True)
class Impulse:
    """Momentum (p,) in N s that is transferred at the instant `at` in s."""

    at: float
    momentum: Array


@dataclass(frozen=True)
class Drive:
    """One case's inputs.

    Attributes
    ----------
    prescribed : ndarray of bool, shape (p,)
    harmonics : tuple of Harmonic
    impulses : tuple of Impulse
    samples : ndarray, shape (t, p), or None
        Values at the instants of the response, joined linearly.
    """

    prescribed: NDArray[np.bool_]
    harmonics: tuple[Harmonic, ...] = ()
    impulses: tuple[Impulse, ...] = ()
    samples: Array | None = None


def values(drive: Drive, time: Array) -> Array:
    """Return the inputs at given instants, shape (t, p); impulses are not among them."""
    total = np.zeros((len(time), len(drive.prescribed)))
    if drive.samples is not None:
        total += drive.samples
    for harmonic in drive.harmonics:
        on = time >= harmonic.start
        phase = harmonic.omega * time
        total += np.outer(on * np.cos(phase), harmonic.cosine) + np.outer(on * np.sin(phase), harmonic.sine)
    return total


def sampled(drive: Drive, time: Array) -> Drive:
    """Return the same drive with its harmonics replaced by samples: a first-order hold.

    Raises
    ------
    UserError
        If a harmonic is faster than half the sampling frequency.
    """
    step = float(time[1] - time[0])
    for harmonic in drive.harmonics:
        if harmonic.omega * step > np.pi:
            raise UserError(
                f"a sinusoid of {harmonic.omega / (2 * np.pi):g} Hz cannot be sampled every {step:g} s; "
                f"take a time step below {np.pi / harmonic.omega:.3g} s"
            )
    return Drive(drive.prescribed, (), drive.impulses, values(drive, time))


def ramped_sine(omega: float, amplitude: Array, ramp: float) -> tuple[Harmonic, ...]:
    """Return amplitude sin(omega t), swung in by sin^2(pi t / (2 ramp)) until `ramp` (0: at once).

    The ramp times the sine is a sum of three sines; three more that start at `ramp` undo the side bands and
    complete the sine.
    """
    zero = np.zeros_like(amplitude)
    if ramp == 0.0:
        return (Harmonic(omega, 0.0, zero, amplitude),)
    side = np.pi / ramp

    def sine(frequency: float, start: float, factor: float) -> Harmonic:
        sign = 1.0 if frequency >= 0 else -1.0
        return Harmonic(sign * frequency, start, zero, sign * factor * amplitude)

    return (
        sine(omega, 0.0, 0.5),
        sine(omega + side, 0.0, -0.25),
        sine(omega - side, 0.0, -0.25),
        sine(omega, ramp, 0.5),
        sine(omega + side, ramp, 0.25),
        sine(omega - side, ramp, 0.25),
    )
