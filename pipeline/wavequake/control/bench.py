"""The oscillating lens bench: pendulums, rings and housing on springs (Störkle 2018, Eq. 5.1 to 5.5).

Every lens hangs as a pendulum in a ring, every ring in the housing; springs couple lens and ring, ring and
housing, and neighboring rings. Rotations are small, so coordinates are horizontal displacements and inertias
are masses I/l². With six lenses the chain has 13 degrees of freedom, without the fifth one, which the stage
carries, 11.
"""

import tomllib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.linalg import eigh

from wavequake.control.linear import Array, LinearModel, second_order_model
from wavequake.errors import UserError
from wavequake.prepared import prepared

# Image displacement per lens displacement (Störkle 2018, Table 5.1).
SENSITIVITIES = (0.071, -0.366, 1.303, -0.913, 1.394, 0.145)
LENSES = 6
COMPENSATOR = 4  # index of the lens that the stage carries
MEASURED = 3  # index of the lens that the Hall sensor sees
GRAVITY = 9.81

_PARAMETERS = ("lens_kg", "ring_kg", "lens_springs", "ring_springs", "couplings")


@dataclass(frozen=True)
class Bench:
    """Parameters of the bench; masses kg, springs N/m.

    Attributes
    ----------
    lens_kg, ring_kg : ndarray, shape (6,)
        Inertia of each lens and ring over its squared pendulum length.
    housing_kg : float
    lens_springs, ring_springs : ndarray, shape (6,)
        Between lens and ring, ring and housing.
    couplings : ndarray, shape (5,)
        Between neighboring rings.
    housing_spring : float
        Between housing and ground.
    pendulum_m : float
        Length of all pendulums.
    alpha, beta : float
        Rayleigh damping alpha M + beta K, 1/s and s.
    active : bool
        Whether the stage carries lens 5: it and its ring are no bodies of the chain then.
    """

    lens_kg: Array
    ring_kg: Array
    housing_kg: float
    lens_springs: Array
    ring_springs: Array
    couplings: Array
    housing_spring: float
    pendulum_m: float = 0.25
    alpha: float = 0.03
    beta: float = 3e-4
    active: bool = True

    def __post_init__(self) -> None:
        for name in _PARAMETERS:
            _check(name, getattr(self, name), 5 if name == "couplings" else LENSES)
        for name in ("housing_kg", "housing_spring", "pendulum_m"):
            _check(name, np.array([getattr(self, name)]), 1)
        if not (np.isfinite([self.alpha, self.beta]).all() and min(self.alpha, self.beta) >= 0):
            raise UserError("The bench's damping parameters alpha and beta must be finite and not negative.")

    @property
    def lenses(self) -> list[int]:
        """Indices of the lenses that swing."""
        return [lens for lens in range(LENSES) if not (self.active and lens == COMPENSATOR)]

    @property
    def size(self) -> int:
        """Number of degrees of freedom, 11 or 13; the lenses come first, then the rings, then the housing."""
        return 2 * len(self.lenses) + 1


def _check(name: str, values: Array, count: int) -> None:
    if np.shape(values) != (count,):
        raise UserError(f"The bench's {name} needs {count} values, not {np.size(values)}.")
    if not (np.isfinite(values).all() and np.min(values) >= 0 and (np.min(values) > 0 or "kg" not in name)):
        raise UserError(f"The bench's {name} must be finite and positive (springs may be 0).")


@prepared(maxsize=4)
def fitted_bench(springs: str = "initial", active: bool = True) -> Bench:
    """Return the synthetic bench: fitted to what is known of the real one (see lens_bench.toml).

    Parameters
    ----------
    springs : {"initial", "changed"}
        Spring configurations (a) and (b) of Störkle 2018, Fig. 5.37: in the second one, the lower of the two
        springs between lens and ring is taken out.
    active : bool
        Whether the stage carries lens 5.

    Raises
    ------
    UserError
        If there is no such configuration.
    """
    record = tomllib.loads((Path(__file__).parent / "lens_bench.toml").read_text(encoding="utf-8"))
    factors = np.array(record.pop("lower_spring_removed"))
    values: dict[str, Any] = {
        name: np.array(value) if name in _PARAMETERS else value for name, value in record.items()
    }
    bench = Bench(**values, active=active)
    if springs == "initial":
        return bench
    if springs == "changed":
        return replace(bench, lens_springs=bench.lens_springs * factors)
    raise UserError(f"There is no spring configuration {springs!r}; choose initial or changed.")


