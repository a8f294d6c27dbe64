"""Disturbances of a store, ranked by any of its numbers."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.table import Table
from rich.text import Text

from wavequake.campaign.contract import DONE
from wavequake.campaign.statistics.judged import judged_in, populations_of, title
from wavequake.campaign.store.store import open_store
from wavequake.errors import UserError
from wavequake.report.answers.tail import per_case
from wavequake.report.table import empty_table, number
from wavequake.workflows.kinds import compared_labels

SMALL_COSTS = ("peak", "strehl", "marechal", "rayleigh", "mtf50", "snr")
"""Numbers of which the small ones are bad."""


@dataclass(frozen=True)
class Ranked:
    """A population: how many cases it has, their median, their P95 (or P5) and the worst of them."""

    name: str
    cases: int
    median: float
    far: float
    worst: float


@dataclass(frozen=True)
class Ranking:
    """Populations, the costliest first, and by what they are ranked; `below`: small values cost."""

    found: tuple[Ranked, ...]
    variable: str
    unit: str
    statistic: str
    below: bool


def ranking(store: Path | str, by: str) -> Ranking:
    """Rank the populations of a store by the P95 over cases of a number, or by the P5 where small ones cost.

    Over instants the rms of a case counts (of what is bad where it is small the mean), of fields and
    wavelengths the worst one.

    Raises
    ------
    UserError
        If there is no such number, or no case is finished.
    """
    dataset = open_store(store)
    judged = judged_in(by, dataset)
    below = judged.variable in SMALL_COSTS
    statistic = "mean" if below else "rms"
    compared = compared_labels(dataset.attrs["study"]) if "study" in dataset.attrs else ()
    names = populations_of(dataset, compared)
    done = dataset["status"].to_numpy() == DONE
    found = []
    for label, values in per_case(dataset, judged, statistic, below).items():
        for name in dict.fromkeys(names[done].tolist()):
            mine = values[(names == name) & done]
            mine = mine[~np.isnan(mine)]
            if mine.size:
                # Of a case, as a radius beyond the frame is infinite.
                far = _far(mine, below)
                worst = float(mine.min() if below else mine.max())
                found.append(Ranked(title(name, label), mine.size, float(np.median(mine)), far, worst))
    if not found:
        raise UserError(f"No finished case of {store} has a number {by!r} to rank by.")
    found.sort(key=lambda one: one.far if below else -one.far)
    unit = str(dataset[judged.variable].attrs.get("units", "1"))
    return Ranking(tuple(found), by, unit, statistic, below)


def _far(values: NDArray[np.float64], below: bool) -> float:
    ordered, last = np.sort(values), len(values) - 1
    return float(ordered[last // 20 if below else last - last // 20])


def ranking_table(ranking: Ranking) -> Table:
    """Return the ranking as a table for the terminal."""
    headers = ("disturbance", "cases", "P50", "P5" if ranking.below else "P95", "worst")
    table = empty_table(headers, pad_edge=False, title=f"{ranking.variable} ({ranking.unit})")
    for one in ranking.found:
        numbers = map(number, (one.median, one.far, one.worst))
        table.add_row(Text(one.name), str(one.cases), *numbers)
    return table


def ranking_notes(ranking: Ranking) -> Iterator[str]:
    """Yield what the numbers mean, in lines."""
    quantile, side = ("P5", "small") if ranking.below else ("P95", "large")
    yield (
        f"Ranked by the {quantile} over cases, as {side} values cost. Over the instants of a case it is the "
        f"{ranking.statistic}, of fields and wavelengths the worst."
    )
    first = ranking.found[0]
    yield f"By {ranking.variable} {first.name} costs the most."
