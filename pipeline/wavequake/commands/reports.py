"""`wavequake report`: what a store says."""

from pathlib import Path
from typing import Annotated

import typer

from wavequake.commands.pictures import animate as animate_case
from wavequake.errors import UserError
from wavequake.terminal import out, print_fitting, print_in_blocks
from wavequake.words import unsaid


def report(
    store: Annotated[Path, typer.Argument(help="Folder of the store.")],
    animate: Annotated[
        int | None, typer.Option(min=0, help="Write a moving picture of this case (and no report).")
    ] = None,
    controller: Annotated[
        str | None,
        typer.Option("--controller", "--of", help="What of the case: a controller, excitation or mode."),
    ] = None,
    format: Annotated[str | None, typer.Option(help="Of the animation: gif, or mp4 (by ffmpeg).")] = None,
    by: Annotated[
        str | None, typer.Option(help="Rank disturbances by a stored number, as 'ee80' (and no report).")
    ] = None,
) -> None:
    """Print the table of a store and write its HTML report."""
    if by is not None:
        _rank(store, by)
        return
    if animate is None and (controller or format):
        raise UserError("--controller and --format belong to an animation; say --animate CASE, too.")
    if animate is None:
        write_report(store, fresh=True)
        return
    animate_case(store, animate, controller, format or "gif")


def _rank(store: Path, by: str) -> None:
    from wavequake.report.answers.ranking import ranking, ranking_notes, ranking_table

    found = ranking(store, by)
    print_fitting(ranking_table(found))
    for line in ranking_notes(found):
        out.print(line, markup=False)


def write_report(store: Path, fresh: bool) -> None:
    """Print the table of a store and what its report says, which is written anew if `fresh`."""
    from wavequake.report.campaign import is_current, report_path, report_store, summary_table
    from wavequake.report.written import read_answer

    if fresh or not is_current(store):
        table, path = report_store(store)
    else:
        table, path = summary_table(store), report_path(store)
    answer = read_answer(path)
    if table.caption:
        table.caption = unsaid(str(table.caption), answer) or None
    print_in_blocks(table)
    if answer:
        out.print(answer, markup=False, style="bold", highlight=False)
    out.print(f"Report: {path.resolve()}", markup=False, soft_wrap=True)
