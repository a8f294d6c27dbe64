"""The error of every number of a store: by rays, terms, reduction, linearisation and sampling.

A sample of the stored cases is computed again, finer and finer, one origin after the other.
"""

import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from wavequake.campaign.contract import DONE, StudyKind
from wavequake.campaign.engine.pool import HERE, Place, mapped
from wavequake.campaign.schema import Study, study_from_identity
from wavequake.campaign.statistics.judged import populations_of
from wavequake.campaign.statistics.refinement import Refined, refinement_error
from wavequake.campaign.store.store import ERRORS, open_store, read_manifest
from wavequake.campaign.store.whole import read_dataset, write_dataset
from wavequake.errors import UserError
from wavequake.prepared import one_thread
from wavequake.report.at_hand import device_at_hand
from wavequake.report.plain import Row, compared_labels, groups_of, rows
from wavequake.report.statistics import quantile
from wavequake.workflows.kinds import find_kind
from wavequake.workflows.refinements import REDUCTION, Refinement, refinements
from wavequake.workflows.study import study_with

if TYPE_CHECKING:
    import xarray as xr

Array = NDArray[np.float64]
Progress = Callable[[int, int, int], None]
Key = tuple[str, str]  # measure and place

SCHEMA = 1
SAMPLING = "sampling"
FEWEST = 2
_FULL = "full"
_LEVELS = {"P50": 0.5, "P95": 0.95}


@dataclass(frozen=True)
class _Work:
    """What a worker has to know; the kind brings its plug-ins."""

    kind: StudyKind
    device: str


@dataclass(frozen=True)
class Sampled:
    """Numbers (n,) of n cases by measure and place, at each step of a refinement, or why there are none."""

    refinement: Refinement
    values: tuple[dict[Key, Array], ...]
    trouble: str = ""


def cases_again(
    study: Study, ids: NDArray[np.int64], device: str, place: Place = HERE, progress: Progress | None = None
) -> list[Sampled]:
    """Compute cases of a study again at every step of all its refinements."""
    work = _Work(find_kind(study.study.workflow), device)
    found: list[Sampled] = []
    pieces: list[tuple[int, int, str, NDArray[np.int64]]] = []
    asked = list(refinements(study))
    troubles = dict.fromkeys(range(len(asked)), "")
    for index, one in enumerate(asked):
        for step, keys in enumerate(one.steps):
            try:
                text = study_with(study, keys).identity_text()
                work.kind.check(text)
            except UserError as error:
                troubles[index] = str(error)
            else:
                pieces.append((index, step, text, ids))
    pieces = [piece for piece in pieces if not troubles[piece[0]]]
    values: dict[tuple[int, int], dict[Key, Array] | str] = {}
    for count, (piece, numbers) in enumerate(mapped(_numbers, work, pieces, place), start=1):
        values[piece[:2]] = numbers
        if progress:
            progress(count, len(pieces), 0)
    for index, one in enumerate(asked):
        if troubles[index]:
            found.append(Sampled(one, (), troubles[index]))
        else:
            found.append(_possible(one, [values[index, step] for step in range(len(one.steps))]))
    return found


def _numbers(work: _Work, piece: tuple[int, int, str, NDArray[np.int64]]) -> dict[Key, Array] | str:
    """Return the numbers of a step, or why it is not possible."""
    try:
        return numbers_of(work.kind, piece[2], piece[3], work.device)
    except UserError as error:
        return str(error)


def _possible(one: Refinement, steps: Sequence[dict[Key, Array] | str]) -> Sampled:
    """Return a refinement by the steps that are possible; those of models of higher orders may not be."""
    bad = {number: words for number, words in enumerate(steps) if isinstance(words, str)}
    kept = [number for number in range(len(steps)) if number not in bad]
    needed = {one.base, len(steps) - 1} if one.origin == REDUCTION else set(range(len(steps)))
    if needed & set(bad):
        return Sampled(one, (), next(words for number, words in bad.items() if number in needed))
    counts, keys = tuple(one.counts[k] for k in kept), tuple(one.steps[k] for k in kept)
    one = replace(one, counts=counts, steps=keys, base=kept.index(one.base))
    return Sampled(one, tuple(values for values in steps if not isinstance(values, str)))


