"""Find the folders of files that are not Python: ``kernels``, ``workflows``, ``firmware``."""

from pathlib import Path

_PACKAGE = Path(__file__).resolve().parent


def folder(name: str) -> Path:
    """Return the folder of non-Python files called `name`.

    The installed wheel carries it as ``wavequake/_files/<name>``; a source checkout has it at the top of the
    repository.

    Raises
    ------
    FileNotFoundError
        If neither place has it, which means that the installation is broken.
    """
    for candidate in (_PACKAGE / "_files" / name, _PACKAGE.parents[1] / name):
        if candidate.is_dir():
            return candidate
    raise FileNotFoundError(f"the folder {name!r} is in neither the installed package nor a source checkout")
