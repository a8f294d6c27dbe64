"""Measures that others add to the kinds of studies there are: ``store.measures`` of a study names them.

Such a measure is taken of the numbers that the kind itself computes of some cases, by their names: arrays
(case, ...). It is stored, shown, judged, exported and compared as those are.
"""

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wavequake.campaign.contract import DONE, RAISED, ChunkResult, StudyKind, Template
from wavequake.campaign.measures import Axis, Measure, evaluate, template_of
from wavequake.campaign.schema import store_measures
from wavequake.errors import UserError
from wavequake.registry import entry_points, note_own

_GROUP = "wavequake.measures"
_registered: dict[str, Measure] = {}


def register(measure: Measure) -> None:
    """Let studies name a measure in ``store.measures``; a plug-in calls this where it is loaded.

    Raises
    ------
    UserError
        If it is no measure, or its name is taken by another.
    """
    if not isinstance(measure, Measure):
        raise UserError(f"{measure!r} is no measure; Measure(...) makes one.")
    if _registered.get(measure.name, measure) != measure:
        raise UserError(f"There is a measure {measure.name!r} already; choose another name.")
    _registered[measure.name] = measure
    note_own(measure.value)


def with_extra(kind: StudyKind) -> StudyKind:
    """Return a kind that also takes the measures that a study's ``store.measures`` names."""
    return replace(kind, template=partial(_template, kind), compute=partial(_compute, kind))


def _asked(study: str) -> tuple[Measure, ...]:
    return tuple(_found(name) for name in store_measures(study))


def _found(name: str) -> Measure:
    if name not in _registered:
        for point in entry_points(_GROUP):
            if point.name == name:
                register(point.load())
    if name not in _registered:
        known = ", ".join(_registered) or "none is registered"
        raise UserError(
            f"store.measures: there is no measure {name!r} ({known}); one of your own is loaded with "
            "--plugin FILE."
        )
    return _registered[name]


def _template(kind: StudyKind, study: str) -> Template:
    template = kind.template(study)
    asked = _asked(study)
    if not asked:
        return template
    taken = next((one.name for one in asked if one.name in template.per_case), None)
    if taken:
        raise UserError(f"store.measures: {kind.name} has a number {taken!r} already; choose another name.")
    sizes = {
        dim: Axis(size)
        for one in template.per_case.values()
        for dim, size in zip(one.dims, one.shape, strict=True)
    }
    return replace(template, per_case={**template.per_case, **template_of(asked, sizes).per_case})


def _compute(kind: StudyKind, study: str, cases: NDArray[np.int64], device: str) -> ChunkResult:
    result = kind.compute(study, cases, device)
    asked = _asked(study)
    if not asked:
        return result
    template = _template(kind, study)
    arrays: dict[str, NDArray[Any]] = dict(result.arrays)
    status, messages = result.status.copy(), list(result.messages)
    for measure in asked:
        shape = template.per_case[measure.name].shape
        try:
            arrays[measure.name] = evaluate(measure, result.arrays, len(cases), shape)
        except Exception as error:  # what others wrote fails in ways of its own
            if len(cases) > 1:
                raise  # the engine tries each case alone
            done = status == DONE
            status[done] = RAISED
            messages = [
                f"the measure {measure.name!r} failed: {type(error).__name__}: {error}" if was else before
                for was, before in zip(done, messages, strict=True)
            ]
            empty = np.nan if np.dtype(measure.dtype).kind == "f" else 0
            arrays[measure.name] = np.full((len(cases), *shape), empty, measure.dtype)
    return replace(result, arrays=arrays, status=status, messages=tuple(messages))