def numbers_of(kind: StudyKind, text: str, ids: NDArray[np.int64], device: str) -> dict[Key, Array]:
    """Compute cases and return a number per case of every measure; NaN of cases that fail."""
    import xarray as xr

    with one_thread():
        result = kind.compute(text, ids, device)
    template = kind.template(text)
    variables = {
        name: xr.Variable(("case", *one.dims), result.arrays[name], dict(one.attrs))
        for name, one in template.per_case.items()
        if not one.measured and not one.coordinate
    }
    labels = {name: values for name, (dims, values, _) in template.fixed.items() if dims == (name,)}
    done = result.status == DONE
    return {
        (row.name, row.label): np.where(done, row.values, np.nan)
        for row in rows(xr.Dataset(variables, labels))
    }


def error_of(sampled: Sampled, key: Key, mine: NDArray[np.bool_]) -> Refined | None:
    """Return the error of a measure of some of the cases; None where the steps do not have it."""
    if not sampled.values or any(key not in step for step in sampled.values):
        return None
    values = np.array([step[key][mine] for step in sampled.values])
    values = values[:, np.isfinite(values).all(axis=0)]
    if not values.shape[1]:
        return None
    return refinement_error(sampled.refinement.counts, values, sampled.refinement.base)


def spread_ids(members: NDArray[np.bool_], count: int) -> NDArray[np.int64]:
    """Return `count` of the places that are members, evenly spread, or all."""
    places = np.flatnonzero(members)
    chosen = np.unique(((np.arange(count) + 0.5) / count * len(places)).astype(np.int64))
    return places[chosen] if len(places) else places


def store_errors(
    store: Path, cases: int = 8, place: Place = HERE, progress: Progress | None = None
) -> "xr.Dataset":
    """Measure the errors of every number of a store, and keep them there as ``errors.zarr``.

    Parameters
    ----------
    store : Path
    cases : int
        Of each population, that are computed again.
    place : Place
    progress : callable, optional

    Returns
    -------
    xarray.Dataset
        ``error`` (population, measure, origin) in the measure's unit, ``level`` and ``sampling``
        (population, measure, quantile), ``order`` and ``settled``.

    Raises
    ------
    UserError
        If there is no store, nothing in it is done, its cases are drawn near a limit, or `cases` is below 2;
        or if it cannot be written.
    """
    import xarray as xr

    if cases < FEWEST:
        raise UserError(f"{cases} cases say nothing of an error; take at least {FEWEST}.")
    manifest, dataset = read_manifest(store), open_store(store)
    if "log_weight" in dataset.variables:
        raise UserError(
            f"The cases of {store} are drawn near a limit, and others are with other rays or terms: they "
            "have no errors of their own; take those of wavequake run, of the study without [rare]."
        )
    if not os.access(store, os.W_OK):  # before anything is computed
        raise UserError(f"{store} cannot be written, and keeps its errors: copy it to where it can.")
    groups = {name: mine for name, mine in groups_of(store, dataset).items() if mine.any()}
    if not groups:
        raise UserError(f"No case of {store} is done, and none has an error; wavequake run computes them.")
    kind = find_kind(manifest.workflow)
    study = study_from_identity(kind.model, manifest.study)
    ids = np.unique(np.concatenate([spread_ids(mine, cases) for mine in groups.values()]))
    sampled = cases_again(study, dataset["case"].to_numpy()[ids], device_at_hand(manifest), place, progress)
    found = [row for row in rows(dataset) if not _measured(kind, manifest.study, row.name)]
    measured = any(one.refinement.origin == REDUCTION for one in sampled)
    reduced = {} if measured else reduction_errors(dataset, found)
    origins = [one.refinement.origin for one in sampled] + ([REDUCTION] if reduced else [])
    shape = (len(groups), len(found), len(origins))
    error, order, settled = np.full(shape, np.nan), np.full(shape, np.nan), np.ones(shape, dtype=np.int8)
    level, sampling = np.full((*shape[:2], 2), np.nan), np.full((*shape[:2], 2), np.nan)
    sets = dataset["replicate"].to_numpy() if "replicate" in dataset.coords else None
    drawn = populations_of(dataset, compared_labels(store, dataset))
    for g, mine in enumerate(groups.values()):
        for r, row in enumerate(found):
            known = mine & np.isfinite(row.values)
            for q, p in enumerate(_LEVELS.values()):
                one = quantile(row.values[known], p, sets=None if sets is None else sets[known])
                level[g, r, q] = one.value
                if not _each_its_own(drawn[known]):
                    sampling[g, r, q] = 0.5 * (one.high - one.low)
            for o, each in enumerate(sampled):
                if (refined := error_of(each, (row.name, row.label), mine[ids])) is not None:
                    error[g, r, o], order[g, r, o] = refined.error, refined.order
                    settled[g, r, o] = refined.settled
            if reduced:
                error[g, r, -1] = reduced[row.name, row.label](mine)
    dims = ("population", "measure", "origin")
    made = xr.Dataset(
        {
            "error": (dims, error, {"long_name": "rms over cases of a number minus what it converges to"}),
            "order": (dims, order, {"long_name": "power of the count with which the error falls"}),
            "settled": (dims, settled, {"long_name": "1: the steps converge; 0: the error is their spread"}),
            "level": ((*dims[:2], "quantile"), level, {"long_name": "quantile over cases"}),
            "sampling": (
                (*dims[:2], "quantile"),
                sampling,
                {"long_name": "half the 95 % confidence interval of the quantile"},
            ),
        },
        {
            "population": np.array(list(groups), dtype=object),
            "measure": np.array([row.title for row in found], dtype=object),
            "name": (("measure",), np.array([row.name for row in found], dtype=object)),
            "units": (("measure",), np.array([row.units for row in found], dtype=object)),
            "origin": np.array(origins, dtype=object),
            "quantile": np.array(list(_LEVELS), dtype=object),
        },
        {
            "title": "Errors",
            "schema": SCHEMA,
            "study_sha256": study.identity(),
            "cases": len(ids),
            "steps": json.dumps({one.refinement.origin: list(_words(one)) for one in sampled}),
        },
    )
    write_dataset(made, Path(store) / ERRORS)
    return made


