"""What all study files share: strict sections, identity, and errors in one sentence.

The identity is everything that determines one case's numbers. How many cases there are, where they are stored
and what runs them is not part of it. Files that a study names (polygons, spectra, meshes) are read when the
study is loaded and become part of the effective study, so a store never depends on a file that may change.
"""

import difflib
import hashlib
import json
import re
from base64 import b64encode
from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, ClassVar, Literal, Self, TypeVar, Union, get_args, get_origin

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from wavequake.campaign.store.objects import location
from wavequake.errors import UserError
from wavequake.user_files import read_bytes, read_text
from wavequake.words import counted

Location = Sequence[str | int]


class Section(BaseModel):
    """A table of a study file: frozen, strict, unknown keys are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False, defer_build=True)


def require_own_names(kind: str, blocks: Sequence[Any], taken: Sequence[str] = ()) -> None:
    """Raise ValueError if two of a kind have one name, or one has a name that is taken."""
    names = [*taken, *(one.name for one in blocks)]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise ValueError(f"two {kind}s are called {twice!r}; each needs a name of its own")


def each_once(value: tuple[Any, ...]) -> tuple[Any, ...]:
    """Return the values of a list, as a pydantic validator; raise ValueError if one is listed twice."""
    twice = next((one for one in value if value.count(one) > 1), None)
    if twice is not None:
        raise ValueError(f"{twice!r} is listed twice")
    return value


class StudySection(Section):
    """What the study is called and which workflow runs it."""

    name: str = Field(
        min_length=1,
        pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$",
        description="letters, digits, dots and hyphens; stores are named after it",
    )
    workflow: str = Field(description="which kind of study it is, one of those below")
    title: str = Field(default="", description="one line for lists and reports")
    seed: int = Field(
        default=20180701, ge=0, lt=2**63, description="all random numbers follow from it and a case's number"
    )


class CampaignSection(Section):
    """How much of the study to run, and on which device; not part of its identity."""

    cases: int = Field(
        default=1000, ge=1, le=100_000_000, description="how many; a run with more adds what is missing"
    )
    device: str = Field(
        default="auto",
        min_length=1,
        description="auto (a GPU, else a CPU), gpu, cpu, numpy, or part of a name in `wavequake devices`",
    )
    until: str | None = Field(
        default=None,
        description="goal of statistics at which to stop before `cases`, as wfe_rms.p95 ci<=2% or "
        "peak[controller=rigid].p5 ci<=1%",
    )
    timeout_s: float | None = Field(default=None, gt=0.0, description="longest time of a chunk on a worker")

    def identity_record(self) -> dict[str, object]:
        """Return the keys of this section that determine a case's numbers: none."""
        return {}


class StoreSection(Section):
    """Where the results go, which is no part of the identity, and what of them is kept, which is."""

    path: str | None = Field(
        default=None, description="folder of the store; by default runs/NAME- and the study's identity"
    )
    chunk_cases: int | None = Field(
        default=None,
        ge=1,
        le=100_000,
        description="K: cases per task and per shard; by default an eighth of the cases, from 20 to 200, "
        "or a fortieth, up to 400, within 256 MB",
    )
    every: int = Field(default=1, ge=1, description="keep the numbers of every n-th instant only")
    reduce: Literal["none", "summary"] = Field(
        default="none",
        description="summary: of each series over the instants of a case, keep mean, rms, min, max, 95 % "
        "quantile and last value, and of coefficients their rms",
    )
    images: Literal["double", "single", "none"] = Field(
        default="double",
        description="precision of stored images; none: keep only the numbers that are made of them, as radii "
        "of encircled energy",
    )

    measures: tuple[str, ...] = Field(
        default=(),
        strict=False,
        description="further measures to keep, by name: those that a plug-in or an installed package adds "
        "(docs/extending.md)",
    )

    def identity_record(self) -> dict[str, object]:
        """Return the keys of this section that say what is kept, where that is not everything."""
        return self.model_dump(mode="json", exclude={"path", "chunk_cases"}, exclude_defaults=True)


