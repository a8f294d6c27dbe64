"""What a store is: its manifest, which the driver alone writes, and which nobody believes unread."""

import json
import os
import uuid
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

from wavequake import __version__
from wavequake.campaign.store.difference import first_difference
from wavequake.campaign.store.engine_variables import ENGINE_VARIABLES
from wavequake.campaign.store.folder import BUDGET, MANIFEST, SENSITIVITY
from wavequake.campaign.store.journal import Chunk, flush
from wavequake.campaign.store.objects import ObjectPath, location, write
from wavequake.errors import StoreDamageError, UserError

SCHEMA = 1
MOST_CASES, MOST_CHUNKS = 10**8, 10**6  # their labels and records are held in memory
_LONGEST = 2**26  # bytes


@dataclass(frozen=True)
class Manifest:
    """What a store is.

    ``study`` is the canonical text that identifies it, ``identity`` its SHA-256, ``chunk`` the number of
    cases per file (K), ``variables`` the arrays that chunks write, in this order. ``metadata`` is the digest
    of units and all else that describes the arrays, but for the number of cases; "" where it is not known.
    """

    schema: int
    workflow: str
    study: str
    identity: str
    cases: int
    chunk: int
    variables: tuple[str, ...]
    device: str
    device_kind: str
    provenance: Mapping[str, str]
    metadata: str = ""

    def plan(self) -> list[Chunk]:
        """Return the chunks, cases first <= id < last, that cover all cases."""
        return [(first, min(first + self.chunk, self.cases)) for first in range(0, self.cases, self.chunk)]


def write_manifest(path: Path, manifest: Manifest) -> None:
    """Write or replace the manifest of a store, durably and at once."""
    text = json.dumps(sealed(asdict(manifest)), indent=1)
    if isinstance(path, ObjectPath):
        write({path / MANIFEST: text.encode()})
        return
    partial = path / f"{MANIFEST}.partial-{uuid.uuid4().hex}"
    try:
        with partial.open("w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path / MANIFEST)
    finally:
        partial.unlink(missing_ok=True)
    flush(path)


def read_manifest(path: Path | str) -> Manifest:
    """Read what a store is.

    Raises
    ------
    UserError
        If there is no store at `path`, or another version of Wavequake made it.
    StoreDamageError
        If the manifest is damaged.
    """
    path = location(path)
    file = path / MANIFEST
    if not file.is_file():
        kept = [name for name in (BUDGET, SENSITIVITY) if (path / name).exists()]
        if kept:
            raise UserError(
                f"{path} has no runs to report, but {' and '.join(kept)} (xarray.open_zarr reads it): "
                f"`wavequake run` of the same study with --store {path} adds runs."
            )
        raise UserError(f"There is no store at {path}: a store is a folder with a {MANIFEST}.")
    try:
        entry = json.loads(_text(file))
        schema, checksum = entry["schema"], entry.pop("checksum", None)
        if schema == SCHEMA:
            if checksum not in (None, _checksum(entry)):
                raise ValueError("its checksum does not fit")
            if not isinstance(entry["variables"], list) or not {*ENGINE_VARIABLES} <= {*entry["variables"]}:
                raise ValueError("its variables are no list of arrays with a status")
            manifest = Manifest(**{**entry, "variables": tuple(entry["variables"])})
            if wrong := _what_is_wrong(manifest):
                raise ValueError(wrong)
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise StoreDamageError(f"{file} is damaged: {error}.") from None
    if schema != SCHEMA:
        raise UserError(
            f"The store {path} has schema {schema}; this version of Wavequake reads schema {SCHEMA}."
        )
    return manifest


def _text(file: Path) -> str:
    with file.open("rb") as content:
        size = content.seek(0, os.SEEK_END)
        content.seek(0)
        if size > _LONGEST:
            raise ValueError(f"it is longer than {_LONGEST >> 20} MiB")
        return content.read(size + 1).decode()  # reading takes the memory that it is allowed


def sealed(entry: dict[str, Any]) -> dict[str, Any]:
    """Return the entries of a manifest with their checksum."""
    return {**entry, "checksum": _checksum(entry)}


def _checksum(entry: dict[str, Any]) -> str:
    return sha256(json.dumps(entry, sort_keys=True).encode()).hexdigest()


def _what_is_wrong(manifest: Manifest) -> str:
    """Return which entry cannot be, in words; "" if all can."""
    texts = {
        name: getattr(manifest, name) for name in ("workflow", "study", "identity", "device", "device_kind")
    }
    texts |= {"metadata": manifest.metadata, **dict(zip(manifest.variables, manifest.variables, strict=True))}
    for name, value in texts.items():
        if not isinstance(value, str):
            return f"{name} is no text"
    for name in ("cases", "chunk"):
        value = getattr(manifest, name)
        if type(value) is not int or value < 1:
            return f"{name} is {str(value)[:40]!r}, no whole number from 1"
    if too_many := why_too_many(manifest.cases, manifest.chunk):
        return too_many
    if not isinstance(manifest.provenance, dict):
        return "provenance is no table"
    if sha256(manifest.study.encode()).hexdigest() != manifest.identity:
        return f"its study does not match its identity {manifest.identity[:12]}"
    return ""


def why_too_many(cases: int, chunk: int) -> str:
    """Return why a store cannot have so many cases or chunks; "" if it can."""
    if cases > MOST_CASES:
        return f"{cases} cases are more than {MOST_CASES}"
    chunks, least = -(-cases // chunk), -(-cases // MOST_CHUNKS)
    if chunks > MOST_CHUNKS:
        return (
            f"{cases} cases in chunks of {chunk} are {chunks} chunks, each a file of every array; at most "
            f"{MOST_CHUNKS} are possible, with store.chunk_cases={least} or more"
        )
    return ""


def refuse_other(path: Path, manifest: Manifest, workflow: str, study: str, kind: str) -> None:
    """Raise UserError if a store belongs to another study or to another kind of device."""
    if (manifest.workflow, manifest.study) != (workflow, study):
        theirs = {"workflow": manifest.workflow, **json.loads(manifest.study)}
        ours = {"workflow": workflow, **json.loads(study)}
        key, there, here = first_difference(theirs, ours)
        made_by = manifest.provenance.get("wavequake", __version__)
        words = f", made by Wavequake {made_by}" if made_by != __version__ else ""
        raise UserError(
            f"{path} belongs to another study{words}: {key} is {there} there, {here} here; choose another "
            "--store."
        )
    if manifest.device_kind != kind:
        raise UserError(
            f"{path} was begun on a device of kind {manifest.device_kind!r} ({manifest.device}), and {kind!r}"
            f" gives other last bits: use campaign.device={manifest.device_kind}, or choose another --store."
        )


def refuse_mixed(path: Path, manifest: Manifest, code: str) -> None:
    """Raise UserError if another version of the code began a store."""
    theirs = manifest.provenance.get("code", code)
    if theirs != code:
        raise UserError(
            f"{path} was begun by {theirs}; this is {code}, which may give other last bits: give "
            "--allow-mixed to go on all the same (the journal keeps what computed each chunk), or choose "
            "another --store."
        )
