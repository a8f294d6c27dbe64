"""Damage files, as transfers, editors and enemies do; the same seed gives the same damage."""

import io
import zipfile
from random import Random

WORDS = [
    b"1e-320", b"1e400", b"-1e308", b"nan", b"inf", b"-1", b"0", b"-0.0", b"0x10", b"1_000", b"1D+400", b"1e",
    b"9" * 19, b"9" * 5000, b"2147483648", b"-9223372036854775808", b"1000000000000", b"65536", b"1.5", b"",
    b"x", b'"', b"'", b"[" * 2000, b"{" * 300, b"a." * 100_000, b"," * 300, b"\0", b"\xff\xfe",
    "\u202e١²".encode(),
    b"x" * 20_000, b"\n\n", b"*", b"#", b"=", b"\t", b"\x1b[2J", b"../../../../etc/passwd", b"/dev/zero",
]  # fmt: skip
INTEGERS = (0, 1, -1, 2, 127, 255, 2**15, 2**16, 2**31 - 1, -(2**31), 2**40, 2**62, 2**63 - 1, -(2**63))


def damaged(data: bytes, random: Random) -> bytes:
    """Return `data` with one to four kinds of damage; inside of zip archives also in what they pack."""
    if data.startswith(b"PK\x03\x04") and random.random() < 0.8:
        return _repacked(data, random)
    for _ in range(random.choice((1, 1, 1, 2, 4))):
        data = random.choice(_KINDS)(data, random)
    return data


def _repacked(data: bytes, random: Random) -> bytes:
    with zipfile.ZipFile(io.BytesIO(data)) as packed:
        members = {name: packed.read(name) for name in packed.namelist()}
    chosen = random.choice(list(members))
    action = random.randrange(6)
    if action == 0:
        del members[chosen]
    elif action == 1:
        members[random.choice(("../x.npy", "x", "a" * 300 + ".npy"))] = members.pop(chosen)
    elif action == 2:
        members[chosen] = members[random.choice(list(members))]
    else:
        members[chosen] = damaged(members[chosen], random)
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", random.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))) as packed:
        for name, content in members.items():
            packed.writestr(name, content)
    return out.getvalue()


def _place(data: bytes, random: Random) -> tuple[int, int]:
    start = random.randrange(len(data) + 1)
    return start, min(len(data), start + random.choice((1, 2, 4, 8, 30, 200)))


def _flip(data: bytes, random: Random) -> bytes:
    changed = bytearray(data)
    for _ in range(random.choice((1, 1, 3, 10))):
        if changed:
            changed[random.randrange(len(changed))] = random.randrange(256)
    return bytes(changed)


def _cut(data: bytes, random: Random) -> bytes:
    return data[: random.randrange(len(data) + 1)]


def _remove(data: bytes, random: Random) -> bytes:
    start, stop = _place(data, random)
    return data[:start] + data[stop:]


def _repeat(data: bytes, random: Random) -> bytes:
    start, stop = _place(data, random)
    return data[:start] + data[start:stop] * random.choice((2, 3, 50)) + data[stop:]


def _zero(data: bytes, random: Random) -> bytes:
    start, stop = _place(data, random)
    return data[:start] + bytes(stop - start) + data[stop:]


def _insert(data: bytes, random: Random) -> bytes:
    start, _ = _place(data, random)
    return data[:start] + random.choice(WORDS) + data[start:]


def _integer(data: bytes, random: Random) -> bytes:
    """Replace 2, 4 or 8 bytes by a whole number that somebody may have forgotten."""
    size = random.choice((2, 4, 8))
    value = random.choice(INTEGERS) % 2 ** (8 * size)
    start = random.randrange(max(len(data) - size, 0) + 1)
    return data[:start] + value.to_bytes(size, random.choice(("little", "big"))) + data[start + size :]


def _word(data: bytes, random: Random) -> bytes:
    """Replace one word of a text, which are between blanks and punctuation."""
    places = [index for index, byte in enumerate(data[:100_000]) if byte in b" ,=\n\t[]\"'<>:;"]
    if len(places) < 2:
        return _insert(data, random)
    index = random.randrange(len(places) - 1)
    return data[: places[index] + 1] + random.choice(WORDS) + data[places[index + 1] :]


def _lines(data: bytes, random: Random) -> bytes:
    lines = data.split(b"\n")
    one, other = random.randrange(len(lines)), random.randrange(len(lines))
    action = random.randrange(4)
    if action == 0:
        del lines[one]
    elif action == 1:
        lines.insert(one, lines[other])
    elif action == 2:
        lines[one], lines[other] = lines[other], lines[one]
    else:
        lines[one] = b""
    return b"\n".join(lines)


_KINDS = (_flip, _cut, _remove, _repeat, _zero, _insert, _integer, _word, _word, _word, _lines, _lines)
