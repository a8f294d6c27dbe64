"""The page of a report: one self-contained HTML file, no scripts, the same bytes for the same data."""

import json
import os
import re
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import xarray as xr
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup, escape
from matplotlib.figure import Figure

from wavequake.campaign.store.objects import ObjectPath, location
from wavequake.drawing.style import WIDTH, hover, svg_text, with_titles
from wavequake.errors import UserError
from wavequake.report.populations import Excluded
from wavequake.words import printable

LISTED = 200
KNOWN_ERRORS = "known_errors"  # of the encoding of a store's dataset: what adds its errors to a page
_WIDE = 1.2 * 72.0 * WIDTH  # points
_TEXT = 7.0  # points: the smallest text that is drawn where there is room
_PAGE = 1028.0  # points of the widest pages
_PHONE = 350  # pixels of the narrowest pages
# Kinds whose stores the viewer shows; a test compares them with the viewer's own.
VIEWED = frozenset(
    {
        "segment-disturbance", "system-disturbance", "telescope-exposure", "mirror-mor", "mirror-exposure",
        "mirror-trace", "segment-mor", "lens-experiment", "lens-passive", "controller-mor", "telescope-loop",
        "tip-tilt-vibration", "segment-control", "sweep", "system-loop",
    }
)  # fmt: skip
OF_A_RECORD = "line"  # kind of a page that is of no store and has no cases
_LONGEST = 100_000  # characters of a file of a study
_OUTLINE, _FURTHER_DIGITS = re.compile(r' d="[^"]*"'), re.compile(r"(?<=\.\d\d)\d+")


@dataclass(frozen=True)
class Picture:
    """A drawn figure, its place in the document, its title, and how to read it."""

    id: str
    text: str
    svg: Markup
    how: str = ""

    @property
    def width(self) -> float:
        """Width of the drawing, points."""
        found = re.search(r'viewBox="0 0 ([\d.]+)', self.svg)
        return float(found[1]) if found else 0.0

    @property
    def points(self) -> int:
        """Width at which its smallest text has 7 points, of which 1.3 times as many pixels make 9.

        Not more than a page is wide.
        """
        sizes = [float(one) for one in re.findall(r'<text style="font-size: ([\d.]+)px', self.svg)]
        larger = self.width * max(1.0, _TEXT / min(sizes, default=_TEXT))
        return round(max(self.width, min(_PAGE, larger)))

    @property
    def wide(self) -> bool:
        """Whether it needs the whole width of the page."""
        return self.width > _WIDE

    @property
    def scrolls(self) -> bool:
        """Whether a phone shows its text at 9 pixels only if it is scrolled."""
        return 1.3 * self.points > _PHONE


@dataclass(frozen=True)
class Section:
    """Figures under a heading."""

    name: str
    figures: list[Picture]


@dataclass(frozen=True)
class Page:
    """What a report says beside what the store itself knows.

    Attributes
    ----------
    answer : str
        One or two sentences.
    table : list of dict
        Rows: header -> (value, its small print).
    small_print : str
        Beneath the table.
    overview : list of Picture
    sections : list of Section
    definitions : list of (str, str)
        Term and meaning.
    kind : str
        What a case is a case of: "disturbance", "variant".
    left_out : sequence of Excluded
        Cases that are in no number.
    """

    answer: str
    table: list[dict[str, tuple[str, str]]]
    small_print: str
    overview: list[Picture]
    sections: list[Section]
    definitions: list[tuple[str, str]]
    kind: str
    left_out: Sequence[Excluded]


def render_page(dataset: xr.Dataset, page: Page) -> str:
    """Return the report of a store as HTML."""
    from wavequake.report.layout_picture import drawn_layout  # what draws is slow to load

    if (layout := drawn_layout(dataset)) is not None:
        page = replace(page, overview=[picture("layout", *layout), *page.overview])
    if (add_errors := dataset.encoding.get(KNOWN_ERRORS)) is not None:
        page = add_errors(page)
    study = _study(dataset)
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
    )
    environment.filters["marked"] = _marked
    text = environment.get_template("report.html.j2").render(
        name=_entry(study, "name") or "Campaign",
        title=str(dataset.attrs.get("study_title", "")),
        page=page,
        left_out=page.left_out[:LISTED],
        more_left_out=max(0, len(page.left_out) - LISTED),
        provenance=list(_provenance(dataset)),
        cases=page.kind != OF_A_RECORD,
        viewed=page.kind != OF_A_RECORD and (_entry(study, "workflow") or "") in VIEWED,
        study=json.dumps(_shortened(study), indent=2, ensure_ascii=False) if study else "",
    )
    return printable(text)


