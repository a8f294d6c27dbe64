"""Write a study kind as typed functions and measures, in place of what the engine asks of it as text.

The author gives what is prepared once, which cases there are, what is computed of a block of them and the
measures that are taken of it; template, padding, statuses and errors follow.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wavequake.campaign.contract import (
    DONE,
    RAISED,
    ChunkResult,
    Drawn,
    Fixed,
    StudyKind,
    Template,
    unknown_arrays,
)
from wavequake.campaign.engine.chunk_size import stored_bytes
from wavequake.campaign.measures import Axis, Measure, evaluate, template_of
from wavequake.campaign.schema import Study, study_from_identity
from wavequake.campaign.stopwatch import Stopwatch
from wavequake.errors import UserError
from wavequake.prepared import one_thread, prepared

CaseTable = dict[str, NDArray[Any]]


@dataclass(frozen=True)
class Block:
    """What was computed of some cases: ``result`` is what the measures read.

    ``rows`` are their places among the cases that were asked for, by default all; ``messages`` say why a case
    failed, by its place in ``rows``; where all failed nothing is measured of the result.
    """

    result: Any
    rows: NDArray[np.int64] | None = None
    messages: Mapping[int, str] = field(default_factory=dict)


Compute = Callable[[Any, CaseTable, str, Stopwatch], Iterator[Block] | Block]


def one_by_one(
    cases: NDArray[np.int64], compute: Callable[[int], Mapping[str, ArrayLike]]
) -> Iterator[Block]:
    """Yield the numbers of cases that are computed one after the other; one that raises UserError has none.

    `compute` returns those of a case by name, for measures that are found under their names.
    """
    for row, case in enumerate(cases.tolist()):
        try:
            found = compute(case)
        except UserError as error:
            yield Block(None, np.array([row]), {0: str(error)})
            continue
        yield Block({name: np.asarray(values)[None] for name, values in found.items()}, np.array([row]))


def _study_itself(study: Any) -> Any:
    return study


def _nothing_wrong(study: Any) -> None:
    """Find nothing wrong with a study that can be prepared."""


def _no_axes(bench: Any) -> Mapping[str, Axis]:
    return {}


def _no_fixed(bench: Any) -> Mapping[str, Fixed]:
    return {}


def _no_words(bench: Any) -> Mapping[str, str]:
    return {}


def _no_amounts(bench: Any, cases: int) -> dict[str, tuple[float, str]]:
    return {}


def _no_bytes(bench: Any) -> int:
    return 0


def _no_lines(study: Any) -> Iterable[str]:
    return ()


def _no_pictures(bench: Any, dataset: Any) -> Iterable[Drawn]:
    return ()


@dataclass(frozen=True)
class _Parts:
    """The author's functions; all are of a module, so that they travel by reference."""

    name: str
    model: type[Study]
    prepare: Callable[[Any], Any]
    cases: Callable[[Any, NDArray[np.int64]], CaseTable]
    compute: Compute
    measures: Callable[[Any], Iterable[Measure]]
    axes: Callable[[Any], Mapping[str, Axis]]
    fixed: Callable[[Any], Mapping[str, Fixed]]
    describe: Callable[[Any], Mapping[str, str]]
    work: Callable[[Any, int], dict[str, tuple[float, str]]]
    notices: Callable[[Any], Iterable[str]]
    pictures: Callable[[Any, Any], Iterable[Drawn]]
    check: Callable[[Any], None]
    memory: Callable[[Any], int]


def study_kind(
    name: str,
    model: type[Study],
    *,
    prepare: Callable[[Any], Any] = _study_itself,
    cases: Callable[[Any, NDArray[np.int64]], CaseTable],
    compute: Compute,
    measures: Callable[[Any], Iterable[Measure]],
    axes: Callable[[Any], Mapping[str, Axis]] = _no_axes,
    fixed: Callable[[Any], Mapping[str, Fixed]] = _no_fixed,
    describe: Callable[[Any], Mapping[str, str]] = _no_words,
    work: Callable[[Any, int], dict[str, tuple[float, str]]] = _no_amounts,
    notices: Callable[[Any], Iterable[str]] = _no_lines,
    pictures: Callable[[Any, Any], Iterable[Drawn]] = _no_pictures,
    check: Callable[[Any], None] = _nothing_wrong,
    memory: Callable[[Any], int] = _no_bytes,
    compared: tuple[str, ...] = ("disturbance",),
) -> StudyKind:
    """Return a study kind that is made of typed functions.

    Parameters
    ----------
    name : str
        As study files say it: ``workflow = "..."``.
    model : type of Study
        Its study files.
    prepare : callable
        From a study to the bench: what all cases share, made once per process with one BLAS thread. It raises
        UserError for a study of which no case can succeed. By default the bench is the study.
    cases : callable
        From a study and case ids (n,) to their labels, arrays (n,) of str, int or float.
    compute : callable
        From the bench, the case table (the labels and ``case``, the ids), the device's name and a stopwatch
        to a block of results, or several in any order. A case's numbers depend on its id and labels alone.
    measures : callable
        From the bench to the measures of a study.
    axes, fixed : callable
        From the bench to the dimensions of measures, and to further arrays that do not depend on the case.
    describe, work, notices, pictures : callable
        Lines of the plan (bench), amounts of work by kind of a number of cases (bench, cases), what the user
        should read before a run (study), pictures of the report (bench, dataset).
    check : callable
        Raises UserError for a study of which no case can succeed, where preparing it does not: it is called
        before a store is made, not by workers.
    memory : callable
        From the bench to the bytes that each case takes while it is computed, beside what is stored.
    compared : tuple of str
        Labels of cases that reports tell apart.

    Raises
    ------
    UserError
        If the name is no text, the model no `Study`, or a part no function.
    """
    if not isinstance(name, str) or not name:
        raise UserError(f"The name of a study kind is a text, as 'pendulum', not {name!r}.")
    if not (isinstance(model, type) and issubclass(model, Study)):
        raise UserError(f"The model of the study kind {name!r} is {model!r}; it must be a subclass of Study.")
    parts = _Parts(
        name,
        model,
        prepare,
        cases,
        compute,
        measures,
        axes,
        fixed,
        describe,
        work,
        notices,
        pictures,
        check,
        memory,
    )
    for one in fields(parts)[2:]:
        if not callable(getattr(parts, one.name)):
            raise UserError(f"{one.name} of the study kind {name!r} must be a function.")
    return StudyKind(
        name,
        partial(_template, parts),
        partial(_case_table, parts),
        partial(_compute, parts),
        partial(_describe, parts),
        partial(_work, parts),
        check=partial(_check, parts),
        notices=partial(_notices, parts),
        model=model,
        compared=compared,
        pictures=partial(_pictures, parts),
    )


