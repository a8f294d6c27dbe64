"""Load study files: TOML in, one validated frozen record of the study's own kind out."""

import difflib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from wavequake.bundled import bundled_studies as bundled_studies
from wavequake.campaign.schema import Study
from wavequake.errors import UserError
from wavequake.optics.lens_archive import LENS_FILES
from wavequake.user_files import read_text, read_toml
from wavequake.workflows.kinds import find_kind, kind_names
from wavequake.workflows.overrides import (
    FILES,
    follow_in_title,
    overridden,
    override,
    replace_alternatives,
    split_overrides,
    validated,
)
from wavequake.workflows.sweep import NAME, SweepStudy, base_study, swept_study


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

    Examples
    --------
    >>> load_study("tmt-segments", ["campaign.cases=40"])
    <SegmentStudy tmt-segments: 40 cases of segment-disturbance>
    """
    if not isinstance(name, str | Path):
        raise UserError(f"A study is loaded by name or path, not by {type(name).__name__}.")
    path = _find(str(name))
    if path.suffix.lower() in LENS_FILES:
        raise UserError(
            f"{path} is a lens file, not a study: a study names it as `file` of its [system]; `wavequake "
            "info` and `wavequake sensitivity` take the lens file itself."
        )
    if path.suffix.lower() == ".sti":
        raise UserError(
            f"{path} is a stiffness matrix of CalculiX, part of a finite element model, not a study: "
            f"`wavequake new {path}` begins a study of that model."
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
    sweep = record.pop("sweep", None)
    swept, pairs = _of_sweep(pairs)
    replace_alternatives(record, pairs, model)
    for key, value in pairs:
        override(record, key, _located(key, value, base), model)
    follow_in_title(record, dict(pairs))
    model.read_files(record, base)
    study = validated(model, record, where, [key for key, _ in pairs])
    if sweep is None and not swept:
        return study
    if not isinstance(sweep, dict | None):
        raise UserError(f"{where}: sweep is {sweep!r}; write a table [sweep] of keys and lists of values.")
    return swept_study(study, {**_flat(sweep or {}), **swept})


def study_with(study: Study, keys: Mapping[str, Any]) -> Study:
    """Return a copy of `study` with ``section.key`` values replaced; raises as :func:`load_study`.

    Files cannot be replaced: those of a loaded study have been read.
    """
    file = next((key for key in keys if key.rpartition(".")[2] in FILES), None)
    if file is not None:
        raise UserError(
            f"The study {study.study.name} is loaded and has read its files, so {file!r} changes nothing in "
            "it; load it with this key (wavequake.load_study)."
        )
    swept, own = _of_sweep(keys.items())
    if isinstance(study, SweepStudy):
        before = {one.key: one.values for one in study.sweep}
        return swept_study(study_with(base_study(study), dict(own)), {**before, **swept})
    found = overridden(type(study), study.model_dump(mode="json"), dict(own), study.study.name)
    return swept_study(found, swept) if swept else found


def chosen_study(study: str | Path | Study, overrides: Mapping[str, Any], cases: int | None = None) -> Study:
    """Return a study, loaded where it is not, with keys of Python (`optics__wavelength_nm`) replaced."""
    keys = {key.replace("__", "."): value for key, value in overrides.items()}
    if cases is not None:
        keys["campaign.cases"] = cases
    return study_with(study, keys) if isinstance(study, Study) else load_study(study, keys)


def _of_sweep(pairs: Iterable[tuple[str, Any]]) -> tuple[dict[str, Any], list[tuple[str, Any]]]:
    """Part overrides into those of the sweep, ``sweep.section.key = [...]``, and the others."""
    pairs, head = list(pairs), f"{NAME}."
    swept = {key.removeprefix(head): value for key, value in pairs if key.startswith(head)}
    return swept, [(key, value) for key, value in pairs if not key.startswith(head)]


def _flat(table: Mapping[str, Any], head: str = "") -> dict[str, Any]:
    """Return a table of tables by keys with dots: ``model.rings = [4, 6]`` in TOML is a table in a table."""
    found: dict[str, Any] = {}
    for key, value in table.items():
        found |= _flat(value, f"{head}{key}.") if isinstance(value, dict) else {f"{head}{key}": value}
    return found


def _located(key: str, value: Any, base: Path) -> Any:
    """Return the path of a file that an override names: in the current folder, or else beside the study."""
    if key.rpartition(".")[2] not in FILES or not isinstance(value, str):
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
    if name == NAME:
        raise UserError(
            f"{where}: study.workflow: a sweep is a table [sweep] in a study of any workflow; choose one of "
            f"{', '.join(kind_names())}."
        )
    try:
        return find_kind(str(name)).model
    except UserError as error:
        raise UserError(f"{where}: study.workflow: {error}") from None


def near_matches(name: str, known: Iterable[str]) -> str:
    """Return the end of a sentence that there is no `name`: which ones are near, and what lists all."""
    near = map(repr, difflib.get_close_matches(name, [*dict.fromkeys(known)], n=3))
    meant = f": did you mean {listed}?" if (listed := " or ".join(near)) else "."
    return f"{meant} `wavequake studies` lists all that are bundled"


def _find(name: str) -> Path:
    bundled = bundled_studies()
    if name in bundled:
        return bundled[name]
    path = Path(name)
    if path.is_file():
        return path
    if path.suffix or path.parent != Path():
        there = "is no regular file" if path.exists() else "does not exist"
        what = "is a folder, not a study file" if path.is_dir() else there
        raise UserError(f"The file {name} {what}; `wavequake new` begins a study of your own.")
    raise UserError(
        f"There is no study {name!r}{near_matches(name, bundled)}; a study of your own is a path to a .toml "
        "file."
    )
