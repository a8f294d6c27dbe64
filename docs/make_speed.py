"""Write the table of docs/speed.md from files of ``python -m benchmarks --json``.

``python docs/make_speed.py [FILE ...]``; by default the files in docs/measured/.
"""

import json
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

PAGE = Path(__file__).with_name("speed.md")
MEASURED = PAGE.with_name("measured")
FIRST, LAST = "<!-- made by make_speed.py -->\n", "<!-- end -->\n"


def tables(files: Iterable[Mapping[str, Any]]) -> str:
    """Return Markdown: where each file was measured, and its rows beside one another."""
    found = list(files)
    heads = [chr(ord("A") + place) for place in range(len(found))]
    lines = [
        f"- {head}: {one['processor']}, vectors of {one['vectors']}, {one['cpus']} CPUs, {one['date']}"
        + (f"; {one['note']}" if one.get("note") else "")
        for head, one in zip(heads, found, strict=True)
    ]
    lines += ["", f"| | demanded | aim | {' | '.join(heads)} |", "|---|---|---|" + "---|" * len(found)]
    rows = {}
    for place, one in enumerate(found):
        for row in one["rows"]:
            known = rows.setdefault((row["benchmark"], row["name"]), (row, [""] * len(found)))
            known[1][place] = _value(row)
    for (benchmark, name), (row, values) in rows.items():
        sign = "" if row["least"] else "at most "
        demanded = f"{sign}{row['demanded']:g} {row['unit']}".rstrip()
        lines.append(f"| {benchmark}: {name} | {demanded} | {row['aim']:g} | {' | '.join(values)} |")
    return "\n".join(lines) + "\n"


def _value(row: Mapping[str, Any]) -> str:
    """Return what was measured; bold where it falls short, with what it is for the speed of its processor."""
    value = row["value"]
    if value is None:
        return f"– ({row['reason']})"
    met = value >= row["demanded"] if row["least"] else value <= row["demanded"]
    if met:
        return f"{value:.3g}"
    scaled = value / row.get("slower", 1.0)
    spared = not row["least"] and scaled <= row["demanded"]
    return f"{value:.3g} ({scaled:.3g})" if spared else f"**{value:.3g}**"


def page(text: str, files: Iterable[Mapping[str, Any]]) -> str:
    """Return the page with its table made anew."""
    before, rest = text.split(FIRST)
    _, after = rest.split(LAST)
    return before + FIRST + tables(files) + LAST + after


def main() -> None:
    """Write the page."""
    names = [Path(name) for name in sys.argv[1:]] or sorted(MEASURED.glob("*.json"))
    files = [json.loads(name.read_text(encoding="utf-8")) for name in names]
    PAGE.write_text(page(PAGE.read_text(encoding="utf-8"), files), encoding="utf-8")


if __name__ == "__main__":
    main()
