"""Show what came out of a store."""

from pathlib import Path

from wavequake.terminal import out, print_in_blocks
from wavequake.words import unsaid


def write_report(store: Path, fresh: bool) -> None:
    """Show table and answer of a store, and write its report if that is wanted `fresh` or lacks results."""
    from wavequake.report.written import is_current, read_answer, read_table, report_path

    path = report_path(store)
    if fresh or not is_current(store):
        from wavequake.report.campaign import report_store

        table, path = report_store(store)
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
