"""Squares of what the modal model knows, as quadratic forms of the motions: no wavefront is formed."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wavequake.optics.segments.modal import COMMON, ModalModel, layout_of

Array = NDArray[np.float64]


@dataclass(frozen=True)
class MotionForm:
    """constant + linear . q + q . square q of motions q (D S + 4,) as in `modal.forms`; waves^2 or mm^2."""

    constant: float
    linear: Array
    square: Array


def length_form(rest: Array, columns: Array) -> MotionForm:
    """Return the squared length of rest + columns^T q, for `rest` (k,) and `columns` (D S + 4, k)."""
    return MotionForm(float(rest @ rest), 2.0 * columns @ rest, columns @ columns.T)


def raw_form(model: ModalModel) -> MotionForm:
    """Return the mean square of the OPD over the rays about its mean, waves^2."""
    places = layout_of(model.terms)
    count, segments = len(model.dofs), model.square.shape[2]
    local = count * segments
    square = np.zeros((local + COMMON, local + COMMON))
    each = np.arange(segments)
    for i in range(count):
        for j in range(i, count):  # what is below the diagonal stands above it
            square[i * segments + each, j * segments + each] += 0.5 * model.square[i, j]
            square[j * segments + each, i * segments + each] += 0.5 * model.square[i, j]
    cross = model.columns[:local, places.cross]
    square[:local, local:], square[local:, :local] = cross, cross.T
    square[local:, local:] = model.common
    mean, rest = model.columns[:, places.mean], float(model.rest[places.mean])
    return MotionForm(
        model.rest_square - rest**2,
        2.0 * (model.columns[:, places.static] - rest * mean),
        square - np.outer(mean, mean),
    )
