"""What a plant answers: steady vibration at given frequencies, and static sag under gravity. SI units."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.mechanics.assembly.plant import FLOOR, Plant
from wavequake.mechanics.model import Array

Complex = NDArray[np.complex128]

STANDARD_GRAVITY = 9.80665

_COUPLED = 1e-12
_NUMBERS = 1 << 22  # of phases at a time


@dataclass(frozen=True)
class Shaking:
    """Sinusoids that act on a plant: input u(t) = Re sum of pattern exp(i omega t).

    Attributes
    ----------
    omega : ndarray, shape (w,)
        rad/s, positive.
    patterns : ndarray, shape (w, p)
        Complex amplitudes of all inputs: forces, moments and motions of the floor.
    """

    omega: Array
    patterns: Complex


def steady(plant: Plant, shaking: Shaking) -> Complex:
    """Return the complex amplitudes (w, m) of the outputs under steady vibration."""
    modal = plant.modal
    forcing = shaking.patterns @ modal.inputs.T
    forcing += 1j * shaking.omega[:, None] * (shaking.patterns @ modal.input_rates.T)
    rates = np.diag(modal.damping)
    apart = np.abs(modal.damping - np.diag(rates)).max(initial=0.0)
    if apart <= _COUPLED * np.abs(rates).max(initial=0.0):
        square = shaking.omega[:, None] ** 2
        swing = forcing / (modal.squared - square + 1j * shaking.omega[:, None] * rates)
    else:
        swing = np.empty_like(forcing)
        for row, omega in enumerate(shaking.omega):  # one at a time: no case's bits depend on another's
            matrix = np.diag(modal.squared - omega**2) + 1j * omega * modal.damping
            swing[row] = np.linalg.solve(matrix, forcing[row])
    return np.asarray(swing @ plant.shapes.T + shaking.patterns @ plant.carried.T)


def over_time(plant: Plant, shaking: Shaking, time: Array) -> Array:
    """Return the outputs (n, m) at the instants `time` (n,), s, under steady vibration."""
    amplitudes = steady(plant, shaking)
    both = np.vstack([amplitudes.real, -amplitudes.imag])
    result = np.empty((len(time), both.shape[1]))
    rows = max(1, _NUMBERS // max(1, len(shaking.omega)))
    for first in range(0, len(time), rows):
        phase = np.outer(time[first : first + rows], shaking.omega)
        result[first : first + rows] = np.hstack([np.cos(phase), np.sin(phase)]) @ both
    return result


def sag(plant: Plant, gravity: Array) -> Array:
    """Return the outputs (n, m) under gravity (n, 3), m/s^2, relative to the unloaded structure.

    Gravity g does to what stands on a floor what an acceleration -g of the floor would do: the loads of the
    modes are their shares of the floor's shifts.

    Raises
    ------
    UserError
        If the assembly does not stand on the ground, or a body is held by stiffness of its own.
    """
    require_floor(plant, "gravity")
    shares = plant.modal.inputs[:, FLOOR][:, :3] / plant.modal.squared[:, None]
    sagged = (shares @ gravity.T) / plant.modal.squared[:, None]
    return np.asarray((plant.shapes @ sagged).T)


def require_floor(plant: Plant, what: str) -> None:
    """Refuse a plant that the floor does not carry; `what` asks for it."""
    if not plant.grounded:
        raise UserError(f"{what} needs something that stands on the ground; add a link to 'ground'")
    if plant.held:
        raise UserError(
            f"{what} needs bodies that the floor carries by links, but the stiffness of {plant.held[0]!r} "
            "holds it in space by itself; give a model that is free, and links to the ground"
        )


def moved(plant: Plant, values: Array) -> tuple[dict[str, Array], dict[str, Array]]:
    """Split outputs (n, m) into rigid motions (n, 6) by element and figures (n, J) by surface."""
    rigid, figure = (
        {name: values[:, part] for (kind, name), part in plant.outputs.items() if kind == wanted}
        for wanted in ("rigid", "figure")
    )
    return rigid, figure


def watching(plant: Plant, nodes: Mapping[str, str]) -> Plant:
    """Return a plant that gives the motions of nodes, in the system's axes, as "rigid" outputs beside.

    `nodes` are ``body.node`` by what their outputs are called. A node without rotations of its own does not
    turn.
    """
    outputs, first = dict(plant.outputs), len(plant.shapes)
    shapes, carried, free = [plant.shapes], [plant.carried], [plant.free]
    for name, node in nodes.items():
        outputs["rigid", name] = slice(first, first + 6)
        for group in plant.places[node]:
            none = slice(0, 3) if group is None else group
            shapes.append((group is not None) * plant.modal.inputs[:, none].T)
            carried.append((group is not None) * plant.followed[none])
            free.append((group is not None) * plant.adrift[none])
        first += 6
    moved = np.vstack(shapes), np.vstack(carried), np.vstack(free)
    return replace(plant, outputs=outputs, shapes=moved[0], carried=moved[1], free=moved[2])
