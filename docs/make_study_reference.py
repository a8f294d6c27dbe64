"""Write the tables of keys in docs/study.md from the code: ``python docs/make_study_reference.py``."""

from collections.abc import Iterator
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic_core import PydanticUndefined

from wavequake.campaign.schema import Study
from wavequake.workflows.kinds import bundled_kinds, find_kind

PAGE = Path(__file__).with_name("study.md")
MARK = "<!-- the tables below are made by make_study_reference.py -->\n"
TAGS = ("model", "kind")  # keys that say which of several kinds an entry is of
ALL = ": what all have"


def table(model: type[BaseModel], skip: frozenset[str] = frozenset()) -> str:
    """Return one Markdown table: key, default, meaning."""
    lines = ["| key | default | meaning |", "|---|---|---|"]
    for name, info in model.model_fields.items():
        if name in skip or name.endswith(("_csv", "_npz", "_text")) or models(info.annotation):
            continue
        default = (
            "required"
            if info.default is PydanticUndefined and not info.default_factory
            else shown(info.get_default(call_default_factory=True))
        )
        meaning = (info.description or "").replace("|", "\\|")
        lines.append(f"| `{name}` | {default} | {meaning} |")
    return "\n".join(lines) + "\n" if len(lines) > 2 else ""


def shown(default: Any) -> str:
    """Return a default as it stands in a study file; nothing where there is none."""
    return "" if default in (None, "", ()) else f"`{default}`"


def models(annotation: Any) -> list[type[BaseModel]]:
    """Return the models that an annotation speaks of: itself, or inside Annotated, unions and tuples."""
    for choice in getattr(annotation, "__metadata__", ()):
        if hasattr(choice, "models"):  # of a registry
            return [model for model in choice.models() if model.__module__.startswith("wavequake.")]
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    if get_origin(annotation) in (Annotated, Union, UnionType, tuple):
        return [model for part in get_args(annotation) for model in models(part)]
    return []


def is_list(annotation: Any) -> bool:
    """Return whether an annotation is that of a list of entries."""
    if get_origin(annotation) in (Annotated, Union, UnionType):
        return any(is_list(part) for part in get_args(annotation))
    return get_origin(annotation) is tuple


def sections(model: type[BaseModel], path: str = "") -> Iterator[tuple[str, str, list[type[BaseModel]]]]:
    """Yield heading, owner and models of each section of a model, and of those inside it.

    The owner is the kind of entry that a section is inside of, where there are several kinds. What there must
    be comes first.
    """
    for name, info in sorted(model.model_fields.items(), key=lambda one: not one[1].is_required()):
        found = models(info.annotation)
        if not found:
            continue
        place = f"{path}{name}"
        yield (f"[[{place}]]" if is_list(info.annotation) else f"[{place}]"), "", found
        for one in found:
            owner = tagged(one) if len(found) > 1 else ""
            for heading, inner, its in sections(one, f"{place}."):
                yield heading, inner or owner, its


def tag_of(model: type[BaseModel]) -> str:
    """Return the key that says of which kind an entry is."""
    return next(key for key in TAGS if key in model.model_fields)


def tagged(model: type[BaseModel]) -> str:
    """Return what an entry of this kind says, as `model = "lqg"`."""
    tag = tag_of(model)
    return f'`{tag} = "{model.model_fields[tag].default}"`'


def words(model: type[BaseModel]) -> str:
    """Return the docstring in one paragraph."""
    return " ".join(line.strip() for line in (model.__doc__ or "").strip().splitlines())


def kinds(found: list[type[BaseModel]]) -> Iterator[tuple[str, str]]:
    """Yield which kinds a section may be of, nothing for what all have, and the text of each."""
    if len(found) == 1:
        yield "", f"{words(found[0])}\n\n{table(found[0])}"
        return
    shared = next(base for base in found[0].__mro__ if all(issubclass(model, base) for model in found))
    common: frozenset[str] = frozenset()
    if issubclass(shared, BaseModel) and len(shared.model_fields) > 0:
        common = frozenset(shared.model_fields)
        yield ALL, table(shared)
    for model in found:
        own = {key for key in common if model.model_fields[key].default == shared.model_fields[key].default}
        yield f"with {tagged(model)}", f"{words(model)}\n\n{table(model, frozenset(own) | {tag_of(model)})}"


def entries(study: type[BaseModel]) -> dict[tuple[str, str, str], list[str]]:
    """Return the entries of a study kind, (heading, kind, text), each once, with the owners of each."""
    found: dict[tuple[str, str, str], list[str]] = {}
    for heading, owner, its in sections(study):
        for kind, text in kinds(its):
            owners = found.setdefault((heading, kind, text), [])
            owners += [owner] if owner and owner not in owners else []
    return found


def title(heading: str, kind: str, owners: list[str]) -> str:
    """Return the title of an entry."""
    inside = f" of {', '.join(owners)}" if owners else ""
    return f"`{heading}`{inside}{'' if kind == ALL else ' '}{kind}".rstrip()


def reference() -> str:
    """Return all tables: what all workflows have, then what each has of its own or shares with another."""
    parts: list[str] = []
    # Where each text stands; a section of another name that says the same is referred to it, too.
    homes: dict[tuple[str, str], tuple[str, str]] = {}
    for workflow, study in {"": Study, **{name: find_kind(name).model for name in bundled_kinds()}}.items():
        own: list[str] = []
        shared: dict[tuple[str, str, str], list[str]] = {}
        for (heading, kind, text), owners in entries(study).items():
            home, name = homes.setdefault((kind, text), (workflow, heading))
            if (home, name) == (workflow, heading):
                own.append(f"{'###' if workflow else '##'} {title(heading, kind, owners)}\n{text}")
            elif home:
                shared.setdefault((home, name, heading), []).append(kind)
        if workflow:
            parts.append(f"## Study kind `{workflow}`\n")
        lines: dict[str, list[str]] = {}
        for (home, name, heading), names in shared.items():
            whole = {kind for kind, _ in homes if homes[kind, _] == (home, name)} <= set(names)
            which = [kind.removeprefix("with ") for kind in names if kind not in ("", ALL)]
            some = "" if whole or not which else f" with {', '.join(which)}"
            as_there = "" if name == heading else f" as `{name}`"
            lines.setdefault(home, []).append(f"`{heading}`{as_there}{some}")
        for home, said in lines.items():
            whose = "this kind" if home == workflow else f"`{home}`"
            parts.append(f"As of {whose}: {'; '.join(dict.fromkeys(said))}.\n")
        parts += own
    return "\n".join(parts)


if __name__ == "__main__":
    text = PAGE.read_text().split(MARK)[0]
    PAGE.write_text(text + MARK + "\n" + reference())
