"""Studies and their stores in one call each; the command of the same name prints what these return."""

from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from wavequake.campaign.schema import Study
from wavequake.notebook import progress_bar
from wavequake.workflows import run as workflow_run

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

    from wavequake.campaign.store.verify import VerifyReport


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


def report(store: str | Path, file: str | Path | None = None) -> Path:
    """Write the HTML report of a store and return the file.

    Parameters
    ----------
    store : str or Path
    file : str or Path, optional
        By default ``STORE/report.html``; elsewhere, of a store that cannot be written.

    Raises
    ------
    UserError
        If there is no store, or the file cannot be written.
    StoreDamageError
        If its numbers cannot be read.

    Examples
    --------
    >>> report("runs/tmt-segments-1a2b3c4d")  # doctest: +SKIP
    """
    from wavequake.campaign.store.objects import location
    from wavequake.report.campaign import report_store

    return report_store(location(store), None if file is None else Path(file))[1]


def compare(first: str | Path, *others: str | Path, figure: str | Path | None = None) -> "pd.DataFrame":
    """Compare stores with the first one, case by case, and return a row per store, group and measure.

    Cases of equal labels are paired: the same draws. ``mean`` is the mean difference, ``margin`` half its
    95 % confidence interval, ``relative`` the mean of the cases' relative differences. `figure` is a file
    (.png, .svg, .pdf) to draw them into. `agreement` compares with telemetry.

    Raises
    ------
    UserError
        If a store is missing, two have nothing in common, or the figure cannot be written.

    Examples
    --------
    >>> compare("runs/reference", "runs/finer").query("measure == 'wfe_rms'")  # doctest: +SKIP
    """
    import pandas as pd

    from wavequake.report.answers.comparison import compare_stores

    _, comparisons = compare_stores([first, *others], None if figure is None else Path(figure))
    rows = []
    for other, differences in zip(others, comparisons, strict=True):
        for one in differences:
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
    variable: str | None = None,
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
    variable : str, optional
        A variable of the store, or as ``"peak[controller=rigid]"``; by default ``wfe_rms_raw``.
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
        If there is no such variable, none is named and there is not the usual one, or no population has a
        tail, as of too few cases.

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


def export(
    store: str | Path,
    file: str | Path,
    *,
    overwrite: bool = False,
    case: int | None = None,
    instant: int = 0,
    under: str = "",
) -> Path:
    """Write a store, or one of its cases, to a file for other programs and return its path (the first).

    Parameters
    ----------
    store : str or Path
    file : str or Path
        ``.nc`` or ``.fits`` (every array), ``.csv`` (one row per case); of one case ``.zmx`` (its lens file,
        or one for each segment) or ``.txt`` (displacements, a file for each surface).
    overwrite : bool
        Replace the file.
    case, instant : int
        Of ``.zmx`` and ``.txt``; the instant is counted from 0.
    under : str
        Controller or excitation of that case, where it has several.

    Raises
    ------
    UserError
        If there is no store or case, or the file exists or is of another kind.

    Examples
    --------
    >>> export("runs/tmt-segments-1a2b3c4d", "tmt.csv")  # doctest: +SKIP
    """
    from wavequake.campaign.store.objects import location
    from wavequake.report.campaign import export_store

    return export_store(location(store), Path(file), overwrite, case, instant, under)[0]


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
    from wavequake.workflows.study import chosen_study

    found = loops_of(chosen_study(study, overrides))
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
