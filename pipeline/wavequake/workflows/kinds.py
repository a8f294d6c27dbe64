"""The kinds of studies by name: bundled ones, those of plug-ins, and those of installed packages."""

import difflib
import json
from collections.abc import Iterator
from importlib import import_module
from typing import Any

from wavequake.campaign.contract import StudyKind
from wavequake.campaign.extra import with_extra
from wavequake.campaign.schema import study_from_identity
from wavequake.errors import UserError
from wavequake.registry import entry_points, note_own

_GROUP = "wavequake.studies"
# Each module has KIND. It is imported when its name is first asked for: commands that need none are quick.
_BUNDLED = {
    "segment-disturbance": "wavequake.workflows.segments.disturbance",
    "mirror-mor": "wavequake.workflows.mirrors.mor",
    "segment-mor": "wavequake.workflows.segments.mor",
    "mirror-trace": "wavequake.workflows.mirrors.trace",
    "system-disturbance": "wavequake.workflows.systems.disturbance",
    "telescope-exposure": "wavequake.workflows.exposures.telescope_exposure",
    "mirror-exposure": "wavequake.workflows.exposures.mirror_exposure",
    "lens-experiment": "wavequake.workflows.lens.experiment",
    "lens-passive": "wavequake.workflows.lens.passive",
    "controller-mor": "wavequake.workflows.loops.controller_mor",
    "tip-tilt-vibration": "wavequake.workflows.loops.tip_tilt",
    "telescope-loop": "wavequake.workflows.loops.telescope_loop",
    "system-loop": "wavequake.workflows.loops.system_loop",
    "segment-control": "wavequake.workflows.loops.segment_control",
}
# Kinds that no study file names: the loader makes such studies.
_MADE = {"sweep": "wavequake.workflows.sweep"}
_registered: dict[str, StudyKind] = {}


def register(kind: StudyKind) -> None:
    """Let studies name a kind; a plug-in calls this where it is loaded.

    Raises
    ------
    UserError
        If it is no study kind, or its name is taken.
    """
    _add(kind)
    note_own(kind.model)


def _add(kind: StudyKind) -> None:
    if not isinstance(kind, StudyKind):
        raise UserError(f"{kind!r} is no study kind; study_kind(...) makes one.")
    if kind.name in {**_BUNDLED, **_MADE} or _registered.get(kind.name, kind) != kind:
        raise UserError(f"There is a study kind {kind.name!r} already; choose another name.")
    _registered[kind.name] = kind


def bundled_kinds() -> tuple[str, ...]:
    """Return the names of the study kinds that come with Wavequake."""
    return tuple(_BUNDLED)


def kind_names() -> tuple[str, ...]:
    """Return the names of all study kinds that can be found."""
    return tuple(dict.fromkeys([*_BUNDLED, *_registered, *_installed()]))


def find_kind(name: str) -> StudyKind:
    """Return the study kind of a name.

    Raises
    ------
    UserError
        If there is none; names the nearest one, and says how a plug-in is given.
    """
    if name not in _registered and (module := {**_BUNDLED, **_MADE}.get(name)):
        return with_extra(import_module(module).KIND)
    if name not in _registered and name in _installed():
        (entry,) = (one for one in entry_points(_GROUP) if one.name == name)
        _add(entry.load())
    if name in _registered:
        return with_extra(_registered[name])
    near = difflib.get_close_matches(str(name), kind_names(), n=1)
    hint = f": did you mean {near[0]!r}?" if near else "."
    raise UserError(
        f"there is no workflow {name!r}{hint} Choose one of {', '.join(kind_names())}; one of your own is "
        "loaded with --plugin FILE."
    )


def study_of(text: str) -> Any:
    """Return the study of an identity text, by the model of its kind."""
    return study_from_identity(find_kind(json.loads(text)["study"]["workflow"]).model, text)


def compared_labels(study: str) -> tuple[str, ...]:
    """Return the labels by which a study tells its cases apart, from the text of its identity."""
    kind = find_kind(json.loads(study)["study"]["workflow"])
    return kind.compared_of(study) if kind.compared_of else kind.compared


def _installed() -> Iterator[str]:
    return (entry.name for entry in entry_points(_GROUP))
