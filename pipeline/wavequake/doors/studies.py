"""Studies and their stores in one call each; the command of the same name prints what these return."""

from collections.abc import Mapping
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from wavequake.campaign.schema import Study
from wavequake.errors import UserError
from wavequake.notebook import progress_bar
from wavequake.workflows import run as workflow_run

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

    from wavequake.campaign.store.verify import VerifyReport
    from wavequake.report.answers.rare import RareAnswer
    from wavequake.workflows.allow import Allowances


@wraps(workflow_run.run)
def run(study: str | Path | Study, **keywords: Any) -> "xr.Dataset":
    """Show a progress bar in a notebook; all else is `wavequake.workflows.run.run`."""
    with progress_bar() as progress:
        keywords.setdefault("progress", progress)
        return workflow_run.run(study, **keywords)


def studies() -> dict[str, str]:
    """Return the names of the bundled studies and what each one shows.

    Examples
    --------
    >>> sorted(studies())[:3]
    ['controller-mor', 'double-gauss', 'euv']
    """
    from wavequake.workflows.study import bundled_studies, load_study

    return {name: load_study(name).study.title for name in bundled_studies()}


def report(store: str | Path) -> Path:
    """Write the HTML report of a store into its folder and return the file.

    Raises
    ------
    UserError
        If there is no store.
    StoreDamageError
        If its numbers cannot be read.

    Examples
    --------
    >>> report("runs/tmt-segments-1a2b3c4d")  # doctest: +SKIP
    """
    from wavequake.report.campaign import report_store

    return report_store(Path(store))[1]


def compare(first: str | Path, *others: str | Path) -> "pd.DataFrame":
    """Compare stores with the first one, case by case, and return a row per store, group and measure.

    Cases of equal labels are paired: the same draws. ``mean`` is the mean difference, ``margin`` half its
    95 % confidence interval, ``relative`` the mean of the cases' relative differences.

    Raises
    ------
    UserError
        If a store is missing, or two have nothing in common.

    Examples
    --------
    >>> compare("runs/reference", "runs/finer").query("measure == 'wfe_rms'")  # doctest: +SKIP
    """
    import pandas as pd

    from wavequake.campaign.store.store import open_store
    from wavequake.report.answers.comparison import compare as differences

    if not others:
        raise UserError("compare needs at least two stores.")
    reference, rows = open_store(first), []
    for other in others:
        for one in differences(reference, open_store(other), str(first), str(other)):
            known = one.relative[np.isfinite(one.relative)]
            rows.append(
                {
                    "store": str(other),
                    "group": one.group,
                    "measure": one.measure,
                    "units": one.units,
                    "cases": one.cases,
                    "first": one.first,
                    "second": one.second,
                    "mean": one.mean,
                    "margin": one.margin,
                    "relative": float(known.mean()) if known.size else np.nan,
                }
            )
    return pd.DataFrame(rows)


def tail(
    store: str | Path,
    variable: str = "wfe_rms_raw",
    *,
    probability: float = 1e-4,
    limit: float | None = None,
    statistic: str = "rms",
    below: bool = False,
    threshold: float | None = None,
) -> "pd.DataFrame":
    """Estimate rare events of a store: what is hardly ever exceeded, and how often a limit is.

    Parameters
    ----------
    store : str or Path
    variable : str
        A variable of the store, or as ``"peak[controller=rigid]"``.
    probability : float
        What is exceeded so rarely?
    limit : float, optional
        How often is it exceeded? In the unit stored.
    statistic : {"rms", "mean", "min", "max", "last"}
        Over the instants of a case.
    below : bool
        Judge small values, as of Strehl ratios.
    threshold : float, optional
        Where the tail begins; by default the farthest 5 % of the cases.

    Returns
    -------
    pandas.DataFrame
        A row per population: ``value`` and its 95 % interval; ``odds`` and theirs if there is a limit.

    Raises
    ------
    UserError
        If there is no such variable, or no population has a tail, as of too few cases.

    Examples
    --------
    >>> tail("runs/tmt-million", "wfe_rms_raw", probability=1e-5, limit=100.0)  # doctest: +SKIP
    """
    import pandas as pd

    from wavequake.report.answers.tail import RareQuestion, rare_events

    answer = rare_events(store, RareQuestion(variable, statistic, probability, limit, threshold, below))
    sign, rows = -1.0 if below else 1.0, []
    for one in answer.found:
        ends = sorted((sign * one.value.low, sign * one.value.high))
        row = {"population": one.name, "value": sign * one.value.value, "low": ends[0], "high": ends[1]}
        if one.odds is not None:
            row |= {"odds": one.odds.value, "odds_low": one.odds.low, "odds_high": one.odds.high}
        rows.append(row | {"units": answer.unit})
    return pd.DataFrame(rows)


