"""What the names of controllers say that stand for values of their keys: ``tilt/15/2``."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any


def explain_names(controllers: Iterable[Mapping[str, Any]]) -> str:
    """Say which keys the values behind the slashes of names belong to; "" where there are none.

    Examples
    --------
    >>> one = {"name": "tilt/15/2", "bandwidth_hz": 15.0, "latency_frames": 2.0}
    >>> explain_names([one, {"name": "off"}])
    'Behind the slashes of names: bandwidth_hz/latency_frames (tilt).'
    """
    families: dict[str, list[Mapping[str, Any]]] = {}
    for one in controllers:
        family, slash, _ = one["name"].partition("/")
        if slash:
            families.setdefault(family, []).append(one)
    alike: dict[str, list[str]] = {}
    for family, members in families.items():
        if keys := _keys(members):
            alike.setdefault("/".join(keys), []).append(family)
    words = [f"{keys} ({', '.join(names)})" for keys, names in alike.items()]
    return f"Behind the slashes of names: {', '.join(words)}." if words else ""


def _keys(members: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the keys whose values the names of a family end on; none if that is not plain."""
    names = [one["name"].split("/")[1:] for one in members]
    if len({len(words) for words in names}) > 1:
        return []
    found = []
    for words in zip(*names, strict=True):
        fit = [
            key
            for key in members[0]
            if all(_word(one.get(key)) == word for one, word in zip(members, words, strict=True))
        ]
        if len(fit) != 1:
            return []
        found += fit
    return found


def _word(value: Any) -> str:
    if isinstance(value, int | float):
        return f"{value:g}"
    return value if isinstance(value, str) else ""