@contextmanager
def _explained(parts: _Parts, part: str) -> Iterator[None]:
    """Turn what the author's function raises into a sentence, where it concerns all cases."""
    try:
        yield
    except (UserError, MemoryError):
        raise
    except (Exception, SystemExit) as error:
        raise UserError(
            f"The study kind {parts.name!r} fails in {part}: {type(error).__name__}: {error}."
        ) from error


@prepared(maxsize=4)
def _bench(parts: _Parts, text: str) -> Any:
    return parts.prepare(study_from_identity(parts.model, text))


@prepared(maxsize=8)
def _template(parts: _Parts, text: str) -> Template:
    with _explained(parts, "prepare"):
        bench = _bench(parts, text)
    with _explained(parts, "measures, axes, fixed or memory"):
        found = template_of(_measures(parts, text), parts.axes(bench), parts.fixed(bench))
        more = parts.memory(bench)
        return replace(found, working_bytes=stored_bytes(found) + more) if more else found


@prepared(maxsize=8)
def _measures(parts: _Parts, text: str) -> tuple[Measure, ...]:
    return tuple(parts.measures(_bench(parts, text)))


def _case_table(parts: _Parts, text: str, first: int, last: int) -> CaseTable:
    with _explained(parts, "cases"):
        table = {
            name: np.asarray(values)
            for name, values in parts.cases(
                study_from_identity(parts.model, text), np.arange(first, last)
            ).items()
        }
    for name, values in table.items():
        if values.shape != (last - first,) or values.dtype.kind not in "OUfiub":
            raise UserError(
                f"The study kind {parts.name!r} labels {last - first} cases with {name!r} of the shape "
                f"{values.shape} ({values.dtype}); it must be one text or number for each."
            )
    return table


@one_thread()
def _compute(parts: _Parts, text: str, cases: NDArray[np.int64], device: str) -> ChunkResult:
    study, bench, clock = study_from_identity(parts.model, text), _bench(parts, text), Stopwatch()
    template, measures = _template(parts, text), _measures(parts, text)
    arrays: dict[str, NDArray[Any]] = {}
    status, messages = np.zeros(len(cases), np.int8), [""] * len(cases)
    try:
        blocks = parts.compute(bench, {"case": cases, **parts.cases(study, cases)}, device, clock)
    except SystemExit as error:  # of a script that became a plug-in
        raise RuntimeError(f"compute called sys.exit({error.code!r})") from error
    for block in [blocks] if isinstance(blocks, Block) else blocks:
        if not isinstance(block, Block):
            raise TypeError(f"compute of {parts.name} gave {type(block).__name__}, not Block(...)")
        rows = np.arange(len(cases)) if block.rows is None else np.asarray(block.rows)
        taken = {
            measure.name: evaluate(measure, block.result, len(rows), template.per_case[measure.name].shape)
            for measure in (measures if len(block.messages) < len(rows) else ())
        }
        if block.rows is None and not block.messages:  # all at once
            arrays = taken
        arrays = arrays or unknown_arrays(template.per_case, len(cases))
        for name, values in taken.items() if arrays is not taken else ():
            arrays[name][rows] = values
        status[rows] = DONE
        for place, message in block.messages.items():
            row = int(rows[place])
            status[row], messages[row] = RAISED, str(message)
            for values in arrays.values():
                values[row] = np.nan if values.dtype.kind == "f" else 0
    missing = np.flatnonzero(status == 0)
    if len(missing):
        raise ValueError(f"{parts.name} gave no numbers of case {cases[missing[0]]}")
    return ChunkResult(arrays, status, tuple(messages), clock.seconds)


def _describe(parts: _Parts, text: str) -> dict[str, str]:
    with _explained(parts, "describe"):
        words = parts.describe(_bench(parts, text))
        return {str(name): str(value) for name, value in words.items()}


def _work(parts: _Parts, text: str, cases: int) -> dict[str, tuple[float, str]]:
    with _explained(parts, "work"):
        return parts.work(_bench(parts, text), cases)


def _check(parts: _Parts, text: str) -> None:
    with _explained(parts, "check"):
        parts.check(study_from_identity(parts.model, text))
    _template(parts, text)
    _case_table(parts, text, 0, 1)


def _notices(parts: _Parts, text: str) -> Iterator[str]:
    with _explained(parts, "notices"):
        yield from map(str, parts.notices(study_from_identity(parts.model, text)))


def _pictures(parts: _Parts, text: str, dataset: Any) -> Iterator[Drawn]:
    with _explained(parts, "pictures"):
        for one in parts.pictures(_bench(parts, text), dataset):
            if not isinstance(one, Drawn):
                raise TypeError(f"{one!r} is no Drawn(title, caption, figure)")
            yield one
