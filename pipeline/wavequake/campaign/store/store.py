"""The store of a campaign: a folder with a manifest, plain zarr arrays and a journal.

``manifest.json`` says which study it belongs to, ``data.zarr`` holds the numbers and ``done/`` the journal.
The manifest is written last when a store is created: where it is, the store is complete. Only the driver
creates and extends a store, under a lock; workers write whole chunks.
"""

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING

from wavequake.campaign.contract import StudyKind
from wavequake.campaign.store.engine_variables import ENGINE_VARIABLES
from wavequake.campaign.store.folder import BUDGET as BUDGET
from wavequake.campaign.store.folder import DATA as DATA
from wavequake.campaign.store.folder import ERRORS as ERRORS
from wavequake.campaign.store.folder import JOURNAL as JOURNAL
from wavequake.campaign.store.folder import LOCK as LOCK
from wavequake.campaign.store.folder import LOG as LOG
from wavequake.campaign.store.folder import MANIFEST as MANIFEST
from wavequake.campaign.store.folder import REPORT as REPORT
from wavequake.campaign.store.folder import SENSITIVITY as SENSITIVITY
from wavequake.campaign.store.folder import SHARDS as SHARDS
from wavequake.campaign.store.folder import refuse_foreign as refuse_foreign
from wavequake.campaign.store.folder import write_errors_explained as write_errors_explained
from wavequake.campaign.store.grid import unstack as grid
from wavequake.campaign.store.journal import Chunk, Journal, Record
from wavequake.campaign.store.layout import has_room, labels_of, metadata_digest, write_layout
from wavequake.campaign.store.manifest import SCHEMA, why_too_many, write_manifest
from wavequake.campaign.store.manifest import Manifest as Manifest
from wavequake.campaign.store.manifest import read_manifest as read_manifest
from wavequake.campaign.store.manifest import refuse_other as refuse_other
from wavequake.campaign.store.objects import ObjectPath, location, remove
from wavequake.campaign.store.retention import stored_template
from wavequake.errors import UserError
from wavequake.kernels.device.devices import choose_device

if TYPE_CHECKING:
    import xarray as xr

_SMALL = 2**28  # bytes of numbers


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
    path = location(path)
    if cases < 1 or chunk < 1:
        raise UserError(
            f"A store needs at least one case (campaign.cases is {cases}) "
            f"and one case per chunk (store.chunk_cases is {chunk})."
        )
    if too_many := why_too_many(cases, chunk):
        raise UserError(f"{too_many[0].upper()}{too_many[1:]}.")
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
        (*stored_template(workflow, study).per_case, *ENGINE_VARIABLES),
        chosen.name,
        chosen.kind,
        dict(provenance),
    )
    with write_errors_explained(path):
        path.mkdir(parents=True, exist_ok=True)
        data = path / DATA
        if isinstance(data, ObjectPath):
            remove(data)
        elif data.exists():  # left by a creation that did not reach its manifest
            shutil.rmtree(data)
        (path / JOURNAL).mkdir(exist_ok=True)
        write_layout(path / DATA, manifest, workflow)
        manifest = replace(manifest, metadata=metadata_digest(path / DATA))
        write_manifest(path, manifest)
    return manifest


def extend_store(path: Path | str, workflow: StudyKind, cases: int) -> Manifest:
    """Give a store room for `cases` cases; earlier cases and their numbers stay, and a store never shrinks.

    The number in the manifest changes last; running this again completes an extension that was interrupted.

    Raises
    ------
    UserError
        If there is no store at `path`, or it cannot be written.
    """
    path = location(path)
    manifest = read_manifest(path)
    extended = replace(manifest, cases=max(cases, manifest.cases))
    if too_many := why_too_many(extended.cases, extended.chunk):
        raise UserError(f"{path}: {too_many}.")
    with write_errors_explained(path):
        (path / JOURNAL).mkdir(exist_ok=True)
    if extended == manifest and has_room(path / DATA, manifest):
        return manifest
    if isinstance(path, ObjectPath):
        write_layout(path / DATA, extended, workflow)
        write_manifest(path, extended)
        return extended
    from wavequake.campaign.store import arrays  # zarr is slow to load

    labels = labels_of(workflow, manifest.study, manifest.cases, extended.cases)
    group = arrays.open_group(path / DATA)
    with write_errors_explained(path):
        for name in (*manifest.variables, *labels):
            array = arrays.array_of(group, name)
            if array.shape[0] != extended.cases:
                array.resize((extended.cases, *array.shape[1:]))
        if extended != manifest:
            for name, values in labels.items():
                with arrays.damage_explained(path / DATA / name):
                    arrays.array_of(group, name)[manifest.cases :] = values
            arrays.consolidate(path / DATA)
            write_manifest(path, extended)
    return extended


