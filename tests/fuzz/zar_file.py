"""Archives of lens files as OpticStudio writes them, for tests: packed by the book."""


def packed(data: bytes) -> bytes:
    """Lempel, Ziv and Welch: codes of 9 bits and more, the highest bit first."""
    table = {bytes([value]): value for value in range(256)}
    codes, word = [], b""
    for value in data:
        longer = word + bytes([value])
        if longer in table:
            word = longer
            continue
        codes.append(table[word])
        table[longer] = len(table)
        word = bytes([value])
    codes += [table[word]] if word else []
    # Before the code number k a reader's table has 254 + k entries.
    widths = (max(9, (254 + k).bit_length()) for k in range(2, len(codes) + 2))
    bits = "".join(format(code, f"0{width}b") for code, width in zip(codes, [9, *widths], strict=False))
    bits += "0" * (-len(bits) % 8)
    return int(bits, 2).to_bytes(len(bits) // 8, "big") if bits else b""


def entry(name: str, data: bytes, recent: bool = True, size: int | None = None) -> bytes:
    """One entry; `size` is what the header says of the length when unpacked."""
    body = packed(data) if name.endswith(".LZW") else data
    if not recent:
        head = b"\xea\x03" + bytes(6) + bytes([1, 0, 0, 0]) + len(body).to_bytes(4, "little") + bytes(16)
        return (head + name.encode()).ljust(0x14C, b"\0") + body
    head = b"\xec\x03" + bytes(6) + bytes([1]) + bytes(7) + len(body).to_bytes(8, "little")
    head += (len(data) if size is None else size).to_bytes(8, "little") + bytes(16)
    return (head + name.encode("utf-16-le")).ljust(0x288, b"\0") + body


def archive(lens: bytes, recent: bool = True) -> bytes:
    """A lens beside its glasses and a picture."""
    others = entry("A.AGF.LZW", b"CC a catalogue\n", recent), entry("A.BMP", bytes(40), recent)
    return others[0] + entry("LENS.ZMX.LZW", lens, recent) + others[1]
