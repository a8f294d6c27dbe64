"""How far the numbers of tests are from what they should be: the figures of docs/validation.md.

Runs the tests that the page names, or those that are given, and prints for each of their comparisons the
largest difference found and how much of its tolerance that is.

``python -m benchmarks.measured`` or ``python -m benchmarks.measured tests/optics/test_media.py``
"""

import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

from benchmarks._comparisons import REPORT

ROOT = Path(__file__).parents[1]


def named_tests() -> list[str]:
    """Return the tests that docs/validation.md names: folders, files and functions."""
    text = (ROOT / "docs" / "validation.md").read_text(encoding="utf-8")
    names = set(re.findall(r"`([a-z]+/(?:test_\w+\.py(?:::\w+)?)?)`", text)) - {"tests/"}
    whole = {name for name in names if "::" not in name}
    return [
        f"tests/{name}"
        for name in sorted(names)
        if not whole & ({name.split("::")[0], name.split("/")[0] + "/"} - {name})
    ]


def main() -> None:
    """Run the tests in a process of their own and print what their comparisons found."""
    tests = sys.argv[1:] or named_tests()
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report"
        surroundings = os.environ | {REPORT: str(report)}
        options = ["-p", "benchmarks._comparisons", "-o", "enable_assertion_pass_hook=true", "-q"]
        code = subprocess.run(
            [sys.executable, "-m", "pytest", *options, *tests], cwd=ROOT, env=surroundings, check=False
        ).returncode
        print(report.read_text(encoding="utf-8") if report.exists() else "no comparison was made")
    sys.exit(code)


if __name__ == "__main__":
    main()
