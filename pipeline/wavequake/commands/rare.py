"""`wavequake rare` and `wavequake allow`: how often a limit is exceeded, and what may be off."""

from pathlib import Path
from typing import Annotated

import typer

from wavequake.commands.options import OnOption, StoreOption, WorkersOption
from wavequake.terminal import live_progress, out, print_fitting


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
    print_fitting(rare_table(answer))
    for line in rare_notes(answer):
        out.print(line, markup=False)
    out.print(f"Traces: {answer.store.resolve()}", markup=False, soft_wrap=True)


def allow(
    study: Annotated[
        str, typer.Argument(help="Study of the workflow segment-disturbance or system-disturbance.")
    ],
    overrides: Annotated[
        list[str] | None, typer.Argument(metavar="[KEY=VALUE]...", help="e.g. telescope.name=tmt-18")
    ] = None,
    measure: Annotated[
        str | None, typer.Option(help="What is limited, as wfe_rms.p95 or los_mm.p99.")
    ] = None,
    limit: Annotated[str | None, typer.Option(help="As '60 nm'.")] = None,
    by: Annotated[
        str | None,
        typer.Option(help="shares: equal ones; cost: by [allow.cost]; factor: on what the study has."),
    ] = None,
    of: Annotated[str | None, typer.Option("--of", help="The disturbance, where there are several.")] = None,
    cases: Annotated[int, typer.Option(help="Cases that are traced in full as the check.")] = 400,
    files: Annotated[
        list[Path] | None,
        typer.Option("--output", "-o", help="FILE.csv (every element and axis), FILE.svg, .png or .pdf."),
    ] = None,
    debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks.")] = False,
) -> None:
    """Say how far every element may be off along every axis, so that the whole stays below a limit."""
    from wavequake.report.answers.allow import (
        allow_notes,
        allow_table,
        asked_of,
        require_writable,
        write_allowances,
    )
    from wavequake.workflows.allow import allowances
    from wavequake.workflows.study import load_study

    for file in files or ():
        require_writable(file)
    loaded = load_study(study, overrides or [])
    asked = asked_of(loaded, measure, limit, by)
    with live_progress() as progress:
        found = allowances(loaded, asked.name, asked.probability, asked.limit, asked.by, of, cases, progress)
    print_fitting(allow_table(found))
    for line in allow_notes(found, asked.measure, asked.limit):
        out.print(line, markup=False)
    for file in files or ():
        write_allowances(found, file, asked.measure)
        out.print(f"Written: {file.resolve()}", markup=False, soft_wrap=True)
