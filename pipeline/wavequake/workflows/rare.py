"""The campaign that proves a rare event: a study whose cases are drawn near a limit and traced in full."""

from collections.abc import Sequence
from pathlib import Path

from wavequake.campaign.rare.certificate import RareProbability, estimated
from wavequake.campaign.schema import Study
from wavequake.errors import UserError
from wavequake.mechanics.disturbances.population import Population
from wavequake.workflows.segments.rare import RareCases, rare_cases
from wavequake.workflows.segments.study import TRACED, SegmentStudy, without_images
from wavequake.workflows.study import study_with

DRAWS = 50_000
TRACES = 2000
FEWEST = 50


def rare_study(
    study: Study,
    measure: str | None = None,
    limit: float | None = None,
    probability: float | None = None,
    of: str | None = None,
    traces: int | None = None,
) -> SegmentStudy:
    """Return the study whose cases are those of another one near a limit.

    Parameters
    ----------
    study : Study
        Of the workflow segment-disturbance.
    measure : str, optional
        As ``[rare]`` of a study file names it; by default that of the study, or ``wfe_rms``.
    limit, probability : float, optional
        One of them, or what the study's ``[rare]`` says.
    of : str, optional
        The disturbance; by default the only one of which there are cases.
    traces : int, optional
        Number of cases; by default 2000, or as many as a study with ``[rare]`` has.

    Raises
    ------
    UserError
        If the study is of another workflow, has several disturbances to choose from, or neither a limit nor
        a probability is given; or for a wrong key.
    """
    if not isinstance(study, SegmentStudy) or study.study.workflow != "segment-disturbance":
        raise UserError(
            f"Rare events are of segment-disturbance studies, not of {study.study.workflow}: run it and ask "
            "`wavequake tail` of its store."
        )
    study.require_one_place("Rare events are")
    own = study.rare
    traces = traces or (study.cases if own else TRACES)
    if traces < FEWEST:
        raise UserError(f"{traces} traces prove nothing; take at least {FEWEST}.")
    if limit is not None and probability is not None:
        raise UserError("Give either a limit or a probability, not both.")
    if limit is None and probability is None:
        if own is None:
            raise UserError("What is rare? Give a limit, as --limit '120 nm', or a probability.")
        limit, probability = own.limit, own.probability
    names = [entry.name for entry in study.disturbance]
    chosen = chosen_disturbance(study.disturbance, of)
    keys = {
        **TRACED,
        **{f"disturbance.{name}.share": int(name == chosen) for name in names},
        "rare.measure": measure or (own.measure if own else "wfe_rms"),
        "rare.limit": limit,
        "rare.probability": probability,
        "campaign.cases": traces,
    }
    found = study_with(without_images(study), keys)
    assert isinstance(found, SegmentStudy)
    return found


def chosen_disturbance(entries: Sequence[Population], of: str | None) -> str:
    """Return the name of the disturbance `of` a study's, by default of the only one that has cases.

    Raises
    ------
    UserError
        If there is none of that name, or several to choose from.
    """
    names = [entry.name for entry in entries]
    active = [entry.name for entry in entries if entry.share]
    if of is not None and of not in names:
        raise UserError(f"There is no disturbance {of!r} in this study; there is {', '.join(names)}.")
    if of is None and len(active) > 1:
        raise UserError(
            f"This study has several disturbances; choose one with --of: {', '.join(active)}; "
            'a sum of them is a disturbance of the model "combine".'
        )
    return of or active[0]


def rare_folder(study: Study, made: SegmentStudy, store: Path | str | None) -> Path:
    """Return the folder of the traces: never that of a study's own cases."""
    if store not in (None, ""):
        return made.folder(store)
    own = isinstance(study, SegmentStudy) and study.rare is not None
    return made.folder() if own else made.default_store()


def modal_answer(made: SegmentStudy) -> tuple[RareCases, RareProbability]:
    """Return how the cases are drawn, and the probability by weighted draws of the modal model."""
    cases = rare_cases(made.identity_text())
    return cases, estimated(cases.tilt, cases.limit**2, made.study.seed, DRAWS)
