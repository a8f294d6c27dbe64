"""Show what came out of a store."""

from pathlib import Path

from wavequake.terminal import out, print_in_blocks
from wavequake.words import unsaid


def write_report(store: Path, fresh: bool) -> None:
    """Show table and answer of a store, and write its report if that is wanted `fresh` or lacks results."""
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
