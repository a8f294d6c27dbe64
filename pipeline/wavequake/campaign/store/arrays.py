"""The zarr arrays of a store: how they are laid out, and the one way in which numbers enter them.

Every array of numbers per case is cut along ``case`` into pieces of K cases, one file each. Reading a file
that is missing or empty gives fill values without any error, so that only the journal can say what was
written. In object storage they are read through fsspec; what is written there is encoded first, and then put
by :mod:`wavequake.campaign.store.objects`.
"""

import asyncio
import atexit
import os
import uuid
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import lru_cache
from math import prod
from pathlib import Path
from typing import Any, cast

import google_crc32c
import numpy as np
import zarr
from numpy.typing import NDArray
from zarr.abc.codec import BytesBytesCodec
from zarr.codecs import Crc32cCodec, ZstdCodec
from zarr.core.buffer import Buffer, default_buffer_prototype
from zarr.core.sync import sync
from zarr.errors import ZarrUserWarning
from zarr.storage import FsspecStore, LocalStore, MemoryStore

from wavequake.campaign.contract import ChunkResult, Variable
from wavequake.campaign.store.journal import Chunk, digest, flush
from wavequake.campaign.store.objects import ObjectPath, file_system, location, write
from wavequake.errors import StoreDamageError

Array = zarr.Array[Any]

_LABELS_PER_FILE = 65536  # cases per file of the coordinates, which the driver alone writes
_EVEN = (ZstdCodec(level=1),)  # labels count on or repeat, and fill a file of a small store with nothing
_PLAIN_BYTES, _INNER_BYTES = 2**24, 2**20  # a larger piece is a shard of inner chunks of about this size


class DurableStore(LocalStore):
    """A zarr store whose files survive a loss of power once `set` has returned."""

    async def set(self, key: str, value: Buffer) -> None:
        """Write a file atomically and durably."""
        self._check_writable()
        # In threads: a disk flushes many files in little more than the time of one.
        await asyncio.to_thread(_put, self.root / key, [memoryview(value.as_buffer_like()).cast("B")])


def _put(path: Path, parts: Iterable[bytes | memoryview]) -> None:
    """Write a file that gets its name when it is whole and on the disk."""
    path.parent.mkdir(exist_ok=True)  # not its parents: a store that was moved leaves nothing where it was
    partial = path.with_name(f"{path.name}.{uuid.uuid4().hex}.partial")
    try:
        with partial.open("wb", buffering=0) as file:
            for part in parts:
                content = memoryview(part)
                while content:
                    content = content[file.write(content) :]
            os.fsync(file.fileno())
        partial.replace(path)
    except OSError:
        partial.unlink(missing_ok=True)
        raise
    flush(path.parent)


@contextmanager
def damage_explained(what: object) -> Iterator[None]:
    """Turn the errors of reading broken zarr metadata or data into StoreDamageError."""
    try:
        yield
    except (FileNotFoundError, ValueError, KeyError, TypeError, RuntimeError) as error:
        raise StoreDamageError(f"{what} is missing or damaged: {error}.") from None


@contextmanager
def missing_reads_as_fill() -> Iterator[None]:
    """Have arrays that are opened meanwhile give fill values for files that are missing.

    Those are cases to do, and the journal says which; users may have told newer versions of zarr to raise.
    """
    with zarr.config.set({"array.read_missing_chunks": True}):
        yield


def zarr_store(folder: Path, *, read_only: bool = False) -> FsspecStore | DurableStore:
    """Return zarr's store of a folder; of objects one that reads."""
    if isinstance(folder, ObjectPath):
        return FsspecStore(_reader(), True, f"{folder.bucket}/{folder.key}")
    return DurableStore(folder, read_only=read_only)


@lru_cache(maxsize=1)
def _reader() -> Any:
    found = file_system(asynchronous=True)

    def close() -> None:
        if client := getattr(found, "_s3creator", None):
            with suppress(Exception):
                sync(client.__aexit__(None, None, None), timeout=1.0)

    atexit.register(close)  # or connections that are open at the end are complained of
    return found


