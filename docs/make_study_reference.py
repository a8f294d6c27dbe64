"""Write the tables of keys in docs/study.md from the code: ``python docs/make_study_reference.py``."""

from pathlib import Path

from pydantic import BaseModel
from pydantic_core import PydanticUndefined

from wavequake.workflows.segment_study import SegmentStudy, SurfaceSection, disturbance_models

PAGE = Path(__file__).with_name("study.md")
MARK = "<!-- the tables below are made by make_study_reference.py -->\n"


def table(model: type[BaseModel], skip: frozenset[str] = frozenset()) -> str:
    """Return one Markdown table: key, default, meaning."""
    lines = ["| key | default | meaning |", "|---|---|---|"]
    for name, info in model.model_fields.items():
        if name in skip or name.endswith("_csv"):
            continue
        default = (
            "required"
            if info.default is PydanticUndefined and not info.default_factory
            else f"`{info.get_default(call_default_factory=True)}`"
        )
        lines.append(f"| `{name}` | {default} | {info.description or ''} |")
    return "\n".join(lines) + "\n"


def reference() -> str:
    """Return all tables."""
    parts = []
    for name, info in SegmentStudy.model_fields.items():
        if name == "disturbance":
            continue
        section = info.annotation
        assert isinstance(section, type)
        parts.append(f"## `[{name}]`\n{(section.__doc__ or '').strip()}\n\n{table(section)}")
    parts.append(f"## `[[telescope.surfaces]]`\n{SurfaceSection.__doc__}\n\n{table(SurfaceSection)}")
    common = frozenset({"name", "duration_s", "instants", "share"})
    models = disturbance_models()
    shared = next(iter(models.values())).__mro__[1]
    parts.append(f"## `[[disturbance]]`: what all have\nOne population of cases each.\n\n{table(shared)}")
    for name, model in models.items():
        words = " ".join(line.strip() for line in (model.__doc__ or "").strip().splitlines())
        parts.append(
            f'## `[[disturbance]]` with `model = "{name}"`\n{words}\n\n{table(model, common | {"model"})}'
        )
    return "\n".join(parts)


if __name__ == "__main__":
    text = PAGE.read_text().split(MARK)[0]
    PAGE.write_text(text + MARK + "\n" + reference())