def rare(study: str | Path | Study, **keywords: Any) -> "RareAnswer":
    """Say how often a limit is exceeded, however rarely, and prove it with full traces near the limit.

    Parameters
    ----------
    study : str, Path or Study
        Of the workflow segment-disturbance.
    measure : str, optional
        ``"wfe_rms"`` (the default), ``"wfe_rms_raw"``, ``"zernike[noll=4]"``, ``"los"`` or ``"centroid"``.
    limit : str or float, optional
        As ``"120 nm"``; a number is in the unit that is stored.
    probability : float, optional
        What is exceeded so rarely? In the place of a limit.
    of : str, optional
        The disturbance, where there are several.
    traces : int, optional
        Cases near the limit that are traced in full, by default 2000; a store that has some gets the others.
    store : str or Path, optional
        Folder of the traces.
    on : str
        As of `run`.
    workers : int, optional
        As of `run`.
    **overrides
        Further keys with double underscores for dots, e.g. ``telescope__name="tmt-18"``.

    Returns
    -------
    RareAnswer
        ``certified`` is the probability with its 95 % interval; ``exact``, ``modal``, ``traced`` and
        ``correction`` say what it is made of.

    Raises
    ------
    UserError
        If the limit is none that is rarely exceeded, the measure is unknown, or the disturbance does not draw
        Gaussian numbers.

    Examples
    --------
    >>> found = rare("tmt-segments", of="alignment", limit="20 nm")  # doctest: +SKIP
    >>> print(found.certified)                                      # doctest: +SKIP
    """
    from wavequake.report.answers.rare import rare_answer

    overrides = {key: keywords.pop(key) for key in list(keywords) if "__" in key}
    with progress_bar() as progress:
        keywords.setdefault("progress", progress)
        return rare_answer(_loaded(study, overrides), **keywords)


def allow(
    study: str | Path | Study,
    measure: str = "wfe_rms.p95",
    *,
    limit: str | float,
    by: str = "shares",
    of: str | None = None,
    cases: int = 400,
    **overrides: Any,
) -> "Allowances":
    """Say how far every segment may be off along every axis, so that the whole stays below a limit.

    Parameters
    ----------
    study : str, Path or Study
        Of the workflow segment-disturbance.
    measure : str
        An upper quantile of what is limited.
    limit : str or float
        As ``"60 nm"``; a number is in the unit that is stored.
    by : {"shares", "factor"}
        Equal shares of the mean square, or what the study has times the largest factor.
    of : str, optional
        The disturbance, where there are several.
    cases : int
        That are drawn with these allowances and traced in full, as the check.
    **overrides
        Further keys with double underscores for dots, e.g. ``telescope__name="tmt-18"``.

    Returns
    -------
    Allowances
        ``rms`` (axis, element) in m, or rad of turns; ``check`` is the quantile of the full traces.

    Raises
    ------
    UserError
        If the limit is exceeded at rest, or the study has none that can be allowed.

    Examples
    --------
    >>> found = allow("tmt-segments", of="alignment", limit="30 nm")  # doctest: +SKIP
    >>> print(found.check)                                           # doctest: +SKIP
    """
    from wavequake.report.answers.allow import goal_of
    from wavequake.workflows.allow import allowances

    name, probability, value = goal_of(measure, limit)
    with progress_bar() as progress:
        return allowances(_loaded(study, overrides), name, probability, value, by, of, cases, progress)


