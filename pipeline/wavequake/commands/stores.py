"""Commands that look after a store: what is done, whether it is whole, its report, cases computed again."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from wavequake.commands import pictures
from wavequake.commands.options import (
    ClusterOption,
    DashboardOption,
    OnOption,
    WorkersOption,
    complete_from,
    store_at,
)
from wavequake.errors import UserError
from wavequake.terminal import (
    EXIT_DAMAGED,
    EXIT_QUARANTINED,
    live_progress,
    out,
    print_fitting,
    print_in_blocks,
)
from wavequake.words import are, counted, unsaid

StoreArgument = Annotated[
    Path, typer.Argument(parser=store_at, metavar="STORE", help="Folder of the store, or s3://BUCKET/PREFIX.")
]


_FEW = 20  # files that are named


def show_link(link: str) -> None:
    """Print the link of a dashboard."""
    out.print(f"Dashboard: {link}", markup=False, soft_wrap=True)


def status(store: StoreArgument) -> None:
    """Say what of a store is done, quarantined (and why) and still to do."""
    from wavequake.campaign.store.status import store_status

    for line in store_status(store).lines():
        out.print(line, markup=False, soft_wrap=True)


def verify(store: StoreArgument) -> None:
    """Read every stored number again and compare it (exit code 4: damaged, or cases are still to do)."""
    from wavequake.campaign.store.verify import verify_store

    report = verify_store(store)
    for line in report.lines():
        out.print(line, markup=False, soft_wrap=True)
    if not report.ok:
        sys.exit(EXIT_DAMAGED)


def report(
    store: StoreArgument,
    animate: Annotated[
        int | None, typer.Option(min=0, help="Write a moving picture of this case (and no report).")
    ] = None,
    controller: Annotated[
        str | None,
        typer.Option("--controller", "--of", help="What of the case: a controller, excitation or mode."),
    ] = None,
    format: Annotated[
        str | None,
        typer.Option(
            help="Of the animation: gif, or mp4 (by ffmpeg).", autocompletion=complete_from("gif", "mp4")
        ),
    ] = None,
    by: Annotated[
        str | None, typer.Option(help="Rank disturbances by a stored number, as 'ee80' (and no report).")
    ] = None,
    file: Annotated[
        Path | None,
        typer.Option("-o", "--output", help="FILE.html (default: STORE/report.html), or of the animation."),
    ] = None,
) -> None:
    """Print the table of a store and write its HTML report."""
    if by is not None:
        _rank(store, by)
        return
    if animate is None and (controller or format):
        raise UserError("--controller and --format belong to an animation; say --animate CASE, too.")
    if animate is None:
        write_report(store, fresh=True, file=file)
        return
    pictures.animate(store, animate, controller, format or "gif", file)


def _rank(store: Path, by: str) -> None:
    from wavequake.report.answers.ranking import ranking, ranking_notes, ranking_table

    found = ranking(store, by)
    print_fitting(ranking_table(found))
    for line in ranking_notes(found):
        out.print(line, markup=False)


def export(
    store: StoreArgument,
    file: Annotated[
        Path,
        typer.Argument(
            help="FILE.nc or FILE.fits (every array), FILE.csv (one row per case), FILE.zmx (one case; "
            "a file for each segment), FILE.txt (displacements in one case, a file for each surface)."
        ),
    ],
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace FILE.")] = False,
    case: Annotated[int | None, typer.Option(help="Case of FILE.zmx or FILE.txt.")] = None,
    instant: Annotated[int, typer.Option(help="Instant of that case, counted from 0.")] = 0,
    under: Annotated[
        str, typer.Option(help="Controller or excitation of that case, where it has several.")
    ] = "",
) -> None:
    """Write a store to one NetCDF, FITS or CSV file, or one case to a lens file or displacements."""
    from wavequake.report.campaign import export_store

    written = export_store(store, file, overwrite, case, instant, under)
    few = (
        [str(one) for one in written] if len(written) <= _FEW else [str(written[0]), "...", str(written[-1])]
    )
    count = f" ({len(written)} files)" if len(written) > _FEW else ""
    out.print(f"Written: {', '.join(few)}{count}", markup=False, soft_wrap=True)


def retry(
    store: StoreArgument,
    statuses: Annotated[
        str, typer.Option("--status", help="Which failed cases, by name or number of their status.")
    ] = "raised,crashed,timed_out,diverged",
    on: OnOption = "local",
    cluster: ClusterOption = None,
    workers: WorkersOption = None,
    dashboard: DashboardOption = False,
) -> None:
    """Compute quarantined cases of a store again, with the others of their chunks."""
    from wavequake.campaign.engine.rerun import retry_store
    from wavequake.campaign.engine.rerun import statuses as status_numbers
    from wavequake.campaign.store.store import read_manifest
    from wavequake.workflows.kinds import find_kind

    wanted, workflow = status_numbers(statuses), find_kind(read_manifest(store).workflow)
    with live_progress() as progress:
        summary = retry_store(
            workflow,
            store,
            wanted,
            on=on,
            workers=workers,
            progress=progress,
            cluster=cluster,
            dashboard=show_link if dashboard else None,
        )
    words = f"{are(summary.quarantined, 'case')} quarantined now."
    out.print(f"{counted(summary.chunks, 'chunk')} computed again; {words}")
    if summary.quarantined:
        sys.exit(EXIT_QUARANTINED)


def rerun(
    store: StoreArgument,
    case: Annotated[int, typer.Option("--case", min=0, help="Id of the case.")],
    file: Annotated[
        Path | None, typer.Option("--file", help="Where its numbers go (.nc; default: STORE/case-ID.nc).")
    ] = None,
) -> None:
    """Compute one case again in full detail and compare its bits with the store (exit code 4 if others)."""
    from wavequake.report.exports.rerun import rerun_stored

    found = rerun_stored(store, case, file)
    out.print(found.table())
    for line in found.lines():
        out.print(line, markup=False, soft_wrap=True)
    if found.differing:
        sys.exit(EXIT_DAMAGED)


def write_report(store: Path, fresh: bool, file: Path | None = None) -> None:
    """Print the table and the answer of a store, and write its report where that is older or asked for."""
    from wavequake.report.written import is_current, read_answer, read_table, report_path

    path = report_path(store)
    if fresh or not is_current(store):
        from wavequake.drawing.unexplained import leave_help_out

        leave_help_out()
        from wavequake.report.campaign import report_store

        table, path = report_store(store, file)
    elif (read := read_table(path)) is not None:
        table = read
    else:
        from wavequake.report.campaign import summary_table

        table = summary_table(store)
    answer = read_answer(path)
    if table.caption:
        table.caption = unsaid(str(table.caption), answer) or None
    print_in_blocks(table)
    if answer:
        out.print(answer, markup=False, style="bold", highlight=False)
    out.print(f"Report: {path.resolve()}", markup=False, soft_wrap=True)
