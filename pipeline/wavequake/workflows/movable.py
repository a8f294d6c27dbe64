"""What a disturbance moves and what that does to a measure: all that an allowance has to know of a study."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wavequake.mechanics.disturbances.gaussian import GaussianMotions
from wavequake.optics.segments.modal_forms import MotionForm

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Movable:
    """What the disturbance `name` moves, what that does to the square of a measure, and how it is traced.

    A motion is a row of K columns. Each of the first k is an element along an axis; those behind them belong
    to no element alone.

    Attributes
    ----------
    elements, axes : tuple of str
        Lengths E and D.
    place : ndarray of int, shape (k, 2)
        Axis and element of the first columns.
    metric : ndarray, shape (k,)
        m or rad per unit of a column.
    form : MotionForm
        The square of the measure of K columns.
    moved, idle : ndarray of bool, shape (K,)
        What the disturbance moves, and what does nothing to the measure.
    lasting : ndarray of bool, shape (k,)
        Which of the first columns cannot change during a case.
    time : ndarray, shape (n,)
        Instants of a case in s.
    seed : int
    unit : str
        Of the measure.
    gaussian : callable
        Returns the motions as sums of Gaussian numbers, or raises NotGaussianError.
    drawn : callable
        Returns the motion (n, K) of a realization.
    traced : callable
        Returns the measure of cases, motions (n, K) each, by full traces; NaN where that fails.
    """

    name: str
    elements: tuple[str, ...]
    axes: tuple[str, ...]
    place: NDArray[np.int64]
    metric: Array
    form: MotionForm
    moved: NDArray[np.bool_]
    idle: NDArray[np.bool_]
    lasting: NDArray[np.bool_]
    time: Array
    seed: int
    unit: str
    gaussian: Callable[[], GaussianMotions]
    drawn: Callable[[int], Array]
    traced: Callable[[Sequence[Array]], Array]

    def column_name(self, column: int) -> tuple[str, str]:
        """Return element and axis of one of the first k columns."""
        axis, element = self.place[column]
        return self.elements[element], self.axes[axis]
