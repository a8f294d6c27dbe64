"""A linker for PoCL, whose last step in building a kernel is to call ``ld`` as a compiler would.

A machine without a compiler has no ``ld``, or has it without the libraries that come with a compiler, and
PoCL then aborts the whole process. Kernels call nothing but what is loaded in the process already, so that
any linker will do if the libraries are left out: that of the machine, or the one in the ``ziglang`` wheel.
"""

import hashlib
import os
import shlex
import shutil
import sys
from importlib.util import find_spec
from pathlib import Path

from platformdirs import user_cache_path

from wavequake.errors import UserError

_SCRIPT = """#!/bin/sh
# Links PoCL's kernels; the libraries of a compiler are not needed, and this machine may not have them.
for argument; do
  shift
  case "$argument" in
    -lgcc | -lgcc_s | -lc | -lm) ;;
    *) set -- "$@" "$argument" ;;
  esac
done
exec {linker} "$@"
"""


def ensure_linker() -> None:
    """Put a linker that works for PoCL on this process's PATH, unless the machine can link by itself.

    Raises
    ------
    UserError
        If there is no linker at all.
    """
    home = user_cache_path("wavequake") / "linker"
    path = os.environ.get("PATH", "").split(os.pathsep)
    if machine_can_link() or any(Path(entry).parent == home for entry in path):
        return
    linker = find_linker()
    if not linker:
        raise UserError(
            "PoCL needs a linker, which this machine lacks: `pip install ziglang` brings one (or install "
            "gcc), or run without OpenCL with `campaign.device=numpy`"
        )
    os.environ["PATH"] = os.pathsep.join([str(wrapped(linker, home)), *path])


def machine_can_link() -> bool:
    """Return whether there is an ``ld`` and what a compiler links everything with."""
    roots = [Path("/usr/lib/gcc"), Path("/usr/lib64/gcc")]
    libraries = [Path("/usr/lib/x86_64-linux-gnu"), Path("/usr/lib64"), Path("/usr/lib")]
    return (
        shutil.which("ld") is not None
        and any(file for root in roots for file in root.glob("*/*/libgcc.a"))
        and any((folder / "libc.so").exists() for folder in libraries)
    )


def find_linker() -> list[str]:
    """Return the command of a linker, of the machine or of the ``ziglang`` wheel; empty if there is none."""
    for name in ("ld", "ld.lld", "ld.bfd", "ld.gold"):
        found = shutil.which(name)
        if found:
            return [found]
    return [sys.executable, "-m", "ziglang", "ld.lld"] if find_spec("ziglang") else []


def wrapped(linker: list[str], folder: Path) -> Path:
    """Write a program ``ld`` that calls `linker` without a compiler's libraries; return its folder.

    Other processes may do the same at the same time: the program appears whole.
    """
    folder = folder / hashlib.blake2b(shlex.join(linker).encode(), digest_size=6).hexdigest()
    folder.mkdir(parents=True, exist_ok=True)
    partial = folder / f"ld.{os.getpid()}"
    partial.write_text(_SCRIPT.format(linker=shlex.join(linker)))
    partial.chmod(0o755)
    partial.replace(folder / "ld")
    return folder
