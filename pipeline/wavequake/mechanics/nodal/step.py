"""What every reader of nodal results returns: steps of one kind, and where the nodes are."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from wavequake.mechanics.importers.entries import Array, Integers

Kind = Literal["case", "time", "mode"]


@dataclass(frozen=True)
class Step:
    """One load case, instant or mode; lengths in the file's unit.

    Attributes
    ----------
    kind : str
    number : int
        Of the load case or mode; of instants it means nothing.
    value : float
        Of an instant s, of a mode its frequency in Hz.
    labels : ndarray of int, shape (p,)
        Node numbers.
    values : ndarray, shape (p, 3), (p, 6) or (p, 1)
        Displacements and perhaps rotations, in the axes of the coordinates; or temperatures.
    """

    kind: Kind
    number: int
    value: float
    labels: Integers
    values: Array

    @property
    def is_thermal(self) -> bool:
        """Whether it holds temperatures."""
        return bool(self.values.shape[1] == 1)


@dataclass(frozen=True)
class Written:
    """What a file holds.

    ``points`` (N, 3) of the nodes ``labels`` (N,) are in ``length`` m, or None where the file does not know
    them. Of a file that does not say its unit, ``length`` is None. ``note`` says where numbers are from.
    ``own_axes``: displacements stand in the axes that the deck gives each node, which the file does not know.
    """

    source: str
    steps: tuple[Step, ...]
    labels: Integers | None = None
    points: Array | None = None
    length: float | None = None
    note: str = ""
    own_axes: bool = False


def in_common_axes(step: Step, labels: Integers, turns: Array) -> Step:
    """Return a step whose displacements and rotations at some nodes stood in other axes.

    ``turns`` (k, 3, 3) are the unit vectors of these axes, as columns, at the nodes ``labels`` (k,).
    """
    order = np.argsort(labels)
    place = np.minimum(np.searchsorted(labels[order], step.labels), max(len(labels) - 1, 0))
    here = np.flatnonzero(labels[order][place] == step.labels) if len(labels) else place[:0]
    if step.is_thermal or not len(here):
        return step
    turn, values = turns[order[place[here]]], step.values.copy()
    for first in range(0, values.shape[1], 3):
        part = values[here, first : first + 3]
        values[here, first : first + 3] = np.einsum("pij,pj->pi", turn, part)
    return replace(step, values=values)
