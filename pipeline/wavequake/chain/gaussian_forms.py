"""Squares of what is linear in motions, as quadratic forms of the Gaussian numbers behind the motions."""

import numpy as np

from wavequake.campaign.rare.quadratic import QuadraticForm, quadratic_form
from wavequake.mechanics.disturbances.gaussian import GaussianMotions
from wavequake.optics.segments.modal_forms import MotionForm


def form_of_numbers(form: MotionForm, motions: GaussianMotions) -> QuadraticForm:
    """Return the mean over the instants of a form of the motions, as one of the numbers behind them."""
    count, instants, _ = motions.columns.shape
    constant, linear, square = 0.0, np.zeros(count), np.zeros((count, count))
    for instant in range(instants):
        columns, rest = motions.columns[:, instant], motions.rest[instant]
        bent = form.square @ rest
        constant += form.constant + float(form.linear @ rest + rest @ bent)
        linear += columns @ (form.linear + 2.0 * bent)
        square += columns @ form.square @ columns.T
    square = (square + square.T) / (2.0 * instants)
    return quadratic_form(constant / instants, linear / instants, square)
