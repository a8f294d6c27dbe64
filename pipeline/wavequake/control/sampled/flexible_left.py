"""What a loop on a flexible structure leaves of disturbances and noise: integrals over frequency.

Of the mean over a period the sensitivity is what is left; what varies within a period no command changes. How
the correction itself moves within a period is not counted.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from wavequake.control.linear import Array
from wavequake.control.robustness.margins import Margins
from wavequake.control.sampled.flexible import Complex, FlexibleLoop, Reduced, poles, response
from wavequake.control.sampled.margins import LoopGain, gain_margins, pole_grid
from wavequake.control.sampled.stability import LoopCurve, curve_of_loci

# Where integrals are parted about a pole, in its half widths.
_ABOUT = np.array([-10.0, -3.0, -1.0, 0.0, 1.0, 3.0, 10.0])


@dataclass(frozen=True)
class Covariance:
    """Of a disturbance that moves a mirror's modes.

    Attributes
    ----------
    along : ndarray, shape (N, N)
        Among the directions of a reduced loop.
    others : ndarray, shape (G,)
        Sum of variances of each group's other directions.
    """

    along: Array
    others: Array

    @property
    def total(self) -> float:
        """Variance of all."""
        return float(np.trace(self.along) + self.others.sum())


def covariance(found: Reduced, factor: Array) -> Covariance:
    """Return F F' of modes (M, n) as a reduced loop has it."""
    small = found.basis.T @ factor
    along = small @ small.T
    squares, taken = np.sum(factor**2, axis=1), (found.basis @ small)
    # A direction of the basis is of one group, so that what is taken of a group is its part of the product.
    inside = np.sum(taken * factor, axis=1)
    others = np.array([max(float((squares - inside)[group].sum()), 0.0) for group in found.groups])
    return Covariance(along, others)


def left_of(found: Reduced, *disturbed: Covariance) -> Callable[[Array], Array]:
    """Return over frequency what is left, as variances (n, *f), of n disturbances of any spectra."""
    period = found.loop.timing.period
    totals = np.array([one.total for one in disturbed])

    def left(hertz: Array) -> Array:
        held = np.sinc(hertz * period) ** 2
        return np.asarray(np.multiply.outer(totals, 1 - held) + held * _passed(found, hertz, disturbed))

    return left


def noise_left(found: Reduced, noise: Covariance) -> Callable[[Array], Array]:
    """Return the one-sided spectrum of positions, up to half the rate, by noise that is white by periods."""
    period = found.loop.timing.period
    return lambda hertz: np.asarray(2 * period * _passed(found, hertz, (noise,), complementary=True)[0])


def turns(found: Reduced) -> tuple[float, ...]:
    """Return rising frequencies, Hz, below half the rate of commands, between which a loop is smooth."""
    half = 0.5 / found.loop.timing.period
    values = poles(found)
    rates = np.log(values[np.abs(values) > 1e-6]) * 2 * half / (2 * np.pi)
    rates = rates[rates.imag > 0]
    about = (rates.imag[:, None] + np.abs(rates.real)[:, None] * _ABOUT).ravel()
    return tuple(np.unique(about[(about > 0) & (about < half)]).tolist())


def _passed(
    found: Reduced, hertz: Array, disturbed: Sequence[Covariance], complementary: bool = False
) -> Array:
    """Return the variances (n, *f) of what is left of mean readings, or of what noise does."""
    at = response(found, hertz.ravel())
    size, others = at.sensitivity, 1 / (1 + at.others)
    if complementary:
        size, others = np.eye(size.shape[1]) - size, 1 - others
    # The trace of S C S^H is the sum over S^H S times C.
    squares = (np.swapaxes(size.conj(), 1, 2) @ size).reshape(len(size), -1)
    taken = np.abs(others) ** 2
    total = [(squares @ one.along.T.ravel()).real + taken @ one.others for one in disturbed]
    return np.reshape(total, (len(disturbed), *hertz.shape))


def frequency_grid(found: Reduced) -> Array:
    """Return rising frequencies up to half the rate of commands, some about each pole, Hz."""
    return pole_grid(poles(found), found.loop.timing.period)


def sensitivity_of(found: Reduced, hertz: Array) -> tuple[Array, Array]:
    """Return the largest singular value of the sensitivity (f,), and along each structure mode (f, K)."""
    at = response(found, hertz)
    values = np.linalg.svd(at.sensitivity, compute_uv=False).max(axis=1, initial=0.0)
    shapes = found.loop.structure.shapes
    by_mode = np.linalg.norm(at.sensitivity @ shapes, axis=1) / np.linalg.norm(shapes, axis=0)
    return np.maximum(values, np.abs(1 / (1 + at.others)).max(axis=1)), by_mode


def curve_of(found: Reduced, hertz: Array) -> tuple[Array, LoopCurve]:
    """Return the largest singular value of the complementary sensitivity (f,), and a stable loop's curve."""
    at = response(found, hertz)
    others = at.others / (1 + at.others)
    along = np.eye(at.gain.shape[1]) - at.sensitivity
    sizes = np.linalg.svd(along, compute_uv=False).max(axis=1, initial=0.0)
    loci = np.concatenate([np.linalg.eigvals(at.gain), at.others], axis=1)
    curve = curve_of_loci(loci, np.ones(len(hertz), dtype=bool))
    return np.maximum(sizes, np.abs(others).max(axis=1)), curve


def flexible_margins(found: Reduced) -> Margins:
    """Return the margins of a stable loop, all gains changed alike; delay in s, frequencies in rad/s."""

    def loci(hertz: Array) -> Complex:
        at = response(found, hertz)
        return np.concatenate([np.linalg.eigvals(at.gain), at.others], axis=1)

    def whole(hertz: float) -> Complex:
        at = response(found, np.array([hertz]))
        n, g = at.gain.shape[1], at.others.shape[1]
        full = np.zeros((n + g, n + g), dtype=complex)
        full[:n, :n], full[n:, n:] = at.gain[0], np.diag(at.others[0])
        return full

    return gain_margins(LoopGain(loci, whole), frequency_grid(found), lambda one: radius(found, one))


def radius(found: Reduced, factor: float) -> float:
    """Return the size of the largest pole by periods with all gains of a reduced loop times a factor."""
    return float(np.abs(poles(scaled(found, factor))).max())


def scaled(found: Reduced, factor: float) -> Reduced:
    """Return a reduced loop with all gains times a factor."""
    small = found.loop
    changed = FlexibleLoop(small.timing, small.dynamics, factor * small.gains, small.leak, small.structure)
    return Reduced(changed, found.basis, factor * found.gains, found.groups)
