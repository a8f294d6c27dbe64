"""The study kind ``sweep``: any study over lists of values of its keys.

A study file with a table ``[sweep]`` is one. Its cases are those of the study at its first point (the first
values of all keys), then those at the next one, the last key varying fastest; the values label the cases.
"""

import json
from collections import Counter
from collections.abc import Iterator, Mapping
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from wavequake.campaign.contract import ChunkResult, StudyKind, Template
from wavequake.campaign.schema import CampaignSection, Section, StoreSection, Study, study_from_identity
from wavequake.errors import UserError
from wavequake.prepared import prepared
from wavequake.words import counted
from wavequake.workflows.kinds import find_kind
from wavequake.workflows.overrides import FILES, overridden, validated

NAME = "sweep"
_MOST_CASES = 100_000_000
_MOST_POINTS = 100_000
# Keys that do not belong to a case's numbers.
_ELSEWHERE = ("campaign", "store", "study", "sweep", "allow", "budget")
Value = bool | int | float | str | tuple[int | float, ...]


class SweptKey(Section):
    """A key of the study and its values."""

    key: str
    values: tuple[Value, ...] = Field(strict=False)


class SweepStudy(Study):
    """A study at every combination of some values of its keys.

    ``base`` is the study's identity record at no point in particular; ``each`` its number of cases.
    """

    sweep: tuple[SweptKey, ...] = Field(strict=False)
    base: dict[str, Any]
    each: int

    @property
    def cases(self) -> int:
        """Number of cases of all points."""
        return self.each * len(points_of(self))

    @property
    def fewest_instants(self) -> int:
        """Number of instants of the shortest case of the study."""
        return self.one.fewest_instants

    @property
    def stores_images(self) -> bool:
        """Whether images are computed of a case."""
        return self.one.stores_images

    @property
    def one(self) -> Study:
        """The study at its first point."""
        return point_study(self.base, points_of(self)[0])

    @model_validator(mode="after")
    def _is_not_endless(self) -> "SweepStudy":
        points = int(np.prod([len(one.values) for one in self.sweep], dtype=object))
        if points > _MOST_POINTS or points * self.each > _MOST_CASES:
            raise ValueError(
                f"{points} points of {self.each} cases each are more than {_MOST_POINTS} points or "
                f"{_MOST_CASES} cases; sweep fewer values"
            )
        return self


def swept_study(study: Study, sweep: Mapping[str, Any]) -> SweepStudy:
    """Return a study over values of its keys, each point of which is a study of its kind.

    Raises
    ------
    UserError
        If a key is unknown, names a file or belongs to no case, its values are no list of different numbers
        or texts, a point is no valid study, or `campaign.until` is set; names the key and the value.
    """
    keys = [_swept(str(key), values) for key, values in sweep.items()]
    if not keys:
        raise UserError(f"{study.study.name}: sweep is empty; give a key and its values.")
    if study.campaign.until is not None:  # points come one after the other: the first would decide
        raise UserError(
            f"{study.study.name}: campaign.until judges cases of one point alone; leave it out, or leave out "
            "sweep."
        )
    base = json.loads(study.identity_text())
    base["store"] = {}  # what is kept is the sweep's own
    campaign, store = (
        one.model_dump(include=set(model.model_fields), exclude_none=True)
        for one, model in ((study.campaign, CampaignSection), (study.store, StoreSection))
    )
    record = {
        "study": study.study.model_dump() | {"workflow": NAME},
        "campaign": campaign | {"cases": study.cases},
        "store": store,
        "sweep": keys,
        "base": base,
        "each": study.cases,
    }
    points = [dict(zip(sweep, values, strict=True)) for values in product(*(one["values"] for one in keys))]
    for values in points[:1] if len(points) > _MOST_POINTS else points:
        point = point_study(base, values)
        if (cases := _cases_of(point, study)) != study.cases:
            raise UserError(
                f"{study.study.name}: sweep: at {_words(values)} there would be "
                f"{counted(cases, 'case')} instead of {study.cases}; sweep over what leaves their number."
            )
    found = validated(SweepStudy, record, study.study.name)
    assert isinstance(found, SweepStudy)
    return found


