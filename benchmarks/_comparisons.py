"""A pytest plugin that notes by how much numbers in tests differ from what they are compared with."""

import os
import re
import sys
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
from _pytest.assertion import rewrite

# Rewritten tests are kept apart: those of usual runs do not tell of comparisons that hold.
rewrite.PYC_TAIL = rewrite.PYC_TAIL.replace("-pytest-", "-measured-")
REPORT = "WAVEQUAKE_COMPARISONS"
_SCALAR = re.compile(r"np\.\w+\('?([^()']*)'?\)")
_BELOW = re.compile(r"^([-+*/().e\d ]+) <=? ([-+*/().e\d ]+)$")
_TESTS = str(Path(__file__).parents[1] / "tests")
# By file, test and line: tolerance, largest difference, largest share of the tolerance, source.
_FOUND: dict[tuple[str, str, int], tuple[float, float, float, str]] = {}
_NOW = [""]


def _note(file: str, line: int, tolerance: float, difference: float, share: float, source: str) -> None:
    key = (file, _NOW[0], line)
    if key not in _FOUND or share > _FOUND[key][2]:
        _FOUND[key] = (tolerance, difference, share, source)


@lru_cache
def _source(file: str) -> str:
    return Path(file).read_text(encoding="utf-8")


def _place() -> tuple[str, int]:
    """Return the line of a test that is being run."""
    frame = sys._getframe(2)
    while frame and not frame.f_code.co_filename.startswith(_TESTS):
        frame = frame.f_back
    return (frame.f_code.co_filename, frame.f_lineno) if frame else ("", 0)


def pytest_assertion_pass(item: pytest.Item, lineno: int, orig: str, expl: str) -> None:
    """Note comparisons of the form ``difference < tolerance``."""
    match = _BELOW.match(_SCALAR.sub(r"\1", expl.partition("\n")[0]))
    if match and orig in _source(str(item.path)):
        difference, tolerance = (float(eval(side)) for side in match.groups())  # numbers and their products
        if difference >= 0.0 < tolerance:
            _note(str(item.path), lineno, tolerance, difference, difference / tolerance, orig)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item):
    """Know which test it is."""
    _NOW[0] = item.originalname
    return (yield)


def pytest_configure() -> None:
    """Note what `assert_allclose` and `approx` find, too."""
    approx = type(pytest.approx(1.0))
    given, equal = np.testing.assert_allclose, approx.__eq__

    def assert_allclose(actual, desired, rtol=1e-7, atol=0, *args, **kwargs):
        given(actual, desired, rtol, atol, *args, **kwargs)
        one, other = np.broadcast_arrays(np.asarray(actual), np.asarray(desired))
        if one.size and one.dtype.kind in "fciu":
            with np.errstate(all="ignore"):
                apart = np.nan_to_num(np.abs(one - other).astype(float).ravel(), posinf=0.0)
                allowed = (atol + rtol * np.abs(other).astype(float)).ravel()
                share = np.nan_to_num(apart / allowed, posinf=0.0)
            worst = int(share.argmax())
            file, line = _place()
            text = f"assert_allclose, rtol {rtol:g}, atol {atol:g}, largest {np.nanmax(np.abs(other)):.3g}"
            _note(file, line, float(allowed[worst]), float(apart.max()), float(share[worst]), text)

    def approx_equal(self, actual):
        same = equal(self, actual)
        try:
            difference, tolerance = float(abs(actual - self.expected)), float(self.tolerance)
        except (TypeError, ValueError):
            return same
        if same is True or (same and tolerance > 0):
            file, line = _place()
            if tolerance > 0 and np.isfinite(difference):
                text = f"approx {self.expected!r}"
                _note(file, line, tolerance, difference, difference / tolerance, text)
        return same

    np.testing.assert_allclose = assert_allclose
    approx.__eq__ = approx_equal


def pytest_sessionfinish() -> None:
    """Write the table."""
    lines, last = [], ""
    for (file, test, line), (tolerance, difference, share, source) in sorted(_FOUND.items()):
        head = f"{Path(file).relative_to(_TESTS) if file.startswith(_TESTS) else file}::{test}"
        if head != last:
            lines.append(head)
            last = head
        lines.append(f"  {line:4d}  {difference:8.1e} of {tolerance:8.1e} = {share:5.1%}  {source[:120]}")
    Path(os.environ[REPORT]).write_text("\n".join(lines) + "\n", encoding="utf-8")
