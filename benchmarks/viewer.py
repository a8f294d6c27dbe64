"""How soon pages of the viewer show their first picture, and how many a second, in headless Chromium.

``python -m benchmarks.viewer PAGE.html ...`` prints for each page its size, the time from navigation to the
first picture, and pictures a second while it plays; without a GPU, whatever else the machine does meanwhile.
"""

import sys
import tempfile
from pathlib import Path

from tests.viewer.browser import MISSING, PROGRAM, Browser

_FRAMES = "Number(document.body?.dataset.frames || 0)"
_SECONDS = 3.0
_TIMES = 3


def measured(browser: Browser, page: Path) -> tuple[float, float]:
    """Return seconds to the first picture, and pictures a second in play."""
    browser.resize(1400, 900)
    browser.call("Page.navigate", url=page.resolve().as_uri())
    browser.wait(f"{_FRAMES} > 0")
    first = browser.ask("performance.now()")
    code = f"""new Promise((done) => {{
      document.getElementById('play').click();
      const before = {_FRAMES}, began = performance.now();
      setTimeout(() => done(1000 * ({_FRAMES} - before) / (performance.now() - began)), {1e3 * _SECONDS});
    }})"""
    return 1e-3 * first, browser.ask(code)


def main(pages: list[str]) -> int:
    """Print a row for every page: the best of three openings."""
    if PROGRAM is None:
        print(MISSING)
        return 2
    with tempfile.TemporaryDirectory() as folder:
        browser = Browser(folder)
        try:
            for name in pages:
                found = [measured(browser, Path(name)) for _ in range(_TIMES)]
                first, rate = min(one[0] for one in found), max(one[1] for one in found)
                size = Path(name).stat().st_size / 1e6
                said = f"first picture after {first:.2f} s, {rate:.0f} pictures a second"
                print(f"{name}: {size:.1f} MB, {said}")
        finally:
            browser.close()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
