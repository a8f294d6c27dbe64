"""What a budget varies: factors that are on, off or drawn again, and how their cases are measured."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

AGAIN = "~again"  # what is drawn again; no disturbance's name can end so


@dataclass(frozen=True)
class Factor:
    """A disturbance ("source"), a "ring" of segments, or a surface or body that moves ("element").

    ``members`` is the number of segments or elements that it moves. Only a factor whose random numbers are
    ``independent`` of those of its kind has indices of variance.
    """

    name: str
    kind: str
    members: int
    independent: bool = True


@dataclass(frozen=True)
class Experiment:
    """How the cases of a budget of k factors are varied and measured.

    ``values(first, last)`` gives (cases, 2 + 2 k, quantities + 1): with all factors, with all drawn again,
    without each, with each drawn again; NaN where a case cannot be traced. Last comes the largest number of
    rays, of `rays`, that do not arrive at an instant. ``at_once`` cases are measured together. ``rest()``
    gives (quantities + 1,) without any factor; ``light`` says what the quantities are where rays are missing.
    """

    factors: tuple[Factor, ...]
    quantities: tuple[str, ...]
    at_once: int
    values: Callable[[int, int], Array]
    rest: Callable[[], Array]
    rays: int
    light: str