def mass_and_stiffness(bench: Bench) -> tuple[Array, Array]:
    """Return the diagonal of the mass matrix, (n,), and the stiffness matrix, (n, n), of Eq. 5.2."""
    kept, count = bench.lenses, len(bench.lenses)
    housing = 2 * count
    masses = np.concatenate([bench.lens_kg[kept], bench.ring_kg[kept], [bench.housing_kg]])
    ends = [(place, count + place, bench.lens_springs[lens]) for place, lens in enumerate(kept)]
    ends += [(count + place, housing, bench.ring_springs[lens]) for place, lens in enumerate(kept)]
    ends += [
        (count + place, count + place + 1, bench.couplings[lens])
        for place, lens in enumerate(kept[:-1])
        if kept[place + 1] == lens + 1
    ]
    stiffness = np.diag(masses * GRAVITY / bench.pendulum_m)
    stiffness[housing, housing] += bench.housing_spring
    for one, other, spring in ends:
        stiffness[[one, other], [one, other]] += spring
        stiffness[[one, other], [other, one]] -= spring
    return masses, stiffness


def image_row(bench: Bench) -> Array:
    """Return the sensitivities of the image to the coordinates, (n,) (Eq. 5.1)."""
    row = np.zeros(bench.size)
    row[: len(bench.lenses)] = np.array(SENSITIVITIES)[bench.lenses]
    return row


def measured_row(bench: Bench) -> Array:
    """Return the row of the measured lens, (n,)."""
    row = np.zeros(bench.size)
    row[MEASURED] = 1.0
    return row


def force_column(bench: Bench) -> Array:
    """Return the input column of the hammer, which hits the housing, (n,)."""
    column = np.zeros(bench.size)
    column[-1] = 1.0
    return column


def bench_model(bench: Bench) -> LinearModel:
    """Return the bench from hammer force to (image, measured lens), states (q, q') (Eq. 5.16)."""
    masses, stiffness = mass_and_stiffness(bench)
    damping = bench.alpha * np.diag(masses) + bench.beta * stiffness
    rows = np.stack([image_row(bench), measured_row(bench)])
    return second_order_model(np.diag(masses), damping, stiffness, force_column(bench), rows)


@dataclass(frozen=True)
class BenchModes:
    """Modes of a bench: q = shapes η, η'' + 2 σ η' + ω² η = shapesᵀ f.

    Attributes
    ----------
    omega : ndarray, shape (n,)
        Undamped, rad/s.
    poles : ndarray of complex, shape (n,)
        -σ + i sqrt(ω² - σ²), 1/s.
    shapes : ndarray, shape (n, n)
        Mass-normalized, a mode per column.
    """

    omega: Array
    poles: np.ndarray[tuple[int], np.dtype[np.complex128]]
    shapes: Array


def bench_modes(bench: Bench) -> BenchModes:
    """Return the modes of a bench.

    Raises
    ------
    UserError
        If a mode has no stiffness or is overdamped.
    """
    masses, stiffness = mass_and_stiffness(bench)
    squared, shapes = eigh(stiffness, np.diag(masses))
    decay = (bench.alpha + bench.beta * squared) / 2
    if (squared <= decay**2).any():
        number = int(np.argmax(squared <= decay**2)) + 1
        raise UserError(f"Mode {number} of the bench does not swing: it is overdamped, or has no stiffness.")
    # The sign of a mode is free: the hammer pushes it forward.
    shapes = shapes * np.where(shapes[-1] < 0, -1.0, 1.0)
    return BenchModes(np.sqrt(squared), -decay + 1j * np.sqrt(squared - decay**2), shapes)
