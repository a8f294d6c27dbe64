"""The command line; `wavequake --help` lists its commands."""

import io
import os
import shlex
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, NoReturn

import typer
from rich.table import Table

from wavequake import BEGUN, __version__
from wavequake.campaign.plugins import load_named
from wavequake.commands import firmware, identify, loops, new, pictures, rare, sensitivity, statistics, stores
from wavequake.commands.ahead import while_it_runs
from wavequake.commands.options import (
    ClusterOption,
    DashboardOption,
    OnOption,
    RecheckOption,
    StoreOption,
    WorkersOption,
)
from wavequake.errors import StoreDamageError, UserError
from wavequake.terminal import (
    EXIT_BAD_INPUT,
    EXIT_DAMAGED,
    EXIT_INTERRUPTED,
    EXIT_QUARANTINED,
    err,
    fail,
    interrupted,
    live_progress,
    out,
    print_pairs,
    rate_words,
)
from wavequake.words import are, counted

app = typer.Typer(
    help="What does vibration do to the image, and which model, mirror or controller is good enough?",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
_own = False  # is the process that of the command alone?
_PLAN_S = 6.0  # since the command began; what compiled code does is waited for a moment longer
StudyArgument = Annotated[
    str,
    typer.Argument(
        help="Name of a bundled study or path of a .toml file.", autocompletion=pictures.complete_study
    ),
]
OverridesArgument = Annotated[
    list[str] | None, typer.Argument(metavar="[KEY=VALUE]...", help="e.g. campaign.cases=40")
]


def main(came: Sequence[float] | None = None) -> None:
    """Run the command line; the exit code says how it ended (0, 1, 2, 3, 4 or 130).

    `came` has the times at which signals came to end it: what is raised later is their consequence. Without
    it the process is another's, which no command may end.
    """
    global _own
    _own = came is not None
    debug = "--debug" in sys.argv  # before or after the command
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # a terminal that has no Greek shall not end a run
    try:
        app(load_named([word for word in sys.argv[1:] if word != "--debug"]), prog_name="wavequake")
    except Exception as error:
        if came:
            interrupted()
        _explain(error, debug)
    except KeyboardInterrupt:
        interrupted()
    except SystemExit as end:
        if end.code == EXIT_INTERRUPTED:  # typer's way to pass Ctrl-C on
            interrupted()
        raise


def _explain(error: Exception, debug: bool) -> NoReturn:
    if isinstance(error, UserError):
        fail(f"Error: {error}", EXIT_BAD_INPUT, debug, error.details)
    if isinstance(error, StoreDamageError):
        fail(f"Damaged store: {error}", EXIT_DAMAGED, debug)
    if isinstance(error, OSError):
        fail(f"Error: {error.strerror or error}: {error.filename or 'a file'}.", EXIT_BAD_INPUT, debug)
    if isinstance(error, MemoryError):
        fail(
            f"Error: the memory does not suffice: {str(error) or 'no more is given'}.", EXIT_BAD_INPUT, debug
        )
    words = f"Internal error: {type(error).__name__}: {error} (run again with --debug for the traceback)."
    fail(words, 1, debug)


def _version(asked: bool) -> None:
    if asked:
        out.print(f"wavequake {__version__}")
        raise typer.Exit


@app.callback()
def _global(
    debug: Annotated[
        bool, typer.Option("--debug", help="Show tracebacks (before or after the command).")
    ] = False,
    plugin: Annotated[
        list[Path] | None,
        typer.Option(
            "--plugin", help="Load a file of own study kinds, measures, sources... (docs/extending.md)."
        ),
    ] = None,
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version.")
    ] = False,
) -> None:
    """Take the options that every command shares."""


