"""Rewrite kernels for PoCL, so that it compiles them once and with all that the processor can do.

PoCL compiles a kernel three times over, for different ways to launch it, and only with the instructions of
the newest processor that its LLVM knows: 256-bit vectors and 16 registers on AMD's Zen 4, which has 32 with
512 bits. A function that a kernel calls is compiled once, and may state what instructions it needs; it must
not ask for the work-item's number, else PoCL makes it a part of the kernel again.
"""

import re
from functools import lru_cache
from pathlib import Path

# What LLVM calls the instructions that all processors with AVX-512 have but the first, and Linux's names.
_WIDE = ("avx512f", "avx512cd", "avx512bw", "avx512dq", "avx512vl")
# In the order of instructions that LLVM prefers for that processor traces take 2 % less time on Zen 4 than in
# the order for Zen 3 or for the first processors with AVX-512.
_ORDER = "tune=haswell"
_KERNEL = re.compile(r"^__kernel void (\w+)\((.*?)\)\n\{\n(.*?)^\}$", re.DOTALL | re.MULTILINE)
_LOCAL_ARRAY = re.compile(r"^ *__local (\w+) (\w+)\[.+\];.*\n", re.MULTILINE)


@lru_cache(maxsize=1)
def has_wide_vectors(cpuinfo: Path = Path("/proc/cpuinfo")) -> bool:
    """Return whether this machine's processors calculate with 512-bit vectors, as Linux tells."""
    try:
        text = cpuinfo.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return False
    flags = re.search(r"^flags\s*:(.*)$", text, re.MULTILINE)
    return flags is not None and set(_WIDE) <= set(flags[1].split())


def for_pocl(text: str, wide: bool) -> str:
    """Return a program in which every kernel only calls a function, that does its work.

    Parameters
    ----------
    text : str
        A program whose kernels end with a brace at the start of a line, and whose parameters have a line's
        preprocessor directives to themselves.
    wide : bool
        Whether to compile for 512-bit vectors.
    """
    text = _KERNEL.sub(_separated, text)
    if not wide:
        return text
    attribute = f'__attribute__((target("{",".join([*_WIDE, _ORDER])}")))'
    begin = f"#pragma clang attribute push({attribute}, apply_to = function)"
    return f"{begin}\n{text}\n#pragma clang attribute pop\n"


def _separated(kernel: re.Match[str]) -> str:
    name, parameters, body = kernel.groups()
    arrays = list(_LOCAL_ARRAY.finditer(body))
    body = _LOCAL_ARRAY.sub("", body)
    for dimension in range(3):
        body = body.replace(f"get_global_id({dimension})", f"global_id_{dimension}")
    more = [f"__local {array[1]} *{array[2]}" for array in arrays]
    more += [f"const size_t global_id_{dimension}" for dimension in range(3)]
    given = [array[2] for array in arrays] + [f"get_global_id({dimension})" for dimension in range(3)]
    declared = "".join(array[0] for array in arrays)
    return (
        f"__attribute__((noinline)) void {name}_work({parameters},\n{', '.join(more)})\n{{\n{body}}}\n"
        f"__kernel void {name}({parameters})\n{{\n"
        f"{declared}    {name}_work({_names(parameters)},\n{', '.join(given)});\n}}"
    )


def _names(parameters: str) -> str:
    """Return the names of parameters, each line of the preprocessor in its place."""
    lines = []
    for line in parameters.splitlines():
        directive = line.startswith("#")
        lines.append(line if directive else re.sub(r"[^,]*?(\w+)\s*(?=,|$)", r" \1", line))
    return "\n".join(lines)
