"""The loop of a large plant with a controller that a smaller model of it gave: its matrix and its poles.

The controller is u = -H(s) y. It is strictly proper, so that the static part of a plant closes no loop by
itself.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import lu_factor, lu_solve, schur

from wavequake.control.gains import kalman_bucy_gain, regulator_gain
from wavequake.control.linear import Array, LinearModel
from wavequake.control.robustness.plant import Complex, Plant, linear
from wavequake.errors import UserError

_STEPS, _SETTLED = 20, 1e-10
# Steps of inverse iteration from beside an eigenvalue, as a share of it.
_INVERSE, _BESIDE = 3, 1e-10


def lqg(model: Plant, effort: float, noise: float) -> LinearModel:
    """Design a regulator and a filter on a model: the controller H of u = -H y.

    The cost is the mean of y'y + effort u'u; white forces of unit intensity act at the inputs, white noise of
    the intensity `noise` at the outputs.

    Parameters
    ----------
    model : Plant
        In units in which its inputs, outputs and frequencies of interest are about 1.
    effort, noise : float

    Returns
    -------
    LinearModel
        From m outputs of the plant to p forces, with the states of the model.

    Raises
    ------
    UserError
        If a weight is not positive, no force or sensor reaches the model, or a mode that does not decay is
        not driven or not seen; says which.
    """
    for name, value in (("effort", effort), ("noise", noise)):
        if not (np.isfinite(value) and value > 0):
            raise UserError(f"The {name} of a controller is {value}; it must be positive and finite.")
    for part, what in ((model.inputs, "no force moves"), (model.outputs, "no sensor sees")):
        if not np.abs(part).max(initial=0.0) > 0:
            raise UserError(f"{what[0].upper()}{what[1:]} any mode of the model; it has no controller.")
    known = linear(model)
    gain = regulator_gain(known, known.c.T @ known.c, effort)
    filtered = kalman_bucy_gain(known, 1.0, noise, known.b)
    inner = known.a - known.b @ gain - filtered @ (known.c - known.d @ gain)
    return LinearModel(inner, filtered, gain, np.zeros((len(gain), len(known.c))))


@dataclass(frozen=True)
class Loop:
    """A plant and its controller, u = -H y.

    Attributes
    ----------
    plant : Plant
        Of n modes, p inputs and m outputs.
    controller : LinearModel
        Strictly proper, of r states.
    """

    plant: Plant
    controller: LinearModel

    @cached_property
    def triangular(self) -> tuple[Complex, Complex]:
        """T and unitary Q of the controller's A = Q T Q^H, T triangular (Schur)."""
        found, vectors = schur(self.controller.a, output="complex")
        return np.asarray(found), np.asarray(vectors)


def closed_matrix(loop: Loop) -> Array:
    """Return the matrix of the closed loop (2 n + r, 2 n + r), states (q, q', controller)."""
    plant, own = linear(loop.plant), loop.controller
    return np.block(
        [[plant.a, -plant.b @ own.c], [own.b @ plant.c, own.a - own.b @ loop.plant.static @ own.c]]
    )


@dataclass(frozen=True)
class Pole:
    """A pole of a loop, and which mode of the plant swings with it.

    Attributes
    ----------
    value : complex
        With a positive imaginary part, or real.
    mode : int
        Of the plant, from 0: the one of the largest energy.
    share : float
        Its share of the energy of all modes.
    """

    value: complex
    mode: int
    share: float


def closed_poles(loop: Loop) -> tuple[Complex, Pole]:
    """Return all poles of a loop, those that decay least first, and what swings with the first.

    Returns
    -------
    poles : ndarray of complex, shape (2 n + r,)
    worst : Pole
    """
    values, vectors = np.linalg.eig(closed_matrix(loop))
    # Of a pair the upper one first.
    order = np.lexsort((values.imag < 0, -values.real))
    first = order[0]
    count = len(loop.plant.squared)
    moved, moving = np.abs(vectors[:count, first]), np.abs(vectors[count : 2 * count, first])
    energy = loop.plant.squared * moved**2 + moving**2
    worst = Pole(
        complex(values[first]), int(energy.argmax()), float(energy.max() / max(energy.sum(), 1e-300))
    )
    return np.asarray(values[order], dtype=np.complex128), worst


def vector_of(matrix: Array, value: complex) -> Complex:
    """Return the vector of an eigenvalue that is known, by inverse iteration; in no unit."""
    near = lu_factor(matrix - value * (1.0 + _BESIDE) * np.eye(len(matrix)), check_finite=False)
    vector = np.random.default_rng(0).standard_normal(len(matrix)).astype(complex)
    for _ in range(_INVERSE):
        vector = lu_solve(near, vector, check_finite=False)
        vector /= np.abs(vector).max()
    return vector


# Transfer matrix (m, p) of a plant at a complex frequency, and its derivative.
Response = Callable[[complex], tuple[Complex, Complex]]


def refined_pole(pole: complex, plant: Response, controller: LinearModel) -> complex:
    """Return the pole of a loop next to a given one, from the plant's exact transfer function.

    Newton's iteration for the eigenvalue of I + G(s) H(s) next to zero, which is a smooth function of s also
    where two poles are close to each other.

    Raises
    ------
    UserError
        If it does not settle, because the loop has no pole there.
    """
    s = pole
    for _ in range(_STEPS):
        g, slope = plant(s)
        h, bend = _controller_at(controller, s)
        values, right = np.linalg.eig(np.eye(len(g)) + g @ h)
        near = int(np.abs(values).argmin())
        left = np.linalg.inv(right)[near]
        change = left @ (slope @ h + g @ bend) @ right[:, near]
        if change == 0:
            break
        with np.errstate(over="ignore", invalid="ignore"):
            step = values[near] / change
        s -= complex(step)
        if not np.isfinite(s * s):
            break
        if abs(step) <= _SETTLED * abs(s):
            return s
    raise UserError(f"No pole of the full model was found near {pole:.6g} 1/s.")


def _controller_at(controller: LinearModel, s: complex) -> tuple[Complex, Complex]:
    matrix = s * np.eye(len(controller.a)) - controller.a
    once = np.linalg.solve(matrix, controller.b.astype(complex))
    return controller.c @ once, -controller.c @ np.linalg.solve(matrix, once)
