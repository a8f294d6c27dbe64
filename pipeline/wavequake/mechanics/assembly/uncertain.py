"""Structures that are not known exactly: other frequencies, damping and shapes of the modes of a plant.

What is drawn are modal parameters, so that no model is assembled or solved again. Masses are kept: the shares
of the floor's motion in the modes stay, and shapes turn into each other without a change of their scale.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.mechanics.assembly.plant import Plant
from wavequake.mechanics.model import Array


@dataclass(frozen=True)
class Spread:
    """How far modes may be off.

    Attributes
    ----------
    frequency, damping : float
        Standard deviations of the logarithms.
    shapes : float
        Standard deviation of the angle, rad, by which neighbors in frequency turn into each other.
    """

    frequency: float = 0.0
    damping: float = 0.0
    shapes: float = 0.0


@dataclass(frozen=True)
class Measured:
    """A mode whose frequency and damping ratio were measured, and the deviations of their logarithms."""

    number: int
    frequency_hz: float
    damping_ratio: float
    frequency_error: float = 0.0
    damping_error: float = 0.0


def corrected(plant: Plant, measured: Sequence[Measured]) -> Plant:
    """Return a plant with the frequencies and damping ratios that were measured.

    Raises
    ------
    UserError
        If there is no such mode.
    """
    factors = np.ones((2, len(plant.omega)))
    for one in measured:
        if one.number > len(plant.omega):
            raise UserError(f"There is no mode {one.number}; the structure has {len(plant.omega)}.")
        own = plant.omega[one.number - 1]
        ratio = 0.5 * plant.modal.damping[one.number - 1, one.number - 1] / own
        if not ratio > 0.0:
            raise UserError(f"Mode {one.number} has no damping that a measured one could replace.")
        factors[:, one.number - 1] = 2.0 * np.pi * one.frequency_hz / own, one.damping_ratio / ratio
    return _scaled(plant, *factors)


def drawn(plant: Plant, spread: Spread, measured: Sequence[Measured], random: np.random.Generator) -> Plant:
    """Return a plant whose modes are off by what is not known of them.

    The k-th mode takes the k-th three random numbers, so that reduced models of one structure are off alike.
    Modes that were measured have their own errors, and keep their shapes.
    """
    count = len(plant.omega)
    normal = random.standard_normal((count, 3))
    sizes = np.repeat([[spread.frequency, spread.damping]], count, axis=0)
    turns = spread.shapes * normal[:-1, 2]
    for one in measured:
        sizes[one.number - 1] = one.frequency_error, one.damping_error
        turns[max(0, one.number - 2) : one.number] = 0.0
    turned = _turned(plant, turns)
    return _scaled(turned, *np.exp(sizes * normal[:, :2]).T)


def _scaled(plant: Plant, frequency: Array, damping: Array) -> Plant:
    """Return a plant whose frequencies and damping ratios are multiplied, mode by mode."""
    modal = plant.modal
    root = np.sqrt(frequency * damping)
    squared, rates = modal.squared * frequency**2, modal.damping * np.outer(root, root)
    shares = np.where(modal.prescribed, modal.inputs, 0.0) / modal.squared[:, None]
    count = plant.resonances.shape[1]
    off = np.ones((2, count))
    off[0, : len(frequency)], off[1, : len(damping)] = frequency[:count], damping[:count]
    return replace(
        plant,
        modal=replace(
            modal,
            squared=squared,
            damping=rates,
            inputs=np.where(modal.prescribed, shares * squared[:, None], modal.inputs),
            input_rates=modal.input_rates + (rates - modal.damping) @ shares,
        ),
        resonances=plant.resonances * off,
    )


def _turned(plant: Plant, angles: Array) -> Plant:
    """Return a plant in which each shape turns into the next by an angle (r - 1,), rad."""
    if not angles.any():
        return plant
    modal = plant.modal
    shares = np.where(modal.prescribed, modal.inputs, 0.0) / modal.squared[:, None]
    strained = modal.input_rates - modal.damping @ shares
    columns = np.vstack([plant.shapes, modal.modes, np.where(modal.prescribed, shares, modal.inputs).T])
    for k in np.flatnonzero(angles):
        cosine, sine = np.cos(angles[k]), np.sin(angles[k])
        pair: NDArray[np.float64] = columns[:, k : k + 2] @ np.array([[cosine, -sine], [sine, cosine]])
        columns[:, k : k + 2] = pair
    shapes, modes, inputs = np.split(columns, np.cumsum([len(plant.shapes), len(modal.modes)]))
    shares = np.where(modal.prescribed, inputs.T, 0.0)
    return replace(
        plant,
        modal=replace(
            modal,
            inputs=np.where(modal.prescribed, shares * modal.squared[:, None], inputs.T),
            input_rates=strained + modal.damping @ shares,
            modes=modes,
        ),
        shapes=shapes,
    )
