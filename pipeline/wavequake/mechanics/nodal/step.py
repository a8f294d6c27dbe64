"""What every reader of nodal results returns: steps of one kind, and where the nodes are."""

from dataclasses import dataclass
from typing import Literal

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
    """

    source: str
    steps: tuple[Step, ...]
    labels: Integers | None = None
    points: Array | None = None
    length: float | None = None
    note: str = ""
