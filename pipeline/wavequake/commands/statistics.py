"""`wavequake budget` and `wavequake tail`: what contributes, and how often limits are exceeded."""

import shlex
from pathlib import Path
from typing import Annotated

import typer

from wavequake.terminal import live_progress, out


def budget(
    study: Annotated[str, typer.Argument(help="Study of a workflow ...-disturbance.")],
    overrides: Annotated[
        list[str] | None, typer.Argument(metavar="[KEY=VALUE]...", help="e.g. telescope.name=tmt-18")
    ] = None,
    cases: Annotated[int, typer.Option(help="Cases; each factor is on, off and redrawn.")] = 100,
    of: Annotated[str | None, typer.Option("--of", help="Combination to take apart.")] = None,
    store: Annotated[Path | None, typer.Option("--store", help="Folder of the store (store.path).")] = None,
    debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks.")] = False,
) -> None:
    """Rank disturbances, and rings of segments or elements, by what they contribute; the store keeps it."""
    from wavequake.campaign.store.store import BUDGET, MANIFEST
    from wavequake.report.answers.budget import explanations, tables
    from wavequake.workflows.budgets.budget import stored_budget
    from wavequake.workflows.study import load_study

    loaded = load_study(study, overrides or [])
    path = loaded.folder(store)
    with live_progress() as progress:
        found, kept = stored_budget(loaded, path, cases, of, progress)
    for table in tables(found):
        out.print(table)
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
        str, typer.Option(help="What is judged: a variable, or as 'peak[controller=rigid]'.")
    ] = "wfe_rms_raw",
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
    out.print(rare_table(answer, question))
    for line in rare_notes(answer, question):
        out.print(line, markup=False)
