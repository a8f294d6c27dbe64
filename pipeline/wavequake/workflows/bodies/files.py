"""Files that the bodies of a study name: matrices, modes, imported models."""

from base64 import b64encode
from pathlib import Path
from typing import Any

from wavequake.campaign.schema import base64_of
from wavequake.errors import UserError
from wavequake.mechanics.importers.model import ImportedModel
from wavequake.mechanics.nodal.modes import modes_of
from wavequake.workflows.bodies.sections import ImportedBodySection
from wavequake.workflows.mirrors.model_store import keep_imported


def read_body_files(record: dict[str, Any], base: Path) -> None:
    """Add what the files of the bodies in a study's record hold."""
    for entry in record.get("body") or ():
        if not isinstance(entry, dict):
            continue
        for kind in ("matrices", "modes"):
            section = entry.get(kind)
            if isinstance(section, dict) and isinstance(section.get("file"), str):
                if kind == "modes" and not section["file"].lower().endswith(".npz"):
                    section["file_npz"] = _modes(section, base, f"body.{entry.get('name')}.modes")
                    continue
                section["file_npz"] = base64_of(
                    base / section["file"], f"body.{entry.get('name')}.{kind}.file"
                )
        section = entry.get("imported")
        if not isinstance(section, dict) or section.keys() - ImportedBodySection.model_fields.keys():
            continue  # a misspelled key is said before what would be wrong without it
        if isinstance(section.get("file"), str):
            keys = {key: one for key, one in section.items() if key in ImportedModel.model_fields}
            keys.setdefault("damping_beta", 0.0)
            section["content"] = keep_imported(keys, base, f"body.{entry.get('name')}.imported")


def _modes(section: dict[str, Any], base: Path, where: str) -> str:
    """Return what a file of another program than NumPy holds of modes, in base64."""
    mesh = section.get("mesh")
    try:
        found = modes_of(
            base / section["file"],
            section.get("units"),
            base / mesh if isinstance(mesh, str) else None,
            section.get("nodes", ()),
            section.get("damping_ratios"),
            section.get("modal_masses", 1.0),
        )
    except (UserError, TypeError, ValueError) as error:  # numbers may be anything yet
        raise UserError(f"{where}: {error}") from None
    return b64encode(found).decode()
