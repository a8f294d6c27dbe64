"""A vibration line as several signals see it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

NORMAL = 1.959963984540054
"""Standard deviations on either side that hold 95 %."""

RESOLVED = 4.0
"""Coefficients within the full width at half maximum from which on a line's width can be told."""


@dataclass(frozen=True)
class Line:
    """An oscillator that noise drives, or a sinusoid, as several signals see it.

    Attributes
    ----------
    frequency_hz, damping : float
        Undamped natural frequency and damping ratio. Of what the record does not resolve the frequency, and
        the largest damping ratio that it may have.
    rms : ndarray, shape (c,)
        In each signal's unit; equal signs move together.
    covariance : ndarray, shape (2 + c, 2 + c)
        Of the logarithms of frequency and damping ratio, and rms.
    resolved : bool
        Whether its width can be told; a sinusoid is not resolved.
    ends : ndarray, shape (2 + c, 2), optional
        Of the 95 % intervals, in the same logarithms and rms; by default `NORMAL` deviations to both sides.
    """

    frequency_hz: float
    damping: float
    rms: Array
    covariance: Array
    resolved: bool
    ends: Array | None = None

    @property
    def fwhm_hz(self) -> float:
        """Full width at half maximum of its density, Hz; 0 of what is not resolved."""
        return 2.0 * self.damping * self.frequency_hz if self.resolved else 0.0

    @property
    def deviations(self) -> Array:
        """Standard deviations (2 + c,) of the logarithms of frequency and damping ratio, and rms."""
        return np.asarray(np.sqrt(np.maximum(np.diag(self.covariance), 0.0)))

    @property
    def interval(self) -> Array:
        """95 % intervals (2 + c, 2) of frequency, damping ratio and rms."""
        ends = self.ends
        if ends is None:
            middle = np.append(np.log([self.frequency_hz, self.damping]), self.rms)
            ends = middle[:, None] + NORMAL * self.deviations[:, None] * np.array([-1.0, 1.0])
        return np.vstack([np.exp(ends[:2]), ends[2:]])