def write_page(text: str, path: str | Path) -> Path:
    """Write a report, whole or not at all, and return its absolute path; UserError if that fails."""
    target = location(path).resolve()
    if isinstance(target, ObjectPath):
        target.write_bytes(text.encode())
    else:
        _write_whole(target, text)
    return target


def picture(id_: str, text: str, figure: Figure, how: str = "") -> Picture:
    """Return a figure as part of a page; `id_` is unique in it, `text` its title, `how` how to read it."""
    return Picture(id_, text, Markup(inline_svg(figure, id_)), how)


def inline_svg(figure: Figure, salt: str) -> str:
    """Draw a figure as an SVG element of an HTML document, without prolog and metadata.

    Its ids are unique as long as `salt` is. Matplotlib has escaped all text in it. Curves with labels and
    marks of artists with the id of `hover` say theirs when they are pointed at.
    """
    for axes in figure.axes:
        for line in axes.lines:
            label = str(line.get_label())
            if label and not label.startswith("_") and line.get_gid() is None:
                line.set_gid(hover([label]))
    text = with_titles(svg_text(figure, salt))
    text = re.sub(r"<metadata>.*?</metadata>", "", text[text.index("<svg") :], flags=re.DOTALL)
    # Groups are numbered alike in each figure and never referred to; outlines need no more than 0.01 points.
    text = re.sub(r'<g id="[^"]*"', "<g", text)
    text = _OUTLINE.sub(lambda outline: _FURTHER_DIGITS.sub("", outline[0]), text)
    text = re.sub(r' transform="rotate\(-0 [^"]*\)"', "", text)
    return re.sub(r"\n\s*", "\n", text)


def _study(dataset: xr.Dataset) -> dict[str, Any]:
    try:
        study = json.loads(dataset.attrs.get("study", "{}"))
    except (TypeError, json.JSONDecodeError):
        return {}
    return study if isinstance(study, dict) else {}


def _marked(text: str) -> Markup:
    """Return a text as HTML; what stands between backticks is code."""
    return Markup(re.sub(r"`([^`<>]+)`", r"<code>\1</code>", str(escape(text))))


def _shortened(value: Any) -> Any:
    """Return a part of a study with the beginnings alone of files that fill pages."""
    if isinstance(value, dict):
        return {key: _shortened(one) for key, one in value.items()}
    if isinstance(value, list):
        return [_shortened(one) for one in value]
    if isinstance(value, str) and len(value) > _LONGEST:
        return f"{value[:200]}... ({len(value)} characters, which the store's manifest.json holds)"
    return value


def _entry(study: Mapping[str, Any], key: str) -> str:
    section = study.get("study")
    return str(section.get(key) or "") if isinstance(section, dict) else ""


def _provenance(dataset: xr.Dataset) -> Iterator[tuple[str, str]]:
    """Yield the attributes of the store but the study, which stands below; JSON records as lists."""
    for key, value in dataset.attrs.items():
        if key == "study":
            continue
        try:
            record = json.loads(value) if isinstance(value, str) else value
        except json.JSONDecodeError:
            record = value
        if isinstance(record, dict):
            record = ", ".join(f"{name} {part}" for name, part in record.items())
        yield str(key).replace("_", " "), str(record if isinstance(record, str) else value)


def _write_whole(target: Path, text: str) -> None:
    temporary = None
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(
            "w", encoding="utf-8", dir=target.parent, suffix=".tmp", delete=False
        ) as file:
            temporary = Path(file.name)
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        temporary.chmod(0o644)
        temporary.replace(target)
    except OSError as error:
        if temporary is not None:
            temporary.unlink(missing_ok=True)
        words = (
            f"The page {target} cannot be written: {error.strerror or error}; -o FILE writes it elsewhere."
        )
        raise UserError(words) from None
