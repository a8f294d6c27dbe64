"""In which key two studies differ."""

import json
from typing import Any


def first_difference(there: Any, here: Any, key: str = "") -> tuple[str, str, str]:
    """Return the first key at which two records (of JSON) differ, and both values in words.

    Entries of lists are told apart by their names, where they have any.
    """
    if isinstance(there, list) and isinstance(here, list):
        there, here = (
            {_entry_key(entry, i): entry for i, entry in enumerate(part)} for part in (there, here)
        )
    if isinstance(there, dict) and isinstance(here, dict):
        for name in sorted({*there, *here}):
            if name not in there or name not in here or there[name] != here[name]:
                full = f"{key}.{name}" if key else name
                return first_difference(there.get(name, "absent"), here.get(name, "absent"), full)
        return key, "in another order", "in this order"
    return key, _short(there), _short(here)


def _entry_key(entry: Any, index: int) -> str:
    return str(entry["name"]) if isinstance(entry, dict) and "name" in entry else str(index)


def _short(value: Any) -> str:
    text = value if value == "absent" else json.dumps(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
