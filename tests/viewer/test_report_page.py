"""Reports of every kind in headless Chromium: nothing too wide or too small, every figure explained."""

import pytest
from browser import MISSING, PROGRAM, Browser
from test_film import bench, store  # noqa: F401
from tests.recorded import RECORDED

import wavequake as wq
from wavequake.report.written import read_answer

pytestmark = [pytest.mark.skipif(PROGRAM is None, reason=MISSING), pytest.mark.usefixtures("mirror_models")]

SMALLEST = """Math.min(...[...document.querySelectorAll('body *')]
  .filter(e => e.closest('svg') === null && e.textContent.trim())
  .map(e => parseFloat(getComputedStyle(e).fontSize)))"""
DRAWN = """Math.min(...[...document.querySelectorAll('figure svg text')].map(e => {
  const svg = e.ownerSVGElement, pixels = svg.getBoundingClientRect().width / svg.viewBox.baseVal.width;
  return pixels * parseFloat(getComputedStyle(e).fontSize);
}).filter(size => size > 0))"""
HIDDEN = """[...document.querySelectorAll('table, figure svg')].filter(e =>
  e.getBoundingClientRect().right > innerWidth && !e.closest('.wide, figure a')).length"""
UNHINTED = """[...document.querySelectorAll('figure')].filter(e => {
  const shown = e.querySelector('a');
  return shown.scrollWidth > shown.clientWidth + 1 && getComputedStyle(e, '::before').content === 'none';
}).map(e => e.id)"""
EMPTY = """[...document.querySelectorAll('figure')].filter(e => {
  const drawn = e.querySelector('svg').getBoundingClientRect(), card = e.getBoundingClientRect();
  return drawn.width < 0.6 * card.width || drawn.height < 0.6 * card.height;
}).map(e => e.id)"""
UNEXPLAINED = """[...document.querySelectorAll('figure')].filter(e =>
  e.querySelector('figcaption').textContent.trim().split('. ').length < 2).map(e => e.id)"""
LOST = "[...document.querySelectorAll('nav a')].filter(e => !document.querySelector(e.hash)).length"


# Kinds whose small stores are made for other tests, too; segments without images are the fixture's.
KEPT = (
    "controller-mor",
    "lens-experiment",
    "lens-passive",
    "mirror-exposure",
    "segment-control",
    "segment-mor",
    "telescope-exposure",
    "tip-tilt-vibration",
)
# Bundled studies made small. What is repeated on a page is looked at twice, no more: of what shakes by name.
SMALLER = {
    "euv": ({"campaign.cases": 2}, {}),
    "mirror-mor": (
        {
            "model.shapes": ["circular"],
            "reduction.variants": ["craigb18", "krylov36(150)"],
            "criterion.excitations": ["sine100"],
        },
        {"excitation": ("sine100", "blow")},
    ),
    "mirror-trace": ({}, {}),
    "telescope-structure": ({}, {"disturbance": ("floor", "gravity")}),
    "tmt-million": ({}, {}),
}


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    opened = Browser(tmp_path_factory.mktemp("report-profile"))
    yield opened
    opened.close()


SEEN = f"""({{
  width: document.documentElement.scrollWidth, smallest: {SMALLEST}, drawn: {DRAWN}, hidden: {HIDDEN},
  unhinted: {UNHINTED}, empty: {EMPTY}, unexplained: {UNEXPLAINED}, lost: {LOST},
  contents: document.querySelectorAll('nav a').length,
  answer: document.querySelector('.answer').textContent,
}})"""


def fits_and_explains(browser, report):
    browser.open(report)
    for width in (1400, 400):
        browser.resize(width)
        seen = browser.ask(SEEN)
        assert seen["width"] <= width
        assert seen["smallest"] >= 9.0
        assert seen["drawn"] >= 8.99
        assert (seen["hidden"], seen["empty"], seen["unexplained"], seen["lost"]) == (0, [], [], 0)
        assert seen["unhinted"] == []
        assert seen["contents"] > 3
        assert seen["answer"] == read_answer(report) != ""
    assert browser.said == []
    assert [one for one in browser.asked if not one.startswith("data:")] == [report.as_uri()]


def test_a_report_fits_the_screen_and_explains_its_figures(browser, store):  # noqa: F811
    report = wq.report(store)
    fits_and_explains(browser, report)
    marks = "[...document.querySelectorAll('figure svg path > title')].map(e => e.textContent)"
    assert "18: " in "".join(browser.ask(marks))
    assert (
        browser.ask("document.querySelector('header a[href]:not(nav a)').getAttribute('href')") == "view.html"
    )


@pytest.mark.parametrize("name", KEPT)
def test_reports_of_every_kind_fit_the_screen(browser, name, kept_stores):
    fits_and_explains(browser, wq.report(kept_stores[1](name)))


@pytest.mark.parametrize("name", SMALLER)
def test_reports_of_bundled_studies_fit_the_screen(browser, name, tmp_path):
    small, (keys, chosen) = RECORDED[name], SMALLER[name]
    cases = {} if small.cases is None else {"campaign.cases": small.cases}
    study = wq.load_study(small.study, small.keys | cases | keys)
    for key, names in chosen.items():
        study = study.model_copy(update={key: tuple(one for one in getattr(study, key) if one.name in names)})
    wq.run(study, store=tmp_path / "store", on="serial")
    fits_and_explains(browser, wq.report(tmp_path / "store"))
