"""What sensitivities are taken of: a study, or a bundled system, telescope or lens file by itself."""

import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from wavequake.bundled import TELESCOPES as TELESCOPES
from wavequake.bundled import bundled_studies
from wavequake.campaign.schema import Study
from wavequake.errors import UserError
from wavequake.optics.catalog.names import system_names
from wavequake.optics.lens_archive import LENS_FILES
from wavequake.workflows.overrides import split_overrides
from wavequake.workflows.study import load_study, near_matches, study_of

# Keys that say what the system is: with one of them, the name would be that of something else.
_WHOLE = (
    "study.workflow",
    "telescope.name",
    "system.name",
    "system.file",
    "system.file_text",
    "system.surface",
)


def sensitivity_study(source: str | Path, overrides: Mapping[str, Any] | Iterable[str] = ()) -> Study:
    """Return a study for its sensitivities by what it is of.

    Parameters
    ----------
    source : str or Path
        A study by name or path, which goes before a system of the same name; a segmented telescope, with the
        light and rays of the bundled study of it; any other bundled system, or ``lens.zmx``: a study of
        nothing but that, with all defaults, its own fields and wavelengths.
    overrides : mapping or iterable of ``"section.key=value"``
        As `wavequake.load_study` takes them; not another system or telescope in the place of a named one.

    Raises
    ------
    UserError
        If there is no such thing, it cannot be read, or overrides put another in its place.
    """
    if not isinstance(source, str | Path):
        raise UserError(
            f"Sensitivities are taken of a study or system by name or path, not of {type(source).__name__}; "
            "write_zmx makes a file of a system."
        )
    name = str(source)
    is_file, is_system = name.lower().endswith(LENS_FILES), name in TELESCOPES or name in system_names()
    if name in bundled_studies() or (not (is_file or is_system) and Path(name).is_file()):
        return load_study(source, overrides)
    keys = dict(split_overrides(overrides))
    if is_system or is_file:
        other = next((key for key in keys if key in _WHOLE), None)
        if other is not None:
            raise UserError(
                f"The key {other!r} puts something else in the place of {name}; give that by its name or "
                "file, or a study of your own."
            )
    if name in TELESCOPES:
        study, chosen = TELESCOPES[name]
        return load_study(study, chosen | dict(keys))
    if not (is_file or is_system):
        known = tuple(dict.fromkeys((*bundled_studies(), *TELESCOPES, *system_names())))
        raise UserError(
            f"There is no study and no optical system {name!r}{near_matches(name, known)}; one of your own "
            "is a .toml or .zmx file."
        )
    return _bare(name, {"file": name} if is_file else {"name": name}, keys)


def _bare(name: str, system: dict[str, Any], keys: Mapping[str, Any]) -> Study:
    """Return a study of a system; its disturbance only completes it, as it names no surface."""
    record = {
        "study": {
            "name": re.sub(r"[^A-Za-z0-9._-]+", "-", Path(name).stem).strip("-._") or "system",
            "workflow": "system-disturbance",
        },
        "system": system,
        "disturbance": [{"name": "none", "model": "line-of-sight"}],
    }
    return study_of(record, name, Path(), keys.items())
