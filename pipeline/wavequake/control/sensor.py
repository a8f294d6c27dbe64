"""From the lens's position to the number that the control unit reads (Störkle 2018, Section 5.2.3).

Magnetic strip, Hall sensor with quadrature counts, 10-bit converter of the decoding board, 12-bit
converter of the control unit.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wavequake.control.linear import Array
from wavequake.errors import UserError


@dataclass(frozen=True)
class SensorChain:
    """Parameters of the chain; lengths in m.

    Attributes
    ----------
    edge : float
        Travel per quadrature edge.
    reach : float
        Positions -reach to reach span both converters.
    dac_bits, adc_bits : int
    adc_noise : float
        Standard deviation in steps of the second converter.
    strip_error : float
        Largest error of the strip (Fig. 5.18).
    strip_periods : tuple of float
        Wavelengths of the strip's error: its bend, and a pair of its poles.
    strip_shares : tuple of float
        Their shares of the largest error.
    """

    edge: float = 13.6e-6
    reach: float = 8e-3
    dac_bits: int = 10
    adc_bits: int = 12
    adc_noise: float = 0.7
    strip_error: float = 40e-6
    strip_periods: tuple[float, ...] = (6e-3, 2.4e-3)
    strip_shares: tuple[float, ...] = (0.75, 0.25)

    def __post_init__(self) -> None:
        if not (self.edge > 0 and self.reach > 0 and self.adc_noise >= 0 and self.strip_error >= 0):
            raise UserError("The sensor's edge and reach must be positive, its noise and error not negative.")
        if not (1 <= self.dac_bits <= 16 and 1 <= self.adc_bits <= 16):
            raise UserError("The sensor's converters must have 1 to 16 bits.")


def strip_reading(chain: SensorChain, position: Array, phases: Array) -> Array:
    """Return the position that the strip pretends, zero where it is at rest, m.

    Parameters
    ----------
    chain : SensorChain
    position : ndarray, shape (..., time)
    phases : ndarray, shape (..., waves)
        Of the error's waves, rad.
    """
    reading = position.copy()
    for wave, (period, share) in enumerate(zip(chain.strip_periods, chain.strip_shares, strict=True)):
        phase = phases[..., wave, None]
        error = np.sin(2 * np.pi * position / period + phase) - np.sin(phase)
        reading += chain.strip_error * share * error
    return reading


def quadrature_counts(chain: SensorChain, position: Array) -> NDArray[np.int64]:
    """Return the counts of the decoder: edges lie at multiples of the step, half a step from rest."""
    return np.rint(position / chain.edge).astype(np.int64)


def dac_codes(chain: SensorChain, counts: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the codes of the decoding board's converter, saturated."""
    top = 2**chain.dac_bits - 1
    codes = np.rint((counts * chain.edge + chain.reach) * (top / (2 * chain.reach)))
    clipped: NDArray[np.int64] = np.clip(codes, 0, top).astype(np.int64)
    return clipped


def adc_codes(chain: SensorChain, codes: NDArray[np.int64], noise: Array) -> NDArray[np.int64]:
    """Return what the control unit reads for codes of the first converter; `noise` is standard normal."""
    full, top = 2**chain.dac_bits - 1, 2**chain.adc_bits - 1
    read = np.rint(codes * (top / full) + chain.adc_noise * noise)
    clipped: NDArray[np.int64] = np.clip(read, 0, top).astype(np.int64)
    return clipped


def positions(chain: SensorChain, codes: NDArray[np.int64]) -> Array:
    """Return the positions that codes of the control unit's converter stand for, m."""
    return np.asarray(codes * (2 * chain.reach / (2**chain.adc_bits - 1)) - chain.reach)


def read_codes(chain: SensorChain, position: Array, phases: Array, noise: Array) -> NDArray[np.int64]:
    """Return what the control unit's converter reads of the lens's position, (..., time), through the chain.

    Raises
    ------
    UserError
        If a position is not finite.
    """
    if not np.isfinite(position).all():
        raise UserError("The lens's position is not finite; the plant diverged.")
    counts = quadrature_counts(chain, strip_reading(chain, position, phases))
    return adc_codes(chain, dac_codes(chain, counts), noise)


def read_positions(chain: SensorChain, position: Array, phases: Array, noise: Array) -> Array:
    """Return what the control unit takes for the lens's position, (..., time) in m; as `read_codes`."""
    return positions(chain, read_codes(chain, position, phases, noise))


def quantized_command(command: Array, reach: float = 8e-3, bits: int = 12) -> Array:
    """Return commands in m as the control unit's own converter puts them out, saturated at the reach."""
    top = 2**bits - 1
    codes = np.clip(np.rint((command + reach) * (top / (2 * reach))), 0, top)
    return np.asarray(codes * (2 * reach / top) - reach)
