"""A report in headless Chromium: no page wider than the screen, no text too small, every figure explained."""

import pytest
from browser import MISSING, PROGRAM, Browser
from test_film import bench, store  # noqa: F401

import wavequake as wq
from wavequake.report.written import read_answer

pytestmark = pytest.mark.skipif(PROGRAM is None, reason=MISSING)

SMALLEST = """Math.min(...[...document.querySelectorAll('body *')]
  .filter(e => e.closest('svg') === null && e.textContent.trim())
  .map(e => parseFloat(getComputedStyle(e).fontSize)))"""
# Drawings have text of 7 points or more: as many pixels per point as this make 9 pixels of it.
SCALE = """Math.min(...[...document.querySelectorAll('figure svg')]
  .map(e => e.getBoundingClientRect().width / e.viewBox.baseVal.width))"""
HIDDEN = """[...document.querySelectorAll('table, figure svg')].filter(e =>
  e.getBoundingClientRect().right > innerWidth && !e.closest('.wide, figure a')).length"""
EMPTY = """[...document.querySelectorAll('figure')].filter(e => {
  const drawn = e.querySelector('svg').getBoundingClientRect(), card = e.getBoundingClientRect();
  return drawn.width < 0.6 * card.width || drawn.height < 0.6 * card.height;
}).length"""
UNEXPLAINED = """[...document.querySelectorAll('figure')].filter(e =>
  e.querySelector('figcaption').textContent.trim().split('. ').length < 2).map(e => e.id)"""
LOST = "[...document.querySelectorAll('nav a')].filter(e => !document.querySelector(e.hash)).length"


@pytest.mark.parametrize("width", [1400, 400])
def test_a_report_fits_the_screen_and_explains_its_figures(store, tmp_path, width):  # noqa: F811
    report = wq.report(store)
    browser = Browser(tmp_path)
    try:
        browser.open(report, width)
        assert browser.ask("document.documentElement.scrollWidth") <= width
        assert browser.ask(SMALLEST) >= 9.0
        assert browser.ask(SCALE) >= 9.0 / 7.0
        assert browser.ask(HIDDEN) == 0
        assert browser.ask(EMPTY) == 0
        assert browser.ask(UNEXPLAINED) == []
        assert browser.ask("document.querySelectorAll('nav a').length") > 3
        assert browser.ask(LOST) == 0
        assert browser.ask("document.querySelector('.answer').textContent") == read_answer(report) != ""
        assert browser.said == []
        assert [one for one in browser.asked if not one.startswith("data:")] == [report.as_uri()]
    finally:
        browser.close()
