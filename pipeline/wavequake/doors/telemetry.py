"""Telemetry: what moved, and whether a model agrees; the commands print what these return."""

from pathlib import Path
from typing import TYPE_CHECKING

from wavequake.campaign.schema import Study

if TYPE_CHECKING:
    import pandas as pd

    from wavequake.workflows.identify.identify import Identified


def identify(data: str | Path, study: str | Path | Study, output: str | Path | None = None) -> "Identified":
    """Find vibration lines in telemetry, what moves, and modes of the structure.

    Parameters
    ----------
    data : str or Path
        ``.csv``, ``.npz`` or ``.fits`` of time_s and columns such as ``line_of_sight.x_mas``.
    study : str, Path or Study
        What was measured, of the workflow system-disturbance or segment-disturbance.
    output : str or Path, optional
        FILE.toml: the study (given by name or path) with sources that do what was measured; FILE.html: what
        was found as a page; FILE.svg, .png or .pdf: its spectra.

    Returns
    -------
    Identified
        ``lines`` with their covariances, ``explanations``, ``modes`` and ``spectra``.

    Raises
    ------
    UserError
        If the record has no spectrum, or a column names nothing of the study.

    Examples
    --------
    >>> found = identify("los.csv", "tmt-segments", "measured.toml")  # doctest: +SKIP
    >>> [(line.frequency_hz, line.damping) for line in found.lines]    # doctest: +SKIP
    """
    from wavequake.errors import UserError
    from wavequake.report.answers.identify import require_outputs, spectra_figure, write_figure
    from wavequake.report.answers.identify_page import write_identified
    from wavequake.workflows.identify.identify import identified_file
    from wavequake.workflows.identify.study_text import study_text
    from wavequake.workflows.study import load_study

    file = None if output is None else Path(output)
    kind = "" if file is None else file.suffix.lower()
    if file is not None:
        require_outputs([file])
        if isinstance(study, Study) and kind == ".toml":
            raise UserError("A study is written to a .toml file, from the name or path of a study.")
    loaded = study if isinstance(study, Study) else load_study(study)
    found = identified_file(data, loaded)
    if file is not None and kind == ".toml":
        text = study_text(found, str(study), Path(data).name, file.absolute().parent)
        file.write_text(text, encoding="utf-8")
    elif file is not None and kind == ".html":
        write_identified(found, loaded, Path(data), file)
    elif file is not None:
        words = f"{Path(data).name}: what was measured, and what was found"
        write_figure(spectra_figure(found, words), file)
    return found


def agreement(store: str | Path, data: str | Path, of: str | None = None) -> "pd.DataFrame":
    """Say band by band whether the cases of a store and telemetry have the same spectra.

    Parameters
    ----------
    store, data : str or Path
    of : str, optional
        The disturbance that was measured, where the store has several.

    Returns
    -------
    pandas.DataFrame
        A row per signal and band: ``ratio`` of the data's power to the model's with its 95 % interval, and
        whether it ``agrees``, at a rate of false alarms of 5 % for all rows together.

    Raises
    ------
    UserError
        If the store has no such series, or the sampling of both has no common step.

    Examples
    --------
    >>> agreement("runs/measured", "los.csv").query("not agrees")  # doctest: +SKIP
    """
    import pandas as pd

    from wavequake.report.answers.agreement import agreement_of, rows

    names, *values = rows(agreement_of(Path(store), Path(data), of))
    return pd.DataFrame(values, columns=list(names))
