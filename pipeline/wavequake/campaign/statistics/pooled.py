"""Quantiles of more numbers than memory holds: read a few times, a part of them at a time."""

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from wavequake.campaign.statistics.quantiles import (
    Quantile,
    bounded,
    bounds,
    bounds_of_share,
    error_of_shares,
    interpolated,
    neighbors,
    quantile,
)

Array = NDArray[np.float64]
# The name of a population, values (cases, n) of some of its cases, and of stratified cases the set of each.
Part = tuple[str, Array, NDArray[np.int64] | None]
Parts = Callable[[], Iterable[Part]]

HELD = 2**23  # values that are kept in memory
_DIGIT = 16  # bits of a number that one reading finds


def pooled_quantiles(parts: Parts, probability: float) -> dict[str, Quantile]:
    """Return the quantile of each population, and its 95 % confidence interval.

    The values of a case count as one draw; NaN are no values, and -0.0 is 0.0. Up to `HELD` values are read
    once; of more, all are read five times, or ten times if they are stratified, and the quantiles have the
    same bits.

    Parameters
    ----------
    parts : callable
        Gives all parts anew at each call.
    probability : float
        Between 0 and 1.
    """
    kept: dict[str, list[Part]] = defaultdict(list)
    cases, counts, stratified = defaultdict[str, int](int), defaultdict[str, int](int), False
    for name, values, sets in parts():
        cases[name] += len(values)
        counts[name] += int(np.count_nonzero(~np.isnan(values)))
        stratified = sets is not None
        if sum(counts.values()) <= HELD:
            kept[name].append((name, values, sets))
        else:
            kept.clear()
    if sum(counts.values()) <= HELD:
        return {name: _held(found, probability) for name, found in kept.items()}
    some = {name: count for name, count in counts.items() if count}
    ends: dict[str, tuple[int | None, int | None]] = dict.fromkeys(some, (None, None))
    if not stratified:
        ends = {name: bounds(count, min(cases[name], count), probability) for name, count in some.items()}
    places = {name: {*neighbors(count, probability), *_given(ends[name])} for name, count in some.items()}
    found = order_statistics(parts, places)
    value = {name: interpolated(found[name], count, probability) for name, count in some.items()}
    if stratified:
        half = _errors(parts, value)
        ends = {name: bounds_of_share(count, probability, half[name]) for name, count in some.items()}
        found = order_statistics(parts, {name: _given(pair) for name, pair in ends.items()})
    quantiles = {name: Quantile(np.nan, np.nan, np.nan) for name in counts}
    for name, (low, high) in ends.items():
        quantiles[name] = bounded(
            value[name],
            -np.inf if low is None else found[name][low],
            np.inf if high is None else found[name][high],
        )
    return quantiles


def _given(pair: tuple[int | None, int | None]) -> set[int]:
    return {place for place in pair if place is not None}


def _held(parts: list[Part], probability: float) -> Quantile:
    values = np.concatenate([values for _, values, _ in parts]) + 0.0  # -0.0 becomes 0.0, as in _keys
    there = ~np.isnan(values)
    labels = [sets for _, _, sets in parts if sets is not None]
    if not labels:
        return quantile(values[there], probability, min(len(values), int(there.sum())))
    sets = np.broadcast_to(np.concatenate(labels)[:, None], values.shape)[there]
    return quantile(values[there], probability, sets=sets)


def order_statistics(parts: Parts, places: Mapping[str, Iterable[int]]) -> dict[str, dict[int, float]]:
    """Return what stands at some places (from 0) among the sorted values of each population.

    Numbers sort as their bits do, once those of negative ones are turned over; so each of four readings
    counts the next 16 bits of the numbers that begin as the wanted one does.
    """
    found = {(name, place): 0 for name, wanted in places.items() for place in wanted}  # its first bits
    before = dict.fromkeys(found, 0)  # how many numbers are smaller by these bits
    for shift in range(64 - _DIGIT, -1, -_DIGIT):
        begun: dict[tuple[str, int], NDArray[np.int64]] = {
            (name, start): np.zeros(2**_DIGIT, dtype=np.int64) for (name, _), start in found.items()
        }
        for name, keys in _keys(parts, {name for name, _ in begun}):
            for (other, start), counts in begun.items():
                if other == name:
                    mine = keys[keys >> (shift + _DIGIT) == start] if shift < 64 - _DIGIT else keys
                    digits = (mine >> shift) & (2**_DIGIT - 1)
                    counts += np.bincount(digits.astype(np.int64), minlength=2**_DIGIT)
        for (name, place), start in found.items():
            up_to = np.cumsum(begun[name, start])
            digit = int(np.searchsorted(up_to, place - before[name, place], side="right"))
            before[name, place] += int(up_to[digit - 1]) if digit else 0
            found[name, place] = (start << _DIGIT) + digit
    values: dict[str, dict[int, float]] = {name: {} for name in places}
    for (name, place), key in found.items():
        bits = key ^ (1 << 63) if key >> 63 else key ^ (2**64 - 1)
        values[name][place] = float(np.uint64(bits).view(np.float64))
    return values


def _keys(parts: Parts, names: set[str]) -> Iterator[tuple[str, NDArray[np.uint64]]]:
    """Yield unsigned integers that sort as the values of some populations do."""
    for name, values, _ in parts():
        if name in names:
            # The bits of -0.0 are others than those of 0.0, which equals it: the sum makes it 0.0.
            bits = (np.asarray(values[~np.isnan(values)], dtype=np.float64) + 0.0).view(np.uint64)
            yield name, np.where(bits >> 63, ~bits, bits | np.uint64(1 << 63))


def _errors(parts: Parts, level: Mapping[str, float]) -> dict[str, float]:
    """Return half the confidence interval of the share of values up to a level, from the cases' sets."""
    counts: dict[str, dict[int, list[int]]] = {name: {} for name in level}
    for name, values, sets in parts():
        if name not in level or sets is None:
            continue
        for one in np.unique(sets).tolist():
            mine = values[sets == one]
            pair = counts[name].setdefault(one, [0, 0])
            pair[0] += int(np.count_nonzero(mine <= level[name]))
            pair[1] += int(np.count_nonzero(~np.isnan(mine)))
    found = {}
    for name, by_set in counts.items():
        # In the order of the sets, as `share_error` sums them, not in that of their first cases.
        pairs = np.array([by_set[one] for one in sorted(by_set) if by_set[one][1]], dtype=np.int64)
        found[name] = float(error_of_shares(pairs[:, :1], pairs[:, 1])[0]) if len(pairs) > 1 else np.inf
    return found
