"""Load study files: TOML in, one validated frozen record of the study's own kind out."""

import difflib
import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from wavequake.campaign.schema import Study, describe
from wavequake.errors import UserError
from wavequake.files import folder
from wavequake.user_files import read_text, read_toml
from wavequake.workflows.kinds import find_kind, kind_names

# Keys that name files.
_FILES = ("file", "mass", "dofs", "mesh", "polygons", "corners", "picture")


def bundled_studies() -> dict[str, Path]:
    """Return the study files that come with Wavequake, by name."""
    return {path.stem: path for path in sorted(folder("workflows").glob("*.toml"))}


def bundled_titles() -> dict[str, str]:
    """Return what each bundled study says of itself, by name; loads no study kind."""
    records = {
        name: tomllib.loads(path.read_text(encoding="utf-8")) for name, path in bundled_studies().items()
    }
    return {name: str(record["study"].get("title", "")) for name, record in records.items()}


def load_study(name: str | Path, overrides: Mapping[str, Any] | Iterable[str] = ()) -> Study:
    """Load a study by the name of a bundled one or by path, and apply ``key=value`` overrides.

    Parameters
    ----------
    name : str or Path
        ``tmt-segments`` or ``my/study.toml``.
    overrides : mapping or iterable of ``"section.key=value"``
        Values of text overrides are TOML values; bare words are strings. A disturbance is addressed by its
        name: ``disturbance.wind.mean_speed_m_s=8``. Files that overrides name are looked for in the current
        folder, then beside the study file.

    Raises
    ------
    UserError
        If the study is unknown, is no TOML, or does not fit the schema; names the file, the key and the
        nearest valid one.
    """
    if not isinstance(name, str | Path):
        raise UserError(f"A study is loaded by name or path, not by {type(name).__name__}.")
    path = _find(str(name))
    if path.suffix.lower() == ".zmx":
        raise UserError(
            f"{path} is a lens file, not a study: a study names it as `file` of its [system]; `wavequake "
            "info` and `wavequake sensitivity` take the lens file itself."
        )
    try:
        text = read_text(path)
    except UserError as error:
        raise UserError(f"The study file {error}") from None
    try:
        record = read_toml(text)
    except UserError as error:
        raise UserError(f"{path} is not a TOML file: {error}.") from None
    return study_of(record, path.name, path.parent, split_overrides(overrides))


def study_of(record: dict[str, Any], where: str, base: Path, pairs: Iterable[tuple[str, Any]]) -> Study:
    """Return the study of a record that stands at `where`, with ``section.key`` replaced by values.

    Files that it names are looked for in `base`; raises as :func:`load_study`.
    """
    model, pairs = _model(record, where), list(pairs)
    _replace_alternatives(record, pairs, model)
    for key, value in pairs:
        _override(record, key, _located(key, value, base), model)
    model.read_files(record, base)
    return _validated(model, record, where)


def study_with(study: Study, keys: Mapping[str, Any]) -> Study:
    """Return a copy of `study` with ``section.key`` values replaced; raises as :func:`load_study`.

    Files cannot be replaced: those of a loaded study have been read.
    """
    file = next((key for key in keys if key.rpartition(".")[2] in _FILES), None)
    if file is not None:
        raise UserError(
            f"The study {study.study.name} is loaded and has read its files, so {file!r} changes nothing in "
            "it; load it with this key (wavequake.load_study)."
        )
    record = study.model_dump(mode="json")
    _replace_alternatives(record, keys.items(), type(study))
    for key, value in keys.items():
        _override(record, key, value, type(study))
    return _validated(type(study), record, study.study.name)


def _located(key: str, value: Any, base: Path) -> Any:
    """Return the path of a file that an override names: in the current folder, or else beside the study."""
    if key.rpartition(".")[2] not in _FILES or not isinstance(value, str):
        return value
    here = Path.cwd() / value
    return value if (base / value).exists() and not here.exists() else str(here)


def _model(record: Mapping[str, Any], where: str) -> type[Study]:
    """Return the model of a record by the workflow that it names."""
    section = record.get("study")
    name = section.get("workflow") if isinstance(section, dict) else None
    if name is None:
        raise UserError(
            f"{where}: the key 'study.workflow' is missing; choose one of {', '.join(kind_names())}."
        )
    try:
        return find_kind(str(name)).model
    except UserError as error:
        raise UserError(f"{where}: study.workflow: {error}") from None


def _validated(model: type[Study], record: Mapping[str, Any], where: str) -> Study:
    try:
        return model.model_validate(record)
    except ValidationError as error:
        raise UserError(f"{where}: {describe(error, record, model)}") from None


def _find(name: str) -> Path:
    bundled = bundled_studies()
    if name in bundled:
        return bundled[name]
    path = Path(name)
    if path.is_file():
        return path
    near = difflib.get_close_matches(name, bundled, n=1)
    hint = f": did you mean {near[0]!r}?" if near else "."
    raise UserError(
        f"There is no study {name!r}{hint} Bundled studies are {', '.join(bundled)}; "
        "a study of your own is a path to a .toml file."
    )


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
        return key.strip(), tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError:
        return key.strip(), value


def _replace_alternatives(
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


def _override(record: dict[str, Any], key: str, value: Any, model: type[Study]) -> None:
    node: Any = record
    if key == "study.workflow" and value != record["study"]["workflow"]:
        raise UserError(
            f"study.workflow is {record['study']['workflow']!r} and decides which sections a study has; "
            f"for {value!r} write a study file of that workflow."
        )
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
        hint = f"did you mean {homes[0]}.{key}?" if homes else "write section.key=value."
        raise UserError(f"The key {key!r} has no section; {hint}")
    for depth, part in enumerate(parents):
        if isinstance(node, list):
            node = _entry(node, part, ".".join(parents[:depth]))
        else:
            node = node.setdefault(part, {})
        if not isinstance(node, dict | list):
            raise UserError(
                f"The key {key!r} leads nowhere: {'.'.join(parents[: depth + 1])} is a value, not a section."
            )
    if isinstance(node, list):
        raise UserError(f"The key {key!r} names a whole entry; write {key}.key=value.")
    node[last] = value.item() if isinstance(value, np.generic) else value  # np.int64 is a number, too


def _entry(entries: list[Any], name: str, where: str) -> Any:
    for index, entry in enumerate(entries):
        if isinstance(entry, dict) and (entry.get("name") == name or str(index) == name):
            return entry
    names = [str(entry.get("name")) for entry in entries if isinstance(entry, dict)]
    near = difflib.get_close_matches(name, names, n=1)
    hint = f": did you mean {near[0]!r}?" if near else "."
    raise UserError(f"There is no {where} called {name!r}{hint} There are {', '.join(names)}.")