def _swept(key: str, values: Any) -> dict[str, Any]:
    where = f"sweep.{key}"
    if key.partition(".")[0] in _ELSEWHERE and key != "study.seed":
        raise UserError(f"{where}: the key says nothing of a case's numbers; sweep a key of the study.")
    if key.rpartition(".")[2] in FILES:
        raise UserError(f"{where}: files are read when a study is loaded; run a study for each of them.")
    if not isinstance(values, list | tuple) or not values:
        raise UserError(f"{where}: it is {values!r}; give a list of values.")
    for one in values:
        several = isinstance(one, list | tuple) and one and all(isinstance(each, int | float) for each in one)
        if not (several or isinstance(one, bool | int | float | str)):
            raise UserError(f"{where}: {one!r} is neither a number nor a text, nor a list of numbers.")
    values = [tuple(one) if isinstance(one, list) else one for one in values]
    if twice := [one for one, count in Counter(values).items() if count > 1]:
        raise UserError(f"{where}: {twice[0]!r} is listed twice.")
    if (
        len({str if isinstance(one, str) else tuple if isinstance(one, tuple) else float for one in values})
        > 1
    ):
        raise UserError(f"{where}: the values are partly numbers and partly texts or lists.")
    return {"key": key, "values": list(values)}


def _cases_of(point: Study, study: Study) -> int:
    campaign = point.campaign.model_copy(update={"cases": study.campaign.cases})
    return point.model_copy(update={"campaign": campaign}).cases


def points_of(study: SweepStudy) -> list[dict[str, Value]]:
    """Return the keys and values of every point, the last key varying fastest."""
    names = [one.key for one in study.sweep]
    return [dict(zip(names, values, strict=True)) for values in product(*(one.values for one in study.sweep))]


def base_study(study: SweepStudy) -> Study:
    """Return the study that is swept."""
    record = json.loads(json.dumps(study.base))
    record["study"]["title"] = study.study.title
    campaign = study.campaign.model_dump(exclude_none=True) | {"cases": study.each}
    record["campaign"] = record.get("campaign", {}) | campaign
    record["store"] = study.store.model_dump(mode="json")
    return overridden(find_kind(record["study"]["workflow"]).model, record, {}, study.study.name)


def point_study(base: Mapping[str, Any], values: Mapping[str, Value]) -> Study:
    """Return the study of an identity record with some keys replaced; raises UserError that names them."""
    model = find_kind(base["study"]["workflow"]).model
    return overridden(model, json.loads(json.dumps(base)), values, f"sweep, {_words(values)}")


def label_names(study: SweepStudy) -> tuple[str, ...]:
    """Return how the swept keys label cases: by their last part, or by all of them where that is taken."""
    return _labels(study.identity_text())


@prepared(maxsize=8)
def _labels(study_text: str) -> tuple[str, ...]:
    kind, texts, study = _texts(study_text)
    stored = kind.template(texts[0])
    dims = {dim for one in stored.per_case.values() for dim in one.dims}
    taken = {*study.base, *stored.per_case, *stored.fixed, *dims, *kind.case_table(texts[0], 0, 1)}
    taken |= {"case", "model", "variant", "method", "disturbance", "realization", "seed"}
    last = [one.key.rpartition(".")[2] for one in study.sweep]
    return tuple(
        name if last.count(name) == 1 and name not in taken else one.key.replace(".", "_")
        for one, name in zip(study.sweep, last, strict=True)
    )


@prepared(maxsize=8)
def _texts(study_text: str) -> tuple[StudyKind, tuple[str, ...], SweepStudy]:
    study = study_from_identity(SweepStudy, study_text)
    kind = find_kind(study.base["study"]["workflow"])
    return kind, tuple(point_study(study.base, one).identity_text() for one in points_of(study)), study


def template(study_text: str) -> Template:
    """Return what a store holds: what one of the first point does, without what the last one's has not.

    :func:`check` has compared those of all points; workers, which ask for it, too, need not.
    """
    kind, texts, study = _texts(study_text)
    first, last = kind.template(texts[0]), kind.template(texts[-1])
    _require_alike(first, last, *(_words(points_of(study)[place]) for place in (0, -1)))
    same = {name: one for name, one in first.fixed.items() if _has(last, name, one[1])}
    return Template(first.per_case, same, max(first.working_bytes, last.working_bytes))


def _require_alike(first: Template, other: Template, here: str, there: str) -> None:
    """Raise UserError if the numbers of a point have another shape than those of the first one."""
    for name in first.per_case.keys() | other.per_case.keys():
        shapes = [one.per_case[name].shape if name in one.per_case else None for one in (first, other)]
        if shapes[0] != shapes[1]:
            raise UserError(
                f"The numbers {name!r} have another shape at {there} than at {here}: these values need "
                "studies of their own."
            )


def _has(template: Template, name: str, values: Any) -> bool:
    return name in template.fixed and np.array_equal(values, template.fixed[name][1])


