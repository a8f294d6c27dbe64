"""What a budget varies: factors that are on, off or drawn again, and how their cases are measured."""

import difflib
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wavequake.campaign.contract import Variable
from wavequake.errors import UserError
from wavequake.workflows.budgets.kept import UNITS
from wavequake.workflows.budgets.tree import Branch

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

    ``values(first, last)`` gives (cases, 2 + 2 k + b, quantities + 1): with all factors, with all drawn
    again, without each, with each drawn again, and with each of b groups alone; NaN where a case cannot be
    traced. Last comes the largest number of rays, of `rays`, that do not arrive at an instant. ``at_once``
    cases are measured together. ``rest()`` gives (quantities + 1,) without any factor; ``units`` are those of
    the quantities; ``light`` says what the quantities are where rays are missing.
    """

    factors: tuple[Factor, ...]
    branches: tuple[Branch, ...]
    quantities: tuple[str, ...]
    at_once: int
    values: Callable[[int, int], Array]
    rest: Callable[[], Array]
    rays: int
    light: str
    units: tuple[str, ...]


def chosen(
    measure: str | None, usual: tuple[str, ...], known: Mapping[str, Variable]
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the quantities of a budget and their units: a measure that is asked for, and the usual ones.

    Raises
    ------
    UserError
        If there is no such number of a case: it must be no image.
    """
    fitting = [
        name
        for name, one in known.items()
        if not {"x", "y", "detector_x"} & set(one.dims) and not one.coordinate
    ]
    if measure is not None and measure not in fitting:
        near = difflib.get_close_matches(measure, fitting, n=1)
        hint = f"did you mean {near[0]!r}?" if near else f"there are {', '.join(fitting)}."
        raise UserError(f"A budget has no measure {measure!r}; {hint}")
    names = usual if measure is None or measure in usual else (measure, *usual)
    units = [str(UNITS.get(name) or known[name].attrs.get("units", "1")) for name in names]
    return names, tuple(units)
