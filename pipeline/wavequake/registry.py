"""Registries: what a part of the package knows by name, its own and what others add from outside.

An entry comes from a module of the package's own folder, from an installed distribution (entry points) or
from a call of `Registry.add`; one file makes one.
"""

import sys
from collections.abc import Callable, Mapping
from functools import lru_cache
from importlib import import_module, metadata
from pkgutil import iter_modules
from typing import Any, Generic, TypeVar

from wavequake.errors import UserError

Entry = TypeVar("Entry")
_own: dict[str, None] = {}


def entry_points(group: str) -> tuple[metadata.EntryPoint, ...]:
    """Return what installed distributions declare of a group; their files are read once."""
    return tuple(_declared(tuple(sys.path)).select(group=group))


@lru_cache(maxsize=1)
def _declared(places: tuple[str, ...]) -> Any:  # of another type before Python 3.12
    return metadata.entry_points()


def note_own(entry: object) -> None:
    """Remember that something comes from a module that worker processes do not load by themselves."""
    module = str(getattr(entry, "__module__", ""))
    if not module.startswith("wavequake"):
        _own[module] = None


def own_modules() -> tuple[str, ...]:
    """Return the modules that have registered something and are neither installed parts nor plug-ins."""
    return tuple(_own)


class Registry(Generic[Entry]):
    """Entries of one kind by name.

    Parameters
    ----------
    what : str
        An entry in a word, for messages.
    home : str
        The package whose modules add the own entries when they are imported.
    group : str
        The group of entry points by which other distributions name modules (or entries) of theirs.
    name_of : callable
        Returns the name of an entry.
    """

    def __init__(self, what: str, home: str, group: str, name_of: Callable[[Entry], str]) -> None:
        self._what, self._home, self._group, self._name_of = what, home, group, name_of
        self._entries: dict[str, Entry] = {}
        self._loaded = self._installing = False

    def add(self, entry: Entry) -> Entry:
        """Add an entry and return it; one that was made anew from the same file replaces the former.

        Raises
        ------
        UserError
            If another entry has the name, or a method that it must have is not written.
        """
        if unwritten := [name for name in dir(entry) if _is_abstract(entry, name)]:
            called, missing = getattr(entry, "__qualname__", entry), " and no ".join(unwritten)
            raise UserError(
                f"the {self._what} {called} has no {missing} of its own; write what its base class describes"
            )
        name = self._name_of(entry)
        before = self._entries.get(name)
        if before is not None and _origin(before) != _origin(entry):
            raise UserError(
                f"two {self._what}s are called {name!r}, in {_origin(before)} and in {_origin(entry)}; "
                "each needs a name of its own"
            )
        self._entries[name] = entry
        if not self._installing:
            note_own(entry)
        return entry

    def known(self) -> Mapping[str, Entry]:
        """Return the entries that have been added so far, without looking for others."""
        return self._entries

    def entries(self) -> Mapping[str, Entry]:
        """Return all entries by name: the package's own first, then those of other distributions.

        Raises
        ------
        UserError
            If a module of another distribution cannot be imported.
        """
        if not self._loaded:
            self._loaded = True  # first: the modules that are imported may ask, too
            package = import_module(self._home)
            for module in iter_modules(package.__path__):
                import_module(f"{self._home}.{module.name}")
            for point in entry_points(group=self._group):
                try:
                    self._installing = True
                    point.load()
                except Exception as error:
                    raise UserError(
                        f"the {self._what} {point.name!r} of the installed package "
                        f"{point.dist.name if point.dist else point.value} cannot be loaded: "
                        f"{type(error).__name__}: {error}"
                    ) from error
                finally:
                    self._installing = False
        return self._entries


def _is_abstract(entry: object, name: str) -> bool:
    return getattr(getattr(entry, name, None), "__isabstractmethod__", False) is True


def _origin(entry: object) -> str:
    """Return the module and name of an entry; a plug-in's new text takes the place of its former one."""
    module = str(getattr(entry, "__module__", ""))
    place = "a plug-in" if module.startswith("wavequake_plugin_") else module
    return f"{place}.{getattr(entry, '__qualname__', type(entry).__name__)}"
