"""What is asked again and again of one system is computed once.

It is small: no bit of it depends on how many threads BLAS has, other than what `wavequake.prepared` keeps.
"""

from collections import deque
from collections.abc import Callable, Hashable
from functools import wraps
from typing import Any, Concatenate, ParamSpec, TypeVar

from wavequake.optics.systems.system import OpticalSystem

P = ParamSpec("P")
R = TypeVar("R")

_SYSTEMS = 4  # the latest that are remembered


def once_per_system(
    function: Callable[Concatenate[OpticalSystem, P], R],
) -> Callable[Concatenate[OpticalSystem, P], R]:
    """Have a function of a system, and of what can be a key, remember its results; errors come anew."""
    known: deque[tuple[OpticalSystem, dict[Hashable, Any]]] = deque(maxlen=_SYSTEMS)

    @wraps(function)
    def remembering(system: OpticalSystem, *arguments: P.args, **keywords: P.kwargs) -> R:
        found = next((results for one, results in list(known) if one is system), None)
        if found is None:
            known.append((system, found := {}))
        key = (arguments, tuple(keywords.items()))
        try:
            hash(key)
        except TypeError:  # as of what is none: the function says so
            return function(system, *arguments, **keywords)
        if key not in found:
            found[key] = function(system, *arguments, **keywords)
        result: R = found[key]
        return result

    return remembering  # type: ignore[return-value]
