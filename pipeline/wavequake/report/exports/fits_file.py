"""A dataset as a FITS file of any size, written by blocks of cases."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import xarray as xr
from astropy.io import fits
from numpy.typing import NDArray

from wavequake.campaign.statistics.blocks import blocks, pieces

_BLOCK = 2880  # bytes: everything in FITS begins at a multiple
_TITLES = (("ORIGIN", "title"), ("STUDYID", "study_sha256"), ("CREATED", "created"))


def write_fits(dataset: xr.Dataset, path: Path) -> None:
    """Write a table ``CASES`` of labels and scalars, and an image per array of numbers, which may be large.

    Every header has checksums, without the time at which they were made: equal stores give equal files.
    """
    arrays = {str(name): variable for name, variable in dataset.variables.items()}
    columns = {name: array for name, array in arrays.items() if array.dims == ("case",)}
    first = fits.PrimaryHDU()
    for key, name in _TITLES:
        first.header[key] = _ascii(dataset.attrs.get(name, ""))[:60]
    with path.open("w+b") as file:
        _append(file, first.header, [])
        _append_table(file, columns)
        for name, array in arrays.items():
            if name not in columns and array.dtype.kind in "biuf":
                _append_image(file, name, array)


def _append(file: BinaryIO, header: fits.Header, values: Iterable[NDArray[Any]]) -> None:
    """Append a header and the numbers that it announces, and then put their checksums into it."""
    header["CHECKSUM"], header["DATASUM"] = ("0" * 16, "HDU checksum"), ("0", "data unit checksum")
    place = file.tell()
    file.write(header.tostring().encode("ascii"))
    start = file.tell()
    for part in values:
        file.write(np.ascontiguousarray(part, part.dtype.newbyteorder(">")).data)
    file.write(bytes((start - file.tell()) % _BLOCK))
    end = file.tell()
    file.seek(start)
    total = 0
    while data := file.read(1024 * _BLOCK):
        total = _sum32(data, total)
    header["DATASUM"] = str(total)
    header["CHECKSUM"] = _checksum(_sum32(header.tostring().encode("ascii"), total))
    file.seek(place)
    file.write(header.tostring().encode("ascii"))
    file.seek(end)


def _sum32(data: bytes, total: int) -> int:
    """Add 32-bit integers to a sum in ones' complement: what is carried over comes back at the low end."""
    total += int(np.frombuffer(data, ">u4").sum(dtype=np.uint64))
    while total >> 32:
        total = (total & 0xFFFFFFFF) + (total >> 32)
    return total


def _checksum(total: int) -> str:
    """Return the text that makes the sum of an HDU zero where ``0`` stood (FITS standard 4.0, Appendix J).

    Each byte of the complement is the sum of four letters, which give way in pairs where they would be
    punctuation; the first letters of all bytes stand together, and all are turned by one.
    """
    letters = np.empty((4, 4), np.uint8)
    for column, byte in enumerate((~total & 0xFFFFFFFF).to_bytes(4, "big")):
        four = [48 + byte // 4 + byte % 4, *[48 + byte // 4] * 3]
        for pair in (0, 2):
            while not (chr(four[pair]) + chr(four[pair + 1])).isalnum():
                four[pair], four[pair + 1] = four[pair] + 1, four[pair + 1] - 1
        letters[:, column] = four
    return str(np.roll(letters, 1).tobytes(), "ascii")


def _append_table(file: BinaryIO, columns: dict[str, xr.Variable]) -> None:
    codes = {name: _code(array) for name, array in columns.items()}
    empty = [
        fits.Column(name, codes[name], _ascii(array.attrs.get("units", "")), array=np.empty(0))
        for name, array in columns.items()
    ]
    table = fits.BinTableHDU.from_columns(empty, name="CASES")
    table.header["NAXIS2"] = max((array.size for array in columns.values()), default=0)
    kinds = np.dtype([(name, _KINDS.get(code, f"S{code[:-1]}")) for name, code in codes.items()])

    def rows(cases: slice) -> NDArray[np.uint8]:
        found = np.zeros(cases.stop - cases.start, kinds)
        for name, array in columns.items():
            values = array[cases].to_numpy()
            if codes[name] == "L":
                values = np.where(values, b"T", b"F")
            elif codes[name] not in _KINDS:
                values = np.array([_ascii(text).encode() for text in values.tolist()])
            found[name] = values
        return found.view(np.uint8)

    _append(file, table.header, map(rows, blocks(columns.values())))


_KINDS = {"L": "S1", "D": ">f8", "K": ">i8"}


def _code(array: xr.Variable) -> str:
    """Return the FITS code of a column: truth value, 64-bit number, 64-bit integer, or text of a width."""
    kind = array.dtype.kind
    if kind in "biuf":
        return {"b": "L", "f": "D"}.get(kind, "K")
    return f"{max([1, *(len(_ascii(text)) for _, values in pieces(array) for text in values.tolist())])}A"


def _append_image(file: BinaryIO, name: str, array: xr.Variable) -> None:
    dtype = np.dtype(np.uint8) if array.dtype.kind == "b" else array.dtype
    shape = array.shape or (1,)
    image = fits.ImageHDU(np.zeros((1,) * len(shape), dtype), name=name)
    for number, size in enumerate(reversed(shape), 1):
        image.header[f"NAXIS{number}"] = size
    image.header["BUNIT"] = _ascii(array.attrs.get("units", ""))
    for number, dim in enumerate(reversed(array.dims), 1):  # FITS counts axes from the last
        image.header[f"CTYPE{number}"] = str(dim)
    _append(file, image.header, (_stored(values.astype(dtype)) for _, values in pieces(array)))


def _stored(values: NDArray[Any]) -> NDArray[Any]:
    """Return numbers of a type that FITS has: others are kept less the middle of their range (BZERO)."""
    size, kind = values.dtype.itemsize, values.dtype.kind
    if kind == "f" or (kind == "u") == (size == 1):
        return values
    middle = np.array(1 << (8 * size - 1), f"u{size}")
    return np.asarray((values.view(middle.dtype) ^ middle).view("u1" if size == 1 else f"i{size}"))


def _ascii(text: object) -> str:
    return str(text).encode("ascii", "replace").decode()
