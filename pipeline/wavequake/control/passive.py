"""Passive suppression of image motion: springs and inertias under which a blow moves the image least.

Störkle 2018, Section 5.1.1, Eq. 5.3 and 5.4.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize

from wavequake.control.bench import Bench, bench_modes, force_column, image_row, mass_and_stiffness
from wavequake.control.hammer import HAMMER
from wavequake.control.linear import Array
from wavequake.control.regulator import blow_spectrum
from wavequake.errors import UserError

_SPRINGS, _INERTIAS = ("lens_springs", "ring_springs", "couplings"), ("lens_kg", "ring_kg")


@dataclass(frozen=True)
class Optimized:
    """A bench with less image motion.

    Attributes
    ----------
    bench : Bench
    before, after : float
        Sum of the amplitudes of the modes in the image after the blow, m.
    evaluations : int
    """

    bench: Bench
    before: float
    after: float
    evaluations: int


def modal_amplitudes(bench: Bench) -> Array:
    """Return the image amplitude of each mode after the blow, m: the terms of Eq. 5.4 but for a factor of 2.

    A mode swings after the blow with C_j B_j |u(ω_j)| / ω_j, where u is the spectrum of the force.
    """
    modes = bench_modes(bench)
    shares = (image_row(bench) @ modes.shapes) * (force_column(bench) @ modes.shapes)
    return np.asarray(np.abs(shares) * _size(modes.omega))


def objective(bench: Bench) -> float:
    """Return the sum of all modes' amplitudes, m: image motion cannot exceed it.

    Eq. 5.4 adds terms with their signs, of which large ones may cancel; amplitudes are what it is after.
    """
    return float(modal_amplitudes(bench).sum())


def optimize(
    bench: Bench,
    *,
    springs: bool = True,
    inertias: bool = True,
    factor: float = 1.5,
    start: Array | None = None,
    iterations: int = 200,
) -> Optimized:
    """Search springs and inertias within a factor of their present values for the least image motion.

    Parameters
    ----------
    bench : Bench
    springs, inertias : bool
        What may change.
    factor : float
        Largest ratio of new and present values, both ways.
    start : ndarray, shape (n,), optional
        Where to start, as shares -1 to 1 of the logarithm of `factor`; at the present values by default.
        There are many local minima: try several.
    iterations : int
        At most.

    Raises
    ------
    UserError
        If nothing may change, or the factor is not above 1.
    """
    names = _SPRINGS * springs + _INERTIAS * inertias
    if not names:
        raise UserError("Neither springs nor inertias may change; nothing is left to optimize.")
    if not 1 < factor < np.inf:
        raise UserError(f"The factor is {factor}; it must be above 1.")
    sizes = [len(getattr(bench, name)) for name in names]
    first = np.zeros(sum(sizes)) if start is None else np.asarray(start, dtype=np.float64)
    if first.shape != (sum(sizes),) or not (np.abs(first) <= 1).all():
        raise UserError(f"The start needs {sum(sizes)} shares between -1 and 1.")

    def changed(shares: Array) -> Bench:
        parts = np.split(factor**shares, np.cumsum(sizes)[:-1])
        values = {name: getattr(bench, name) * part for name, part in zip(names, parts, strict=True)}
        return replace(bench, **values)

    scale, (masses, stiffness) = objective(bench), directions(bench, names)

    def cost(shares: Array) -> tuple[float, Array]:
        ratios = factor**shares
        value, slope = objective_and_slope(
            changed(shares), masses * ratios[:, None], stiffness * ratios[:, None, None]
        )
        return value / scale, slope * np.log(factor) / scale

    found = minimize(
        cost, first, jac=True, method="L-BFGS-B", bounds=[(-1, 1)] * len(first),
        options={"maxiter": iterations},
    )  # fmt: skip
    best = changed(found.x)
    return Optimized(best, scale, objective(best), int(found.nfev))


def objective_and_slope(bench: Bench, masses: Array, stiffness: Array) -> tuple[float, Array]:
    """Return the objective and its derivatives along changes of the matrices, as `directions` gives.

    Modes and frequencies are followed to first order in the changes of the mass and stiffness matrices.
    """
    modes = bench_modes(bench)
    omega, shapes = modes.omega, modes.shapes
    squared = omega**2
    # (parameter, i, j): how much of mode i the change mixes into mode j, and how it moves the frequency of j.
    by_mass = np.einsum("ai,pa,aj->pij", shapes, masses, shapes)
    force = np.einsum("ai,pab,bj->pij", shapes, stiffness, shapes) - by_mass * squared
    gaps = squared - squared[:, None]
    np.fill_diagonal(gaps, 1.0)
    mixed = force / gaps
    own = np.arange(len(omega))
    mixed[:, own, own] = -0.5 * by_mass[:, own, own]
    seen, driven = image_row(bench) @ shapes, force_column(bench) @ shapes
    shares = seen * driven
    slopes = np.einsum("i,pij->pj", seen, mixed) * driven + seen * np.einsum("i,pij->pj", driven, mixed)
    size, steeper = _size(omega), (_size(omega * (1 + 1e-6)) - _size(omega * (1 - 1e-6))) / (2e-6 * omega)
    faster = force[:, own, own] / (2 * omega)
    slope = (np.sign(shares) * slopes * size + np.abs(shares) * steeper * faster).sum(axis=1)
    return float((np.abs(shares) * size).sum()), np.asarray(slope)


def _size(omega: Array) -> Array:
    """Return |u(ω)|/ω, the amplitude of an oscillator of unit mass after the blow."""
    return np.asarray(np.abs(blow_spectrum(HAMMER, 1j * omega.astype(np.complex128))) / omega)


def directions(bench: Bench, names: tuple[str, ...]) -> tuple[Array, Array]:
    """Return how mass diagonal (p, n) and stiffness (p, n, n) change by the logarithm of each parameter.

    Both are linear in all parameters, so that doubling one shows its whole part.
    """
    masses, stiffness = mass_and_stiffness(bench)
    found = []
    for name in names:
        values = getattr(bench, name)
        for place in range(len(values)):
            doubled = values.copy()
            doubled[place] *= 2
            found.append(mass_and_stiffness(replace(bench, **{name: doubled})))
    return (
        np.stack([one for one, _ in found]) - masses,
        np.stack([other for _, other in found]) - stiffness,
    )
