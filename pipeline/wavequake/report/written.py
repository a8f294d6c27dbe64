"""What a written report says, without what draws reports."""

import re
from html import unescape
from pathlib import Path


def read_answer(report: Path) -> str:
    """Return the answer that a written report gives; empty where it has none."""
    with open(report, encoding="utf-8") as file:
        found = re.search(r'<meta name="description" content="([^"]*)">', file.read(8192))
    return unescape(found[1]) if found else ""
