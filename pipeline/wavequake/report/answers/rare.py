"""How often a limit is exceeded: by the modal model, and what full traces near the limit say of it."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.table import Table

from wavequake.campaign.contract import DONE
from wavequake.campaign.rare.certificate import Correction, RareProbability, correction, weighted
from wavequake.campaign.rare.quadratic import limit_of
from wavequake.campaign.schema import Study
from wavequake.campaign.statistics.judged import judged_in
from wavequake.campaign.statistics.quantiles import Quantile
from wavequake.campaign.store.store import open_store
from wavequake.errors import UserError
from wavequake.report.answers.tail import per_case
from wavequake.report.table import empty_table, number
from wavequake.words import counted
from wavequake.workflows.limits import in_unit, unit_of
from wavequake.workflows.rare import modal_answer, rare_folder, rare_study
from wavequake.workflows.run import run_study
from wavequake.workflows.segments.rare import RareCases

_WIDE = 0.1  # share of the probability that a correction may leave open


@dataclass(frozen=True)
class RareAnswer:
    """How often a limit is exceeded, and what is known of it.

    Attributes
    ----------
    name, measure, unit : str
        The disturbance, what is limited, and its unit.
    limit : float
    exact : float
        Probability by the modal model.
    numbers : int
        Of Gaussian numbers that a case draws.
    modal, traced : RareProbability
        By weighted draws of the modal model, and by the weighted traces alone.
    correction : Correction
        What full traces change of the modal model's probability.
    certified : Quantile
        The probability with that correction, and its 95 % interval.
    limits : Quantile
        Limit that is exceeded with the modal model's probability according to the traces.
    difference : float
        Largest difference of a traced case to the modal model, in the unit.
    store : Path
        Of the traces.
    """

    name: str
    measure: str
    unit: str
    limit: float
    exact: float
    numbers: int
    modal: RareProbability
    traced: RareProbability
    correction: Correction
    certified: Quantile
    limits: Quantile
    difference: float
    store: Path


def rare_answer(
    study: Study,
    measure: str | None = None,
    limit: str | float | None = None,
    probability: float | None = None,
    *,
    of: str | None = None,
    traces: int | None = None,
    store: Path | str | None = None,
    on: str = "serial",
    workers: int | None = None,
    progress: Callable[[int, int, int], None] | None = None,
) -> RareAnswer:
    """Return how often a limit is exceeded; the traces go to a store, which may have some of them already.

    Raises
    ------
    UserError
        As `wavequake.workflows.rare.rare_study` and `rare_cases`, for a limit of another unit, or as
        `run_study`.
    """
    if probability is not None and not 1e-200 < probability < 0.5:
        raise UserError(f"The probability {probability:g} must be between 1e-200 and 0.5, as 1e-6.")
    own = getattr(study, "rare", None)
    named = measure or (own.measure if own else "wfe_rms")
    wanted = None if limit is None else in_unit(limit, unit_of(named))
    made = rare_study(study, measure, wanted, probability, of, traces)
    cases, modal = modal_answer(made)
    path = rare_folder(study, made, store)
    run_study(made, path, on=on, workers=workers, progress=progress)
    assert made.rare is not None
    dataset = open_store(path)
    known = dataset["status"].to_numpy() == DONE
    judged = judged_in(made.rare.measure, dataset)
    (values,) = per_case(dataset, judged, "rms").values()
    labels = cases.labels(dataset["realization"].to_numpy())
    weights, cheap = np.exp(labels["log_weight"]), labels["modal_value"]
    at_limit = float(cases.tilt.weights(np.array(cases.limit**2)))
    exceeds = known & (values > cases.limit)
    found = correction(weights, at_limit, cheap > cases.limit, exceeds, known)
    exact, ends = cases.probability, [max(cases.probability + end, 0.0) for end in (found.low, found.high)]
    certified = Quantile(max(exact + found.value, 0.0), *ends)
    return RareAnswer(
        name=next(entry.name for entry in made.disturbance if entry.share),
        measure=made.rare.measure,
        unit=str(dataset[judged.variable].attrs["units"]),
        limit=cases.limit,
        exact=exact,
        numbers=len(cases.motions.moving),
        modal=modal,
        traced=weighted(np.where(exceeds, weights, 0.0), cases.limit),
        correction=found,
        certified=certified,
        limits=Quantile(*(_limit(cases, one) for one in (certified.value, *ends))),
        difference=float(np.abs(values - cheap)[known].max()) if known.any() else np.nan,
        store=path,
    )


def _limit(cases: RareCases, chance: float) -> float:
    """Return what is exceeded as often as the limit by the modal model, if that is exceeded with `chance`."""
    if chance <= 0.0:
        return 0.0
    return float(np.sqrt(max(limit_of(cases.tilt.form, min(cases.probability**2 / chance, 0.9)), 0.0)))


def rare_table(answer: RareAnswer) -> Table:
    """Return the answer as a table for the terminal."""
    asked = f"{answer.name}: {answer.measure} above\n{number(answer.limit, 4)} {answer.unit}"
    headers = (asked, "probability\n(95 % interval)", "from")
    table = empty_table(headers, (asked, "from"), fixed=True, pad_edge=False)
    found = answer.correction
    table.add_row(
        "modal model, exact",
        f"{answer.exact:.3g}",
        f"distribution of a quadratic form of {answer.numbers} Gaussian numbers",
    )
    table.add_row("modal model, drawn", _words(answer.modal), f"{answer.modal.evaluations} weighted draws")
    table.add_row("full traces alone", _words(answer.traced), counted(found.cases, "weighted case"))
    low, middle, high = (f"{100.0 * one / answer.exact:+.2g}" for one in (found.low, found.value, found.high))
    table.add_row(
        "correction by full traces",
        f"{middle} % ({low} to {high} %)",
        f"{found.more} of {found.cases} cases exceed the limit in full traces alone, {found.fewer} in the "
        "modal model alone",
    )
    table.add_row(
        "certified", _words(answer.certified), "modal model, exact, with the correction", style="bold"
    )
    return table


def _words(found: RareProbability | Quantile) -> str:
    return f"{found.value:.3g} ({found.low:.3g}–{found.high:.3g})"


def rare_notes(answer: RareAnswer) -> Iterator[str]:
    """Yield what the numbers mean and where they are not to be trusted, in lines."""
    unit, found = answer.unit, answer.correction
    ends = sorted((answer.limits.low, answer.limits.high))
    plain = float(f"{100.0 / answer.exact:.2g}")
    yield (
        f"Exceeded with a probability of {answer.exact:.3g}: {answer.limits.value:.5g} {unit} "
        f"({ends[0]:.5g}–{ends[1]:.5g}). Plain Monte Carlo to 10 %: {plain:.6g} cases."
    )
    yield (
        f"Cases are drawn near the limit and traced in full; they differ from the modal model by at most "
        f"{answer.difference:.2g} {unit}. What is certified is the model of the study: its distributions are "
        "taken as they are, however far out."
    )
    if found.unknown:
        yield (
            f"WARNING {found.unknown} of {found.cases} cases cannot be traced; the interval counts them on "
            "the worse side (wavequake status says why)."
        )
    left = (found.high - found.low) / 2.0 / answer.exact
    if left > _WIDE and not found.more + found.fewer + found.unknown:
        enough = int(np.ceil(found.cases * left / _WIDE))
        yield (
            f"WARNING {found.cases} traces without a difference prove the probability to {100.0 * left:.2g} "
            f"% only; for {100.0 * _WIDE:g} % take --traces {enough}."
        )
    elif left > _WIDE:
        yield (
            "WARNING Full traces do not confirm the modal model's probability to 10 %: the interval says "
            "what they do; it narrows with more --traces."
        )
