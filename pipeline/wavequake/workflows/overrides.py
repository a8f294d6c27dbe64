"""Overrides of a study's keys: ``section.key = value`` in a record, which is then validated."""

import difflib
import sys
from collections.abc import Iterable, Mapping
from typing import Any

from pydantic import ValidationError

from wavequake.campaign.schema import Study, describe
from wavequake.errors import UserError
from wavequake.user_files import read_toml
from wavequake.words import shortened

# Sections that say how much of a study is computed and kept, and the study's own name and title.
_UNTITLED = ("campaign", "store", "study")
_MOST_TITLED, _MOST_VALUE = 4, 40
_MOST_DOTS = 40  # in the key of an override
# Keys that name files.
FILES = ("file", "glass_file", "mass", "dofs", "mesh", "polygons", "corners", "picture")


def overridden(model: type[Study], record: dict[str, Any], keys: Mapping[str, Any], where: str) -> Study:
    """Return the study of a record with ``section.key`` replaced by values, which changes the record.

    Raises
    ------
    UserError
        If a key is unknown or the study does not fit its model; names `where`, the key and the nearest one.
    """
    replace_alternatives(record, keys.items(), model)
    for key, value in keys.items():
        override(record, key, value, model)
    follow_in_title(record, keys)
    return validated(model, record, where, keys)


def follow_in_title(record: dict[str, Any], keys: Mapping[str, Any]) -> None:
    """Have the title of a study say which keys were replaced, but for how much is computed and kept.

    The title is not part of the identity of a study.
    """
    section = record.get("study")
    if "study.title" in keys:  # it says what the user wants it to say
        return
    shown = {key: value for key, value in keys.items() if key.partition(".")[0] not in _UNTITLED}
    if not (
        isinstance(section, dict) and isinstance(section.get("title"), str) and section["title"] and shown
    ):
        return
    words = [f"{key} = {shortened(_shown(value), _MOST_VALUE)}" for key, value in shown.items()]
    more = f" and {len(words) - _MOST_TITLED} more" if len(words) > _MOST_TITLED else ""
    section["title"] += f" [{', '.join(words[:_MOST_TITLED])}{more}]"


def _shown(value: Any) -> str:
    """Return a value as a title has it; of a long list the first ones, whole, and how many more there are."""
    if not isinstance(value, list | tuple) or len(str(value)) <= _MOST_VALUE:
        return str(value)
    few = 1
    while few < len(value) and len(str(value[: few + 1])) + 9 <= _MOST_VALUE:
        few += 1
    return f"{str(value[:few])[1:-1].rstrip(',')} and {len(value) - few} more"


def validated(model: type[Study], record: Mapping[str, Any], where: str, keys: Iterable[str] = ()) -> Study:
    """Return the study of a record; UserError in one sentence if it does not fit the model.

    The sentence says so where one of `keys`, which override the file, is what does not fit.
    """
    try:
        return model.model_validate(record)
    except ValidationError as error:
        place = error.errors(include_url=False)[0]["loc"]
        own = next((key for key in keys if place and _is_at(key.split("."), place)), None)
        found = where if own is None or own in where else f"{where}, overridden by {own}=..."
        raise UserError(f"{found}: {describe(error, record, model)}") from None


def _is_at(key: list[str], place: tuple[str | int, ...]) -> bool:
    """Return whether a key leads to a place of a record, where entries of lists have numbers and kinds."""
    names = [part for part in place if isinstance(part, str)]
    return key[0] == names[0] and key[-1] in names


def split_overrides(overrides: Mapping[str, Any] | Iterable[str]) -> list[tuple[str, Any]]:
    """Return keys and values of overrides; UserError for text that is none."""
    if isinstance(overrides, str):
        return [_split(overrides)]
    if not isinstance(overrides, Iterable):
        raise UserError(f"The overrides are {overrides!r}; give a mapping or a list of 'section.key=value'.")
    pairs = list(overrides.items() if isinstance(overrides, Mapping) else map(_split, overrides))
    for key, _ in pairs:
        if not isinstance(key, str):
            raise UserError(f"The key {key!r} is no text; write section.key.")
    return pairs


def _split(text: str) -> tuple[str, Any]:
    key, separator, value = str(text).partition("=")
    if not separator or not key:
        raise UserError(
            f"{text!r} is not an override; write section.key=value, for example campaign.cases=40."
        )
    try:
        return key.strip(), read_toml(f"value = {value}")["value"]
    except UserError:
        return key.strip(), value


def replace_alternatives(
    record: dict[str, Any], pairs: Iterable[tuple[str, Any]], model: type[Study]
) -> None:
    """Remove from a record what the keys of overrides stand in for, such as another kind of pupil."""
    for key, value in pairs:
        home, _, last = key.partition(".")
        field, section = model.model_fields.get(home), record.get(home)
        for group in getattr(field and field.annotation, "alternatives", ()):
            if last in group and value is not None and isinstance(section, dict):
                for other in group:
                    section.pop(other, None)


def override(record: dict[str, Any], key: str, value: Any, model: type[Study]) -> None:
    """Replace one value of a record; UserError for a key that leads nowhere."""
    node: Any = record
    if key == "study.workflow" and value != record["study"]["workflow"]:
        raise UserError(
            f"study.workflow is {record['study']['workflow']!r} and decides which sections a study has; "
            f"for {value!r} write a study file of that workflow."
        )
    if key.count(".") > _MOST_DOTS:
        raise UserError(f"The key {key[:40]}... has {key.count('.') + 1} parts; write section.key=value.")
    *parents, last = key.split(".")
    homes = [
        name
        for name, field in model.model_fields.items()
        if last in getattr(field.annotation, "model_fields", ())
    ]
    if len(parents) == 1 and parents[0] not in model.model_fields:
        near = difflib.get_close_matches(parents[0], model.model_fields, n=1)
        if homes and not near:
            raise UserError(f"The key {key!r} is unknown; did you mean {homes[0]}.{last}?")
    if not parents:
        places = {
            one: name
            for name, field in reversed(model.model_fields.items())
            for one in getattr(field.annotation, "model_fields", ())
        }
        near = difflib.get_close_matches(key, places, n=1, cutoff=0.75)
        hint = f"did you mean {places[near[0]]}.{near[0]}?" if near else "write section.key=value."
        raise UserError(f"The key {key!r} has no section; {hint}")
    for depth, part in enumerate(parents):
        if isinstance(node, list):
            node = _entry(node, part, ".".join(parents[:depth]))
        else:
            if node.get(part) is None:  # of a loaded study: the section that a file leaves out
                node[part] = {}
            node = node[part]
        if not isinstance(node, dict | list):
            raise UserError(
                f"The key {key!r} leads nowhere: {'.'.join(parents[: depth + 1])} is a value, not a section."
            )
    if isinstance(node, list):
        raise UserError(f"The key {key!r} names a whole entry; write {key}.key=value.")
    numpy = sys.modules.get("numpy")  # who has not loaded it gives no np.int64, which is a number, too
    node[last] = value.item() if numpy is not None and isinstance(value, numpy.generic) else value


def _entry(entries: list[Any], name: str, where: str) -> Any:
    for index, entry in enumerate(entries):
        if isinstance(entry, dict) and (entry.get("name") == name or str(index) == name):
            return entry
    names = [str(entry.get("name")) for entry in entries if isinstance(entry, dict)]
    near = difflib.get_close_matches(name, names, n=1)
    hint = f": did you mean {near[0]!r}?" if near else "."
    raise UserError(f"There is no {where} called {name!r}{hint} There are {', '.join(names)}.")
