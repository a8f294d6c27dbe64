"""Plug-ins: files of Python that add study kinds, measures, sources, shapes, methods or controllers.

``wavequake run STUDY --plugin FILE`` loads such a file before anything else; what it registers is found by
name like what comes with Wavequake. Its text travels with every task, so that workers have the same, and its
digest is a part of what stores say computed them. Nothing is loaded that the user did not name.
"""

import hashlib
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from traceback import extract_tb
from types import ModuleType

from wavequake.errors import UserError
from wavequake.user_files import read_text

_loaded: dict[str, "Plugin"] = {}


@dataclass(frozen=True)
class Plugin:
    """A loaded file: its name without folder, and its text."""

    name: str
    text: str

    @property
    def digest(self) -> str:
        """What tells this text from others, 12 hexadecimal digits."""
        return hashlib.blake2b(self.text.encode(), digest_size=6).hexdigest()

    @property
    def module(self) -> str:
        """The fixed name of its module, the same in every process."""
        return f"wavequake_plugin_{self.digest}"

    def __str__(self) -> str:
        """Return name and digest, as stores quote them."""
        return f"{self.name} ({self.digest})"

    def __reduce__(self) -> tuple[object, ...]:
        """Load the plug-in where it arrives."""
        return load_text, (self.name, self.text)


def loaded_plugins() -> tuple[Plugin, ...]:
    """Return the plug-ins of this process, in the order in which they were loaded."""
    return tuple(_loaded.values())


def load_plugin(path: str | Path) -> Plugin:
    """Load a plug-in from a file; what it registers is found from then on.

    Raises
    ------
    UserError
        If the file cannot be read, or running it fails; names the line.
    """
    return load_text(Path(path).name, read_plugin(path))


def read_plugin(path: str | Path) -> str:
    """Return the text of a plug-in; raises UserError if the file cannot be read."""
    try:
        return read_text(path)
    except UserError as error:
        raise UserError(f"The plug-in {error}") from None


def load_text(name: str, text: str) -> Plugin:
    """Load a plug-in from its text, once per process; raises as :func:`load_plugin`."""
    plugin = Plugin(name, text)
    if plugin.module in _loaded:
        return _loaded[plugin.module]
    module = ModuleType(plugin.module)
    module.__file__ = name
    sys.modules[plugin.module] = module  # what it defines is pickled by this name
    try:
        exec(compile(text, name, "exec"), module.__dict__)
    except UserError as error:
        del sys.modules[plugin.module]
        raise UserError(f"The plug-in {name}: {error}") from None
    except KeyboardInterrupt:
        del sys.modules[plugin.module]
        raise
    except BaseException as error:  # a script's sys.exit() is no end of ours
        del sys.modules[plugin.module]
        lines = [one.lineno for one in extract_tb(error.__traceback__) if one.filename == name]
        line = error.lineno if isinstance(error, SyntaxError) else lines[-1] if lines else None
        where = f", line {line}" if line else ""
        raise UserError(
            f"The plug-in {name} cannot be loaded{where}: {type(error).__name__}: {_words(error)}."
        ) from error
    _loaded[plugin.module] = plugin
    return plugin


def _words(error: BaseException) -> str:
    try:
        return str(error)
    except Exception:  # its own fault
        return "it cannot say what"


def load_named(words: Iterable[str]) -> list[str]:
    """Load the files that ``--plugin FILE`` names in a command line; return the other words.

    Raises
    ------
    UserError
        As `load_plugin`, and if no file follows.
    """
    rest = []
    for word in (given := iter(words)):
        name, equals, file = word.partition("=")
        if name != "--plugin":
            rest.append(word)
            continue
        path = file if equals else next(given, None)
        if path is None:
            raise UserError("--plugin needs the file to load: --plugin my_kind.py.")
        load_plugin(path)
    return rest
