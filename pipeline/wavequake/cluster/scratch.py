"""Folders for Dask's own files that nobody else can write.

Its schedulers, nannies and workers look for modules there before anywhere else. By default that is one folder
for all users of a machine: whoever makes it first could have code run in the processes of all others.
"""

import os
import stat
import tempfile
from contextlib import suppress
from pathlib import Path

SETTING = "temporary-directory"
"""Dask's setting of the folder."""
_VARIABLE = "DASK_TEMPORARY_DIRECTORY"


def scratch_folder() -> str:
    """Return a folder in the temporary one of this machine that belongs to this user alone.

    It is the same for all runs, so that Dask finds there what killed ones have left; another one if somebody
    else has been there before.
    """
    folder = Path(tempfile.gettempdir()) / f"wavequake-{os.getuid()}"
    with suppress(FileExistsError):
        folder.mkdir(0o700)
    found = folder.lstat()  # a link would lead where its owner likes
    ours = stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & 0o077
    return str(folder) if ours else tempfile.mkdtemp(prefix="wavequake-")


def scratch_lines(parent: str | None) -> list[str]:
    """Return the lines of a shell that make such a folder in `parent`, and take it away at the end."""
    parent = parent or '"${TMPDIR:-/tmp}"'
    return [
        f"mkdir -p {parent} && {_VARIABLE}=$(mktemp -d -p {parent} wavequake-XXXXXXXXXX) || exit 1",
        f"export {_VARIABLE}",
        f"""trap 'rm -rf "${_VARIABLE}"' EXIT""",
    ]
