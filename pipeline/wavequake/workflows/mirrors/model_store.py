"""Heavy models, built once and kept on disk by the hash of what determines them.

Workers of a campaign load what the first of them has built. The files lie in the user's cache folder and may
be removed at any time; an imported model then has to be imported again, by loading its study file.
"""

import hashlib
import json
import os
import re
import uuid
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from platformdirs import user_cache_path
from pydantic import ValidationError
from scipy.sparse import csc_array, issparse

from wavequake.campaign.provenance import code
from wavequake.errors import UserError
from wavequake.mechanics.importers.model import ImportedModel, load_model
from wavequake.mechanics.model import FiniteElementModel, RayleighDamping, check_model
from wavequake.reduction.intermediate import Intermediate

Arrays = dict[str, NDArray[Any]]
Kind = TypeVar("Kind", FiniteElementModel, Intermediate)

# Part of every hash: raise it when what an imported model is made of changes.
_VERSION = 2
_NOTES = "import_notes"
_SPARSE = ("data", "indices", "indptr", "shape")


def model_folder() -> Path:
    """Return the folder of kept models."""
    return user_cache_path("wavequake") / "models"


def digest(record: Mapping[str, Any]) -> str:
    """Return the SHA-256 of what determines a model."""
    text = json.dumps({"version": _VERSION, **record}, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


# Keys of a model that its intermediate model does not depend on: bases are those without damping.
DAMPING = frozenset({"damping_alpha", "damping_beta"})


def kept_intermediate(
    name: str, build: Callable[[], Intermediate], damping: RayleighDamping | None = None
) -> Intermediate:
    """Return an intermediate model by its hash; it is built and kept if it is not there, or not readable.

    With `damping`, the hash is that of what determines the model but for its damping, which it then has.
    """
    found = _unpacked(Intermediate, kept_arrays(name, lambda: _packed(build())))
    return found if damping is None else replace(found, damping=damping)


def kept_arrays(name: str, build: Callable[[], Arrays]) -> Arrays:
    """Return named arrays by their hash, as `kept_intermediate` does a model.

    What other code or libraries have built is not taken: a store says which ones made its numbers.
    """
    name = digest({"name": name, "code": code()})
    found = _read(name)
    if found is None:
        found = build()
        _write(name, found)
    return found


def keep_imported(keys: Mapping[str, Any], base: Path, section_name: str = "model") -> str:
    """Import the model that the keys of a study's [model], or another section, name; return its hash.

    Raises
    ------
    UserError
        If a key is missing or wrong, or the files cannot be imported.
    """
    try:
        section = ImportedModel.model_validate(dict(keys))
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        where = ".".join((section_name, *map(str, first["loc"])))
        reason = "is missing" if first["type"] == "missing" else first["msg"]
        raise UserError(f"{where}: {reason[0].lower()}{reason[1:]}.") from None
    imported = load_model(section, base)
    check_model(imported.model)
    packed = _packed(imported.model)
    contents = hashlib.sha256()
    for key in sorted(packed.keys() - {"name"}):  # a renamed file is the same model
        contents.update(key.encode() + np.ascontiguousarray(packed[key]).tobytes())
    name = digest({"contents": contents.hexdigest()})
    kept = _read(name)
    if kept is None or _NOTES not in kept or kept["name"] != packed["name"]:
        _write(name, packed | {_NOTES: np.array(imported.notes, dtype=np.str_)})
    return name


def kept_model(name: str) -> FiniteElementModel:
    """Return an imported model by its hash.

    Raises
    ------
    UserError
        If it is not kept here.
    """
    found = _read(name)
    if found is None:
        raise UserError(
            f"The imported model {name[:12]} is not in {model_folder()}: run the study file that imports it "
            "on this machine, or copy that folder."
        )
    return _unpacked(FiniteElementModel, found)


def kept_notes(name: str) -> tuple[str, ...]:
    """Return what the import did to a model that its author may want to know."""
    return tuple(map(str, (_read(name) or {}).get(_NOTES, ())))


def shown_name(content: str | None, name: str) -> str:
    """Return what to call a model: an imported one by its file, without its ending.

    A study's identity does not hold that name, so labels in a store are "file", and that is what is shown on
    a machine that does not keep the model.

    Parameters
    ----------
    content : str, optional
        Hash of the imported model; None: it is built in.
    name : str
        Its label in the store.
    """
    if content is None:
        return name
    try:
        with np.load(model_folder() / f"{content}.npz", allow_pickle=False) as file:
            return re.sub(r"[^\w.-]+", "-", str(file["name"])).strip("-") or name
    except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile):
        return name


def _packed(model: FiniteElementModel | Intermediate) -> Arrays:
    arrays: Arrays = {}
    for field in fields(model):
        value = getattr(model, field.name)
        if issparse(value):
            arrays |= {f"{field.name}.{part}": np.asarray(getattr(value, part)) for part in _SPARSE}
        elif isinstance(value, RayleighDamping):
            arrays[field.name] = np.array([value.mass, value.stiffness])
        elif field.name == "turns" and not len(value):
            continue  # so that the hash of a model without stays what it was
        elif not isinstance(value, Mapping):  # node sets have done their work
            arrays[field.name] = np.asarray(value)
    return arrays


def _unpacked(kind: type[Kind], arrays: Arrays) -> Kind:
    values: dict[str, Any] = {}
    for field in fields(kind):
        if f"{field.name}.data" in arrays:
            data, indices, indptr, shape = (arrays[f"{field.name}.{part}"] for part in _SPARSE)
            values[field.name] = csc_array((data, indices, indptr), shape=tuple(shape))
        elif field.name == "damping":
            values[field.name] = RayleighDamping(*arrays[field.name].tolist())
        elif field.name in arrays:
            value = arrays[field.name]
            values[field.name] = value.item() if value.ndim == 0 else value
    return kind(**values)


def _read(name: str) -> Arrays | None:
    """Return the arrays of a kept model; None if there are none that can be read."""
    try:
        with np.load(model_folder() / f"{name}.npz", allow_pickle=False) as file:
            return {key: file[key] for key in file.files}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile):
        return None


def _write(name: str, arrays: Arrays) -> None:
    """Keep arrays, all or nothing; a full or read-only disk costs only the time of building again."""
    folder = model_folder()
    partial = folder / f"{name}.partial-{uuid.uuid4().hex}.npz"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        np.savez(partial, **arrays)  # type: ignore[arg-type]
        os.replace(partial, folder / f"{name}.npz")
    except OSError:
        partial.unlink(missing_ok=True)
