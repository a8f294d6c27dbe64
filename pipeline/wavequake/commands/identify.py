"""`wavequake identify` and `wavequake compare`: models from telemetry, and whether they agree with it."""

from pathlib import Path
from typing import Annotated

import typer

from wavequake.errors import UserError
from wavequake.terminal import out


def identify(
    data: Annotated[Path, typer.Argument(help="Telemetry: .csv, .npz or .fits (docs/telemetry.md).")],
    study: Annotated[str, typer.Option("--study", help="What was measured: a bundled study or a file.")],
    files: Annotated[
        list[Path] | None,
        typer.Option(
            "--output", "-o", help="FILE.toml (a study that does the same), .html, .svg, .png, .pdf."
        ),
    ] = None,
    debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks.")] = False,
) -> None:
    """Find vibration lines in telemetry, what moves, and sources of a study that does the same."""
    from wavequake.report.answers.identify import (
        identify_notes,
        lines_table,
        modes_table,
        require_outputs,
        spectra_figure,
        write_figure,
    )
    from wavequake.report.answers.identify_page import write_identified
    from wavequake.workflows.identify.identify import doubts, identified_file
    from wavequake.workflows.identify.study_text import study_text
    from wavequake.workflows.study import load_study

    require_outputs(files or [])
    loaded = load_study(study)
    found = identified_file(data, loaded)
    out.print(lines_table(found))
    if (modes := modes_table(found)) is not None:
        out.print(modes)
    for line in (*identify_notes(found), *doubts(found)):
        out.print(line, markup=False)
    for file in files or ():
        if file.suffix.lower() == ".toml":
            text = study_text(found, study, data.name, file.absolute().parent)
            file.write_text(text, encoding="utf-8")
        elif file.suffix.lower() == ".html":
            write_identified(found, loaded, data, file)
        else:
            write_figure(spectra_figure(found, f"{data.name}: what was measured, and what was found"), file)
        out.print(f"Written: {file.resolve()}", markup=False, soft_wrap=True)


def compare(
    stores: Annotated[
        list[Path],
        typer.Argument(help="The reference store, then those to compare with it; or a store and telemetry."),
    ],
    figure: Annotated[
        Path | None,
        typer.Option("--figure", help="Where the figure goes (.png, .svg, .pdf; default: the last store)."),
    ] = None,
    of: Annotated[
        str | None, typer.Option("--of", help="With telemetry: the disturbance that was measured.")
    ] = None,
    table: Annotated[
        Path | None, typer.Option("--output", "-o", help="With telemetry: FILE.csv of all bands.")
    ] = None,
    debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks.")] = False,
) -> None:
    """Compare stores case by case (equal labels are paired), or a store with telemetry, band by band."""
    from wavequake.report.answers.agreement import RECORDS

    if len(stores) == 2 and stores[1].suffix.lower() in RECORDS and not stores[1].is_dir():
        _compare_with_telemetry(stores[0], stores[1], figure, of, table)
        return
    if of is not None or table is not None:
        raise UserError("--of and --output belong to telemetry: wavequake compare STORE DATA.csv.")
    from wavequake.report.answers.comparison import compare_stores
    from wavequake.report.answers.comparison_table import comparison_table

    path = figure or stores[-1] / "comparison.png"
    out.print(comparison_table(*compare_stores(stores, path)))
    out.print(f"Figure: {path.resolve()}", markup=False, soft_wrap=True)


def _compare_with_telemetry(
    store: Path, data: Path, figure: Path | None, of: str | None, table: Path | None
) -> None:
    from wavequake.report.answers.agreement import (
        agreement_notes,
        agreement_of,
        agreement_table,
        write_agreement,
    )

    found = agreement_of(store, data, of)
    out.print(agreement_table(found))
    for line in agreement_notes(found):
        out.print(line, markup=False)
    for file in (table, figure):
        if file is not None:
            write_agreement(found, file)
            out.print(f"Written: {file.resolve()}", markup=False, soft_wrap=True)
