"""How far the elements of a study may be off so that a measure stays below a limit, and traces as the check.

Segments of a telescope, or surfaces and bodies of any optical system.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from threadpoolctl import threadpool_limits

from wavequake.campaign.rare.quadratic import largest_factor
from wavequake.campaign.schema import Study
from wavequake.campaign.statistics.quantiles import Quantile, quantile
from wavequake.chain.gaussian_forms import form_of_numbers
from wavequake.errors import UserError
from wavequake.mechanics.disturbances.gaussian import GaussianMotions, NotGaussianError
from wavequake.mechanics.disturbances.motion import generator
from wavequake.workflows.allow_motions import AllowedMotions, allowed_motions, of_columns, power_of
from wavequake.workflows.asked_sections import STATIC, AllowedSpectrumSection, AllowSection
from wavequake.workflows.movable import Movable
from wavequake.workflows.rare import chosen_disturbance, rare_study
from wavequake.workflows.segments.allow import segment_movable
from wavequake.workflows.segments.study import SegmentStudy
from wavequake.workflows.systems.allow import system_movable
from wavequake.workflows.systems.study import SystemStudy

Array = NDArray[np.float64]
Progress = Callable[[int, int, int], None]

WAYS = ("shares", "cost", "factor")
FEWEST, MOST = 100, 1_000_000  # cases of a check
_STREAM = "~allow"
_AT_ONCE = 32
_TRIALS = 4000  # by the linear model, of motions that are no sums of Gaussian numbers


@dataclass(frozen=True)
class Allowances:
    """How far every element may be off along every axis that its disturbance moves.

    Attributes
    ----------
    elements : tuple of str, length S
    axes : tuple of str, length D
        dx ... rz, or ``figure 4`` for the figure's Noll term.
    rms : ndarray, shape (D, S)
        In m, or rad of turns; infinite of what does nothing, NaN of what the disturbance does not move.
    shares : ndarray, shape (D, S)
        Of the mean square of the measure beyond that at rest, at these allowances.
    kinds : ndarray of object, shape (D, S)
        How it moves during a case: ``static``, ``rms``, or the name of a spectrum; "" of what does not move.
    levels : ndarray, shape (D, S)
        By what the named spectrum of the study is to be multiplied to be that of the motion, in m^2/Hz or
        rad^2/Hz; NaN of all else.
    spectra : mapping
        The spectra of the study by name.
    factor : float
        By which this is what the study has; NaN of shares.
    exact : bool
        Whether the quantile of the linear model is exact, not that of drawn cases.
    unit : str
        Of the measure.
    check : Quantile
        The same quantile of `cases` full traces, with its 95 % interval.
    failed : int
        Of these, that could not be traced.
    """

    elements: tuple[str, ...]
    axes: tuple[str, ...]
    rms: Array
    shares: Array
    kinds: NDArray[np.object_]
    levels: Array
    spectra: Mapping[str, AllowedSpectrumSection]
    factor: float
    exact: bool
    unit: str
    check: Quantile
    cases: int
    failed: int


@dataclass(frozen=True)
class _Found:
    """Rms (K,) of the columns, the mean square that they cost, the factor, and the motion of a case."""

    rms: Array
    excess: float
    factor: float
    case: Callable[[int], Array]


def allowances(
    study: Study,
    measure: str,
    probability: float,
    limit: float,
    by: str = "shares",
    of: str | None = None,
    cases: int = 400,
    progress: Progress | None = None,
) -> Allowances:
    """Return how far segments, surfaces and bodies may be off until a quantile of a measure reaches a limit.

    Parameters
    ----------
    study : Study
        Of the workflow segment-disturbance or system-disturbance.
    measure : str
        As `wavequake tail` names it: the rms over the instants of a case; of a system over the field points,
        too, unless one is chosen, at the primary wavelength.
    probability : float
        With which the limit may be exceeded, below 0.5.
    limit : float
        In the measure's unit.
    by : "shares", "cost" or "factor"
        Every element and axis that the disturbance moves costs the same mean square, each independent of the
        others; or in proportion to its cost in ``[allow]``; or what the study has, times one factor.
    of : str, optional
        The disturbance, where there are several.
    cases : int
        That are drawn with these allowances and traced in full.

    Raises
    ------
    UserError
        If the limit is exceeded at rest, nothing that moves changes the measure, the disturbance moves more
        than elements (shares), or the measure is unknown.
    """
    if by not in WAYS:
        raise UserError(f"There is no way {by!r} to allow; use {', '.join(WAYS[:-1])} or {WAYS[-1]}.")
    if not FEWEST <= cases <= MOST:
        words = (
            f"take at least {FEWEST}" if cases < FEWEST else f"{MOST} are enough, and all that is possible"
        )
        raise UserError(f"{cases} cases {'check nothing' if cases < FEWEST else 'are too many'}; {words}.")
    own: AllowSection | None = getattr(study, "allow", None)
    cost = _cost_of(own, by)
    movable = _movable(study, measure, probability, of)
    rest = np.sqrt(movable.form.constant)
    if rest >= limit:
        raise UserError(
            f"At rest {measure} is {rest:.4g} {movable.unit} already; no allowance keeps it below {limit:g} "
            f"{movable.unit}."
        )
    if not (movable.moved & ~movable.idle).any():
        raise UserError(
            f"What the disturbance {movable.name!r} moves does nothing to {measure}: anything is allowed."
        )
    goal, kinds = (limit**2, probability), [""] * len(movable.place)
    with threadpool_limits(1):
        if by == "factor":
            exact, found = _grown(movable, goal)
        else:
            kinds = _kinds_of(movable, own)
            motions = _shared(movable, _weights(movable, cost), kinds, own.spectrum if own else {})
            exact, found = True, _of_shares(movable, motions, goal)
    values = _checked(movable, found.case, cases, progress)
    known = np.sort(values[np.isfinite(values)])
    if len(known) < FEWEST:
        raise UserError(
            f"{cases - len(known)} of {cases} cases cannot be traced with these allowances; take a lower "
            "limit or more cases."
        )
    count = len(movable.place)
    costs = np.diag(movable.form.square)[:count]
    moved, idle = movable.moved[:count], movable.idle[:count]
    allowed = np.where(idle, np.inf, found.rms[:count] * movable.metric)
    share = np.where(idle, 0.0, found.rms[:count] ** 2 * costs / max(found.excess, 1e-300))
    powers = [power_of(own.spectrum[kind]) if own and kind in own.spectrum else np.nan for kind in kinds]

    def table(values: Sequence[object] | Array, nothing: object) -> NDArray[Any]:
        """Return values of the columns by axis and element."""
        axis, element = movable.place[moved].T
        found = np.full((len(movable.axes), len(movable.elements)), nothing, np.asarray(values).dtype)
        found[axis, element] = np.asarray(values)[moved]
        return found

    rms = table(allowed, np.nan)
    used = ~np.isnan(rms).all(axis=1)
    return Allowances(
        elements=movable.elements,
        axes=tuple(name for name, one in zip(movable.axes, used, strict=True) if one),
        rms=rms[used],
        shares=table(share, np.nan)[used],
        kinds=table(np.array(kinds, dtype=object), "")[used],
        levels=table(allowed**2 / np.array(powers), np.nan)[used],
        spectra=own.spectrum if own else {},
        factor=found.factor if by == "factor" else np.nan,
        exact=exact,
        unit=movable.unit,
        check=quantile(known, 1.0 - probability),
        cases=cases,
        failed=cases - len(known),
    )


def _movable(study: Study, measure: str, probability: float, of: str | None) -> Movable:
    if isinstance(study, SystemStudy):
        return system_movable(study, measure, chosen_disturbance(study.disturbance, of))
    if not isinstance(study, SegmentStudy) or study.study.workflow != "segment-disturbance":
        raise UserError(
            "Allowances are of segment-disturbance and system-disturbance studies, not of "
            f"{study.study.workflow}."
        )
    study.require_one_place("Allowances are")
    return segment_movable(rare_study(study, measure, None, probability, of), measure)


def _cost_of(own: AllowSection | None, by: str) -> Mapping[str, float]:
    """Return the own costs of a study, none for equal shares."""
    if by != "cost":
        return {}
    if own is None or not own.cost:
        raise UserError(
            "By which cost? Give the study a table [allow.cost] of elements, axes, or both: M1 = 2.0, "
            'rx = 3.0, "M2 rx" = 5.0.'
        )
    return own.cost


def _weights(movable: Movable, cost: Mapping[str, float]) -> Array:
    """Return the cost of each of the first columns, 1 where none is named."""
    return np.array(of_columns(cost, movable, 1.0, "allow.cost"))


def _kinds_of(movable: Movable, own: AllowSection | None) -> list[str]:
    """Return how each of the first columns moves during a case."""
    kinds = of_columns(own.kind if own else {}, movable, STATIC, "allow.kind")
    for column in np.flatnonzero(movable.lasting & movable.moved[: len(kinds)]).tolist():
        if kinds[column] != STATIC:
            element, axis = movable.column_name(column)
            raise UserError(
                f"allow.kind: {axis!r} of {element!r} is {kinds[column]!r}, but figures of segments do not "
                "change during a case: they are static."
            )
    return kinds


def _shared(
    movable: Movable, weights: Array, kinds: Sequence[str], spectra: Mapping[str, AllowedSpectrumSection]
) -> AllowedMotions:
    """Return independent motions of all that acts, each of which costs its weight of mean square."""
    count, total = len(movable.place), len(movable.moved)
    if movable.moved[count:].any():
        raise UserError(
            f"The disturbance {movable.name!r} moves M2 or the mount; equal shares are of motions of "
            "segments: take --by factor."
        )
    places = np.flatnonzero(movable.moved & ~movable.idle)
    sizes = np.zeros(total)
    sizes[places] = np.sqrt(weights[places] / np.diag(movable.form.square)[places])
    return allowed_motions(movable, sizes, kinds, spectra)


def _of_shares(movable: Movable, motions: AllowedMotions, goal: tuple[float, float]) -> _Found:
    """Return how far independent motions may grow until the goal's limit is exceeded so often: exact."""
    form = motions.form(movable.form)
    factor = largest_factor(form, *goal)
    grown = motions.grown(factor)

    def case(number: int) -> Array:
        return grown.drawn(generator(movable.seed, movable.name + _STREAM, number))

    return _Found(grown.sizes, factor**2 * (form.mean - form.constant), factor, case)