def case_table(study_text: str, first: int, last: int) -> dict[str, NDArray[Any]]:
    """Return the labels of cases first <= id < last: those of the study, and the swept values."""
    kind, texts, study = _texts(study_text)
    points, found = points_of(study), []
    for point, begin, end in _parts(study.each, first, last):
        table = dict(kind.case_table(texts[point], begin, end))
        for name, value in zip(label_names(study), points[point].values(), strict=True):
            label = _label(value)
            table[name] = np.full(end - begin, label, dtype=object if isinstance(label, str) else np.float64)
        found.append(table)
    return {name: np.concatenate([one[name] for one in found]) for name in found[0]}


def _label(value: Value) -> str | float:
    """Return what labels cases: a list of numbers is a text."""
    return ", ".join(map(_shortest, value)) if isinstance(value, tuple) else value


def _shortest(one: float) -> str:
    """Return the shortest text that is this number and no other."""
    text = format(one, "g")
    return text if float(text) == one else repr(one)


def _parts(each: int, first: int, last: int) -> Iterator[tuple[int, int, int]]:
    """Yield every point that cases belong to, and the first and last of its own cases; of no cases one."""
    if first == last:
        yield 0, 0, 0
    for point in range(first // each, -(-last // each) if last > first else 0):
        yield point, max(first - point * each, 0), min(last - point * each, each)


def compute(study_text: str, cases: NDArray[np.int64], device: str) -> ChunkResult:
    """Compute cases, those of each point by the study's own kind."""
    kind, texts, study = _texts(study_text)
    arrays: dict[str, NDArray[Any]] = {}
    status, messages = np.zeros(len(cases), np.int8), [""] * len(cases)
    seconds: dict[str, float] = {}
    for point in np.unique(cases // study.each):
        rows = np.flatnonzero(cases // study.each == point)
        result = kind.compute(texts[point], cases[rows] - point * study.each, device)
        for name, values in result.arrays.items():
            arrays.setdefault(name, np.zeros((len(cases), *values.shape[1:]), values.dtype))[rows] = values
        status[rows] = result.status
        for row, message in zip(rows, result.messages, strict=True):
            messages[row] = message
        for name, value in result.timings.items():
            seconds[name] = seconds.get(name, 0.0) + value
    return ChunkResult(arrays, status, tuple(messages), seconds)


def describe(study_text: str) -> dict[str, str]:
    """Return what is swept, and what the first point's study says of itself."""
    kind, texts, study = _texts(study_text)
    values = {f"sweep {one.key}": ", ".join(map(str, one.values)) for one in study.sweep}
    return {
        "points": f"{len(texts)} of {counted(study.each, 'case')} each",
        **values,
        **kind.describe(texts[0]),
    }


def work(study_text: str, cases: int) -> dict[str, tuple[float, str]]:
    """Return the amounts of work as if all points were the first one."""
    kind, texts, _ = _texts(study_text)
    return kind.work(texts[0], cases)


def check(study_text: str) -> None:
    """Raise UserError if the study cannot work at a point, or needs another store there; says at which."""
    kind, texts, study = _texts(study_text)
    points, first = points_of(study), None
    changes: dict[str, str] = {}  # the first point at which what is of no case differs
    for text, values in zip(texts, points, strict=True):
        try:
            kind.check(text)
        except UserError as error:
            raise UserError(f"At {_words(values)}: {error}") from None
        found = kind.template(text)  # which is quick now
        first = first or found
        _require_alike(first, found, _words(points[0]), _words(values))
        for name, (_, one, _) in first.fixed.items():
            if not _has(found, name, one):
                changes.setdefault(name, _words(values))
    if hidden := [name for name in template(study_text).fixed if name in changes]:
        raise UserError(
            f"{hidden[0]!r} is the same at {_words(points[0])} and at {_words(points[-1])}, but not at "
            f"{changes[hidden[0]]}, and a store keeps one of them: give the values in another order."
        )


def notices(study_text: str) -> Iterator[str]:
    """Yield what every point's study says, once."""
    kind, texts, _ = _texts(study_text)
    said: dict[str, None] = {}
    for text in texts:
        said |= dict.fromkeys(kind.notices(text))
    return iter(said)


def compared_of(study_text: str) -> tuple[str, ...]:
    """Return the labels that reports tell apart: those of the study's kind, and the swept ones."""
    kind, _, study = _texts(study_text)
    return (*kind.compared, *label_names(study))


def _words(values: Mapping[str, Value]) -> str:
    return ", ".join(f"{key} = {value}" for key, value in values.items())


KIND = StudyKind(
    NAME,
    template,
    case_table,
    compute,
    describe,
    work,
    check,
    notices,
    model=SweepStudy,
    compared_of=compared_of,
)
