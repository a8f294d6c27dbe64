"""`wavequake rare` and `wavequake allow`: how often a limit is exceeded, and what may be off."""

from pathlib import Path
from typing import Annotated

import typer

from wavequake.commands.options import OnOption, StoreOption, WorkersOption
from wavequake.terminal import live_progress, out


def rare(
    study: Annotated[str, typer.Argument(help="Study of the workflow segment-disturbance.")],
    overrides: Annotated[
        list[str] | None, typer.Argument(metavar="[KEY=VALUE]...", help="e.g. telescope.name=tmt-18")
    ] = None,
    measure: Annotated[
        str | None, typer.Option(help="wfe_rms, wfe_rms_raw, 'zernike[noll=4]', los or centroid.")
    ] = None,
    limit: Annotated[str | None, typer.Option(help="How often is it exceeded? As '120 nm'.")] = None,
    probability: Annotated[float | None, typer.Option(help="What is exceeded so rarely? As 1e-6.")] = None,
    of: Annotated[str | None, typer.Option("--of", help="The disturbance, where there are several.")] = None,
    traces: Annotated[
        int | None, typer.Option(min=1, help="Cases near the limit that are traced in full (default: 2000).")
    ] = None,
    store: StoreOption = None,
    on: OnOption = "serial",
    workers: WorkersOption = None,
    debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks.")] = False,
) -> None:
    """Say how often a limit is exceeded, however rarely; full traces near the limit are kept as the proof."""
    from wavequake.report.answers.rare import rare_answer, rare_notes, rare_table
    from wavequake.workflows.study import load_study

    loaded = load_study(study, overrides or [])
    path = Path(store) if store else None
    with live_progress() as progress:
        answer = rare_answer(
            loaded,
            measure,
            limit,
            probability,
            of=of,
            traces=traces,
            store=path,
            on=on,
            workers=workers,
            progress=progress,
        )
    out.print(rare_table(answer))
    for line in rare_notes(answer):
        out.print(line, markup=False)
    out.print(f"Traces: {answer.store.resolve()}", markup=False, soft_wrap=True)


def allow(
    study: Annotated[str, typer.Argument(help="Study of the workflow segment-disturbance.")],
    overrides: Annotated[
        list[str] | None, typer.Argument(metavar="[KEY=VALUE]...", help="e.g. telescope.name=tmt-18")
    ] = None,
    measure: Annotated[str, typer.Option(help="What is limited, as wfe_rms.p95.")] = "wfe_rms.p95",
    limit: Annotated[str, typer.Option(help="As '60 nm'.")] = "",
    by: Annotated[str, typer.Option(help="shares: equal ones; factor: on what the study has.")] = "shares",
    of: Annotated[str | None, typer.Option("--of", help="The disturbance, where there are several.")] = None,
    cases: Annotated[int, typer.Option(help="Cases that are traced in full as the check.")] = 400,
    file: Annotated[
        Path | None, typer.Option("--output", "-o", help="FILE.csv of every segment and axis.")
    ] = None,
    debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks.")] = False,
) -> None:
    """Say how far every segment may be off along every axis, so that the whole stays below a limit."""
    from wavequake.report.answers.allow import allow_notes, allow_table, goal_of, write_allowances
    from wavequake.workflows.allow import allowances
    from wavequake.workflows.study import load_study

    name, probability, value = goal_of(measure, limit)
    loaded = load_study(study, overrides or [])
    with live_progress() as progress:
        found = allowances(loaded, name, probability, value, by, of, cases, progress)
    out.print(allow_table(found))
    for line in allow_notes(found, measure, value):
        out.print(line, markup=False)
    if file is not None:
        write_allowances(found, file)
        out.print(f"Written: {file.resolve()}", markup=False, soft_wrap=True)
