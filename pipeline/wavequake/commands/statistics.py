"""`wavequake budget`, `tail`, `errors`: what contributes, how often limits are exceeded, how well known."""

import shlex
from pathlib import Path
from typing import Annotated

import typer

from wavequake.commands.options import ClusterOption, OnOption, StoreOption, WorkersOption
from wavequake.terminal import live_progress, out, print_fitting, print_pairs


def budget(
    study: Annotated[str, typer.Argument(help="Study of a workflow ...-disturbance.")],
    overrides: Annotated[
        list[str] | None, typer.Argument(metavar="[KEY=VALUE]...", help="e.g. telescope.name=tmt-18")
    ] = None,
    cases: Annotated[int, typer.Option(help="Cases; each factor is on, off and redrawn.")] = 100,
    of: Annotated[str | None, typer.Option("--of", help="Combination to take apart.")] = None,
    measure: Annotated[str | None, typer.Option(help="Rank by a further number, as peak.")] = None,
    store: StoreOption = None,
    on: OnOption = "serial",
    cluster: ClusterOption = None,
    workers: WorkersOption = None,
    plan: Annotated[
        bool,
        typer.Option("--plan", help="Show factors, groups and the time that it takes."),
    ] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks.")] = False,
) -> None:
    """Rank disturbances, and rings of segments or elements, by what they contribute; the store keeps it.

    Groups of a study ([[budget.group]]) have allocations and margins.
    """
    from wavequake.campaign.engine.pool import Place
    from wavequake.campaign.store.store import BUDGET, MANIFEST
    from wavequake.report.answers.budget import explanations, tables
    from wavequake.workflows.budgets.budget import plan_budget, stored_budget
    from wavequake.workflows.study import load_study

    loaded = load_study(study, overrides or [])
    if plan:
        print_pairs(plan_budget(loaded, cases, of, measure))
        return
    path = loaded.folder(store)
    with live_progress() as progress:
        place = Place(on, workers, cluster)
        found, kept = stored_budget(loaded, path, cases, of, progress, place, measure)
    for table in tables(found):
        print_fitting(table)
    for line in explanations(found):
        out.print(line, markup=False)
    words = "Was there already, nothing was computed" if kept else "Written"
    out.print(f"{words}: {(path / BUDGET).resolve()}", markup=False, soft_wrap=True)
    if (path / MANIFEST).exists() and not kept:
        command = shlex.join(["wavequake", "report", str(path)])
        out.print(f"To see it in the report: {command}", markup=False, soft_wrap=True)


def tail(
    store: Annotated[Path, typer.Argument(help="Folder of the store.")],
    variable: Annotated[
        str | None,
        typer.Option(help="A variable, or as 'peak[controller=rigid]' (default: wfe_rms_raw where stored)."),
    ] = None,
    limit: Annotated[float | None, typer.Option(help="How often is it exceeded? In the unit stored.")] = None,
    probability: Annotated[float, typer.Option(help="What is exceeded so rarely?")] = 1e-4,
    statistic: Annotated[
        str, typer.Option(help="Over the instants of a case: rms, mean, min, max or last.")
    ] = "rms",
    below: Annotated[bool, typer.Option("--below", help="Judge small values, as of Strehl ratios.")] = False,
    threshold: Annotated[
        float | None, typer.Option(help="Where the tail begins (default: the farthest 5 % of the cases).")
    ] = None,
    debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks.")] = False,
) -> None:
    """Estimate rare events: values that are hardly ever exceeded, and how often a limit is."""
    from wavequake.report.answers.tail import RareQuestion, rare_events, rare_notes, rare_table

    question = RareQuestion(variable, statistic, probability, limit, threshold, below)
    answer = rare_events(store, question)
    print_fitting(rare_table(answer, question))
    for line in rare_notes(answer, question):
        out.print(line, markup=False)


def errors(
    store: Annotated[Path, typer.Argument(help="Folder of the store.")],
    cases: Annotated[int, typer.Option(help="Cases of each population to compute again, finer.")] = 8,
    on: OnOption = "serial",
    cluster: ClusterOption = None,
    workers: WorkersOption = None,
    debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks.")] = False,
) -> None:
    """Say each number's error by rays, terms, linearisation, reduction and sampling; the store keeps it."""
    from wavequake.campaign.engine.pool import Place
    from wavequake.campaign.store.store import ERRORS
    from wavequake.report.answers.errors import store_errors
    from wavequake.report.answers.errors_shown import errors_notes, errors_table

    with live_progress() as progress:
        found = store_errors(store, cases, Place(on, workers, cluster), progress)
    print_fitting(errors_table(found))
    for line in errors_notes(found):
        out.print(line, markup=False)
    out.print(f"Written: {(store / ERRORS).resolve()}", markup=False, soft_wrap=True)
    command = shlex.join(["wavequake", "report", str(store)])
    out.print(f"To see it in the report: {command}", markup=False, soft_wrap=True)


def sharpen(
    store: Annotated[Path, typer.Argument(help="Folder of a store of full traces of segments.")],
    cases: Annotated[int, typer.Option(help="Of the modal model, in all.")] = 20_000,
    debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks.")] = False,
) -> None:
    """Narrow the intervals of means and quantiles by many cases of the modal model: control variates."""
    from wavequake.report.answers.sharpen import sharpen, sharpen_notes, sharpen_table

    with live_progress() as progress:
        rows = sharpen(store, cases, progress)
    print_fitting(sharpen_table(rows))
    for line in sharpen_notes(rows):
        out.print(line, markup=False)