class Study(Section):
    """A validated study file: what every workflow's own model of it has."""

    study: StudySection
    campaign: CampaignSection = CampaignSection()
    store: StoreSection = StoreSection()

    asked: ClassVar[frozenset[str]] = frozenset()  # sections that only ask something of a study's cases

    def __repr__(self) -> str:
        cases = counted(self.cases, "case")
        return f"<{type(self).__name__} {self.study.name}: {cases} of {self.study.workflow}>"

    def __str__(self) -> str:
        return repr(self)

    @property
    def cases(self) -> int:
        """Number of cases to run."""
        return self.campaign.cases

    @property
    def fewest_instants(self) -> int:
        """Number of instants of the shortest case; 0 if nothing is stored over time."""
        return 0

    @property
    def stores_images(self) -> bool:
        """Whether images are computed of a case."""
        return False

    @model_validator(mode="after")
    def _what_is_kept_is_there(self) -> Self:
        store, fewest = self.store, self.fewest_instants
        if not fewest and (store.every > 1 or store.reduce != "none"):
            raise ValueError(
                f"{self.study.workflow} stores nothing over time; leave store.every and store.reduce out"
            )
        if store.reduce == "summary" and store.every > 1:
            raise ValueError("store.reduce = 'summary' keeps nothing over time; leave store.every out")
        if store.every > max(fewest, 1):
            raise ValueError(f"store.every is {store.every}, but there are cases of {fewest} instants")
        if store.images != "double" and not self.stores_images:
            raise ValueError("there are no images to keep; leave store.images out")
        return self

    @classmethod
    def read_files(cls, record: dict[str, Any], base: Path) -> None:
        """Replace the files that a record names, relative to `base`, by their contents."""

    def identity_text(self) -> str:
        """Return the canonical JSON text of all that determines one case's numbers (and of what is kept)."""
        record = self.model_dump(mode="json", exclude={"campaign", "store", *self.asked})
        record["study"].pop("title")
        record["store"] = self.store.identity_record()
        if campaign := self.campaign.identity_record():
            record["campaign"] = campaign
        return json.dumps(record, sort_keys=True, separators=(",", ":"))

    def identity(self) -> str:
        """Return the SHA-256 of :meth:`identity_text` in hexadecimal."""
        return hashlib.sha256(self.identity_text().encode()).hexdigest()

    def default_store(self) -> Path:
        """Return the folder that results go to when the study names none: another study never lands in it."""
        return Path("runs") / f"{self.study.name}-{self.identity()[:8]}"

    def folder(self, store: object = None) -> Path:
        """Return the folder of results: the one asked for, or the study's own, or the default one.

        Raises
        ------
        UserError
            If what was asked for is no path.
        """
        chosen = store if store not in (None, "") else self.store.path or self.default_store()
        if not isinstance(chosen, str | Path):
            raise UserError(f"The store is {chosen!r}; it must be the path of a folder, as text.")
        return location(chosen)


Kind = TypeVar("Kind", bound=Study)


@lru_cache(maxsize=16)
def study_from_identity(model: type[Kind], text: str) -> Kind:
    """Rebuild a study from its identity text, as workers do."""
    return model.model_validate_json(text, strict=False)


def store_measures(text: str) -> tuple[str, ...]:
    """Return which further measures the study with an identity text keeps."""
    return tuple(json.loads(text).get("store", {}).get("measures", ()))


def text_of(path: Path, key: str) -> str:
    """Return the text of a file that the study names under `key`; UserError if it cannot be read."""
    try:
        return read_text(path)
    except UserError as error:
        raise UserError(f"{key}: the file {error}") from None


def base64_of(path: Path, key: str) -> str:
    """Return a file that the study names under `key` in base64; UserError if it cannot be read."""
    try:
        return b64encode(read_bytes(path)).decode()
    except UserError as error:
        raise UserError(f"{key}: the file {error}") from None


# What a study file calls the types of Python.
_WORDS_OF_FILES = {
    "valid tuple": "list",
    "valid list": "list",
    "valid dictionary": "table",
    "Tuple should": "list should",
}


