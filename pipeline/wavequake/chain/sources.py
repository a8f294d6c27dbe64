"""What the disturbances and loops of a study file read from files."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from wavequake.campaign.schema import base64_of, text_of
from wavequake.errors import UserError
from wavequake.mechanics.disturbances.source import SOURCES, Source


def read_source_files(record: Mapping[str, Any], base: Path) -> None:
    """Add what the files of disturbances and loops in a study's record hold, where their models want it."""
    for kind in ("sensor", "actuator", "controller"):
        for entry in record.get(kind) or ():
            if isinstance(entry, dict) and isinstance(entry.get("file"), str):
                entry["file_csv"] = text_of(base / entry["file"], f"{kind}.{entry.get('name')}.file")
    sources = SOURCES.entries()
    for entry in record.get("disturbance") or ():
        spectrum = entry.get("spectrum") if isinstance(entry, dict) else None
        if isinstance(spectrum, dict) and isinstance(spectrum.get("file"), str):
            where = f"disturbance.{entry.get('name')}.spectrum.file"
            spectrum["file_csv"] = text_of(base / spectrum["file"], where)
        if not (isinstance(entry, dict) and isinstance(entry.get("file"), str)):
            continue
        source = sources.get(str(entry.get("model")), Source)
        try:
            found = source.embedded(entry, base)
        except UserError as error:
            raise UserError(f"disturbance.{entry.get('name')}.file: {error}") from None
        if found is not None:
            entry |= found
            continue
        key, kind = source.file_key(entry["file"])
        read = base64_of if kind == "base64" else text_of
        entry[key] = read(base / entry["file"], f"disturbance.{entry.get('name')}.file")
