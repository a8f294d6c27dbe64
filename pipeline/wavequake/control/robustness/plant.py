"""A large lightly damped plant: its lower modes and the flexibility of the others, with a bound of the error.

The bound knows no truncated mode, only where they begin and how flexible they are together. With
G(s) = sum c b' / (s^2 + d s + w^2), d = alpha + beta w^2, a truncated mode that is taken as its flexibility
c b' / w^2 is off by that times r = -(s^2 + d s) / (s^2 + d s + w^2), and by Cauchy's inequality
|sum r c b' / w^2| <= max |r| sqrt(|sum c c' / w^2| |sum b b' / w^2|).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wavequake.control.linear import Array, LinearModel

Complex = NDArray[np.complex128]


@dataclass(frozen=True)
class Truncated:
    """What is known of the modes that a plant leaves out.

    Attributes
    ----------
    above : float
        All have squared angular frequencies of this and more.
    mass_rate, stiffness_rate : float
        Rayleigh's alpha and beta: a mode decays with alpha + beta w^2.
    flexibility : float
        Root of the product of the largest eigenvalues of their flexibilities at the inputs and the outputs.
    """

    above: float
    mass_rate: float
    stiffness_rate: float
    flexibility: float


@dataclass(frozen=True)
class Plant:
    """Modes q'' + rates q' + squared q = inputs u, y = outputs q + static u; any consistent units.

    Attributes
    ----------
    squared, rates : ndarray, shape (n,)
        Squared angular frequencies and rates of decay.
    inputs : ndarray, shape (n, p)
    outputs : ndarray, shape (m, n)
    static : ndarray, shape (m, p)
        Flexibility of the modes that are left out.
    truncated : Truncated or None
        None where nothing is left out.
    """

    squared: Array
    rates: Array
    inputs: Array
    outputs: Array
    static: Array
    truncated: Truncated | None = None

    @property
    def poles(self) -> Complex:
        """The poles of the upper half plane (or real ones) of each mode, shape (n,)."""
        half = self.rates / 2
        found: Complex = -half + np.sqrt((half**2 - self.squared).astype(complex))
        return found


def whole_plant(squared: Array, rates: Array, inputs: Array, outputs: Array) -> Plant:
    """Return a plant of all its modes."""
    return Plant(squared, rates, inputs, outputs, np.zeros((len(outputs), inputs.shape[1])))


def in_units(plant: Plant, time: float, force: float, length: float) -> Plant:
    """Return a plant in other units of time, input and output, each given in the present one."""
    far = plant.truncated
    return Plant(
        plant.squared * time**2,
        plant.rates * time,
        plant.inputs * force * time**2,
        plant.outputs / length,
        plant.static * force / length,
        far
        and Truncated(
            far.above * time**2,
            far.mass_rate * time,
            far.stiffness_rate / time,
            far.flexibility * force / length,
        ),
    )


def linear(plant: Plant) -> LinearModel:
    """Return the state space of states (q, q')."""
    count = len(plant.squared)
    zero = np.zeros((count, count))
    return LinearModel(
        np.block([[zero, np.eye(count)], [-np.diag(plant.squared), -np.diag(plant.rates)]]),
        np.vstack([np.zeros_like(plant.inputs), plant.inputs]),
        np.hstack([plant.outputs, np.zeros_like(plant.outputs)]),
        plant.static,
    )


def transfer(plant: Plant, s: Complex) -> Complex:
    """Return the transfer matrices (f, m, p) at complex frequencies s (f,)."""
    resonances = 1.0 / (plant.squared + s[:, None] * (plant.rates + s[:, None]))
    residues = plant.outputs.T[:, :, None] * plant.inputs[:, None, :]
    found = resonances @ residues.reshape(len(residues), -1).astype(complex)
    return np.asarray(found.reshape(len(s), *plant.static.shape) + plant.static)


def truncation_bound(plant: Plant, s: Complex) -> Array:
    """Return by how much `transfer` is off at most, (f,), as a spectral norm; s has no negative real part."""
    far = plant.truncated
    if far is None:
        return np.zeros(len(s))
    return far.flexibility * _largest_ratio(s * (s + far.mass_rate), far.stiffness_rate * s, far.above)


def _largest_ratio(p: Complex, q: Complex, least: float) -> Array:
    """Return the largest |(p + q x) / (p + (1 + q) x)| over x >= least, for every p, q (f,)."""

    def squares(a: Complex, x: Array) -> Array:
        found: Array = np.abs(p + a * x) ** 2
        return found

    # Both squares are parabolas in x, a2 x^2 + a1 x + a0; their ratio is extreme where this quadratic is 0.
    (a2, a1), (b2, b1) = ((np.abs(one) ** 2, 2 * np.real(np.conj(p) * one)) for one in (q, 1 + q))
    a0 = np.abs(p) ** 2
    second, first, constant = a2 * b1 - a1 * b2, 2 * a0 * (a2 - b2), a0 * (a1 - b1)
    with np.errstate(divide="ignore", invalid="ignore"):
        root = np.sqrt(np.maximum(first**2 - 4 * second * constant, 0.0))
        stable = -(first + np.where(first < 0, -1.0, 1.0) * root) / 2
        places = [stable / second, constant / stable]
        found = [np.abs(q / (1 + q)) ** 2]  # x without bound
        for place in [np.full(len(p), least), *places]:
            x = np.where(place > least, place, least)
            found.append(squares(q, x) / squares(1 + q, x))
    return np.asarray(np.sqrt(np.nanmax(found, axis=0)))
