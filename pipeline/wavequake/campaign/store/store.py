"""The store of a campaign: a folder with a manifest, plain zarr arrays and a journal.

``manifest.json`` says which study it belongs to, ``data.zarr`` holds the numbers and ``done/`` the journal.
The manifest is written last when a store is created: where it is, the store is complete. Only the driver
creates and extends a store, under a lock; workers write whole chunks.
"""

import errno
import json
import os
import shutil
import uuid
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from wavequake.campaign.contract import StudyKind, Template
from wavequake.campaign.store import arrays
from wavequake.campaign.store.difference import first_difference
from wavequake.campaign.store.journal import Chunk, Journal, Record, flush
from wavequake.campaign.store.retention import stored_template
from wavequake.errors import StoreDamageError, UserError
from wavequake.kernels.device.devices import choose_device

if TYPE_CHECKING:
    import xarray as xr

SCHEMA = 1
MANIFEST, DATA, JOURNAL, LOCK, REPORT = "manifest.json", "data.zarr", "done", "lock", "report.html"
SENSITIVITY, BUDGET, LOG, SHARDS = "sensitivity.zarr", "budget.zarr", "log", "shards"


@dataclass(frozen=True)
class Manifest:
    """What a store is.

    ``study`` is the canonical text that identifies it, ``identity`` its SHA-256, ``chunk`` the number of
    cases per file (K), ``variables`` the arrays that chunks write, in this order.
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

    def plan(self) -> list[Chunk]:
        """Return the chunks, cases first <= id < last, that cover all cases."""
        return [(first, min(first + self.chunk, self.cases)) for first in range(0, self.cases, self.chunk)]


@contextmanager
def write_errors_explained(path: Path) -> Iterator[None]:
    """Turn the errors of a disk that is full or cannot be written into one sentence for the user."""
    try:
        yield
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise UserError(
                f"The disk of {path} is full: what is done is kept; free some space and repeat the command."
            ) from None
        if error.errno in (
            errno.EROFS,
            errno.EACCES,
            errno.EPERM,
            errno.ENOTDIR,
            errno.EEXIST,
            errno.ENOENT,
            errno.ENAMETOOLONG,
        ):
            reason = os.strerror(error.errno).lower()
            raise UserError(
                f"{path} cannot be written ({reason}): choose another folder with --store."
            ) from None
        raise


def refuse_foreign(path: Path) -> None:
    """Raise UserError if `path` is a file, or a folder of something else than a store."""
    with write_errors_explained(path):
        names = sorted(os.listdir(path)) if path.exists() else []
    if not names or MANIFEST in names:
        return
    # Where we wrote data, we had made the journal's folder before: other data are somebody else's.
    ours = [MANIFEST, JOURNAL, LOCK, REPORT, SENSITIVITY, BUDGET, LOG, SHARDS]
    ours += [DATA] if JOURNAL in names else []
    foreign = [name for name in names if name.split(".partial")[0] not in ours]
    if DATA in names and any((path / JOURNAL).glob("*.jsonl")):
        raise UserError(
            f"{path} has results but no {MANIFEST}: put that file back, or choose another --store."
        )
    if foreign:
        raise UserError(
            f"{path} is not a store: it holds {foreign[0]!r}, no {MANIFEST}; choose another --store."
        )


def create_store(
    path: Path | str,
    workflow: StudyKind,
    study: str,
    cases: int,
    chunk: int,
    device: str,
    provenance: Mapping[str, str],
) -> Manifest:
    """Write an empty store: every array with its coordinates and attributes, and then the manifest.

    Parameters
    ----------
    path : Path or str
        A new or empty folder.
    workflow, study
        What is computed; `study` is the canonical text of the study.
    cases, chunk : int
        Number of cases, and of cases per file (K), which is fixed from now on.
    device : str
        The device that runs the kernels.
    provenance : mapping of str to str
        Attributes that say where the numbers come from.

    Raises
    ------
    UserError
        If `path` is a file, holds something else, or cannot be written.
    """
    path = Path(path)
    if cases < 1 or chunk < 1:
        raise UserError(
            f"A store needs at least one case (campaign.cases is {cases}) "
            f"and one case per chunk (store.chunk_cases is {chunk})."
        )
    refuse_foreign(path)
    chosen = choose_device(device)
    identity = sha256(study.encode()).hexdigest()
    manifest = Manifest(
        SCHEMA,
        workflow.name,
        study,
        identity,
        cases,
        chunk,
        (*stored_template(workflow, study).per_case, *arrays.ENGINE_VARIABLES),
        chosen.name,
        chosen.kind,
        dict(provenance),
    )
    with write_errors_explained(path):
        path.mkdir(parents=True, exist_ok=True)
        if (path / DATA).exists():  # left by a creation that did not reach its manifest
            shutil.rmtree(path / DATA)
        (path / JOURNAL).mkdir(exist_ok=True)
        _write_layout(path / DATA, manifest, workflow)
        _write_manifest(path, manifest)
    return manifest


def _write_layout(folder: Path, manifest: Manifest, workflow: StudyKind) -> None:
    """Write everything of the zarr folder that no chunk writes: metadata, labels, fixed arrays."""
    template = stored_template(workflow, manifest.study)
    labels = _labels(workflow, manifest.study, 0, manifest.cases)
    group = arrays.create_group(folder, _attributes(manifest, template, tuple(labels)))
    for name, variable in {**template.per_case, **arrays.ENGINE_VARIABLES}.items():
        arrays.create_per_case(group, name, variable, manifest.cases, manifest.chunk)
    for name, (dims, values, attrs) in template.fixed.items():
        arrays.create_fixed(group, name, dims, np.asarray(values), attrs)
    for name, values in labels.items():
        arrays.create_fixed(group, name, ("case",), values, {"long_name": name.replace("_", " ")})
    arrays.consolidate(folder)


def lost_layout(path: Path, manifest: Manifest) -> list[Path]:
    """Return the files of metadata, labels and fixed arrays that are missing, empty or no longer agree.

    The root of the zarr folder has a copy of all metadata. Numbers are not read, only the sizes of files.
    """
    data = path / DATA
    entries = _consolidated(data)
    if not entries.keys() >= set(manifest.variables):
        return [data / "zarr.json"]
    lost = [data / name / "zarr.json" for name, entry in entries.items() if _metadata(data / name) != entry]
    for name in entries.keys() - set(manifest.variables):
        sizes, pieces = entries[name]["shape"], entries[name]["chunk_grid"]["configuration"]["chunk_shape"]
        grid = [-(-size // piece) for size, piece in zip(sizes, pieces, strict=True)]
        files = [data / name / ".".join(["c", *map(str, index)]) for index in np.ndindex(*grid)]
        lost += [file for file in files if not file.is_file() or not file.stat().st_size]
    return sorted(lost)


def _metadata(folder: Path) -> dict[str, Any]:
    try:
        found = json.loads((folder / "zarr.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def _consolidated(folder: Path) -> dict[str, dict[str, Any]]:
    try:
        return dict(_metadata(folder)["consolidated_metadata"]["metadata"])
    except (KeyError, TypeError, ValueError):
        return {}


def mend_layout(path: Path, manifest: Manifest, workflow: StudyKind) -> list[str]:
    """Put back metadata, labels and fixed arrays that differ from what a new store would hold.

    Chunks of numbers are left alone. Returns the names of the files that were replaced.
    """
    fresh = path / f"{DATA}.partial-{uuid.uuid4().hex}"
    replaced = []
    with write_errors_explained(path):
        try:
            _write_layout(fresh, manifest, workflow)
            for file in sorted(file for file in fresh.rglob("*") if file.is_file()):
                target = path / DATA / file.relative_to(fresh)
                if not target.is_file() or target.read_bytes() != file.read_bytes():
                    target.parent.mkdir(parents=True, exist_ok=True)
                    file.replace(target)
                    flush(target.parent)
                    replaced.append(str(target.relative_to(path)))
        finally:
            shutil.rmtree(fresh, ignore_errors=True)
    return replaced


def extend_store(path: Path | str, workflow: StudyKind, cases: int) -> Manifest:
    """Give a store room for `cases` cases; earlier cases and their numbers stay, and a store never shrinks.

    The number in the manifest changes last; running this again completes an extension that was interrupted.

    Raises
    ------
    UserError
        If there is no store at `path`, or it cannot be written.
    """
    path = Path(path)
    manifest = read_manifest(path)
    extended = replace(manifest, cases=max(cases, manifest.cases))
    labels = _labels(workflow, manifest.study, manifest.cases, extended.cases)
    group = arrays.open_group(path / DATA)
    with write_errors_explained(path):
        (path / JOURNAL).mkdir(exist_ok=True)
        for name in (*manifest.variables, *labels):
            array = arrays.array_of(group, name)
            if array.shape[0] != extended.cases:
                array.resize((extended.cases, *array.shape[1:]))
        if extended != manifest:
            for name, values in labels.items():
                with arrays.damage_explained(path / DATA / name):
                    arrays.array_of(group, name)[manifest.cases :] = values
            arrays.consolidate(path / DATA)
            _write_manifest(path, extended)
    return extended


def _labels(workflow: StudyKind, study: str, first: int, last: int) -> dict[str, NDArray[Any]]:
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


def _write_manifest(path: Path, manifest: Manifest) -> None:
    partial = path / f"{MANIFEST}.partial-{uuid.uuid4().hex}"
    try:
        with partial.open("w", encoding="utf-8") as file:
            json.dump(asdict(manifest), file, indent=1)
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
    file = Path(path) / MANIFEST
    if not file.is_file():
        raise UserError(f"There is no store at {path}: a store is a folder with a {MANIFEST}.")
    try:
        entry = json.loads(file.read_text(encoding="utf-8"))
        schema = entry["schema"]
        if schema == SCHEMA:
            manifest = Manifest(**{**entry, "variables": tuple(entry["variables"])})
            intact = sha256(manifest.study.encode()).hexdigest() == manifest.identity
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise StoreDamageError(f"{file} is damaged: {error}.") from None
    if schema != SCHEMA:
        raise UserError(
            f"The store {path} has schema {schema}; this version of Wavequake reads schema {SCHEMA}."
        )
    if not intact:
        raise StoreDamageError(
            f"{file} is damaged: its study does not match its identity {manifest.identity[:12]}."
        )
    return manifest


def refuse_other(path: Path, manifest: Manifest, workflow: str, study: str, kind: str) -> None:
    """Raise UserError if a store belongs to another study or to another kind of device."""
    if (manifest.workflow, manifest.study) != (workflow, study):
        theirs = {"workflow": manifest.workflow, **json.loads(manifest.study)}
        ours = {"workflow": workflow, **json.loads(study)}
        key, there, here = first_difference(theirs, ours)
        raise UserError(
            f"{path} belongs to another study: {key} is {there} there, {here} here; choose another --store."
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


def open_store(path: Path | str) -> "xr.Dataset":
    """Open a store as a labelled lazy dataset, one Dask chunk per K cases.

    Cases that are not computed yet have ``status`` 0 and NaN; quarantined ones (2 and above) say why in
    ``message``.

    Raises
    ------
    UserError
        If there is no store at `path`.
    StoreDamageError
        If its metadata is damaged.

    Examples
    --------
    >>> ds = open_store("runs/tmt-segments-1a2b3c4d")                      # doctest: +SKIP
    >>> ds.wfe_rms.where(ds.status == 1).groupby("disturbance").median()   # doctest: +SKIP
    """
    import xarray as xr

    if not isinstance(path, str | Path):
        raise UserError(f"The store is {path!r}; it must be the path of a folder, as text.")
    path = Path(path)
    manifest = read_manifest(path)
    group = arrays.open_group(path / DATA, read_only=True)
    for name in manifest.variables:
        arrays.array_of(group, name)
    with arrays.damage_explained(path / DATA):
        dataset = xr.open_zarr(path / DATA, chunks=None, consolidated=False).isel(case=slice(manifest.cases))
    # Labels, status and messages stay out of Dask: they are small, and selecting by them needs their values.
    numbers = [name for name in manifest.variables if name not in arrays.ENGINE_VARIABLES]
    lazy = {name: dataset[name].variable.chunk(case=manifest.chunk) for name in numbers}
    dataset = dataset.assign(lazy)
    others = [name for name in dataset.data_vars if name not in manifest.variables]
    ordered: xr.Dataset = dataset[[*manifest.variables, *others]]
    return ordered


def done_records(manifest: Manifest, journal: Journal) -> dict[Chunk, Record]:
    """Return the record of each chunk of the plan that is done; a short last chunk that has grown is not."""
    return {chunk: journal.records[chunk] for chunk in manifest.plan() if chunk in journal.records}
