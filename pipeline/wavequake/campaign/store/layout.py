"""What of the zarr folder no chunk writes: metadata, labels, fixed arrays; how they are found and mended."""

import json
import shutil
import tempfile
import uuid
from collections import Counter
from collections.abc import Callable, Mapping
from collections.abc import Set as AbstractSet
from dataclasses import replace
from hashlib import blake2b
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wavequake import __version__
from wavequake.campaign.contract import StudyKind, Template
from wavequake.campaign.store.engine_variables import ENGINE_VARIABLES, MESSAGE
from wavequake.campaign.store.folder import DATA, write_errors_explained
from wavequake.campaign.store.journal import Chunk, Record, flush
from wavequake.campaign.store.manifest import MOST_CASES, Manifest, write_manifest
from wavequake.campaign.store.objects import ObjectPath, presence, upload
from wavequake.campaign.store.retention import stored_template
from wavequake.errors import StoreDamageError, UserError

_MOST_LABELS = 2**33  # numbers of an array that is no case's


def refuse_older(path: Path, manifest: Manifest, kind_of: Callable[[str], StudyKind]) -> None:
    """Raise UserError if another version made a store, without numbers that this one stores."""
    made_by = manifest.provenance.get("wavequake", __version__)
    if made_by == __version__:
        return
    wanted = stored_template(kind_of(manifest.workflow), manifest.study).per_case
    if missing := [name for name in wanted if name not in manifest.variables]:
        raise UserError(
            f"{path} was made by Wavequake {made_by}, which stored no {missing[0]!r}: status, verify, "
            f"compare and export take it; for all else, run its study with {__version__} and another --store."
        )


def write_layout(folder: Path, manifest: Manifest, workflow: StudyKind) -> None:
    """Write everything of the zarr folder that no chunk writes: metadata, labels, fixed arrays."""
    if isinstance(folder, ObjectPath):
        _uploaded(folder, manifest, workflow)
        return
    from wavequake.campaign.store import arrays  # zarr is slow to load, and only this needs it

    template = stored_template(workflow, manifest.study)
    labels = labels_of(workflow, manifest.study, 0, manifest.cases)
    _refuse_two_of_a_name(template, labels)
    group = arrays.create_group(folder, _attributes(manifest, template, tuple(labels)))
    for name, variable in {**template.per_case, **ENGINE_VARIABLES}.items():
        arrays.create_per_case(group, name, variable, manifest.cases, manifest.chunk)
    for name, (dims, values, attrs) in template.fixed.items():
        arrays.create_fixed(group, name, dims, np.asarray(values), attrs)
    for name, values in labels.items():
        arrays.create_fixed(group, name, ("case",), values, {"long_name": name.replace("_", " ")})
    arrays.consolidate(folder)


def _uploaded(folder: ObjectPath, manifest: Manifest, workflow: StudyKind) -> list[str]:
    """Write what differs from a layout that is made on this machine; return the names of its files."""
    with tempfile.TemporaryDirectory(prefix="wavequake-") as scratch:
        write_layout(Path(scratch) / DATA, manifest, workflow)
        return upload(Path(scratch) / DATA, folder)


def _refuse_two_of_a_name(template: Template, labels: Mapping[str, NDArray[Any]]) -> None:
    """Raise UserError if two arrays had the same name, or two of their dimensions sizes that differ."""
    names = Counter([*template.per_case, *ENGINE_VARIABLES, *template.fixed, *labels])
    if twice := [name for name, count in names.items() if count > 1]:
        raise UserError(f"The store would have two arrays called {twice[0]!r}; each needs a name of its own.")
    sizes = {"case": len(labels["case"])}
    shapes = {name: (one.dims, one.shape) for name, one in template.per_case.items()}
    fixed = {name: (dims, np.shape(values)) for name, (dims, values, _) in template.fixed.items()}
    for name, (dims, shape) in {**shapes, **fixed}.items():
        if len(dims) != len(shape) or any(
            sizes.setdefault(*one) != one[1] for one in zip(dims, shape, strict=True)
        ):
            raise UserError(
                f"The array {name!r} has the shape {shape} along {', '.join(dims)}; others of the store "
                f"are as long as {', '.join(f'{dim} {sizes[dim]}' for dim in dims if dim in sizes)}."
            )


def lost_layout(path: Path, manifest: Manifest) -> list[Path]:
    """Return the files of metadata, labels and fixed arrays that are missing, empty or no longer agree.

    The root of the zarr folder has a copy of all metadata. Numbers are not read, only the sizes of files.
    """
    data = path / DATA
    entries = _consolidated(data)
    if not entries.keys() >= set(manifest.variables):
        return [data / "zarr.json"]
    try:
        if manifest.metadata not in ("", metadata_digest(data)):
            return [data / "zarr.json"]
        return _lost_files(data, entries, manifest)
    except (KeyError, TypeError, ValueError, AttributeError, RecursionError):  # what is no metadata raises
        return [data / "zarr.json"]


def metadata_digest(data: Path) -> str:
    """Return the digest of all that describes the arrays of a zarr folder, but for the number of cases."""
    root = _metadata(data)
    entries = {
        name: {**entry, "shape": entry["shape"][(entry.get("dimension_names") or [])[:1] == ["case"] :]}
        for name, entry in root["consolidated_metadata"]["metadata"].items()
    }
    described = json.dumps([root["attributes"], entries], sort_keys=True)
    return blake2b(described.encode(), digest_size=16).hexdigest()


