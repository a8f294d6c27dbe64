"""What the emulator and the size table need of an ELF image: its loaded segments."""

import struct
from dataclasses import dataclass
from pathlib import Path

from wavequake.errors import UserError


@dataclass(frozen=True)
class Segment:
    """A piece of an image.

    Attributes
    ----------
    address : int
        Where it is stored: flash.
    data : bytes
    """

    address: int
    data: bytes


def segments_of(path: Path) -> tuple[Segment, ...]:
    """Return what of a 32-bit little-endian ELF file is stored in flash.

    Raises
    ------
    UserError
        If the file is no such ELF image.
    """
    data = path.read_bytes()
    if data[:6] != b"\x7fELF\x01\x01":
        raise UserError(f"{path} is no 32-bit little-endian ELF image.")
    try:
        (table,) = struct.unpack_from("<I", data, 28)
        size, count = struct.unpack_from("<HH", data, 42)
        headers = [struct.unpack_from("<8I", data, table + k * size) for k in range(count)]
    except struct.error:
        raise UserError(f"{path} is cut off; build it again.") from None
    # Type 1: loaded. Fields: type, offset, virtual and physical address, size in the file.
    return tuple(
        Segment(physical, data[offset : offset + stored])
        for kind, offset, _, physical, stored, *_ in headers
        if kind == 1 and stored
    )


def flash_bytes(path: Path) -> int:
    """Return how many bytes of flash an image takes."""
    return sum(len(segment.data) for segment in segments_of(path))
