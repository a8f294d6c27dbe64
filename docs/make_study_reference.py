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


def table(model: type[BaseModel], skip: frozenset[str] = frozenset()) -> str:
    """Return one Markdown table: key, default, meaning."""
    lines = ["| key | default | meaning |", "|---|---|---|"]
    for name, info in model.model_fields.items():
        if name in skip or name.endswith(("_csv", "_npz", "_text")) or models(info.annotation):
            continue
        default = (
            "required"
            if info.default is PydanticUndefined and not info.default_factory
            else f"`{info.get_default(call_default_factory=True)}`"
        )
        lines.append(f"| `{name}` | {default} | {info.description or ''} |")
    return "\n".join(lines) + "\n" if len(lines) > 2 else ""


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


def sections(model: type[BaseModel], path: str = "") -> Iterator[tuple[str, list[type[BaseModel]]]]:
    """Yield the heading and the models of each section of a model, and of those inside it."""
    for name, info in model.model_fields.items():
        found = models(info.annotation)
        if not found:
            continue
        place = f"{path}{name}"
        yield (f"[[{place}]]" if is_list(info.annotation) else f"[{place}]"), found
        for one in found:
            yield from sections(one, f"{place}.")


def words(model: type[BaseModel]) -> str:
    """Return the docstring in one paragraph."""
    return " ".join(line.strip() for line in (model.__doc__ or "").strip().splitlines())


def kinds(heading: str, found: list[type[BaseModel]]) -> Iterator[tuple[str, str]]:
    """Yield headings and texts of a section that is of one kind, or of one of several."""
    if len(found) == 1:
        yield f"`{heading}`", f"{words(found[0])}\n\n{table(found[0])}"
        return
    tag = next(key for key in TAGS if key in found[0].model_fields)
    shared = next(base for base in found[0].__mro__ if all(issubclass(model, base) for model in found))
    common: frozenset[str] = frozenset()
    if issubclass(shared, BaseModel) and len(shared.model_fields) > 0:
        common = frozenset(shared.model_fields)
        yield f"`{heading}`: what all have", table(shared)
    for model in found:
        name = model.model_fields[tag].default
        own = {key for key in common if model.model_fields[key].default == shared.model_fields[key].default}
        yield (
            f'`{heading}` with `{tag} = "{name}"`',
            f"{words(model)}\n\n{table(model, frozenset(own) | {tag})}",
        )


def reference() -> str:
    """Return all tables: what all workflows have, then what each has of its own or shares with another."""
    parts: list[str] = []
    homes: dict[tuple[str, str], str] = {}
    for workflow, study in {"": Study, **{name: find_kind(name).model for name in bundled_kinds()}}.items():
        own, shared = [], {}
        for heading, found in sections(study):
            for title, text in kinds(heading, found):
                home = homes.setdefault((title, text), workflow)
                if home == workflow:
                    own.append(f"{'###' if workflow else '##'} {title}\n{text}")
                elif home:
                    shared.setdefault(home, []).append(title)
        if workflow:
            parts.append(f"## Study kind `{workflow}`\n")
        for home, titles in shared.items():
            parts.append(f"As of `{home}`: {'; '.join(dict.fromkeys(titles))}.\n")
        parts += own
    return "\n".join(parts)


if __name__ == "__main__":
    text = PAGE.read_text().split(MARK)[0]
    PAGE.write_text(text + MARK + "\n" + reference())
