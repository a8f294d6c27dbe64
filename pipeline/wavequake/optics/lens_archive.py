"""The lens file in an archive of OpticStudio (.zar).

The format is documented by the public reader zmxtools (https://github.com/tttom/zmxtools): one entry after
the other, each a header of fixed length and its bytes. The header begins with EC (lengths of 8 bytes from
byte 16, packed and unpacked, a name in UTF-16 from byte 48, 648 bytes in all) or, in older ones, EA (a length
of 4 bytes at byte 12, a name in UTF-8 from byte 32, 332 bytes). An entry whose name ends with .LZW is packed
by the method of Lempel, Ziv and Welch: codes from 9 bits on, highest bit first, a bit longer when the table
is full.
"""

from collections.abc import Iterator

from wavequake.errors import UserError

LENS_FILES = (".zmx", ".zar")
"""What names of lens files end with that are read as Zemax's."""

_RECENT = b"\xec\x03"
_MARKS = (_RECENT, b"\xea\x03", b"\xea\x00")
_LONGEST = 100_000_000  # bytes of a lens file
_MOST_ENTRIES = 10_000


def is_archive(data: bytes) -> bool:
    """Return whether bytes begin as an archive does."""
    return data[:2] in _MARKS


def lens_of_archive(data: bytes, where: str) -> bytes:
    """Return the lens file in an archive; `where` names it in messages.

    Raises
    ------
    UserError
        If it is damaged, or holds no lens file or several, or one of more than 100 MB.
    """
    lenses = [entry for entry in _entries(data, where) if _plain(entry[0]).lower().endswith(".zmx")]
    if len(lenses) != 1:
        names = ", ".join(_plain(name)[:40] for name, _, _ in lenses[:5]) or "none"
        raise UserError(f"The archive {where} needs one lens file (.zmx) in it; it has {names}.")
    name, packed, size = lenses[0]
    if not name.lower().endswith(".lzw"):
        return packed
    if size > _LONGEST:
        raise UserError(f"The archive {where} announces a lens file of {size} bytes; 100 MB are possible.")
    return _unpacked(packed, size, where)


def _plain(name: str) -> str:
    return name[:-4] if name.lower().endswith(".lzw") else name


def _entries(data: bytes, where: str) -> Iterator[tuple[str, bytes, int]]:
    """Yield name, bytes and unpacked size of each entry: the largest possible size where none is told."""
    place = 0
    for number in range(_MOST_ENTRIES):
        head = data[place : place + 2]
        if not head:
            return
        recent = head == _RECENT
        begin = place + (0x288 if recent else 0x14C)
        header = data[place:begin]
        if head not in _MARKS or len(data) < begin:
            raise UserError(
                f"The archive {where} is damaged at byte {place}: no entry begins there; open it in "
                "OpticStudio and save the lens as .zmx."
            )
        size = _LONGEST
        if recent:
            length, size = (int.from_bytes(header[k : k + 8], "little") for k in (0x10, 0x18))
            name = header[0x30:].decode("utf-16-le", errors="replace")
        else:
            length = int.from_bytes(header[0xC:0x10], "little")
            name = header[0x20:].decode("utf-8", errors="replace")
        if length > len(data) - begin:
            raise UserError(
                f"The archive {where} is cut short: entry {number + 1} has {length} bytes, "
                f"{len(data) - begin} are left."
            )
        yield name.partition("\0")[0], data[begin : begin + length], size
        place = begin + length
    raise UserError(f"The archive {where} has more than {_MOST_ENTRIES} entries.")


def _unpacked(packed: bytes, size: int, where: str) -> bytes:
    """Return what was packed, which must have `size` bytes at most."""
    words = [bytes([value]) for value in range(256)]
    found = bytearray()
    width, bits, held, former = 9, 0, 0, b""
    for value in packed:
        held, bits = (held << 8 | value) & 0xFFFFFFFF, bits + 8
        if bits < width:
            continue
        bits -= width
        code = held >> bits & (1 << width) - 1
        if code > len(words) or (code == len(words) and not former):
            raise UserError(f"The archive {where} is damaged: its lens file has a code that means nothing.")
        word = words[code] if code < len(words) else former + former[:1]
        found += word
        if former:
            words.append(former + word[:1])
        former = word
        if len(found) > size:
            raise UserError(f"The archive {where} is damaged: its lens file is longer than it announces.")
        if len(words) >= 1 << width:
            width += 1
        if width > 24:
            raise UserError(f"The archive {where} is damaged: its lens file is no text.")
    return bytes(found)
