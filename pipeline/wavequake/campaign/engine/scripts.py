"""Scripts that start worker processes without a guard."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType


@contextmanager
def script_hidden() -> Iterator[None]:
    """Keep processes that start inside from running the user's script again: they see an empty one."""
    script = sys.modules["__main__"]
    sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = script