def budget(
    study: str | Path | Study,
    cases: int = 100,
    *,
    of: str | None = None,
    store: str | Path | None = None,
    **overrides: Any,
) -> "xr.Dataset":
    """Rank disturbances, and rings of segments or elements, by what they contribute.

    Parameters
    ----------
    study : str, Path or Study
        Of a workflow ...-disturbance.
    cases : int
        Each factor is on, off and redrawn in each.
    of : str, optional
        The combination to take apart.
    store : str or Path, optional
        Folder that keeps the budget as ``budget.zarr``; by default that of the study's runs.
    **overrides
        Further keys with double underscores for dots, e.g. ``telescope__name="tmt-18"``.

    Raises
    ------
    UserError
        If the study is another kind of study, or most cases cannot be traced.

    Examples
    --------
    >>> found = budget("tmt-segments", 16, telescope__name="tmt-18")  # doctest: +SKIP
    >>> found["share"].sel(quantity="wfe_rms_raw").to_series()        # doctest: +SKIP
    """
    from wavequake.workflows.budgets.budget import stored_budget

    loaded = _loaded(study, overrides)
    with progress_bar() as progress:
        return stored_budget(loaded, loaded.folder(store), cases, of, progress)[0]


def export(store: str | Path, file: str | Path, *, overwrite: bool = False) -> Path:
    """Write a store to one file for other programs and return its path.

    Parameters
    ----------
    store : str or Path
    file : str or Path
        ``.nc`` or ``.fits`` (every array), or ``.csv`` (one row per case).
    overwrite : bool
        Replace the file.

    Raises
    ------
    UserError
        If there is no store, or the file exists or is of another kind.

    Examples
    --------
    >>> export("runs/tmt-segments-1a2b3c4d", "tmt.csv")  # doctest: +SKIP
    """
    from wavequake.report.campaign import export_store

    return export_store(Path(store), Path(file), overwrite)


def margins(study: str | Path, **overrides: Any) -> "pd.DataFrame":
    """Return stability and margins of every loop of a study; nothing is run or stored.

    Parameters
    ----------
    study : str or Path
        Of a workflow with loops.
    **overrides
        Keys with double underscores for dots, e.g. ``loop__delay_frames=1``.

    Returns
    -------
    pandas.DataFrame
        A row per loop: `wavequake.workflows.loops.loop_margins.LoopMargins`, and whether it is ``stable``.

    Raises
    ------
    UserError
        If the study has no loops.

    Examples
    --------
    >>> margins("tip-tilt-vibration", loop__rates_hz=[100.0])["stable"].all()
    np.True_
    """
    from dataclasses import asdict

    import pandas as pd

    from wavequake.workflows.loops.loop_margins import loops_of
    from wavequake.workflows.study import load_study

    changes = {key.replace("__", "."): value for key, value in overrides.items()}
    found = loops_of(load_study(study, changes))
    return pd.DataFrame([{**asdict(one), "stable": one.stable} for one in found])


def verify(store: str | Path) -> "VerifyReport":
    """Read every number of a store again and compare it with the journal's digests.

    Returns
    -------
    VerifyReport
        ``ok`` says whether every case is there as it was written; ``lines()`` says what is not.

    Raises
    ------
    UserError
        If there is no store.

    Examples
    --------
    >>> verify("runs/tmt-segments-1a2b3c4d").ok  # doctest: +SKIP
    """
    from wavequake.campaign.store.verify import verify_store

    return verify_store(store)


def _loaded(study: str | Path | Study, overrides: Mapping[str, Any]) -> Study:
    from wavequake.workflows.study import load_study, study_with

    keys = {key.replace("__", "."): value for key, value in overrides.items()}
    return study_with(study, keys) if isinstance(study, Study) else load_study(study, keys)
