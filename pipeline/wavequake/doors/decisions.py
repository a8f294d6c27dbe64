"""What decides: rare events, allowances, budgets, errors and sharper intervals, in one call each."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from wavequake.campaign.schema import Study
from wavequake.notebook import progress_bar
from wavequake.workflows.study import chosen_study

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

    from wavequake.report.answers.rare import RareAnswer
    from wavequake.workflows.allow import Allowances


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
        return rare_answer(chosen_study(study, overrides), **keywords)


def allow(
    study: str | Path | Study,
    measure: str = "wfe_rms.p95",
    *,
    limit: str | float,
    by: str = "shares",
    of: str | None = None,
    cases: int = 400,
    output: str | Path | None = None,
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
    by : {"shares", "cost", "factor"}
        Equal shares of the mean square, or by the study's own costs, or what it has times the largest factor.
    of : str, optional
        The disturbance, where there are several.
    cases : int
        That are drawn with these allowances and traced in full, as the check.
    output : str or Path, optional
        FILE.csv (every element and axis), FILE.svg, .png or .pdf.
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
    from wavequake.report.answers.allow import goal_of, require_writable, write_allowances
    from wavequake.workflows.allow import allowances

    if (file := _file(output)) is not None:
        require_writable(file)
    name, probability, value = goal_of(measure, limit)
    with progress_bar() as progress:
        found = allowances(chosen_study(study, overrides), name, probability, value, by, of, cases, progress)
    if file is not None:
        write_allowances(found, file, measure)
    return found


def budget(
    study: str | Path | Study,
    cases: int = 100,
    *,
    of: str | None = None,
    measure: str | None = None,
    store: str | Path | None = None,
    on: str = "serial",
    workers: int | None = None,
    cluster: str | Path | None = None,
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
    measure : str, optional
        A further number of cases by which to rank, as ``peak`` (of which the budget takes 1 - peak).
    store : str or Path, optional
        Folder that keeps the budget as ``budget.zarr``; by default that of the study's runs.
    on, workers, cluster
        As of `run`.
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
    from wavequake.campaign.engine.pool import Place
    from wavequake.workflows.budgets.budget import stored_budget

    loaded, place = chosen_study(study, overrides), Place(on, workers, _file(cluster))
    with progress_bar() as progress:
        return stored_budget(loaded, loaded.folder(store), cases, of, progress, place, measure)[0]


def plan_budget(
    study: str | Path | Study,
    cases: int = 100,
    *,
    of: str | None = None,
    measure: str | None = None,
    **overrides: Any,
) -> dict[str, str]:
    """Describe what a budget would take: factors, groups, traces and their time; nothing is stored.

    Parameters
    ----------
    study, cases, of, measure, **overrides
        As of `budget`, which says what it raises.

    Examples
    --------
    >>> plan_budget("tmt-segments", 16, telescope__name="tmt-18")  # doctest: +SKIP
    """
    from wavequake.workflows.budgets.budget import plan_budget as planned

    return planned(chosen_study(study, overrides), cases, of, measure)


def plan_accuracy(
    study: str | Path | Study, accuracy: float | str, measure: str | None = None, **overrides: Any
) -> dict[str, str]:
    """Say what rays, terms, orders and cases a study takes for an accuracy: `plan --accuracy`.

    Parameters
    ----------
    study : str, Path or Study
    accuracy : float or str
        As ``"1 %"``, of every origin of error.
    measure : str, optional
        What shall be as accurate, by default ``wfe_rms``.
    **overrides
        Further keys with double underscores for dots.

    Raises
    ------
    UserError
        If the accuracy is no share, there is no such measure, or cases of the pilot fail.

    Examples
    --------
    >>> plan_accuracy("tmt-segments", "1 %")["proposal"]  # doctest: +SKIP
    """
    from wavequake.report.answers.accuracy import accuracy_of
    from wavequake.report.answers.accuracy import plan_accuracy as planned

    share = accuracy_of(accuracy if isinstance(accuracy, str) else repr(accuracy))
    return planned(chosen_study(study, overrides), share, measure)


def store_errors(
    store: str | Path,
    cases: int = 8,
    *,
    on: str = "serial",
    workers: int | None = None,
    cluster: str | Path | None = None,
) -> "xr.Dataset":
    """Measure the error of every number of a store by refining a sample of its cases: `wavequake errors`.

    Parameters
    ----------
    store : str or Path
    cases : int
        Of each population, that are computed again.
    on, workers, cluster
        As of `run`.

    Returns
    -------
    xarray.Dataset
        ``error`` by population, measure and origin (rays, terms, linearisation, reduction), ``sampling``.

    Raises
    ------
    UserError
        If there is no store, or nothing in it is done.

    Examples
    --------
    >>> store_errors("runs/first")["error"].sel(origin="rays").to_pandas()  # doctest: +SKIP
    """
    from wavequake.campaign.engine.pool import Place
    from wavequake.report.answers.errors import store_errors as measured

    with progress_bar() as progress:
        return measured(Path(store), cases, Place(on, workers, _file(cluster)), progress)


def sharpen(store: str | Path, cases: int = 20_000) -> "pd.DataFrame":
    """Return means and quantiles of traced segments, with narrower intervals by the modal model.

    Parameters
    ----------
    store : str or Path
    cases : int
        Of the modal model, in all.

    Returns
    -------
    pandas.DataFrame
        A row per disturbance, measure and statistic: ``value`` and its 95 % interval, ``alone`` (of the
        traces) and its own, and how many traces it is ``worth``.

    Raises
    ------
    UserError
        If the store has no independent cases of segments that are traced in full, or too few.

    Examples
    --------
    >>> sharpen("runs/first").query("statistic == 'P95'")  # doctest: +SKIP
    """
    import pandas as pd

    from wavequake.report.answers.sharpen import sharpen as sharpened

    with progress_bar() as progress:
        rows = sharpened(store, cases, progress)
    return pd.DataFrame(
        [
            {
                "disturbance": row.disturbance,
                "measure": row.measure,
                "statistic": name,
                "value": one.value.value,
                "low": one.value.low,
                "high": one.value.high,
                "alone": one.alone.value,
                "alone_low": one.alone.low,
                "alone_high": one.alone.high,
                "worth": one.worth,
                "units": row.unit,
            }
            for row in rows
            for name, one in row.found.items()
        ]
    )


def _file(name: str | Path | None) -> Path | None:
    return None if name is None else Path(name)
