"""Text of lens files and glass catalogues, in the encodings that programs write them in."""

from pathlib import Path

from wavequake.errors import UserError
from wavequake.optics.lens_archive import is_archive, lens_of_archive
from wavequake.user_files import read_bytes


def read_text(path: str | Path, what: str = "lens file") -> str:
    """Return the text of a file in UTF-16, UTF-8 or Latin-1, or of the lens file in an archive (.zar).

    UTF-16 without a mark at its beginning is told by the zero bytes of its plain letters.

    Raises
    ------
    UserError
        As `wavequake.user_files.read_bytes` and `wavequake.optics.lens_archive.lens_of_archive`, and if it
        says that it is UTF-16 and is not.
    """
    if not isinstance(path, str | Path):
        raise UserError(f"The {what} is {path!r}; it must be the path of a file, as text.")
    try:
        data = read_bytes(path)
    except UserError as error:
        raise UserError(f"The {what} {error}") from None
    if is_archive(data):
        data = lens_of_archive(data, str(path))
    for encoding in _encodings(data):
        try:
            return data.decode(encoding).removeprefix("\ufeff")
        except UnicodeDecodeError:
            continue
    raise UserError(f"The {what} {path} says that it is UTF-16, but it is not.")


def _encodings(data: bytes) -> tuple[str, ...]:
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return ("utf-16",)
    start = data[:200]
    if len(start) > 3 and start[1::2].count(0) > 0.9 * len(start[1::2]):
        return ("utf-16-le", "latin-1")
    if len(start) > 3 and start[::2].count(0) > 0.9 * len(start[::2]):
        return ("utf-16-be", "latin-1")
    return ("utf-8-sig", "latin-1")