def create_group(folder: Path, attributes: dict[str, Any]) -> zarr.Group:
    """Create the group that holds the arrays of a store."""
    folder.mkdir(parents=True, exist_ok=True)
    return zarr.create_group(DurableStore(folder), zarr_format=3, attributes=attributes)


def open_group(folder: Path, *, read_only: bool = False) -> zarr.Group:
    """Open the arrays of a store; raises StoreDamageError if their metadata is damaged."""
    with damage_explained(folder):
        store = zarr_store(folder, read_only=read_only)
        mode: Any = "r" if store.read_only else "r+"
        return zarr.open_group(store, mode=mode, zarr_format=3, use_consolidated=False)


def consolidate(folder: Path) -> None:
    """Copy the metadata of all arrays to where plain `xarray.open_zarr` looks; we read the originals."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ZarrUserWarning)  # that other zarr libraries may not know of it
        zarr.consolidate_metadata(DurableStore(folder), zarr_format=3)


def array_of(group: zarr.Group, name: str) -> Array:
    """Return an array of a store; raises StoreDamageError if its metadata is missing or damaged."""
    with damage_explained(f"the metadata of the array {name!r}"), missing_reads_as_fill():
        array = cast(Array, group[name])
    # A file per chunk even if all of its cases failed: a missing one is a loss. (Metadata do not hold this.)
    return array.with_config({"write_empty_chunks": array.dtype.kind not in "OUT"})


def create_per_case(group: zarr.Group, name: str, variable: Variable, cases: int, chunk: int) -> None:
    """Create an array with a row per case, of which `chunk` share a file."""
    text = variable.dtype == "str"
    row_bytes = prod(variable.shape) * (8 if text else np.dtype(variable.dtype).itemsize)
    inner = chunk
    if chunk * row_bytes > _PLAIN_BYTES:
        fitting = [n for n in range(1, chunk + 1) if chunk % n == 0 and n * row_bytes <= _INNER_BYTES]
        inner = max(fitting, default=1)
    group.create_array(
        name,
        shape=(cases, *variable.shape),
        shards=(chunk, *variable.shape) if inner < chunk else None,
        chunks=(inner, *variable.shape),
        dimension_names=("case", *variable.dims),
        # Messages are rare: a chunk without any has no file.
        config={"write_empty_chunks": not text},
        attributes=dict(variable.attrs),
        **_encoding(variable.dtype),
    )


def create_fixed(
    group: zarr.Group, name: str, dims: tuple[str, ...], values: NDArray[Any], attrs: Mapping[str, str]
) -> None:
    """Write an array that does not depend on the case, or the labels of the cases, which may grow later."""
    text = values.dtype.kind in "OUT"
    array = group.create_array(
        name,
        shape=values.shape,
        chunks=(_LABELS_PER_FILE,) if dims == ("case",) else tuple(max(1, size) for size in values.shape),
        dimension_names=dims,
        config={"write_empty_chunks": True},
        attributes=dict(attrs),
        **_encoding("str" if text else str(values.dtype), _EVEN),
    )
    array[...] = values.astype(object) if text else values


def _encoding(dtype: str, compression: tuple[BytesBytesCodec, ...] = ()) -> dict[str, Any]:
    """Return type, fill and codecs: a checksum, but no compression of numbers, as noise does not repay it."""
    fill: Any = "" if dtype == "str" else np.nan if np.dtype(dtype).kind in "fc" else 0
    return {
        "dtype": str if dtype == "str" else dtype,
        "fill_value": fill,
        "compressors": (*compression, Crc32cCodec()),
        "chunk_key_encoding": {"name": "default", "separator": "."},  # all files of an array in one folder
    }


def chunk_file(folder: Path, array: Array, first: int) -> Path:
    """Return the file of an array, in the zarr folder, that holds the cases from `first`."""
    size = (array.shards or array.chunks)[0]
    return folder / array.basename / ".".join(["c", str(first // size), *["0"] * (array.ndim - 1)])


def write_chunk(
    arrays: Mapping[str, Array],
    chunk: Chunk,
    result: ChunkResult,
    allowed: Callable[[], None] = lambda: None,
    seen: Mapping[ObjectPath, str | None] | None = None,
) -> dict[str, str]:
    """Write the numbers of one chunk, each array in one file and the status last; return their digests.

    The arrays are written at the same time: one after the other, most of the time would go to waiting.

    Only a whole piece may be written: two writers of one file would lose each other's cases without any
    error. In object storage, `allowed` is asked before arrays are written over what was there before,
    of which `seen` are the versions.
    """
    first, last = chunk
    values = _values(result)
    for name, array in arrays.items():
        size = (array.shards or array.chunks)[0]
        if first % size or last != min(first + size, array.shape[0]):
            raise AssertionError(
                f"cases {first} to {last} are not one piece of {name!r} ({array.shape[0]} cases, K = {size})"
            )

    async def write_files(names: Iterable[str]) -> None:
        ends = await asyncio.gather(
            *(_write(arrays[name], first, last, values[name]) for name in names),
            return_exceptions=True,  # none is under way any more when this returns
        )
        for error in filter(None, ends):
            raise error

    for names in (arrays.keys() - {"status"}, arrays.keys() & {"status"}):
        if isinstance(next(iter(arrays.values())).store, DurableStore):
            sync(write_files(names))
        else:
            chosen = {name: arrays[name] for name in sorted(names)}
            files = {_object(one, first): _encoded(one, chunk, values[name]) for name, one in chosen.items()}
            write(files, allowed, seen)
    return {name: digest(values[name]) for name in arrays}


def digests_of(result: ChunkResult) -> dict[str, str]:
    """Return the digests that :func:`write_chunk` would return."""
    return {name: digest(values) for name, values in _values(result).items()}


def _values(result: ChunkResult) -> dict[str, NDArray[Any]]:
    messages = np.array(result.messages, dtype=object)
    return {**result.arrays, "message": messages, "status": result.status}


async def _write(array: Array, first: int, last: int, values: NDArray[Any]) -> None:
    """Write whole cases; a whole piece without zarr, whose many small steps take longer than the disk."""
    if not _is_plain(array, last - first):
        await array.async_array.setitem(slice(first, last), values)
        return
    folder = cast(DurableStore, array.store).root
    await asyncio.to_thread(_put, chunk_file(folder, array, first), _plain_parts(array, values))


def _is_plain(array: Array, cases: int) -> bool:
    plain = (array.shards, array.filters, array.compressors) == (None, (), (Crc32cCodec(),))
    return plain and array.dtype.kind not in "OUT" and cases == array.chunks[0]


def _plain_parts(array: Array, values: NDArray[Any]) -> list[bytes | memoryview]:
    content = np.ascontiguousarray(values, dtype=array.dtype.newbyteorder("<")).reshape(-1).view(np.uint8)
    return [content.data, google_crc32c.value(content).to_bytes(4, "little")]


def _object(array: Array, first: int) -> ObjectPath:
    folder = location(f"s3://{cast(FsspecStore, array.store).path}")
    return cast(ObjectPath, chunk_file(folder, array, first))


def _encoded(array: Array, chunk: Chunk, values: NDArray[Any]) -> bytes:
    """Return the bytes of the file that holds whole cases, also of messages that are all empty.

    Nothing is deleted in object storage, so what an earlier run said of these cases is written over.
    """
    first, last = chunk
    if _is_plain(array, last - first):
        return b"".join(_plain_parts(array, values))
    written = dict(array.metadata.to_buffer_dict(default_buffer_prototype()))
    copy = zarr.open_array(MemoryStore(written), mode="r+", zarr_format=3)
    copy.with_config({"write_empty_chunks": True})[first:last] = values
    (content,) = (buffer.to_bytes() for key, buffer in written.items() if key != "zarr.json")
    return content
