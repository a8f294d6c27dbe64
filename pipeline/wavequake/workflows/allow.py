"""How far segments may be off, so that a wavefront stays below a limit, and full traces as the check."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from wavequake.campaign.contract import DONE
from wavequake.campaign.rare.quadratic import largest_factor
from wavequake.campaign.schema import Study
from wavequake.campaign.statistics.judged import judged_of_template
from wavequake.campaign.statistics.quantiles import Quantile, quantile
from wavequake.errors import UserError
from wavequake.kernels.device.devices import choose_device
from wavequake.mechanics.disturbances.motion import Motion, generator, still
from wavequake.mechanics.disturbances.registry import instants_of
from wavequake.optics.segments.modal import COMMON, RIGID, ModalModel
from wavequake.workflows.rare import rare_study
from wavequake.workflows.segments.bench import MM_PER_M, Bench, bench_of
from wavequake.workflows.segments.segment_disturbance import CaseDraw, trace_draws
from wavequake.workflows.segments.segment_model import model_of
from wavequake.workflows.segments.segment_rare import (
    MEASURES,
    GaussianMotions,
    form_of_motions,
    form_of_numbers,
    gaussian_motions,
)
from wavequake.workflows.segments.segment_template import template

Array = NDArray[np.float64]
Progress = Callable[[int, int, int], None]

AXES = ("dx", "dy", "dz", "rx", "ry", "rz")
WAYS = ("shares", "factor")
FEWEST = 100
_STREAM = "~allow"
_AT_ONCE = 32


@dataclass(frozen=True)
class Allowances:
    """How far every segment may be off along every axis that its disturbance moves.

    Attributes
    ----------
    elements : tuple of str, length S
    axes : tuple of str, length D
        dx ... rz, or ``figure 4`` for the figure's Noll term.
    rms : ndarray, shape (D, S)
        In m, or rad of turns; infinite of what does nothing.
    shares : ndarray, shape (D, S)
        Of the mean square of the measure beyond that at rest, at these allowances.
    factor : float
        By which this is what the study has; NaN of equal shares.
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
    factor: float
    unit: str
    check: Quantile
    cases: int
    failed: int


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
    """Return how far segments may be off until a quantile of a measure reaches a limit.

    Parameters
    ----------
    study : Study
        Of the workflow segment-disturbance.
    measure : str
        As ``[rare]`` names it: the rms over the instants of a case.
    probability : float
        With which the limit may be exceeded, below 0.5.
    limit : float
        In the measure's unit.
    by : "shares" or "factor"
        Every segment and axis that the disturbance moves costs the same mean square, each independent of the
        others; or what the study has, times one factor.
    of : str, optional
        The disturbance, where there are several.
    cases : int
        That are drawn with these allowances and traced in full.

    Raises
    ------
    UserError
        If the limit is exceeded at rest, the disturbance is no sum of Gaussian numbers or moves more than
        segments (shares), or the measure is unknown.
    """
    if study.study.workflow != "segment-disturbance":
        raise UserError(f"Allowances are of segment-disturbance studies, not of {study.study.workflow}.")
    if by not in WAYS:
        raise UserError(f"There is no way {by!r} to allow; use {' or '.join(WAYS)}.")
    if cases < FEWEST:
        raise UserError(f"{cases} cases check nothing; take at least {FEWEST}.")
    made = rare_study(study, measure, None, probability, of)
    text = made.identity_text()
    bench, model = bench_of(text), model_of(text, "numpy")
    judged = judged_of_template(measure, template(text))
    if judged.variable not in MEASURES:
        raise UserError(f"{judged.variable!r} has no allowances; use one of {', '.join(MEASURES)}.")
    unit = str(template(text).per_case[judged.variable].attrs["units"])
    population = next(entry for entry in made.disturbance if entry.share)
    with threadpool_limits(1):
        motions = gaussian_motions(bench, model, population)
        if motions.rest.any():
            raise UserError(f"{population.name!r} is not zero on average, and has no allowances.")
        square = form_of_motions(bench, model, judged)
        costs = np.diag(square.square)
        if by == "shares":
            motions = _equal(motions, costs, population.name)
        form = form_of_numbers(square, motions)
        if form.constant >= limit**2:
            raise UserError(
                f"At rest {measure} is {np.sqrt(form.constant):.4g} {unit} already; no allowance keeps it "
                f"below {limit:g} {unit}."
            )
        factor = largest_factor(form, limit**2, probability)
    motions = replace(motions, columns=factor * motions.columns)
    rms = np.sqrt(np.mean(np.sum(motions.columns**2, axis=0), axis=0))[:-COMMON]
    each = (rms**2 * costs[:-COMMON]).reshape(len(model.dofs), -1)
    found, failed = _traced(bench, model, motions, judged.chosen, (judged.variable, cases), progress)
    turns = np.array([RIGID > dof >= 3 for dof in model.dofs])
    metric = rms.reshape(len(model.dofs), -1) / np.where(turns, 1.0, MM_PER_M)[:, None]
    moved = metric.any(axis=1)
    return Allowances(
        bench.layout.names,
        tuple(_name(dof) for dof, any_ in zip(model.dofs, moved, strict=True) if any_),
        metric[moved],
        (each / max(form.mean - form.constant, 1e-300) / factor**2)[moved],
        factor if by == "factor" else np.nan,
        unit,
        quantile(np.sort(found), 1.0 - probability),
        cases,
        failed,
    )