def _lost_files(data: Path, entries: Mapping[str, dict[str, Any]], manifest: Manifest) -> list[Path]:
    there = presence(data)
    lost = [
        data / name / "zarr.json" for name, entry in entries.items() if not _fits(data, name, entry, manifest)
    ]
    for name in entries.keys() - set(manifest.variables):
        sizes, pieces = entries[name]["shape"], entries[name]["chunk_grid"]["configuration"]["chunk_shape"]
        if prod(sizes) > _MOST_LABELS:
            lost.append(data / name / "zarr.json")
            continue
        grid = [-(-size // piece) for size, piece in zip(sizes, pieces, strict=True)]
        files = [data / name / ".".join(["c", *map(str, index)]) for index in np.ndindex(*grid)]
        lost += [file for file in files if not there(file)]
    return sorted(lost)


def _fits(data: Path, name: str, entry: dict[str, Any], manifest: Manifest) -> bool:
    """Return whether both copies of an array's metadata agree, and it has room for all cases."""
    per_case = (entry.get("dimension_names") or [])[:1] == ["case"]
    room = not per_case or manifest.cases <= entry["shape"][0] <= MOST_CASES
    return room and _metadata(data / name) == entry


def _metadata(folder: Path) -> dict[str, Any]:
    try:
        found = json.loads((folder / "zarr.json").read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def _consolidated(folder: Path) -> dict[str, dict[str, Any]]:
    try:
        return dict(_metadata(folder)["consolidated_metadata"]["metadata"])
    except (KeyError, TypeError, ValueError):
        return {}


def has_room(data: Path, manifest: Manifest) -> bool:
    """Return whether every array and every label has a row for each of a store's cases, and no more."""
    entries = _consolidated(data)
    per_case = {name for name, one in entries.items() if (one.get("dimension_names") or [])[:1] == ["case"]}
    sizes = {entries[name]["shape"][0] for name in per_case}
    return per_case >= {*manifest.variables} and sizes == {manifest.cases}


def lost_chunks(path: Path, manifest: Manifest, records: Mapping[Chunk, Record]) -> AbstractSet[Chunk]:
    """Return the finished chunks whose files are missing or empty, as they may be after a loss of power.

    Reading them would give NaN without any error. This looks at names and sizes only, by the metadata;
    :func:`wavequake.campaign.store.verify.verify_store` reads.

    Raises
    ------
    StoreDamageError
        If the metadata is damaged.
    """
    if not records:
        return frozenset()
    data, lost = path / DATA, set()
    there = presence(data)
    entries = _consolidated(data)
    try:
        grids = {
            name: entries[name]["chunk_grid"]["configuration"]["chunk_shape"] for name in manifest.variables
        }
        for chunk, record in records.items():
            written = manifest.variables if record.has_messages else [one for one in grids if one != MESSAGE]
            files = (data / name / _piece(record.first, grids[name]) for name in written)
            if not all(map(there, files)):
                lost.add(chunk)
    except (KeyError, TypeError, IndexError, ZeroDivisionError) as error:
        raise StoreDamageError(f"{data / 'zarr.json'} is damaged: {error}.") from None
    return lost


def _piece(first: int, sizes: list[int]) -> str:
    """Return the name of the file of an array that holds the cases from `first`."""
    return ".".join(["c", str(first // sizes[0]), *["0"] * (len(sizes) - 1)])


def mend_layout(path: Path, manifest: Manifest, workflow: StudyKind) -> list[str]:
    """Put back metadata, labels and fixed arrays that differ from what a new store would hold.

    Chunks of numbers are left alone. Returns the names of the files that were replaced.
    """
    if isinstance(path, ObjectPath):
        changed = _uploaded(path / DATA, manifest, workflow)
        _sealed_layout(path, manifest)
        return [f"{DATA}/{name}" for name in changed]
    fresh = path / f"{DATA}.partial-{uuid.uuid4().hex}"
    replaced = []
    with write_errors_explained(path):
        try:
            write_layout(fresh, manifest, workflow)
            for file in sorted(file for file in fresh.rglob("*") if file.is_file()):
                target = path / DATA / file.relative_to(fresh)
                if not target.is_file() or target.read_bytes() != file.read_bytes():
                    target.parent.mkdir(parents=True, exist_ok=True)
                    file.replace(target)
                    flush(target.parent)
                    replaced.append(str(target.relative_to(path)))
            _sealed_layout(path, manifest)
        finally:
            shutil.rmtree(fresh, ignore_errors=True)
    return replaced


def _sealed_layout(path: Path, manifest: Manifest) -> None:
    fresh_digest = metadata_digest(path / DATA)
    if manifest.metadata != fresh_digest:
        write_manifest(path, replace(manifest, metadata=fresh_digest))


def labels_of(workflow: StudyKind, study: str, first: int, last: int) -> dict[str, NDArray[Any]]:
    """Return what labels the cases first <= id < last."""
    return {"case": np.arange(first, last), **workflow.case_table(study, first, last)}


def _attributes(manifest: Manifest, template: Template, labels: tuple[str, ...]) -> dict[str, Any]:
    coordinates = [name for name, variable in template.per_case.items() if variable.coordinate]
    return {
        "title": f"Wavequake campaign {manifest.workflow}",
        "study": manifest.study,
        "study_sha256": manifest.identity,
        "store_schema": manifest.schema,
        "cases_per_chunk": manifest.chunk,
        "device": f"{manifest.device} ({manifest.device_kind})",
        **manifest.provenance,
        # The CF way to say which arrays label others.
        "coordinates": " ".join([*(name for name in labels if name != "case"), *coordinates]),
    }
