"""`wavequake margins`: whether the loops of a study are stable, and how far from the opposite."""

from typing import Annotated

import typer
from rich.markup import escape
from rich.table import Table

from wavequake.terminal import EXIT_QUARANTINED, out

OverridesArgument = Annotated[
    list[str] | None, typer.Argument(metavar="[KEY=VALUE]...", help="e.g. campaign.cases=4")
]

_SMALL_PRINT = (
    "What a loop bears before it is unstable: its gain times so much (and, where a second number stands, "
    "times so little), so much more phase lag, so much more delay. S peak: how much it amplifies at worst, "
    "the largest |S|."
)


def margins(
    study: Annotated[str, typer.Argument(help="Name of a bundled study or path of a .toml file.")],
    overrides: OverridesArgument = None,
) -> None:
    """Show stability and margins of every loop of a study; nothing is run. Exit code 3: one is unstable."""
    import sys

    from wavequake.report.table import number
    from wavequake.words import counted
    from wavequake.workflows.loops.controller_names import explain_names
    from wavequake.workflows.loops.loop_margins import loops_of
    from wavequake.workflows.run import notices
    from wavequake.workflows.study import load_study

    loaded = load_study(study, overrides or [])
    # In controller-mor a section, not blocks with names; on the lens bench they are called loop.
    blocks = getattr(loaded, "loop", None) or getattr(loaded, "controller", ())
    names = explain_names(one.model_dump() for one in blocks) if isinstance(blocks, tuple) else ""
    table = Table(box=None, caption=f"{_SMALL_PRINT} {names}".rstrip(), caption_justify="left")
    heads = ("loop", "S peak", "gain", "phase (deg)", "delay (ms)", "gain 1 up to (Hz)", "grows (1/s, Hz)")
    for head in heads:
        table.add_column(head, justify="left" if head == "loop" else "right")
    unstable = total = 0
    with out.status("the study's models") as busy:
        for one in loops_of(loaded):
            total += 1
            busy.update(f"{counted(total, 'loop')} done, {escape(one.name)} the last")
            if one.stable:
                gain = number(one.gain_up) + (f", {number(one.gain_down)}" if one.gain_down > 0 else "")
                values = (one.peak, one.phase_deg, one.delay_ms, one.last_hz)
                peak, phase, delay, last = map(number, values)
                table.add_row(escape(one.name), peak, gain, phase, delay, last)
            else:
                unstable += 1
                grows = f"{number(one.growth)}, {number(one.growth_hz)}"
                table.add_row(escape(one.name), "[red]unstable[/red]", "", "", "", "", grows)
    out.print(table)
    for line in notices(loaded):
        out.print(line, markup=False, soft_wrap=True)
    if unstable:
        out.print(f"{unstable} of {total} loops are unstable: no margins, and what they leave is no result.")
        sys.exit(EXIT_QUARANTINED)