def run(
    study: StudyArgument,
    overrides: OverridesArgument = None,
    store: StoreOption = None,
    on: OnOption = "local",
    cluster: ClusterOption = None,
    workers: WorkersOption = None,
    shard: Annotated[
        str | None,
        typer.Option(metavar="i/n", help="Compute every n-th chunk only, from 0/n; other runs do the rest."),
    ] = None,
    repair: Annotated[
        bool, typer.Option("--repair", help="Read all results first and compute damaged chunks again.")
    ] = False,
    allow_mixed: Annotated[
        bool, typer.Option("--allow-mixed", help="Go on with a store that other versions of the code began.")
    ] = False,
    recheck: RecheckOption = "0",
    dashboard: DashboardOption = False,
    profile: Annotated[bool, typer.Option("--profile", help="Say where the time went.")] = False,
) -> None:
    """Run a study, or what of it is not done yet, and write its report. Safe to repeat and to interrupt."""
    from wavequake.campaign.engine.driver import begin_workers
    from wavequake.campaign.engine.driver_lock import shard_of
    from wavequake.campaign.engine.plan import share_of
    from wavequake.campaign.store.manifest import read_manifest
    from wavequake.report.answers.profile import profile as profile_of
    from wavequake.workflows.run import finished_study, kind_of, notices, run_study
    from wavequake.workflows.study import load_study

    part = None if shard is None else shard_of(shard)
    share = share_of(recheck)
    loaded = load_study(study, overrides or [])
    path = loaded.folder(store)
    out.print(
        f"{loaded.study.name}  {counted(loaded.cases, 'case')}  ->  {path}", markup=False, soft_wrap=True
    )
    summary = None if part or repair or share else finished_study(loaded, path)
    if summary is None:
        begin_workers(kind_of(loaded), path, on)
        for line in notices(loaded):
            out.print(line, markup=False, soft_wrap=True)
        with live_progress() as progress:
            summary = run_study(
                loaded,
                path,
                on=on,
                workers=workers,
                progress=progress if part else while_it_runs(progress, loaded.study.workflow),
                repair=repair,
                allow_mixed=allow_mixed,
                dashboard=stores.show_link if dashboard else None,
                shard=part,
                cluster=cluster,
                recheck=share,
            )
    if summary.computed:
        again = f", {summary.again} of them again, whose chunk was not full" if summary.again else ""
        speed = rate_words(summary.computed / max(summary.seconds, 1e-9))
        spent = f"{summary.seconds:.1f} s ({speed} cases/s){again}; {summary.done_before} done before."
        out.print(f"{counted(summary.computed, 'case')} computed in {spent}")
    else:
        out.print(f"All done already ({counted(summary.done_before, 'case')}); nothing was computed.")
    if (held := read_manifest(path).cases) > loaded.cases and loaded.campaign.until is None:
        out.print(f"The store holds {held} cases: table and report are of all, not of {loaded.cases} alone.")
    for line in (*summary.goal, *summary.rechecked):
        out.print(line, markup=False, soft_wrap=True)
    if part:
        words = shlex.join(["wavequake", "report", str(path)])
        out.print(f"Shard {part} is complete; once all are: {words}", markup=False, soft_wrap=True)
    else:
        stores.write_report(path, fresh=summary.computed > 0)
    if profile:
        print_pairs(profile_of(path))
    if summary.quarantined:
        words = shlex.join(["wavequake", "status", str(path)])
        err.print(
            f"{are(summary.quarantined, 'case')} quarantined; {words} says why.", markup=False, soft_wrap=True
        )
        sys.exit(EXIT_QUARANTINED)


def plan(
    study: StudyArgument,
    overrides: OverridesArgument = None,
    store: StoreOption = None,  # nothing is stored, but an earlier run tells how long it took
    accuracy: Annotated[
        str | None, typer.Option(help="Propose rays, terms, order and cases for it, as '1 %'.")
    ] = None,
    measure: Annotated[str | None, typer.Option(help="What shall be as accurate (default: wfe_rms).")] = None,
    wait: Annotated[bool, typer.Option("--wait", help="Wait for the estimate, however long.")] = False,
) -> None:
    """Show cases, chunks, memory and an estimate of the time, or soon what is known; stores nothing."""
    from wavequake.workflows.planning.plan import planned
    from wavequake.workflows.study import load_study

    if accuracy is None and measure is not None:
        raise UserError("--measure belongs to an accuracy; say --accuracy '1 %', too.")
    loaded, wanted = load_study(study, overrides or []), None
    if accuracy is not None:
        from wavequake.report.answers.accuracy import accuracy_of, plan_accuracy

        wanted = accuracy_of(accuracy)
    rest = max(0.5, _PLAN_S - (time.monotonic() - BEGUN)) if _own else _PLAN_S
    last_word = _end_with if _own else None
    print_pairs(planned(loaded, None if wait or wanted is not None else rest, store, last_word))
    if wanted is not None:
        print_pairs(plan_accuracy(loaded, wanted, measure, [study, *(overrides or [])]))


def _end_with(known: dict[str, str]) -> NoReturn:
    print_pairs(known)
    sys.stdout.flush()
    os._exit(0)


def studies() -> None:
    """List the bundled studies, systems and telescopes."""
    from wavequake.bundled import TELESCOPES, bundled_titles
    from wavequake.optics.catalog.names import system_names

    table = Table(box=None)
    table.add_column("study", style="bold")
    table.add_column("what it shows")
    for name, title in bundled_titles().items():
        table.add_row(name, title)
    out.print(table)
    systems = dict.fromkeys((*system_names(), *TELESCOPES))
    out.print(f"Systems and telescopes, for info, draw, sensitivity and new: {', '.join(systems)}.")


_BEGIN, _RUN, _DECIDE, _SURE, _MEASURED, _PARTS = (
    "Begin: files and pictures",
    "Run, watch, keep",
    "Decide: what costs, how stable, how rare, how still",
    "How sure the numbers of a store are",
    "Measurements and other stores",
    "Machines",
)
_PANELS: dict[str, list[Callable[..., None]]] = {
    _BEGIN: [studies, new.new, new.migrate, pictures.info, pictures.draw],
    _RUN: [
        run,
        plan,
        stores.status,
        stores.report,
        pictures.view,
        stores.export,
        stores.verify,
        stores.retry,
        stores.rerun,
    ],
    _DECIDE: [statistics.budget, sensitivity.sensitivity, loops.margins, rare.rare, rare.allow],
    _SURE: [statistics.errors, statistics.sharpen, statistics.tail],
    _MEASURED: [identify.identify, identify.compare],
    _PARTS: [sensitivity.devices],
}
for _panel, _commands in _PANELS.items():
    for _command in _commands:
        app.command(rich_help_panel=_panel)(_command)
app.add_typer(firmware.app, name="firmware", rich_help_panel=_PARTS)