def open_store(path: Path | str, unstack: bool | str | Sequence[str] = False) -> "xr.Dataset":
    """Open a store as a labelled lazy dataset, one Dask chunk per K cases.

    Cases that are not computed yet have ``status`` 0 and NaN; quarantined ones (2 and above) say why in
    ``message``.

    Parameters
    ----------
    path : path or str
    unstack : bool, str or sequence of str
        Labels that become dimensions in the place of ``case``, as of :func:`wavequake.unstack`; True: those
        that tell the cases apart.

    Raises
    ------
    UserError
        If there is no store at `path`, or as :func:`wavequake.unstack`.
    StoreDamageError
        If its metadata is damaged.

    Examples
    --------
    >>> ds = open_store("runs/tmt-segments-1a2b3c4d")                      # doctest: +SKIP
    >>> ds.wfe_rms.where(ds.status == 1).groupby("disturbance").median()   # doctest: +SKIP
    >>> open_store("runs/thickness", unstack=("method", "order", "thickness_m"))  # doctest: +SKIP
    """
    manifest, dataset = _labelled(path)
    # Labels, status and messages stay out of Dask: they are small, and selecting by them needs their values.
    lazy = {name: dataset[name].variable.chunk(case=manifest.chunk) for name in _numbers(manifest)}
    dataset = dataset.assign(lazy)
    if not unstack:
        return dataset
    labels = () if unstack is True else (unstack,) if isinstance(unstack, str) else unstack
    return grid(dataset, *labels)


def open_for_report(path: Path | str) -> "xr.Dataset":
    """Open a store as :func:`open_store`, but a small one without arrays of Dask.

    These take longer to start than that to read. Its arrays are read when their values are asked for, each
    as a whole; raises as :func:`open_store`.
    """
    manifest, dataset = _labelled(path)
    small = sum(dataset[name].nbytes for name in _numbers(manifest)) <= _SMALL
    return dataset if small else open_store(path)


def _labelled(path: Path | str) -> "tuple[Manifest, xr.Dataset]":
    """Return the arrays of a store, none of them read, in the order of its manifest."""
    import xarray as xr

    from wavequake.campaign.store import arrays

    if not isinstance(path, str | Path):
        raise UserError(f"The store is {path!r}; it must be the path of a folder, as text.")
    path = location(path)
    manifest = read_manifest(path)
    group = arrays.open_group(path / DATA, read_only=True)
    for name in manifest.variables:
        arrays.array_of(group, name)
    with arrays.damage_explained(path / DATA), arrays.missing_reads_as_fill():
        place = group.store if isinstance(path, ObjectPath) else path / DATA
        found = xr.open_zarr(place, chunks=None, consolidated=False)
        dataset = found.isel(case=slice(manifest.cases))
    others = [name for name in dataset.data_vars if name not in manifest.variables]
    return manifest, dataset[[*manifest.variables, *others]]


def _numbers(manifest: Manifest) -> list[str]:
    return [name for name in manifest.variables if name not in ENGINE_VARIABLES]


def done_records(manifest: Manifest, journal: Journal) -> dict[Chunk, Record]:
    """Return the record of each chunk of the plan that is done; a short last chunk that has grown is not."""
    return {chunk: journal.records[chunk] for chunk in manifest.plan() if chunk in journal.records}
