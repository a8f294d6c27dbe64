"""Open files of users: regular ones only, of bounded size, also of what is packed in them.

A file may come from somebody else, or be none: a device has no end, a pipe has no beginning, an archive of a
kilobyte may announce terabytes. What a file announces is checked before memory is taken for it, and whatever
is wrong is one sentence.
"""

import io
import math
import os
import re
import stat
import tomllib
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from wavequake.errors import UserError

if TYPE_CHECKING:
    from numpy.typing import NDArray

Arrays: TypeAlias = "dict[str, NDArray[Any]]"

LIMIT = "WAVEQUAKE_MOST_MB"
"""Environment variable: the most MB (1e6 bytes) of a file, and of what an archive expands to."""
MOST_MB = 2000.0
MOST_ARRAYS = 10_000
_NUMBERS = "biufc"
_DEEPEST = 40  # tables and lists of a study file within each other
_AT_ONCE = 1 << 24  # bytes of an array
_STUDY_MB = 64.0
# A key of more parts than any study has: reading one of 100,000 takes minutes.
_MOST_PARTS = 40
_LONG_KEY = re.compile(
    rf"""(?:^|[\[{{,])[ \t]*+(?:(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')[ \t]*+\.[ \t]*+){{{_MOST_PARTS}}}""",
    re.MULTILINE,
)


def most_bytes() -> float:
    """Return the most bytes of a file, and of what an archive expands to.

    Raises
    ------
    UserError
        If the environment variable WAVEQUAKE_MOST_MB is no positive number.
    """
    text = os.environ.get(LIMIT, "")
    try:
        most = float(text or MOST_MB)
    except ValueError:
        most = math.nan
    if not most > 0.0:
        raise UserError(f"The environment variable {LIMIT} is {text!r}; it must be a positive number of MB.")
    return 1e6 * most


def read_bytes(path: str | Path) -> bytes:
    """Return the bytes of a regular file.

    Raises
    ------
    UserError
        If it cannot be read, is a folder, device or pipe, or is larger than `most_bytes`.
    """
    try:
        with _opened(Path(path)) as file:
            size = os.fstat(file.fileno()).st_size
            _require_size(path, size)
            data = file.read(size + 1)  # takes the memory of as much as it may read
    except (OSError, ValueError) as error:  # a zero byte in a path
        raise UserError(f"{path} cannot be read ({getattr(error, 'strerror', None) or error}).") from None
    _require_size(path, len(data))
    return data


def read_text(path: str | Path) -> str:
    """Return the text of a regular file in UTF-8, with or without a mark of byte order.

    Raises
    ------
    UserError
        As `read_bytes`, and if it is not UTF-8.
    """
    try:
        return io.TextIOWrapper(io.BytesIO(read_bytes(path)), encoding="utf-8-sig").read()
    except UnicodeDecodeError as error:
        raise UserError(f"{path} is no text in UTF-8 ({error.reason} at byte {error.start}).") from None


def require_file(path: str | Path) -> None:
    """Raise as `read_bytes` does, for files that a library opens itself."""
    try:
        with _opened(Path(path)) as file:
            size = os.fstat(file.fileno()).st_size
    except (OSError, ValueError) as error:
        raise UserError(f"{path} cannot be read ({getattr(error, 'strerror', None) or error}).") from None
    _require_size(path, size)


def _require_size(path: str | Path, size: int) -> None:
    if size > most_bytes():
        raise UserError(
            f"{path} is larger than {most_bytes() / 1e6:g} MB; set the environment variable {LIMIT} to allow "
            "more."
        )


@contextmanager
def _opened(path: Path) -> Iterator[io.FileIO]:
    handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)  # a pipe would wait for a writer
    with io.FileIO(handle) as file:
        kind = os.fstat(handle).st_mode
        if not stat.S_ISREG(kind):
            raise OSError(None, "a folder" if stat.S_ISDIR(kind) else "it is no regular file")
        yield file


def read_toml(text: str) -> dict[str, Any]:
    """Return the tables of a TOML text.

    Raises
    ------
    UserError
        If it is none, is too large, or is nested deeper or has longer keys or numbers than any study; says
        what, without the file's name.
    """
    if len(text) > 1e6 * _STUDY_MB:
        raise UserError(f"it has {len(text) / 1e6:.0f} MB, {_STUDY_MB:g} MB are possible")
    long = _LONG_KEY.search(text)
    if long:
        line = text.count("\n", 0, long.start()) + 1
        raise UserError(f"line {line}: a key has more than {_MOST_PARTS} parts between dots")
    try:
        record = tomllib.loads(text)
    except RecursionError:
        raise UserError("brackets are nested too deeply") from None
    except ValueError as error:  # tomllib's own, and integers of thousands of digits
        raise UserError(str(error).partition(";")[0]) from None
    _require_shallow(record)
    return record


