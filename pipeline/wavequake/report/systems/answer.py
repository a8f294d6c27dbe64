"""The sentence that a report of an optical system begins with: which disturbance does most, and where."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from wavequake.report.statistics import FEWEST, quantile
from wavequake.report.systems.populations import FieldResult, SystemPopulation
from wavequake.report.table import number

Array = NDArray[np.float64]


def is_incomplete(found: Sequence[SystemPopulation]) -> bool:
    """Return whether rays are missing anywhere, so that fits over the full pupil are none of the light."""
    return any(one.lost for population in found for one in population.fields)


def answer(found: Sequence[SystemPopulation], sums: frozenset[str] = frozenset()) -> str:
    """Say which disturbance changes the wavefront most, and where; where light is missing, what it leaves.

    The `sums` of disturbances are left out, unless there is nothing else.
    """
    every = [(population.name, one) for population in found for one in population.fields]
    results = [result for result in every if result[0] not in sums] or every
    if not results:
        return "No case is done yet."
    if is_incomplete(found):
        name, one = max(results, key=lambda result: quantile(result[1].raw, 0.95).value)
        known = np.isfinite(one.strehl_p50)  # the modal model knows none
        strehl = f", where the median Strehl ratio is {number(one.strehl_p50)}" if known else ""
        return (
            f"Rays are missing at some instants. Of the light that arrives, {name} has the largest wavefront "
            f"error: {_share_of(95, one)} {_bound(one)}{number(_level(one.raw, 95))} nm rms at field "
            f"{one.field}{strehl}."
        )
    name, one = max(results, key=lambda result: quantile(result[1].change, 0.95).value)
    value, most = number(_level(one.change, 95)), " most" if len({name for name, _ in results}) > 1 else ""
    moves = f", where the line of sight moves by {number(one.los.radial)} µm rms"
    return (
        f"{name} changes the wavefront{most}: {_share_of(95, one)} by {_bound(one)}{value} nm rms at field "
        f"{one.field}{moves if np.isfinite(one.los.radial) else ''}." + _worst_image(results)
    )


def _worst_image(results: Sequence[tuple[str, FieldResult]]) -> str:
    """Say which disturbance costs most of the exposure, line of sight included, where there are images.

    What the design has at rest is no cost of a disturbance: the least share of it that is left tells.
    """
    imaged = [(name, one, _level(one.peak, 5)) for name, one in results if one.peak is not None]
    if not imaged:
        return ""
    name, one, peak = min(imaged, key=lambda result: result[2] / result[1].peak_at_rest)
    many = len({name for name, _, _ in imaged}) > 1
    what = f"{name} costs most: at" if many else "at"
    least = "at most " if len(one.wfe) >= FEWEST else ""
    return (
        f" Of exposures, which the motion of the line of sight blurs, too, {what} field {one.field} "
        f"{_share_of(5, one)} the peak is {least}{number(peak)} of the perfect image's, "
        f"{number(one.peak_at_rest)} at rest."
    )


def _level(values: Array, percent: int) -> float:
    """Return a percentile over the cases, or of few cases the last one."""
    few = 1.0 if percent > 50 else 0.0
    return quantile(values, percent / 100.0 if len(values) >= FEWEST else few).value


def _bound(one: FieldResult) -> str:
    """Return what stands before the largest of several cases."""
    return "at most " if len(one.wfe) > 1 else ""


def _share_of(percent: int, one: FieldResult) -> str:
    """Return of which cases a percentile speaks: few cases have none."""
    cases = len(one.wfe)
    if cases >= FEWEST:
        return f"in {percent} % of its cases"
    if cases == 1:
        return "in its only case"
    return f"in all of its {cases} cases" if percent > 50 else f"in the worst of its {cases} cases"
