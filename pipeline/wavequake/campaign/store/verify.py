"""Check a store against its journal: read every array of every finished chunk and compare its digest."""

import os
from collections.abc import Collection
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import zarr

from wavequake.campaign.store.arrays import Array, chunk_file, zarr_store
from wavequake.campaign.store.engine_variables import MESSAGE
from wavequake.campaign.store.journal import Chunk, Journal, Record, digest, read_journal
from wavequake.campaign.store.layout import lost_layout
from wavequake.campaign.store.objects import ObjectPath, location, presence
from wavequake.campaign.store.store import DATA, JOURNAL, Manifest, done_records, read_manifest
from wavequake.words import counted

_LARGEST = 2**36  # bytes of labels and other arrays that are read whole


@dataclass(frozen=True)
class Damage:
    """A file whose numbers, of an array in cases first <= id < last, are not those that were written."""

    array: str
    first: int
    last: int
    reason: str
    file: Path

    def __str__(self) -> str:
        return f"{self.array}, cases {self.first} to {self.last - 1} ({self.file}): {self.reason}"


@dataclass(frozen=True, repr=False)
class VerifyReport:
    """What a check found.

    ``checked`` chunks were read; ``missing`` ones are not done yet; ``damaged`` names arrays whose numbers
    changed since they were written; ``layout`` says what is wrong with metadata and labels, which a repair
    writes anew; ``extra`` names files that belong to no array (harmless leftovers of a crash);
    ``unchecked`` names arrays that nothing describes any more, so that their numbers could not be read.
    """

    path: Path
    checked: int
    missing: tuple[Chunk, ...]
    damaged: tuple[Damage, ...]
    extra: tuple[str, ...]
    torn: int
    layout: tuple[str, ...] = ()
    unchecked: tuple[str, ...] = ()

    def __repr__(self) -> str:
        return "\n".join(self.lines())

    @property
    def ok(self) -> bool:
        """Whether every case is there, as it was written."""
        return not (self.missing or self.damaged or self.layout)

    @property
    def chunks(self) -> frozenset[Chunk]:
        """The chunks to compute again."""
        return frozenset((damage.first, damage.last) for damage in self.damaged)

    def lines(self, most: int = 20) -> list[str]:
        """Return the report in words; at most `most` damages are listed."""
        lines = [
            f"{self.path}: {counted(self.checked, 'chunk')} read, {len(self.chunks)} damaged, "
            f"{len(self.missing)} to do"
        ]
        lines += [f"damaged {what}" for what in self.layout]
        lines += [f"damaged {damage}" for damage in self.damaged[:most]]
        if len(self.damaged) > most:
            lines.append(f"... and {len(self.damaged) - most} more")
        if self.unchecked:
            lines.append(f"not checked, as their metadata is lost: {', '.join(self.unchecked)}")
        if self.torn:
            lines.append(f"{counted(self.torn, 'record')} of the journal cut off by a crash (harmless)")
        if self.extra:
            lines.append(
                f"{counted(len(self.extra), 'leftover file')} of a crash (harmless), for example "
                f"{self.extra[0]}"
            )
        if self.damaged or self.layout:
            lines.append("To repair the store, run the study again with --repair.")
        elif self.missing:
            lines.append("Run the study again to complete the store.")
        else:
            lines.append("The store is complete and intact.")
        return lines


def verify_store(path: Path | str) -> VerifyReport:
    """Read every stored number and compare it with the journal.

    Raises
    ------
    UserError
        If there is no store at `path`.
    StoreDamageError
        If its manifest is damaged, or its journal contradicts itself.
    """
    path = location(path)
    return examined(path, read_manifest(path), read_journal(path / JOURNAL))


def examined(path: Path, manifest: Manifest, journal: Journal) -> VerifyReport:
    """Read every number that a journal says is stored, and compare it."""
    records = done_records(manifest, journal)
    data, lost = path / DATA, lost_layout(path, manifest)
    layout = [f"{file}: it is missing, empty or changed" for file in lost]
    arrays, there = _opened(data, manifest.variables), presence(data)
    others = {folder.name for folder in data.glob("*/")} - {*manifest.variables}
    labels = sorted(others - {file.parent.name for file in lost})
    damaged = [
        Damage(name, *record.chunk, reason, chunk_file(data, array, record.first))
        for record in records.values()
        for name, array in arrays.items()
        if (reason := _damage(array, record, there(chunk_file(data, array, record.first))))
    ]
    layout += [
        f"{data / name}: {reason}"
        for name, array in _opened(data, labels).items()
        if (reason := _unreadable(array))
    ]
    unchecked = tuple(name for name in manifest.variables if name not in arrays)
    missing = tuple(chunk for chunk in manifest.plan() if chunk not in records)
    partial = () if isinstance(data, ObjectPath) else data.rglob("*.partial")  # objects are whole
    extra = tuple(sorted(str(file.relative_to(path)) for file in partial))
    checked = len(records) if arrays else 0
    torn = journal.torn
    return VerifyReport(path, checked, missing, tuple(damaged), extra, torn, tuple(layout), unchecked)


def _opened(data: Path, names: Collection[str]) -> dict[str, Array]:
    """Open arrays by the copy of their metadata at the root, or else by their own; without both, no array."""
    store, found = zarr_store(data, read_only=True), {}
    for name in names:
        with suppress(Exception):  # zarr raises what its parsers raise
            found[name] = zarr.open_array(store, path=name, mode="r", zarr_format=3)
    with suppress(Exception):
        group = zarr.open_group(store, mode="r", zarr_format=3, use_consolidated=True)
        found |= {name: array for name, array in group.arrays() if name in {*names}}
    return found


def _damage(array: Array, record: Record, there: bool) -> str:
    """Return what is wrong with a chunk of an array, "" if nothing; `there`: whether its file is."""
    name = array.basename
    if name not in record.digests:
        return "the journal has no digest of it"
    if not there and (name != MESSAGE or record.has_messages):
        return "the file is missing or empty"
    try:
        stored = digest(np.asarray(array[record.first : record.last]))
    except Exception as error:  # zarr raises what its codecs raise
        return f"the file {_in_words(error)}"
    return "" if stored == record.digests[name] else "the numbers are not those that were written"


def _unreadable(array: Array) -> str:
    if array.nbytes > _LARGEST:
        return f"it says that it has {array.nbytes:.0e} bytes"
    try:
        array[...]
    except Exception as error:
        return f"its file {_in_words(error)}"
    return ""


def _in_words(error: Exception) -> str:
    """Say what an error in reading a file means for its bytes, whatever codec raised it."""
    if isinstance(error, OSError) and error.errno:
        return f"cannot be read ({os.strerror(error.errno).lower()})"
    if "checksum" in str(error).lower():
        return "has changed since it was written: its checksum does not fit"
    return "was cut off or overwritten: its bytes are no array"