def _require_shallow(record: dict[str, Any]) -> None:
    layer: list[Any] = [record]
    for _ in range(_DEEPEST):
        inner = [one.values() if isinstance(one, dict) else one for one in layer]
        layer = [one for group in inner for one in group if isinstance(one, dict | list)]
        if not layer:
            return
    raise UserError(f"tables and lists are nested more than {_DEEPEST} deep")


def read_npy(data: bytes) -> "NDArray[Any]":
    """Return the array of numbers or text that an .npy file holds.

    Raises
    ------
    UserError
        If it is no such file, or holds Python objects; says what, without the file's name.
    """
    with _explained("it is no NumPy array"):
        return _array(io.BytesIO(data), len(data))


def read_npz(data: bytes, most: float = math.inf) -> Arrays:
    """Return the arrays of numbers or text in an .npz file, by name.

    Raises
    ------
    UserError
        If it is no such file, an array is of Python objects or not as long as it announces, or all of them
        are larger than `most` or `most_bytes`; says what, without the file's name.
    """
    arrays: Arrays = {}
    with _explained("it is no NumPy .npz file"), zipfile.ZipFile(io.BytesIO(data)) as packed:
        members = packed.infolist()
        _require_modest(len(members), sum(one.file_size for one in members), most)
        for one in members:
            with packed.open(one) as member, _explained(f"{one.filename[:60]!r} is no array"):
                arrays[one.filename.removesuffix(".npy")] = _array(member, one.file_size)
    return arrays


def _require_modest(count: int, size: int, most: float = math.inf) -> None:
    """Raise UserError if an archive announces too many arrays, or too many bytes in all of them."""
    if count > MOST_ARRAYS:
        raise UserError(f"it holds {count} arrays, {MOST_ARRAYS} are possible")
    if size > most:
        raise UserError(f"it expands to {size / 1e6:.3g} MB, {most / 1e6:.3g} MB are possible")
    if size > most_bytes():
        raise UserError(
            f"it expands to {size / 1e6:.3g} MB, {most_bytes() / 1e6:g} MB are possible; set the environment "
            f"variable {LIMIT} to allow more"
        )


def _array(stream: Any, size: int) -> "NDArray[Any]":
    """Read one array from `size` bytes, which must be just what its header announces."""
    import numpy as np  # takes as long to load as a command that computes nothing
    from numpy.lib import format as npy

    version = npy.read_magic(stream)
    header = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}.get(version)
    if header is None:
        raise ValueError(f"version {version[0]}.{version[1]} of the format, which is not for numbers")
    shape, by_columns, dtype = header(stream)
    if dtype.kind not in _NUMBERS + "US":
        raise ValueError(f"it holds {dtype}, not numbers")
    left = size - stream.tell()
    if min(shape, default=1) < 0 or math.prod(shape) * dtype.itemsize != left:
        raise ValueError(f"it announces the shape {shape} of {dtype} and has {left} bytes")
    data, at = bytearray(left), 0
    while chunk := stream.read(min(left - at, _AT_ONCE)):  # all at once would be there twice
        data[at : at + len(chunk)] = chunk
        at += len(chunk)
    del data[at:]
    return np.ndarray(shape, dtype, data if left else None, order="F" if by_columns else "C")


def read_hdf5(path: Path) -> Arrays:
    """Return all arrays of numbers in an HDF5 file, by their paths in it, such as ``group/name``.

    Raises
    ------
    UserError
        If it is no such file, an array lies in another file, or all of them are larger than `most_bytes`;
        says what, without the file's name.
    """
    import h5py  # takes a while to load
    import numpy as np

    found: dict[str, Any] = {}

    def collect(name: str | bytes, item: Any) -> None:
        if isinstance(item, h5py.Dataset):
            if item.shape is not None and item.dtype.kind in _NUMBERS:
                found[name if isinstance(name, str) else name.decode(errors="replace")] = item
            if len(found) > MOST_ARRAYS:
                raise UserError(f"it holds more than {MOST_ARRAYS} arrays")

    require_file(path)
    with _explained("it is no HDF5 file"), h5py.File(path, "r") as file:
        file.visititems(collect)  # follows no links to other files
        for name, item in found.items():
            if item.external or item.is_virtual:
                raise UserError(f"{name!r} lies in another file; write it into this one")
        _require_modest(len(found), sum(math.prod(one.shape) * one.dtype.itemsize for one in found.values()))
        return {name: np.asarray(item[()]) for name, item in found.items()}


@contextmanager
def _explained(what: str) -> Iterator[None]:
    """Turn whatever a library trips over, in a file that may be anything, into a UserError."""
    try:
        yield
    except UserError:
        raise
    except Exception as error:
        words = " ".join(str(error).split())[:200] or type(error).__name__
        raise UserError(f"{what} ({words})") from None
