"""Tell PoCL a processor that its compiler knows, where the machine's is newer than the compiler.

PoCL's wheel asks its LLVM for the name of the processor. To one that is newer, such as AMD's Zen 5, LLVM says
"generic", a name that its own front end refuses: every program fails with "unknown target CPU 'generic'"
(github.com/pocl/pocl/issues/1049). Neither an option nor an environment variable replaces the name, but PoCL
reads it anew for every program from the record of the device, where another can stand.
"""

import ctypes
import os
import re
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

# What PoCL puts at the end of a device's version where LLVM does not know the processor.
_UNKNOWN = "generic"
_RECORD_BYTES = 2048
_LONGEST_ADDRESS = 1 << 47
# The newest that LLVM 14 knows come first; instructions as Linux names them.
_HASWELL = frozenset(["avx", "avx2", "bmi1", "bmi2", "f16c", "fma", "abm", "movbe"])
_PROCESSORS = (
    (
        "znver3",
        _HASWELL
        | frozenset(["adx", "aes", "clflushopt", "clzero", "pclmulqdq", "rdseed", "sha_ni", "sse4a", "vaes"]),
    ),
    ("x86-64-v3", _HASWELL),
    ("x86-64-v2", frozenset(["cx16", "popcnt", "sse4_1", "sse4_2", "ssse3"])),
    ("x86-64", frozenset[str]()),
)
# PoCL keeps the address of the name; it must live as long as the process.
_names: dict[str, ctypes.Array[ctypes.c_char]] = {}


def known_processor(cpuinfo: Path = Path("/proc/cpuinfo")) -> str:
    """Return the newest processor that PoCL's LLVM knows and all of whose instructions this machine has."""
    try:
        text = cpuinfo.read_text(encoding="utf-8", errors="replace")
    except OSError:
        text = ""
    flags = re.search(r"^flags\s*:(.*)$", text, re.MULTILINE)
    has = set(flags[1].split()) if flags else set()
    return next(name for name, needs in _PROCESSORS if needs <= has)


def name_processor(handle: Any, processor: str | None = None) -> bool:
    """Replace the name "generic" in the record of a PoCL device; return whether it stood there.

    Parameters
    ----------
    handle : pyopencl.Device
        A device of PoCL. Its record is searched for the address of the text "generic" by way of
        ``/proc/self/mem``, which answers with an error where nothing may be read.
    processor : str, optional
        `known_processor` by default.
    """
    if not handle.version.rstrip().endswith(f"-{_UNKNOWN}"):
        return False
    try:
        memory = os.open("/proc/self/mem", os.O_RDONLY)
    except OSError:
        return False
    try:
        places = list(_places(memory, handle.int_ptr))
    finally:
        os.close(memory)
    if len(places) != 1:
        return False
    name = processor or known_processor()
    text = _names.setdefault(name, ctypes.create_string_buffer(name.encode()))
    ctypes.c_void_p.from_address(places[0]).value = ctypes.addressof(text)
    return True


def _places(memory: int, start: int) -> Iterator[int]:
    """Yield where in the record at `start` the address of the text "generic" stands."""
    wanted = f"{_UNKNOWN}\0".encode()
    record = os.pread(memory, _RECORD_BYTES, start)
    for index, (address,) in enumerate(struct.iter_unpack("<Q", record)):
        try:
            if 0 < address < _LONGEST_ADDRESS and os.pread(memory, len(wanted), address) == wanted:
                yield start + 8 * index
        except OSError:  # no address of ours
            continue