def describe(error: ValidationError, record: Mapping[str, Any], model: type[BaseModel]) -> str:
    """Turn the first error of a validation into one sentence: where, what, what would be right."""
    found = error.errors(include_url=False)
    places = [one["loc"] for one in found]
    # A list with a bad entry is reported once more itself, as if it lacked that entry.
    errors = [one for one in found if not any(p != one["loc"] == p[: len(one["loc"])] for p in places)]
    first = errors[0]
    *_, (holder, location) = _descent(model, first["loc"])
    where = ".".join(_entry_name(record, location, depth) for depth in range(len(location))) or "the study"
    more = f" ({len(errors) - 1} more after this one)" if len(errors) > 1 else ""
    if first["type"] == "extra_forbidden":
        valid = list(holder.model_fields)
        near = difflib.get_close_matches(str(location[-1]), valid, n=1, cutoff=0.5)
        hint = f"; the nearest valid key is {near[0]!r}" if near else f"; valid keys are {', '.join(valid)}"
        return f"the key {where!r} is unknown{hint}{more}."
    if first["type"] == "missing":
        return f"the key {where!r} is missing{more}."
    if first["type"] in ("union_tag_invalid", "union_tag_not_found"):
        key = first["ctx"]["discriminator"].strip("'")
        choice = first["ctx"].get("expected_tags") or ", ".join(_tags(holder, str(first["loc"][0])))
        given = (
            f"there is no {key} {first['ctx']['tag']!r}" if "tag" in first["ctx"] else "the key is missing"
        )
        return f"{where}.{key}: {given}; choose one of {choice.replace(chr(39), '')}{more}."
    if first["type"] == "too_short":
        limit = first["ctx"]
        return (
            f"{where}: it needs at least {limit['min_length']} entries, not {limit['actual_length']}{more}."
        )
    if first["type"] == "string_pattern_mismatch":
        return (
            f"{where}: {first['input']!r} must begin with a letter or a digit and go on with letters, digits,"
            f" '.', '_' and '-'{more}."
        )
    message = first["msg"].removeprefix("Value error, ")
    for theirs, ours in _WORDS_OF_FILES.items():
        message = message.replace(theirs, ours)
    message = re.sub(r" or instance of \w+", "", message)
    if first["type"].startswith(("greater_than", "less_than")):  # bounds with all their zeros
        message = re.sub(r"\d[\d.]{12,}$", lambda bound: f"{float(bound[0]):g}", message)
    given = first.get("input")
    shown = (
        ""
        if isinstance(given, dict | list | tuple) or first["type"] == "value_error"
        else f" (it is {given!r})"
    )
    return f"{where}: {message[0].lower()}{message[1:].rstrip('.')}{shown}{more}."


def _descent(model: type[BaseModel], location: Location) -> Iterator[tuple[type[BaseModel], list[str | int]]]:
    """Yield the model that holds each part of an error's location, and the location so far.

    Pydantic puts the tag of a discriminated union into the location, though no file has such a key.
    """
    annotation: Any = model
    holder = model
    path: list[str | int] = []
    yield holder, list(path)
    for part in location:
        tagged = {tag: member for member in _models(annotation) for tag in _tags_of(member)}
        if part in tagged and part not in holder.model_fields:
            annotation = holder = tagged[str(part)]
            continue
        path.append(part)
        if isinstance(part, str):
            found = [m for m in _models(annotation) if part in m.model_fields]
            holder = (found or _models(annotation) or [holder])[0]
            annotation = holder.model_fields[part].annotation if part in holder.model_fields else None
        yield holder, list(path)


def _models(annotation: Any) -> list[type[BaseModel]]:
    """Return the models that an annotation speaks of: itself, or inside Annotated, unions and tuples."""
    for choice in getattr(annotation, "__metadata__", ()):
        if hasattr(choice, "models"):  # of a registry
            return list(choice.models())
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    if get_origin(annotation) in (Annotated, Union, UnionType, tuple):
        return [model for part in get_args(annotation) for model in _models(part)]
    return []


def _tags_of(model: type[BaseModel]) -> list[str]:
    return [
        field.default
        for name, field in model.model_fields.items()
        if name in ("model", "kind") and isinstance(field.default, str)
    ]


def _tags(model: type[BaseModel], key: str) -> list[str]:
    field = model.model_fields.get(key)
    return [tag for member in _models(field.annotation if field else None) for tag in _tags_of(member)]


def _entry_name(record: Mapping[str, Any], location: Location, depth: int) -> str:
    part = location[depth]
    if not isinstance(part, int):
        return str(part)
    node: Any = record
    for step in location[: depth + 1]:
        try:
            node = node[step]
        except (KeyError, IndexError, TypeError):
            return str(part)
    return str(node.get("name", part)) if isinstance(node, dict) else str(part)