def _each_its_own(populations: NDArray[np.str_]) -> bool:
    """Tell whether several cases are each of another kind, as models are: no draws, which sampling leaves."""
    return 1 < len(populations) == len(np.unique(populations))


def _measured(kind: StudyKind, text: str, name: str) -> bool:
    """Return whether a stopwatch gave a variable."""
    variable = kind.template(text).per_case.get(name)
    return variable is not None and variable.measured


def _words(one: Sampled) -> Iterator[str]:
    if one.trouble:
        yield f"not measured: {one.trouble}"
        return
    for step in one.refinement.steps:
        yield ", ".join(f"{key}={value}" for key, value in step.items()) or "as it is"


def reduction_errors(
    dataset: "xr.Dataset", found: Sequence[Row]
) -> Mapping[Key, Callable[[NDArray[np.bool_]], float]]:
    """Return what gives the rms error of populations by their reduced models, from cases of the full one."""
    if "reduction" not in dataset.coords or _FULL not in dataset["reduction"].to_numpy():
        return {}
    labels = [dataset[name].to_numpy().tolist() for name in ("disturbance", "realization") if name in dataset]
    draws = list(zip(*labels, strict=True))
    models = dataset["reduction"].to_numpy()
    full = {draw: case for case, draw in enumerate(draws) if models[case] == _FULL}
    partner = np.array([full.get(draw, -1) for draw in draws])

    def of(row: Row) -> Callable[[NDArray[np.bool_]], float]:
        def error(mine: NDArray[np.bool_]) -> float:
            places = np.flatnonzero(mine & (partner >= 0))
            pairs = row.values[places], row.values[partner[places]]
            known = np.isfinite(pairs[0]) & np.isfinite(pairs[1])
            apart = pairs[0][known] - pairs[1][known]
            return float(np.sqrt(np.mean(apart**2))) if apart.size else np.nan

        return error

    return {(row.name, row.label): of(row) for row in found}


def open_errors(store: Path | str) -> "xr.Dataset | None":
    """Return the errors that a store keeps; None if it keeps none."""
    target = Path(store) / ERRORS
    return read_dataset(target, SCHEMA) if target.exists() else None
