"""Which modes of a model are unstable, unobservable or uncontrollable: reports that name them."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import matrix_balance

from wavequake.control.linear import LinearModel
from wavequake.errors import UserError

# Eigenvalues that differ by less than this share of their size are one mode; so are those that differ by less
# than this share of the norm of A, because defective ones scatter by about 1e-8 of it.
_SAME, _SCATTER = 1e-6, 1e-7
# Below, a mode does not show in an output but by rounding.
_HIDDEN = 1e-9


@dataclass(frozen=True)
class Mode:
    """A pole, or a conjugate pair, of a continuous model.

    Attributes
    ----------
    number : int
        From 1, by rising frequency.
    pole : complex
        In 1/s, with positive imaginary part.
    observability, controllability : float
        0 (hidden) to 1: smallest part of an eigenvector that C (or B) sees, in balanced coordinates.
    """

    number: int
    pole: complex
    observability: float
    controllability: float

    @property
    def omega(self) -> float:
        """Undamped angular frequency, rad/s."""
        return abs(self.pole)

    @property
    def stable(self) -> bool:
        """Whether the mode decays."""
        return self.pole.real < 0.0

    def __str__(self) -> str:
        return f"mode {self.number} ({self.omega:.4g} rad/s, {self.omega / 2 / np.pi:.3g} Hz)"


def modes(model: LinearModel, only: Callable[[complex], bool] = lambda pole: True) -> tuple[Mode, ...]:
    """Return the modes of a continuous model, and how well outputs see and inputs drive each.

    Those whose poles are not asked for are left out: two singular value decompositions each.

    The test is that of Popov, Belevitch and Hautus: a mode is observable if C maps no vector of the null
    space of A - λ I to zero. Repeated poles are one mode. A is balanced first, so that units of the states
    count little.

    Raises
    ------
    UserError
        If the model is sampled or has no states.
    """
    if model.sample_time is not None or not len(model.a):
        raise UserError("Modes are those of a continuous model with at least one state.")
    a, scales = matrix_balance(model.a, permute=False, separate=True)
    scale = np.asarray(scales[0])
    b, c = model.b / scale[:, None], model.c * scale
    norm = max(float(np.linalg.norm(a, 2)), np.finfo(float).tiny)
    values = np.linalg.eigvals(a)
    values = values[values.imag >= -_SCATTER * norm]
    found: list[complex] = []
    for value in values[np.lexsort((values.imag, values.real, np.round(np.abs(values) / norm, 9)))]:
        if all(abs(value - other) > _near(value, norm) for other in found):
            found.append(complex(value))
    return tuple(
        Mode(number, value, _seen(a, c, value, norm), _seen(a.T, b.T, value, norm))
        for number, value in enumerate(found, start=1)
        if only(value)
    )


def grows(pole: complex) -> bool:
    """Whether a mode does not decay."""
    return not pole.real < 0.0


def _near(value: complex, norm: float) -> float:
    return max(_SAME * abs(value), _SCATTER * norm)


def _seen(a: NDArray[np.float64], rows: NDArray[np.float64], value: complex, norm: float) -> float:
    """Return the smallest share of a unit vector in the null space of a - value that `rows` sees.

    Every row counts alike, whatever its unit.
    """
    sizes = np.linalg.norm(rows, axis=1)
    rows = rows[sizes > 0.0] / sizes[sizes > 0.0, None]
    if not rows.size:
        return 0.0
    size = float(np.linalg.norm(rows, 2))
    _, singular, right = np.linalg.svd(a - value * np.eye(len(a)))
    space = right[singular <= max(3 * _near(value, norm), singular[-1])].conj().T
    if space.shape[1] > len(rows):
        return 0.0
    return float(np.linalg.svd(rows @ space, compute_uv=False)[-1]) / size


def check_observable(model: LinearModel, what: str = "The observer") -> None:
    """Raise UserError that names the modes which the outputs do not see."""
    hidden = [mode for mode in modes(model) if mode.observability < _HIDDEN]
    if hidden:
        raise UserError(
            f"{what} cannot be designed: the measurement does not see {_listed(hidden)}; measure another "
            "coordinate, or take out the mode."
        )


def check_controllable(model: LinearModel, what: str = "The regulator") -> None:
    """Raise UserError that names the modes which the inputs do not drive."""
    hidden = [mode for mode in modes(model) if mode.controllability < _HIDDEN]
    if hidden:
        raise UserError(
            f"{what} cannot be designed: the input does not drive {_listed(hidden)}; act on another "
            "coordinate, or take out the mode."
        )


def check_stable(model: LinearModel, what: str = "The model") -> None:
    """Raise UserError that names the modes which do not decay."""
    growing = list(modes(model, only=grows))
    if growing:
        worst = max(growing, key=lambda mode: mode.pole.real)
        raise UserError(f"{what} is unstable: {_listed(growing)} grows, real part {worst.pole.real:.3g} 1/s.")


def _listed(found: list[Mode]) -> str:
    return ", ".join(map(str, found[:5])) + (f" and {len(found) - 5} more" if len(found) > 5 else "")