def _name(dof: int) -> str:
    return AXES[dof] if dof < RIGID else f"figure {dof - RIGID + 1}"


def _equal(motions: GaussianMotions, costs: Array, name: str) -> GaussianMotions:
    """Return independent motions of all that a disturbance moves, each of which costs the same."""
    moved: NDArray[np.bool_] = np.asarray(motions.columns.any(axis=(0, 1)))
    if moved[-COMMON:].any():
        raise UserError(
            f"The disturbance {name!r} moves M2 or the mount; equal shares are of motions of segments: take "
            "--by factor."
        )
    acting: NDArray[np.bool_] = moved & (costs > 1e-12 * costs[moved].max())
    idle = int(np.count_nonzero(moved & ~acting))
    if idle:
        raise UserError(
            f"{idle} of {np.count_nonzero(moved)} motions of the disturbance {name!r} do nothing to what is "
            "limited, and have no share of it: leave them out of the study."
        )
    places = np.flatnonzero(acting)
    columns = np.zeros((len(places), 1, len(costs)))
    columns[np.arange(len(places)), 0, places] = 1.0 / np.sqrt(costs[places])
    return GaussianMotions((), np.arange(len(places)), np.zeros((1, len(costs))), columns)


def _traced(
    bench: Bench,
    model: ModalModel,
    motions: GaussianMotions,
    chosen: object,
    what: tuple[str, int],
    progress: Progress | None,
) -> tuple[Array, int]:
    """Return a measure of cases that are drawn and traced in full, and how many could not be."""
    population = next(entry for entry in bench.study.disturbance if entry.share)
    (variable, cases), places = what, dict(chosen)  # type: ignore[call-overload]
    device = choose_device(bench.study.campaign.device).name
    instants = len(motions.rest)
    time = instants_of(bench.study.disturbance, population)[:instants]
    found: list[Array] = []
    for first in range(0, cases, _AT_ONCE):
        if progress:
            progress(first, cases, 0)
        draws = []
        for case in range(first, min(first + _AT_ONCE, cases)):
            random = generator(bench.study.study.seed, population.name + _STREAM, case)
            numbers = random.standard_normal(len(motions.columns))
            motion = _motion(bench, model, np.tensordot(numbers, motions.columns, 1))
            draws.append(CaseDraw(population, case, time, motion))
        result = trace_draws(bench.text, draws, device)
        values = result.arrays[variable][:, :instants]
        if "axis" in places:
            values = values[..., places["axis"]]
        elif variable in ("los", "centroid"):
            values = np.linalg.norm(values, axis=2)
        elif "noll" in places:
            values = values[..., places["noll"]]
        found.append(np.sqrt(np.mean(values**2, axis=1))[result.status == DONE])
    if progress:
        progress(cases, cases, 0)
    good = np.concatenate(found)
    if len(good) < FEWEST:
        raise UserError(f"{cases - len(good)} of {cases} cases cannot be traced with these allowances.")
    return good, cases - len(good)


def _motion(bench: Bench, model: ModalModel, rows: Array) -> Motion:
    """Return the motion of rows (n, D S + 4) in mm and rad, as `motion_rows` gives them."""
    count, segments = len(rows), len(bench.layout)
    terms = max((dof - RIGID + 1 for dof in model.dofs), default=0)
    motion = still(count, segments, max(terms, 0))
    local = rows[:, :-COMMON].reshape(count, len(model.dofs), segments)
    for column, dof in enumerate(model.dofs):
        if dof < RIGID:
            motion.segment_motion[:, :, dof] = local[:, column] / (MM_PER_M if dof < 3 else 1.0)
        else:
            motion.segment_figure[:, dof - RIGID] = local[0, column] / MM_PER_M
    motion.mount[:] = rows[:, -2:]
    if rows[:, -COMMON:-2].any():
        motion.m2[:] = rows[:, -COMMON:-2] @ np.linalg.inv(bench.m2_tilt.T)
    return motion
