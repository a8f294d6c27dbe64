"""What comes with Wavequake, by name: studies and the telescopes of studies. Loads nothing that computes."""

import tomllib
from pathlib import Path
from typing import Any

from wavequake.files import folder

# Telescopes are those of studies, with their light and rays.
TELESCOPES: dict[str, tuple[str, dict[str, Any]]] = {
    "jwst": ("jwst-segments", {}),
    "tmt": ("tmt-segments", {}),
    "tmt-18": ("tmt-segments", {"telescope.name": "tmt-18"}),
    "tmt-thesis": ("tmt-segments", {"telescope.name": "tmt-thesis"}),
    "elt": ("tmt-segments", {"telescope.name": "elt"}),
    "keck": ("tmt-segments", {"telescope.name": "keck"}),
    "gtc": ("tmt-segments", {"telescope.name": "gtc"}),
    "het": ("tmt-segments", {"telescope.name": "het"}),
    "gmt": ("tmt-segments", {"telescope.name": "gmt"}),
}


def bundled_studies() -> dict[str, Path]:
    """Return the study files that come with Wavequake, by name."""
    return {path.stem: path for path in sorted(folder("workflows").glob("*.toml"))}


def bundled_titles() -> dict[str, str]:
    """Return what each bundled study says of itself, by name; of its file no more than that is parsed."""
    titles = {}
    for name, path in bundled_studies().items():
        text = path.read_text(encoding="utf-8")
        first = text.index("[study]")
        titles[name] = str(tomllib.loads(text[first : text.index("\n[", first)])["study"].get("title", ""))
    return titles
