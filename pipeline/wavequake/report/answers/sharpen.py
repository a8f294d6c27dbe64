"""Means and quantiles of a store of full traces, sharpened by many cases of the modal model."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.table import Table

from wavequake.campaign.contract import DONE
from wavequake.campaign.schema import study_from_identity
from wavequake.campaign.statistics.control import FEWEST, Sharpened, sharpened_mean, sharpened_quantile
from wavequake.campaign.statistics.judged import judged_in
from wavequake.campaign.statistics.quantiles import Quantile
from wavequake.campaign.store.store import open_store, read_manifest
from wavequake.errors import UserError
from wavequake.prepared import one_thread
from wavequake.report.answers.tail import per_case
from wavequake.report.at_hand import device_at_hand
from wavequake.report.table import MISSING, empty_table, number
from wavequake.workflows.kinds import find_kind
from wavequake.workflows.segments.control import MEASURES, modal_numbers, modal_partner

Progress = Callable[[int, int, int], None]

LEVELS = {"P50": 0.5, "P95": 0.95}
_AT_ONCE = 1000


@dataclass(frozen=True)
class SharpRow:
    """A measure of the cases of a disturbance: its mean and quantiles by name."""

    disturbance: str
    measure: str
    unit: str
    traces: int
    cases: int
    found: dict[str, Sharpened]


def sharpen(store: Path | str, cases: int = 20_000, progress: Progress | None = None) -> list[SharpRow]:
    """Return means and quantiles of a store, by its traces and with more cases of the modal model.

    Parameters
    ----------
    store : Path or str
        Of a segment-disturbance study whose cases are independent and traced in full.
    cases : int
        Of the modal model, those of the store included; the same draws that the study would have.
    progress : callable, optional

    Raises
    ------
    UserError
        If the store is another kind of store, has stratified cases, too few, or as many as `cases`.
    """
    manifest, dataset = read_manifest(store), open_store(store)
    kind = find_kind(manifest.workflow)
    study = study_from_identity(kind.model, manifest.study)
    if "replicate" in dataset.variables:
        raise UserError(
            f"The cases of {store} are stratified, or share models; sharpen needs independent ones."
        )
    if cases <= manifest.cases:
        raise UserError(
            f"{store} has {manifest.cases} cases; the modal model sharpens them by more: give --cases beyond."
        )
    partner = modal_partner(study)
    sources = kind.case_table(manifest.study, 0, cases)["disturbance"]
    done = np.zeros(cases, dtype=np.bool_)
    done[: manifest.cases] = dataset["status"].to_numpy() == DONE
    traced = []
    for name in MEASURES:
        costly = np.full(cases, np.nan)
        (costly[: manifest.cases],) = per_case(dataset, judged_in(name, dataset), "rms").values()
        for source in dict.fromkeys(sources.tolist()):
            paired = (sources == source) & done & np.isfinite(costly)
            if paired.sum() < FEWEST:  # before the many cases are computed
                raise UserError(
                    f"{source!r} has {paired.sum()} traced cases in {store}; take at least {FEWEST}."
                )
            traced.append((name, source, costly, paired))
    device = device_at_hand(manifest)
    parts = []
    for first in range(0, cases, _AT_ONCE):
        if progress:
            progress(first, cases, 0)
        ids = np.arange(first, min(first + _AT_ONCE, cases))
        with one_thread():
            parts.append(modal_numbers(partner, ids, device))
    cheap = {name: np.concatenate([part[name] for part in parts]) for name in MEASURES}
    rows = []
    for name, source, costly, paired in traced:
        more = (sources == source) & (np.arange(cases) >= manifest.cases)
        given = (costly[paired], cheap[name][paired], cheap[name][more])
        found = {"mean": sharpened_mean(*given)}
        found |= {label: sharpened_quantile(*given, p) for label, p in LEVELS.items()}
        unit = str(dataset[name].attrs.get("units", ""))
        rows.append(SharpRow(source, name, unit, int(paired.sum()), int(more.sum()), found))
    if progress:
        progress(cases, cases, 0)
    return rows


def sharpen_table(rows: list[SharpRow]) -> Table:
    """Return the numbers as a table for the terminal."""
    words, numbers = ("disturbance", "number"), ("traces alone", "with the modal model", "worth\n(traces)")
    table = empty_table((*words, *numbers), words, fixed=True, pad_edge=False)
    head = ""
    for row in sorted(rows, key=lambda one: [other.disturbance for other in rows].index(one.disturbance)):
        for label, one in row.found.items():
            shown = row.disturbance if row.disturbance != head else ""
            head, name = row.disturbance, f"{row.measure} {label} ({row.unit})"
            table.add_row(shown, name, _words(one.alone), _words(one.value), _worth(row, one))
    return table


def _worth(row: SharpRow, one: Sharpened) -> str:
    if one.worth <= row.traces:
        return MISSING
    return number(one.worth, 2) if np.isfinite(one.worth) else "∞"


def _words(found: Quantile) -> str:
    ends = [number(one, 4) if np.isfinite(one) else MISSING for one in (found.low, found.high)]
    return f"{number(found.value, 4)} ({ends[0]}–{ends[1]})"


def sharpen_notes(rows: list[SharpRow]) -> Iterator[str]:
    """Yield what the numbers mean, in lines."""
    traces, cases = rows[0].traces, rows[0].cases
    yield (
        f"Of each disturbance {traces} cases are traced, and {cases} more computed by the modal model, from "
        "which the traces differ by a smooth function and a remainder that the traced cases give; rms over "
        "the instants of a case, 95 % intervals. Worth: traces that alone would give as narrow an interval; "
        "∞: these have no end on one side."
    )
    if any(one.worth <= row.traces for row in rows for one in row.found.values()):
        yield "–: the modal model says too little of this number, and the traces stand alone."
