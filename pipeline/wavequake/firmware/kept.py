"""Images for the host, built once and kept on disk by the hash of all that determines them.

Workers of a campaign load what the first of them has built; two that build at once replace each other's file
as a whole. The files lie in the user's cache folder and may be removed at any time.
"""

import hashlib
import os
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

from platformdirs import user_cache_path

from wavequake.errors import UserError
from wavequake.files import folder
from wavequake.firmware.build import BOARDS, COMMON, Image, build, check_hash, compiler_of
from wavequake.firmware.gains import Gains, header


def image_folder() -> Path:
    """Return the folder of kept images."""
    return user_cache_path("wavequake") / "firmware"


@contextmanager
def host_image(gains: Gains, *, keep: bool = True) -> Iterator[Image]:
    """Yield the core as a shared library, built if need be; load it within the block.

    What is not kept is removed after the block, whether loaded or not.

    Raises
    ------
    UserError
        If it must be built and there is no compiler (says which package brings one).
    """
    command = compiler_of(BOARDS["host"])
    kept = image_folder() / _key(gains, command) / "host.so"
    if keep and (found := _sound(Image(BOARDS["host"], gains, kept, command[0]))):
        yield found
        return
    with tempfile.TemporaryDirectory(prefix="wavequake-firmware-") as place:
        built = build("host", gains, Path(place))
        yield (keep and _moved(built, kept)) or built


def _moved(built: Image, kept: Path) -> Image | None:
    """Put an image to the kept ones, whole; a full or read-only disk costs only that it is built again."""
    try:
        kept.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=kept.parent, suffix=".partial")
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(built.path.read_bytes())
            os.chmod(name, 0o755)
            os.replace(name, kept)
        except OSError:
            Path(name).unlink(missing_ok=True)
            raise
    except OSError:
        return None
    return replace(built, path=kept)


def _sound(image: Image) -> Image | None:
    """Return an image if its file is there and carries the hash of its gains."""
    try:
        check_hash(image.path, image.gains)
    except (UserError, OSError):
        return None
    return image


def _key(gains: Gains, command: tuple[str, ...]) -> str:
    """Return the hash of header, sources, flags and compiler."""
    found = hashlib.blake2b(digest_size=16)
    found.update("\0".join((header(gains), *command, *COMMON, _version(command))).encode())
    home = folder("firmware")
    for place in ("core", "boards/host"):
        for file in sorted((home / place).glob("*.[ch]")):
            found.update(f"{file.name}\0".encode() + file.read_bytes())
    return found.hexdigest()


@lru_cache(maxsize=4)
def _version(command: tuple[str, ...]) -> str:
    """Return what a compiler says of itself."""
    return subprocess.run([*command, "--version"], capture_output=True, text=True, check=False).stdout