def _of_gaussian(movable: Movable, motions: GaussianMotions, goal: tuple[float, float]) -> _Found:
    """Return how far sums of Gaussian numbers may grow until the goal's limit is exceeded so often: exact."""
    if motions.rest.any():
        raise UserError(f"{movable.name!r} is not zero on average, and has no allowances.")
    form = form_of_numbers(movable.form, motions)
    factor = largest_factor(form, *goal)
    columns = factor * motions.columns

    def case(number: int) -> Array:
        random = generator(movable.seed, movable.name + _STREAM, number)
        return np.asarray(np.tensordot(random.standard_normal(len(columns)), columns, 1))

    rms = np.sqrt(np.mean(np.sum(columns**2, axis=0), axis=0))
    return _Found(rms, factor**2 * (form.mean - form.constant), factor, case)


def _grown(movable: Movable, goal: tuple[float, float]) -> tuple[bool, _Found]:
    """Return whether it is exact, and how far a study's own motions may grow."""
    try:
        return True, _of_gaussian(movable, movable.gaussian(), goal)
    except NotGaussianError:
        return False, _of_draws(movable, goal)


def _of_draws(movable: Movable, goal: tuple[float, float]) -> _Found:
    """Return how far any motions may grow, by the quantile of many draws of the linear model."""
    form, (limit, probability) = movable.form, goal
    slopes, squares, total = np.empty(_TRIALS), np.empty(_TRIALS), np.zeros(len(movable.moved))
    for trial in range(_TRIALS):
        rows = movable.drawn(trial)
        slopes[trial] = np.mean(rows @ form.linear)
        squares[trial] = np.mean(np.sum((rows @ form.square) * rows, axis=1))
        total += np.mean(rows**2, axis=0)

    def lacks(logarithm: float) -> float:
        factor = np.exp(logarithm)
        return (
            float(np.quantile(form.constant + factor * slopes + factor**2 * squares, 1 - probability)) - limit
        )

    middle = 0.5 * float(np.log((limit - form.constant) / squares.mean()))
    factor = float(np.exp(brentq(lacks, middle - 20.0, middle + 20.0, xtol=1e-12)))
    rms = factor * np.sqrt(total / _TRIALS)
    return _Found(
        rms, factor**2 * float(squares.mean()), factor, lambda k: factor * movable.drawn(_TRIALS + k)
    )


def _checked(movable: Movable, case: Callable[[int], Array], cases: int, progress: Progress | None) -> Array:
    """Return the measure of cases that are drawn with the allowances and traced in full."""
    found = []
    for first in range(0, cases, _AT_ONCE):
        if progress:
            progress(first, cases, 0)
        found.append(movable.traced([case(k) for k in range(first, min(first + _AT_ONCE, cases))]))
    if progress:
        progress(cases, cases, 0)
    return np.concatenate(found)
